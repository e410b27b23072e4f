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


def test_a_folder_holds_everything(make):
    root = make("video.mp4", "poses.npz", "masks", "cameras.npz")
    found = found_in(root)
    assert found.video == root
    assert found.poses == root / "poses.npz"
    assert found.masks == root / "masks"
    assert found.cameras == root / "cameras.npz"


def test_beside_a_video_comes_before_beside_its_poses(make):
    root = make("a/v.mp4", "a/masks", "b/poses.npz", "b/masks", "b/cameras.npz")
    found = found_in(root / "a/v.mp4", root / "b/poses.npz")
    assert found.masks == root / "a/masks"
    assert found.cameras == root / "b/cameras.npz"


def test_beside_a_folder_named_images_counts_too(make):
    root = make("images", "poses.npz", "masks.npz")
    assert found_in(root / "images", root / "poses.npz").masks == root / "masks.npz"


def test_a_folder_does_not_take_its_neighbours_things(make):
    root = make("one/video.mp4", "one/poses.npz", "masks", "cameras.npz")
    found = found_in(root / "one")
    assert found.masks is None
    assert found.cameras is None


def test_what_is_named_wins(make):
    root = make("v.mp4", "p.npz", "masks", "other", "cameras.npz", "c.npz")
    found = found_in(root / "v.mp4", root / "p.npz", root / "other", root / "c.npz")
    assert (found.masks, found.cameras) == (root / "other", root / "c.npz")
    assert found_in(root / "v.mp4", root / "p.npz", cameras="static").cameras is None


@pytest.mark.parametrize("missing", ["video", "poses", "masks", "cameras"])
def test_what_is_named_must_be_there(make, missing):
    root = make("video.npz", "poses.npz", "masks.npz", "cameras.npz")
    (root / f"{missing}.npz").unlink()
    named = [root / f"{name}.npz" for name in ("video", "poses", "masks", "cameras")]
    with pytest.raises(InputError, match=rf"{missing}\.npz does not exist"):
        found_in(*named)


def test_cameras_that_are_to_be_solved_are_looked_for_nowhere(make):
    root = make("video.mp4", "poses.npz", "cameras.npz")
    assert found_in(root, cameras="solve").cameras is None


def test_poses_beside_a_video_are_not_taken_but_spoken_of(make):
    root = make("a/v.mp4", "a/poses.npz")
    with pytest.raises(InputError, match=r"give --poses FILE .*poses\.npz lies beside it"):
        found_in(root / "a/v.mp4")
