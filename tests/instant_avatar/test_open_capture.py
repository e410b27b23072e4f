"""A video with poses as a stranger's tracker wrote them, and the masks that are chosen."""

import pickle
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks import capture_corruptions
from benchmarks.fuzz_readers import batches
from benchmarks.fuzz_seeds import make_seeds
from capture.input_error import InputError
from capture.source_opening import open_source
from preprocess.body.kinematics import axis_angles_from_matrices, rotation_matrices
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_session import Capture
from preprocess.observation import Observation
from preprocess.open_capture import open_capture
from preprocess.poses.motion_builder import MotionByPerson, build_motion, place_in_camera_world
from preprocess.poses.pose_format_registry import TRACKERS, read_poses


@pytest.fixture(scope="module")
def own(film) -> Capture:
    """The film with its own poses, in the world."""
    return open_capture(CaptureInputs(video=film))


@pytest.fixture(scope="module")
def in_camera(own) -> tuple[np.ndarray, np.ndarray]:
    """Rotation matrices and places of the film's poses in its camera."""
    camera, pelvis = own.cameras[0].camera_from_world, own.shaped.body.joints[0]
    motion = own.motion
    turned = camera[:3, :3] @ rotation_matrices(motion.root_rotations)
    places = (pelvis + motion.root_translations) @ camera[:3, :3].T + camera[:3, 3] - pelvis
    body = rotation_matrices(motion.joint_rotations)
    return np.concatenate([turned[:, None], body], axis=1), places


def test_of_two_people_one_is_taken_and_by_number_the_other(film, in_camera, tmp_path):
    poses = axis_angles_from_matrices(in_camera[0]).reshape(-1, 72)
    actor = {"pose": poses, "trans": in_camera[1], "frame_ids": np.arange(24)}
    visitor = {key: value[:6] for key, value in actor.items()}
    path = tmp_path / "wham_output.pkl"
    path.write_bytes(pickle.dumps({1: visitor, 2: actor}))
    paths = {"video": film, "poses": path}
    longest = open_capture(CaptureInputs(**paths))
    assert len(longest.motion) == 24
    assert any("2 people; 2 was taken" in note for note in longest.notes)
    chosen = open_capture(CaptureInputs(**paths, person="1"))
    assert len(chosen.motion) == 6
    assert not any("people" in note for note in chosen.notes)
    with pytest.raises(InputError, match="no person called '7'"):
        open_capture(CaptureInputs(**paths, person="7"))


def test_a_strangers_poses_are_fitted_to_the_masks_of_this_clip(film, own, tmp_path):
    rows = {"global_orient": own.motion.root_rotations, "model": np.array("smpl")}
    rows |= {"body_pose": own.motion.joint_rotations.reshape(24, 69)}
    far = own.motion.root_translations.copy()
    far[:, 2] -= 0.4  # of a person an eighth taller than SMPL's mean, as its tracker estimates
    np.savez(tmp_path / "poses.npz", **rows, transl=far)
    fitted = open_capture(CaptureInputs(video=film, poses=tmp_path / "poses.npz"))
    note = next(note for note in fitted.notes if "body model 'smpl'" in note)
    before, after = (float(number) for number in re.findall(r"(0\.\d\d) (?:before|after)", note))
    assert after > before + 0.05
    assert after > 0.7


def test_an_unknown_focal_length_is_found_from_the_masks(capture, own):
    capture_corruptions.convert_to_camera_space(capture)
    (capture / "cameras.npz").unlink()
    found = open_capture(CaptureInputs(video=capture))
    assert found.cameras[0].focal_px == pytest.approx(own.cameras[0].focal_px, rel=0.04)
    assert any("found from the masks" in note for note in found.notes)


def test_a_focal_length_that_the_poses_state_is_believed(capture, own, changed):
    capture_corruptions.convert_to_camera_space(capture)
    (capture / "cameras.npz").unlink()
    intrinsic = own.cameras[0].intrinsic.copy()
    intrinsic[[0, 1], [0, 1]] *= 0.8
    changed(capture / "poses.npz", K=intrinsic)
    found = open_capture(CaptureInputs(video=capture))
    assert found.cameras[0].focal_px[0] == pytest.approx(intrinsic[0, 0])


def test_a_pose_that_no_body_has_is_named_once(capture, own, changed):
    bent = own.motion.joint_rotations.copy()
    bent[3, 7] = 0.0, 25.0, 0.0
    changed(capture / "poses.npz", body_pose=bent.reshape(24, -1))
    notes = open_capture(CaptureInputs(video=capture)).notes
    (sentence,) = (note for note in notes if "of 24 poses" in note)
    assert sentence.startswith("Left out: 1 of 24 poses, with a joint bent")


