"""What a user can do wrong: one message each, the agreed exit code, and nothing left behind."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import instant_avatar
from instant_avatar import InputError, ingest, train
from instant_avatar.run import run_capture
from preprocess.capture_inputs import CaptureInputs
from preprocess.open_capture import open_capture


@pytest.fixture
def refused(call_ingest, tmp_path, monkeypatch):
    """Asserts exit code 2, one message that names a file or flag, and no run folder.

    What might mend the capture takes ten seconds to find; tests of ia-check ask for that.
    """
    monkeypatch.setattr(run_capture, "correction_hint", lambda imported: "")

    def check(*arguments, words):
        message = call_ingest(*arguments, "--out", tmp_path / "run").refusal()
        assert [word for word in words if word not in message] == []
        assert not (tmp_path / "run").exists()

    return check


def masks_of(capture: Path) -> list[Path]:
    return sorted((capture / "masks").glob("*.png"))


WITHOUT_HEAVY_CODE = """
import sys
from instant_avatar import ingest
for option in ("poses", "masks", "cameras", "body", "tracker", "segmenter"):
    for video in sys.argv[2:]:
        word = "--masks=segmenter:absent" if option == "segmenter" else f"--{option}=absent"
        assert ingest.main([video, "--out", sys.argv[1], word]) == 2, (option, video)
        assert not {"torch", "numba", "scipy", "onnxruntime"} & set(sys.modules), (option, video)
from instant_avatar import evaluate
assert evaluate.main([sys.argv[2] + "/truth"]) == 2
assert "torch" not in sys.modules
"""


def test_what_nothing_has_is_refused_before_heavy_code_is_loaded(film, tmp_path):
    words = [tmp_path / "run", film, film / "video.mp4"]
    command = [sys.executable, "-c", WITHOUT_HEAVY_CODE, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    refusals = [line for line in done.stderr.splitlines() if line.startswith("ia-ingest:")]
    assert len(refusals) == 12
    assert all("absent" in line for line in refusals), refusals
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith("ia-evaluate: ")  # its folder holds no run


PLAYER = """
import sys
from instant_avatar import JOINT_NAMES, BodyPose, Camera, InputError, Player
assert not {"torch", "cv2"} & set(sys.modules)
"""


def test_the_player_is_imported_without_torch():
    subprocess.run([sys.executable, "-c", PLAYER], check=True)


def test_public_names_are_those_that_are_listed():
    for name in dir(instant_avatar):
        assert getattr(instant_avatar, name).__class__ is not None
    with pytest.raises(AttributeError, match="utils"):
        _ = instant_avatar.utils


def test_training_refuses_bad_input_by_an_error(tmp_path):
    with pytest.raises(InputError, match=r"none\.mp4"):
        train(tmp_path / "none.mp4", tmp_path / "run", quiet=True)
    with pytest.raises(InputError, match="--steps"):
        train(tmp_path, tmp_path / "run", steps=0)
    assert not (tmp_path / "run").exists()


def test_a_pipe_among_masks_is_refused(refused, capture):
    masks_of(capture)[3].unlink()
    os.mkfifo(masks_of(capture)[0].with_name("000003.png"))
    refused(capture, words=["000003.png"])


@pytest.mark.parametrize("make", ["mkfifo", "mkdir"])
@pytest.mark.parametrize(
    ("option", "name"),
    [("poses", "p.npz"), ("cameras", "c.json"), ("masks", "m.mp4"), ("body", "b.npz")],
)
def test_a_pipe_or_an_empty_folder_in_the_place_of_a_file(
    refused, capture, tmp_path, make, option, name
):
    getattr(os, make)(tmp_path / name)
    refused(capture, f"--{option}", tmp_path / name, words=[name])


@pytest.mark.parametrize("flags", [[], ["--force"], ["--masks", "segmenter:blazepose"]])
def test_poses_in_degrees(refused, capture, changed, flags):
    with np.load(capture / "poses.npz") as given:
        changed(capture / "poses.npz", body_pose=np.rad2deg(given["body_pose"]))
    refused(capture, *flags, words=["poses.npz"])


def test_a_video_without_its_end_is_used_as_far_as_it_goes(
    capture, call_ingest, without_baking, tmp_path
):
    content = (capture / "video.mp4").read_bytes()
    (capture / "video.mp4").write_bytes(content[: len(content) // 2])
    outcome = call_ingest(capture, "--out", tmp_path / "run", "--no-refine-poses")
    assert outcome.code == 0
    assert "truncated" in outcome.err
    assert "truncated" in (tmp_path / "run" / "report.html").read_text()


@pytest.mark.parametrize(("step", "hint"), [(2, "--frames ::2"), (1, "--frames 0:20")])
def test_fewer_masks_than_frames_and_what_to_try(refused, capture, step, hint):
    masks = sorted((capture / "masks").iterdir())
    kept = masks[::step][:20]
    for path in set(masks) - set(kept):
        path.unlink()
    refused(capture, words=[hint])


def test_unreadable_phone_image_formats_are_refused(refused, capture, tmp_path):
    (tmp_path / "phone").mkdir()
    (tmp_path / "phone" / "IMG_1.HEIC").write_bytes(b"ftypheic")
    refused(tmp_path / "phone", "--poses", capture / "poses.npz", words=["HEIC"])


def test_endings_in_capitals_are_endings(capture):
    for name in ("poses", "cameras"):
        (capture / f"{name}.npz").rename(capture / f"{name}.NPZ")
    (capture / "video.mp4").rename(capture / "My Video.MOV")
    paths = {"poses": capture / "poses.NPZ", "cameras": str(capture / "cameras.NPZ")}
    recording = open_capture(CaptureInputs(video=capture / "My Video.MOV", **paths))
    assert recording.cameras.source == "cameras.NPZ"
    assert recording.source.frame_count == 24


def test_a_person_behind_the_camera(refused, capture, changed):
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    with np.load(capture / "cameras.npz") as archive:
        changed(capture / "cameras.npz", extrinsic=turned @ archive["extrinsic"])
    refused(capture, words=["camera"])


def test_a_body_with_code_in_it_is_not_run(refused, capture, tmp_path):
    class Trap:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'trapped'}",)

    (tmp_path / "body.pkl").write_bytes(pickle.dumps({"v_template": Trap()}))
    refused(capture, "--body", tmp_path / "body.pkl", words=["body.pkl"])
    assert not (tmp_path / "trapped").exists()


@pytest.mark.parametrize(
    "words",
    [
        ("--size", "3"), ("--threads", "0"), ("--seed", "-1"), ("--frames", "last"),
        ("--frames", "9:3"), ("--frames", "100:"), ("--seconds", "0"), ("--seconds", "1e-9"),
        ("--steps", "0"), ("--steps", "9", "--seconds", "9"), ("--view", "70000"),
        ("--height-cm", "12"), ("--height-cm", "900"),
    ],
)  # fmt: skip
def test_numbers_that_cannot_be_are_refused_by_their_flag(film, call, tmp_path, words):
    refusal = call(ingest, film, "--out", tmp_path / "run", *words).refusal()
    assert words[0].strip("-") in refusal.lower()
    assert not (tmp_path / "run").exists()
