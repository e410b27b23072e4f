"""Tests for ia-check on films that were spoilt on purpose, and for what ia-ingest makes of it."""

import json
import shlex
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks import capture_corruptions
from instant_avatar import check
from instant_avatar.capture_validation import passes_quick_check
from instant_avatar.corrected_capture import renumber_motion
from instant_avatar.studio.shoot import ShootConfig
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.capture_inputs import CaptureInputs
from preprocess.open_capture import open_capture
from preprocess.poses.pose_file import write_motion
from preprocess.poses.pose_format_registry import read_poses
from tests.instant_avatar.conftest import film_without_novel_views
from tests.motions import make_motion

SPOILS = {
    "frame_offset": capture_corruptions.delay_poses(4),
    "frame_rate": capture_corruptions.resample_poses(0.5),
    "opengl_axes": capture_corruptions.use_opengl_poses,
    "root_rotation": capture_corruptions.rotate_tracker_input(90),
    "world_frame": capture_corruptions.apply_extrinsics_twice,
    "focal": capture_corruptions.scale_focal(0.7),
    "left_right": capture_corruptions.swap_left_right,
    "root_origin": capture_corruptions.root_about_origin,
    "body_scale": capture_corruptions.change_units(1000.0),
    "mask_polarity": capture_corruptions.invert_masks,
}


@pytest.fixture(scope="module")
def dancing(tmp_path_factory) -> Path:
    """A capture folder: 40 frames of 96 px."""
    folder = tmp_path_factory.mktemp("dancing") / "capture"
    config = ShootConfig(frames=40, size=96, motion="dance", background="plain", turns=1.0)
    film_without_novel_views(folder, config)
    return folder


@pytest.fixture
def spoilt(dancing, tmp_path):
    """Makes a copy with a mistake in it."""

    def make(*mistakes) -> Path:
        shutil.copytree(dancing, tmp_path / "spoilt")
        for mistake in mistakes:
            mistake(tmp_path / "spoilt")
        return tmp_path / "spoilt"

    return make


@pytest.fixture
def call_check(call, tmp_path):
    """Runs ia-check; returns its exit code, what it said, and its JSON."""

    def call_check(*arguments):
        wanted, sheet = tmp_path / "found.json", tmp_path / "sheet.png"
        ended = call(check, *arguments, "--json", wanted, "--sheet", sheet, "--overwrite")
        found = json.loads(wanted.read_text()) if wanted.exists() else {}
        return ended.code, " ".join(ended.err.split()), found

    return call_check


def test_a_good_capture_is_called_good_and_there_is_nothing_to_mend(dancing, call_check, tmp_path):
    code, said, found = call_check(dancing, "--fix", tmp_path / "mended")
    assert code == 2
    assert "No correctable mistake" in said
    assert not (tmp_path / "mended").exists()
    assert found["verdict"] == "good"
    assert found["cause"] is None
    assert found["iou"]["now"] == found["iou"]["after_fix"] > 0.75
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet is not None
    assert sheet.shape[1] > 3 * sheet.shape[0]


@pytest.mark.parametrize(
    "cause", [pytest.param(c, marks=[pytest.mark.slow] * (c != "frame_offset")) for c in SPOILS]
)
def test_the_mistake_is_named_and_mended(cause, spoilt, dancing, tmp_path, call_check):
    folder, out = spoilt(SPOILS[cause]), tmp_path / "mended"
    code, _, found = call_check(folder, "--fix", out)
    assert found["cause"] == cause
    assert [cure["cause"] for cure in found["corrections"]] == [cause]
    assert found["iou"]["now"] + 0.05 < found["iou"]["after_fix"]
    assert found["tried"][0]["cause"] == cause
    assert code == 0
    assert passes_quick_check(open_capture(CaptureInputs(video=out)))
    copied = [path for path in out.rglob("*") if path.is_file()]
    assert all(path.stat().st_nlink == 1 for path in copied)  # no second name of the user's file
    if cause in ("frame_offset", "frame_rate"):
        mended, true = (read_poses(f / "poses.npz") for f in (out, dancing / "truth"))
        assert mended.frames is not None
        assert np.diff(mended.frames).max() == 1  # rows of half the rate are interpolated
        off = mended.root_translations - true.root_translations[mended.frames]
        assert np.abs(off).max() < {"frame_offset": 1e-9, "frame_rate": 0.02}[cause]


FILM_SPOILS = {
    "video_rotation": capture_corruptions.rotate_video(1),
    "video_mirrored": capture_corruptions.mirror_video,
    "video_crop": capture_corruptions.crop_video(0.05, 0.05, 0.85),
    "video_offset": capture_corruptions.trim_video(4),
}


