"""Where the parts of a capture are found."""

from pathlib import Path

import pytest

from capture.input_error import InputError
from preprocess.capture_inputs import CaptureInputs, CapturePaths


@pytest.fixture
def make(tmp_path):
    def make(*names: str) -> Path:
        for name in names:
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.suffix:
                path.touch()
            else:
                path.mkdir()
        return tmp_path

    return make


def found_in(video: Path, *named: Path, cameras: str | None = None) -> CapturePaths:
    """The parts of a capture whose poses, masks and cameras are named in this order."""
    poses, masks, file = (*named, None, None, None)[:3]
    inputs = CaptureInputs(
        video=video, poses=poses, masks=masks, cameras=cameras or (file and str(file))
    )
    return inputs.find_paths()


@pytest.mark.parametrize(
    ("there", "named", "found"),
    [
        # a folder holds everything, and does not take its neighbours' things
        (["video.mp4", "poses.npz", "masks", "cameras.npz"], ["."],
         ["poses.npz", "masks", "cameras.npz"]),
        (["one/v.mp4", "one/poses.npz", "masks", "cameras.npz"], ["one"],
         ["one/poses.npz", None, None]),
        # beside a video comes before beside its poses; beside a folder named images counts, too
        (["a/v.mp4", "a/masks", "b/poses.npz", "b/masks", "b/cameras.npz"],
         ["a/v.mp4", "b/poses.npz"], ["b/poses.npz", "a/masks", "b/cameras.npz"]),
        (["images", "poses.npz", "masks.npz"], ["images", "poses.npz"],
         ["poses.npz", "masks.npz", None]),
        # what is named wins
        (["v.mp4", "p.npz", "masks", "other", "cameras.npz", "c.npz"],
         ["v.mp4", "p.npz", "other", "c.npz"], ["p.npz", "other", "c.npz"]),
    ],
)  # fmt: skip
def test_masks_and_cameras_are_found_in_this_order(make, there, named, found):
    root = make(*there)
    paths = found_in(*(root / name for name in named))
    expected = [name and root / name for name in found]
    assert [paths.poses, paths.masks, paths.cameras] == expected
    assert paths.video == root / named[0]


@pytest.mark.parametrize("missing", ["video", "poses", "masks", "cameras"])
def test_what_is_named_must_be_there(make, missing):
    root = make("video.npz", "poses.npz", "masks.npz", "cameras.npz")
    (root / f"{missing}.npz").unlink()
    named = [root / f"{name}.npz" for name in ("video", "poses", "masks", "cameras")]
    with pytest.raises(InputError, match=rf"{missing}\.npz does not exist"):
        found_in(*named)


@pytest.mark.parametrize("cameras", ["solve", "static"])
def test_cameras_that_are_to_be_solved_or_assumed_are_looked_for_nowhere(make, cameras):
    root = make("video.mp4", "poses.npz", "cameras.npz")
    assert found_in(root, cameras=cameras).cameras is None


def test_poses_beside_a_video_are_not_taken_but_spoken_of(make):
    root = make("a/v.mp4", "a/poses.npz")
    with pytest.raises(InputError, match=r"give --poses FILE .*poses\.npz lies beside it"):
        found_in(root / "a/v.mp4")
