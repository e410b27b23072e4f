"""What a user can do wrong: one message each, the agreed exit code, and nothing left behind."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from instant_avatar import ingest
from preprocess.capture_session import CaptureInputs
from preprocess.open_capture import open_capture

MASK = (64, 64)


@pytest.fixture
def refused(call_ingest, tmp_path, monkeypatch):
    """Asserts exit code 2, one message with some words in it, and no run folder.

    What might mend the capture takes ten seconds to find; tests of ia-check ask for that.
    """
    monkeypatch.setattr(ingest, "correction_hint", lambda inputs: "")

    def check(*arguments, words):
        outcome = call_ingest(*arguments, "--out", tmp_path / "run")
        assert outcome.code == 2
        message = outcome.complaint()
        for word in words:
            assert word in message
        assert not (tmp_path / "run").exists()
        return outcome

    return check


def masks_of(capture: Path) -> list[Path]:
    return sorted((capture / "masks").glob("*.png"))


def test_a_video_that_is_not_there(refused, tmp_path):
    refused(tmp_path / "none.mp4", "--poses", tmp_path / "none.npz", words=["none.mp4", "exist"])


def test_a_video_that_cannot_be_tracked(refused, capture):
    (capture / "masks").rename(capture / "elsewhere")
    refused(capture / "video.mp4", words=["person", "--poses"])


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
@pytest.mark.parametrize(
    ("option", "name"),
    [("poses", "p.npz"), ("poses", "p.jsonl"), ("cameras", "c.json"), ("masks", "m.mp4"),
     ("body", "b.npz")],
)  # fmt: skip
def test_a_pipe_is_refused_instead_of_waited_for(refused, capture, tmp_path, option, name):
    os.mkfifo(tmp_path / name)
    refused(capture, f"--{option}", tmp_path / name, words=[name, "file", "expected"])


def test_a_pipe_among_masks_is_refused(refused, capture):
    masks_of(capture)[3].unlink()
    os.mkfifo(masks_of(capture)[0].with_name("000003.png"))
    refused(capture, words=["000003.png is a pipe"])


@pytest.mark.parametrize("option", ["poses", "cameras", "masks", "body"])
def test_a_folder_without_what_was_asked_for(refused, capture, tmp_path, option):
    (tmp_path / "empty").mkdir()
    refused(capture, f"--{option}", tmp_path / "empty", words=["empty", "expected"])


@pytest.mark.parametrize("flags", [[], ["--force"], ["--masks", "segmenter:blazepose"]])
def test_poses_in_degrees(refused, capture, changed, flags):
    with np.load(capture / "poses.npz") as given:
        changed(capture / "poses.npz", body_pose=np.rad2deg(given["body_pose"]))
    refused(capture, *flags, words=["poses.npz: A joint is bent by", "degrees given"])


def test_garbage_instead_of_a_video(refused, capture, rng):
    (capture / "video.mp4").write_bytes(rng.bytes(20000))
    refused(capture, words=["video.mp4", "video"])


def test_a_video_without_its_end(refused, capture):
    content = (capture / "video.mp4").read_bytes()
    (capture / "video.mp4").write_bytes(content[: len(content) // 2])
    refused(capture, words=["video.mp4", "cut off"])


def test_a_video_that_ends_early_is_used_as_far_as_it_goes(
    capture, call_ingest, without_baking, tmp_path
):
    video = capture / "video.avi"
    frames = []
    reader = cv2.VideoCapture(str(capture / "video.mp4"))
    while True:
        ok, picture = reader.read()
        if not ok:
            break
        frames.append(picture)
    (capture / "video.mp4").unlink()
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, MASK)
    for picture in frames:
        writer.write(picture)
    writer.release()
    content = video.read_bytes()
    video.write_bytes(content[: int(len(content) * 0.7)])
    outcome = call_ingest(capture, "--out", tmp_path / "run")
    assert outcome.code == 0
    assert "truncated" in outcome.err
    assert "truncated" in (tmp_path / "run" / "report.html").read_text()


def test_more_poses_than_frames(refused, capture, changed):
    with np.load(capture / "poses.npz") as archive:
        longer = {
            key: np.concatenate([archive[key], archive[key][:3]])
            for key in ("global_orient", "body_pose", "transl")
        }
    changed(capture / "poses.npz", **longer, frame=None, time=None, valid=None)
    refused(capture, words=["27", "24", "frame"])


@pytest.mark.parametrize(("step", "hint"), [(2, "--frames ::2"), (1, "--frames 0:20")])
def test_fewer_masks_than_frames_and_what_to_try(refused, capture, step, hint):
    masks = sorted((capture / "masks").iterdir())
    kept = masks[::step][:20]
    for path in set(masks) - set(kept):
        path.unlink()
    refused(capture, words=[f"{len(kept)} masks", "24 frames", hint])


def test_unreadable_phone_image_formats_are_refused(refused, capture, tmp_path):
    (tmp_path / "phone").mkdir()
    (tmp_path / "phone" / "IMG_1.HEIC").write_bytes(b"ftypheic")
    refused(
        tmp_path / "phone",
        "--poses",
        capture / "poses.npz",
        words=["HEIC pictures must be converted"],
    )


@pytest.mark.parametrize("name", ["notes.txt", "poses.NPZ", "0001.png"])
def test_something_else_in_place_of_a_video(refused, capture, tmp_path, name):
    (tmp_path / name).write_bytes(b"hello")
    refused(tmp_path / name, "--poses", capture / "poses.npz", words=["is no video", ".mp4"])


def test_endings_in_capitals_are_endings(capture):
    for name in ("poses", "cameras"):
        (capture / f"{name}.npz").rename(capture / f"{name}.NPZ")
    (capture / "video.mp4").rename(capture / "My Video.MOV")
    paths = {"poses": capture / "poses.NPZ", "cameras": str(capture / "cameras.NPZ")}
    recording = open_capture(CaptureInputs(video=capture / "My Video.MOV", **paths))
    assert recording.cameras.source == "cameras.NPZ"
    assert recording.source.frame_count == 24


def test_poses_that_are_mostly_lost(refused, capture, changed):
    with np.load(capture / "poses.npz") as archive:
        places = archive["transl"].copy()
    places[:13] = np.nan
    changed(capture / "poses.npz", transl=places)
    refused(capture, words=["11 of 24", "half"])


def test_masks_of_another_shape(refused, capture):
    for path in masks_of(capture):
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path), 0), (64, 40)))
    refused(capture, words=["64x40", "64x64"])


def test_turned_masks_are_turned_back(capture, call_ingest, without_baking, tmp_path):
    for path in masks_of(capture):
        cv2.imwrite(str(path), 255 - cv2.imread(str(path), 0))
    outcome = call_ingest(capture, "--frames", "0:4", "--out", tmp_path / "run")
    assert outcome.code == 0
    assert "turned" in outcome.err


def test_masks_that_may_be_either(refused, capture):
    rim = np.full(MASK, 255, np.uint8)
    rim[3:-3, 3:-3] = 0
    for path in masks_of(capture):
        cv2.imwrite(str(path), rim)
    refused(capture, words=["--mask-invert"])


def test_empty_masks(refused, capture):
    for path in masks_of(capture):
        cv2.imwrite(str(path), np.zeros(MASK, np.uint8))
    refused(capture, words=["masks", "empty"])


def test_a_segmenter_that_is_not_installed_is_refused(refused, capture):
    refused(capture, "--masks", "segmenter:sam", words=["no such segmenter", "blazepose"])


def test_a_camera_of_another_aspect_ratio(refused, capture, changed):
    changed(capture / "cameras.npz", height=np.array(64), width=np.array(96))
    refused(capture, words=["96x64", "64x64"])


def test_a_person_behind_the_camera(refused, capture, changed):
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    with np.load(capture / "cameras.npz") as archive:
        changed(capture / "cameras.npz", extrinsic=turned @ archive["extrinsic"])
    refused(capture, words=["the camera or behind it"])


def test_a_body_with_code_in_it_is_not_run(refused, capture, tmp_path):
    class Trap:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'trapped'}",)

    (tmp_path / "body.pkl").write_bytes(pickle.dumps({"v_template": Trap()}))
    refused(capture, "--body", tmp_path / "body.pkl", words=["pickle", "refused"])
    assert not (tmp_path / "trapped").exists()


@pytest.mark.parametrize(
    ("option", "value"),
    [("--size", "3"), ("--threads", "0"), ("--frames", "last"), ("--seed", "-1")],
)
def test_numbers_out_of_range(refused, capture, option, value):
    refused(capture, option, value, words=[option, value])


@pytest.mark.parametrize(
    "words",
    [
        ("--seconds", "0"),
        ("--seconds", "1e-9"),
        ("--steps", "0"),
        ("--seconds", "9", "--steps", "9"),
    ],
)
def test_a_budget_of_no_time_and_two_budgets_are_refused(capture, tmp_path, capsys, words):
    assert ingest.main([str(capture), "--out", str(tmp_path / "run"), *words]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"ia-ingest: {words[0]} is" if len(words) == 2 else "ia-ingest: --steps")
    assert not (tmp_path / "run").exists()


def test_frames_that_are_not_there(refused, capture):
    refused(capture, "--frames", "9:3", words=["9:3", "START"])
    refused(capture, "--frames", "100:", words=["24 frames", "100"])


def test_a_user_sees_no_traceback(capture, tmp_path):
    command = [
        sys.executable,
        "-m",
        "instant_avatar.ingest",
        str(capture),
        "--out",
        str(tmp_path / "run"),
    ]
    (capture / "poses.npz").write_bytes(b"PK nothing")
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith("ia-ingest:")


def test_help_teaches_without_loading_torch():
    code = (
        "import sys\n"
        "from instant_avatar import ingest\n"
        "try: ingest.main(['--help'])\n"
        "except SystemExit: pass\n"
        "sys.exit('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "ia-ingest video.mp4 --poses poses.npz" in done.stdout
    for option in ("--masks", "--cameras", "--seconds", "--resume", "--overwrite"):
        assert option in done.stdout