@pytest.mark.slow
@pytest.mark.parametrize("cause", FILM_SPOILS)
def test_a_mistake_of_the_film_alone_is_named_and_corrected(cause, spoilt, tmp_path, call_check):
    folder, out = spoilt(FILM_SPOILS[cause]), tmp_path / "corrected"
    code, _, found = call_check(folder, "--fix", out)
    assert code == 0
    assert [cure["cause"] for cure in found["corrections"]] == [cause]
    assert found["iou"]["now"] > 0.75
    assert found["film"]["now"] + 0.05 < found["film"]["after_fix"] > 0.7
    assert cv2.imread(str(tmp_path / "sheet.png")) is not None
    _, _, again = call_check(out)
    assert again["cause"] is None
    assert again["film"]["now"] > found["film"]["after_fix"] - 0.03
    assert (out / "masks").exists() == (cause != "video_crop")


def narrowed(folder: Path) -> None:
    """Takes 16 columns from each side of film and masks, so that they are no longer square."""
    capture_corruptions.rewrite_video(
        folder, lambda pictures: [picture[:, 16:-16] for picture in pictures]
    )
    for path in (folder / "masks").iterdir():
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert mask is not None
        cv2.imwrite(str(path), mask[:, 16:-16])
    with np.load(folder / "cameras.npz") as archive:
        camera = dict(archive)
    camera["intrinsic"][0, 2] -= 16.0
    np.savez(folder / "cameras.npz", **{**camera, "width": 64})


@pytest.mark.slow
def test_a_portrait_film_that_was_laid_on_its_side_is_stood_up(spoilt, tmp_path, call_check):
    folder, out = spoilt(narrowed, capture_corruptions.rotate_video(3)), tmp_path / "corrected"
    code, _, found = call_check(folder, "--fix", out)
    assert code == 0
    assert found["refused"]
    assert [cure["cause"] for cure in found["corrections"]] == ["video_rotation"]
    recording = open_capture(CaptureInputs(video=out))
    assert recording.source.size_px == (64, 96)
    assert passes_quick_check(recording)


@pytest.mark.slow
def test_two_people_in_the_masks_are_named_and_one_is_taken_away(spoilt, tmp_path, call_check):
    folder, out = spoilt(capture_corruptions.add_second_person), tmp_path / "corrected"
    _, _, found = call_check(folder, "--fix", out)
    assert [cure["cause"] for cure in found["corrections"]] == ["second_person"]
    assert found["iou"]["after_fix"] > 0.75
    masks = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in (out / "masks").iterdir()]
    masks = [mask for mask in masks if mask is not None and mask.any()]
    assert len(masks) == 40
    alone = [mask for mask in masks if not mask[:, :6].any()]
    assert len(alone) > 35  # an arm that touches the other person makes one part of both


@pytest.mark.slow
def test_without_masks_the_key_points_name_the_mistake(spoilt, call_check, tmp_path):
    folder = spoilt(capture_corruptions.use_opengl_poses)
    shutil.rmtree(folder / "masks")
    code, _, found = call_check(folder, "--fix", tmp_path / "mended")
    assert (code, found["iou"]["now"], found["cause"]) == (0, None, "opengl_axes")
    assert found["film"]["now"] < 0.3 < 0.7 < found["film"]["after_fix"]
    code, _, found = call_check(tmp_path / "mended")
    assert (code, found["verdict"], found["cause"]) == (0, "good", None)
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet is not None
    orange = (sheet[..., 2] > 200) & (sheet[..., 0] < 60)
    assert orange.mean() > 0.005