def test_a_new_format_is_one_importer(film, own, in_camera, tmp_path, monkeypatch):
    """The example of CONTRIBUTING.md."""

    def parse_rows(content: object, prefer_world: bool = False) -> MotionByPerson | None:
        if not isinstance(content, dict) or "rows" not in content:
            return None
        rows = content["rows"]  # 24 axis-angles, then the pelvis in the frame's camera, metres
        return {"1": build_motion([rows[:, :72]], rows[:, 72:], frames=content["frame"])}

    monkeypatch.setitem(TRACKERS, "Rows", parse_rows)
    matrices, places = in_camera
    vectors = axis_angles_from_matrices(matrices).reshape(-1, 72)
    path = tmp_path / "rows.npz"
    np.savez(path, rows=np.concatenate([vectors, places], axis=1), frame=np.arange(24))
    cameras = str(film / "cameras.npz")
    capture = open_capture(CaptureInputs(video=film, poses=path, cameras=cameras))
    read = place_in_camera_world(read_poses(path), own.shaped, own.cameras, cameras_given=True)
    for row in (0, 11, 23):
        joints = [own.shaped.with_pose(m[row]).joints() for m in (own.motion, read)]
        np.testing.assert_allclose(joints[0], joints[1], atol=1e-9)
    assert len(list(capture.observations())) == 24


FRAMES = 4
ESTIMATED, ALPHA = "estimated by BlazePose", "alpha channel"


@pytest.fixture(scope="module")
def shots(film) -> list[tuple[np.ndarray, np.ndarray]]:
    """A few pictures of the film, and who is in them."""
    pictures = [frame.rgb for frame in open_source(film).frames()][:FRAMES]
    masks = sorted((film / "masks").iterdir())
    return [
        (rgb, np.asarray(Image.open(mask).convert("L")))
        for rgb, mask in zip(pictures, masks, strict=False)
    ]


@pytest.fixture
def folder(film, shots, tmp_path):
    """Writes a capture folder of pictures; each kind of mask shows another part of the person."""

    def write(kinds: list[str], *, beside: bool) -> Path:
        """A folder whose pictures have an alpha channel of these kinds, one a picture."""
        (tmp_path / "images").mkdir()
        (tmp_path / "mine").mkdir()
        if beside:
            (tmp_path / "masks").mkdir()
        for name in ("poses.npz", "cameras.npz"):
            shutil.copy(film / name, tmp_path)
        for index, ((rgb, mask), kind) in enumerate(zip(shots, kinds, strict=True)):
            alpha = upper(mask) if kind == "informative" else np.full_like(mask, 255)
            picture = rgb if kind == "none" else np.dstack([rgb, alpha])
            name = f"{index:04d}.png"
            Image.fromarray(picture).save(tmp_path / "images" / name)
            Image.fromarray(lower(mask)).save(tmp_path / "mine" / name)
            if beside:
                Image.fromarray(mask).save(tmp_path / "masks" / name)
        return tmp_path

    return write


def upper(mask):
    """The upper half of what it shows."""
    half = mask.copy()
    half[32:] = 0
    return half


def lower(mask):
    """The lower half of it."""
    half = mask.copy()
    half[:32] = 0
    return half


def wanted(folder, given):
    masks = {"given": folder / "mine", "segmenter": Path("segmenter:blazepose")}.get(given)
    return CaptureInputs(video=folder, masks=masks)


def parts_shown(recording):
    """Which halves of the person the masks show, frame by frame; None of frames left out."""
    return [
        (bool((item.alpha[:32] > 0.5).any()), bool((item.alpha[32:] > 0.5).any()))
        if isinstance(item, Observation)
        else None
        for item in recording.observations()
    ]


@pytest.mark.parametrize("masks", ["none", "beside", "given", "given, beside", "segmenter"])
@pytest.mark.parametrize("alpha", ["none", "opaque", "informative"])
def test_the_masks_that_are_used(folder, alpha, masks):
    expected, shown = {
        "none": (ALPHA, (True, False)) if alpha == "informative" else (ESTIMATED, (True, True)),
        "beside": ("masks", (True, True)),
        "given": ("mine", (False, True)),
        "given, beside": ("mine", (False, True)),
        "segmenter": (ESTIMATED, (True, True)),
    }[masks]
    there = folder([alpha] * FRAMES, beside="beside" in masks)
    recording = open_capture(wanted(there, masks.split(",", maxsplit=1)[0]), skip_checks=True)
    found = parts_shown(recording)
    assert found == [shown] * FRAMES
    report = recording.mask_report()  # after the frames, as of a run
    assert report["masks"] == expected
    assert (report["mask_agreement"] is None) == (expected != ESTIMATED)
    assert 0.6 < (report["mask_agreement"] or 0.8) < 1.0
    assert any("estimated" in note for note in recording.notes) == (expected == ESTIMATED)
    assert any("alpha channel" in note for note in recording.notes) == (expected == ALPHA)
    assert not recording.source.warnings


def test_one_opaque_picture_at_the_start_does_not_decide(folder):
    there = folder(["opaque", "informative", "none", "informative"], beside=False)
    recording = open_capture(wanted(there, "none"))
    assert parts_shown(recording) == [None, (True, False), None, (True, False)]
    assert recording.mask_report()["masks"] == ALPHA


@pytest.mark.slow
def test_every_reader_reads_or_refuses_whatever_it_is_given(tmp_path):
    make_seeds(tmp_path / "seeds")
    found = batches(tmp_path / "seeds", 240, seed=8)
    assert len(found) == 240
    assert {each["kind"] for each in found} >= {"poses", "masks", "cameras", "bodies", "captures"}
    assert [each for each in found if each["ended"] not in ("read", "refused")] == []