@pytest.mark.slow
def test_the_command_that_corrects_can_be_pasted(spoilt, call_check, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the sheet goes to runs/ there
    folder = spoilt(SPOILS["left_right"]).rename(tmp_path / "my film")
    _, said, _ = call_check(folder, "--poses", folder / "poses.npz", "--no-mask-invert")
    command = said[said.index("To correct it: ") :].removeprefix("To correct it: ")
    words = shlex.split(command)
    assert words[:4] == ["ia-check", str(folder), "--poses", str(folder / "poses.npz")]
    assert words[4:6] == ["--no-mask-invert", "--fix"]
    assert words[6] == f"{folder}-corrected"
    assert check.main(words[1:]) == 0
    assert passes_quick_check(open_capture(CaptureInputs(video=tmp_path / "my film-corrected")))


@pytest.mark.slow
def test_two_mistakes_are_both_named_and_an_unusable_capture_ends_with_2(spoilt, call_check):
    code, said, found = call_check(
        spoilt(capture_corruptions.use_opengl_poses, capture_corruptions.delay_poses(-5))
    )
    assert code == 2
    assert found["verdict"] == "unusable"
    assert {cure["cause"] for cure in found["corrections"]} == {"opengl_axes", "frame_offset"}
    assert found["iou"]["after_fix"] > 0.75
    assert "--fix" in said


@pytest.mark.slow
def test_what_no_correction_explains_is_not_named(spoilt, call_check):
    """Poses in a world whose cameras are lost: turns would make the least bad of it."""
    code, said, found = call_check(spoilt(capture_corruptions.reset_extrinsics))
    assert (code, found["verdict"], found["corrections"]) == (2, "unusable", [])
    assert "No known mistake explains this" in said


def test_unreadable_input_is_reported_in_the_json_too(tmp_path, call_check):
    code, said, found = call_check(tmp_path / "nothing", "--poses", tmp_path / "none.npz")
    assert code == 2
    assert found["verdict"] == "unusable"
    assert found["refused"] in said


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_lost_poses_and_jumps_are_odd(spoilt, call_check, changed):
    folder = spoilt()
    motion = read_poses(folder / "poses.npz")
    orient, moved = motion.root_rotations.copy(), motion.root_translations.copy()
    orient[3] = np.nan
    moved[20:22] += [0.9, 0.0, 0.0]
    moved[3] = np.nan
    changed(folder / "poses.npz", global_orient=orient, transl=moved)
    code, _, found = call_check(folder)
    assert code == 0
    assert found["verdict"] == "warn"
    assert any("1 of 40 poses" in odd for odd in found["anomalies"])
    assert any("jump 2 times (20, 22)" in odd for odd in found["anomalies"])


def test_a_glance_is_enough_for_a_good_capture_and_notices_a_late_one(dancing, spoilt):
    assert passes_quick_check(open_capture(CaptureInputs(video=dancing)))
    assert not passes_quick_check(
        open_capture(CaptureInputs(video=spoilt(capture_corruptions.delay_poses(1))))
    )


def test_ingest_stops_before_an_unusable_capture_and_says_why(spoilt, call_ingest, tmp_path):
    folder = spoilt(capture_corruptions.scale_focal(0.4))
    refusal = call_ingest(folder, "--frames", ":12", "--out", tmp_path / "run").refusal()
    assert "--force" in refusal
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_ingest_goes_on_with_force(spoilt, call_ingest, without_baking, tmp_path):
    outcome = call_ingest(
        spoilt(capture_corruptions.delay_poses(-9)), "--force", "--out", tmp_path / "run"
    )
    assert outcome.code == 0
    assert "the poses come 9 frames too early" in " ".join(outcome.err.split())


@pytest.mark.slow
def test_poses_of_another_person_from_the_middle_on_are_no_offset(spoilt, call_check):
    folder = spoilt()
    motion = read_poses(folder / "poses.npz")
    motion.root_translations[20:, 0] += 0.9
    write_motion(folder / "poses.npz", motion)
    code, _, found = call_check(folder)
    assert any("(20)" in anomaly for anomaly in found["anomalies"])
    assert found["corrections"] == []
    assert code == 2


@pytest.mark.slow
def test_boxes_are_called_boxes_and_no_focal_length_is_fitted_to_them(spoilt, call_check):
    folder = spoilt()
    for path in (folder / "masks").iterdir():
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        rows, columns = np.nonzero(mask > 127)
        mask[rows.min() : rows.max(), columns.min() : columns.max()] = 255
        cv2.imwrite(str(path), mask)
    _, _, found = call_check(folder)
    assert any("boxes" in anomaly for anomaly in found["anomalies"])
    assert found["corrections"] == []


def test_poses_on_both_sides_of_a_gap_stay_valid_and_those_within_are_not():
    motion = make_motion(np.zeros((4, 3)), np.arange(12.0).reshape(4, 3))
    geometry = CaptureGeometry(
        motion=motion,
        row_frames=np.array([0.0, 1.0, 5.0, 6.0]),
        intrinsics=np.eye(3)[None],
        extrinsics=np.eye(4)[None],
        size_px=(64, 64),
    )
    renumbered = renumber_motion(geometry, 7, resampled=True)
    assert np.flatnonzero(renumbered.valid).tolist() == [0, 1, 5, 6]
    np.testing.assert_allclose(
        renumbered.root_translations[renumbered.valid], motion.root_translations
    )
