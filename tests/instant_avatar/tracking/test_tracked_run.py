"""ia-ingest without poses: the person is tracked first, or while the frames come."""

import json
import os
import shutil
import signal
import threading
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest

from avatar.training import train
from avatar.training.train import warm_up
from capture.source_opening import open_source
from capture.video_writer import H264, write_video
from instant_avatar import ingest
from instant_avatar.cli.console import Console
from instant_avatar.evaluation.evaluation_frames import held_out_frames
from instant_avatar.run import person_tracking, run_capture, run_tracking
from instant_avatar.run.run_folder import RunFolder
from preprocess.capture_inputs import CaptureInputs
from preprocess.masks.mask_refinement import MaskRefiner
from preprocess.poses.pose_format_registry import read_poses
from preprocess.tracking.blazepose import BlazePoseTracker


@pytest.fixture
def ingest_video(video, tmp_path, call_ingest):
    """Runs ia-ingest on the video in small; returns how it ended and the run's folder."""

    def ingest_video(*words):
        out = tmp_path / "run"
        return call_ingest(video, "--out", out, "--size", 96, *words), out

    return ingest_video


@pytest.mark.usefixtures("without_baking")
def test_a_video_alone_is_tracked_and_learnt(ingest_video, monkeypatch):
    """But for a frame that is left out; each of the others takes a step."""
    graded = person_tracking._grade
    monkeypatch.setattr(
        person_tracking, "_grade", lambda *parts: replace(graded(*parts), left_out=(3,))
    )
    monkeypatch.setattr(run_capture, "preflight_check", None)  # mistakes of files are not sought
    monkeypatch.setattr(ingest, "usable_cores", lambda: 2)  # another process fits, as for a user
    done, out = ingest_video()
    assert done.code == 0, done.err
    assert done.err.count("eft out: 1 ") == 1, done.err
    assert "Left out: 1 frame in which another person is near" in done.err
    assert "Training for 10 steps at least (each frame that is learnt from takes one);" in done.err
    assert "(17 steps)" in done.err
    report = json.loads((out / "report.json").read_text())
    assert report["tracking"]["good_enough"]
    assert report["command"]["poses"] is None
    assert [frame["index"] for frame in report["frames"]["dropped"]] == [3]
    assert read_poses(out / "tracking" / "poses.npz").proportions is not None
    assert "Good enough for an avatar" in (out / "report.html").read_text()
    frames = held_out_frames(RunFolder(path=out), None)
    assert frames.capture.paths.poses == out / "tracking" / "poses.npz"
    assert frames.poses == "tracked"


@pytest.mark.usefixtures("without_baking")
def test_a_refusal_names_its_cause_and_keeps_the_tracked_video(
    ingest_video, video, frames, monkeypatch
):
    write_video(video, [frame[:180] for frame in frames], 30.0, H264)
    few = ("--frames", ":8", "--no-refine-poses")
    done, out = ingest_video(*few)
    cut = "the person is cut by the picture's lower border"
    assert f"no, because {cut} in 8 of 8 frames" in done.refusal()
    assert str(out / "tracking" / "skeleton.mp4") in done.refusal()
    assert "--poses" in done.refusal()
    assert [path.name for path in out.iterdir() if path.name[0] != "."] == ["tracking"]
    assert f"doubtful: 0.0 to 0.2 s: {cut}" in done.err
    assert open_source(out / "tracking" / "skeleton.mp4").frames_in_file == 8
    # what was tracked, before all of today's options were there, is used again where that is wanted
    stored = json.loads((out / "tracking" / "grade.json").read_text())
    assert stored["request"].keys() == {"video", "frames"}
    stored["request"] |= {"masks": None, "person": None}
    (out / "tracking" / "grade.json").write_text(json.dumps(stored))
    monkeypatch.setattr(run_tracking, "track_person", None)
    again, _ = ingest_video(*few, "--resume")
    assert cut in again.refusal()
    forced, _ = ingest_video(*few, "--resume", "--force")
    assert forced.code == 0, forced.err


class CountingTracker(BlazePoseTracker):
    """Ctrl-C comes in the ninth frame of all that it is shown."""

    frames = 0

    def __call__(self, rgb):
        CountingTracker.frames += 1
        if CountingTracker.frames == 9:
            signal.raise_signal(signal.SIGINT)
        return super().__call__(rgb)


@pytest.mark.slow
@pytest.mark.usefixtures("without_baking")
def test_ctrl_c_keeps_the_frames_that_were_tracked(ingest_video, monkeypatch):
    monkeypatch.setattr(CountingTracker, "frames", 0)
    monkeypatch.setattr(person_tracking, "make_tracker", lambda name, person: CountingTracker())
    done, out = ingest_video()
    assert done.code == 130
    assert "9 tracked frames kept" in done.complaint()
    assert "--resume" in done.complaint()
    first = read_poses(out / "tracking" / "poses.npz").keypoints
    again, out = ingest_video("--resume")
    assert again.code == 0, again.err
    assert CountingTracker.frames == 9 + 1 + 11  # the ninth again: is it the same person?
    all_frames = read_poses(out / "tracking" / "poses.npz").keypoints
    assert all_frames.frames.tolist() == list(range(20))
    np.testing.assert_array_equal(all_frames.image_px[:9], first.image_px)
    assert len(list((out / "tracking" / "masks").glob("*.png"))) == 20


@pytest.mark.slow
def test_a_resumed_run_does_not_join_two_persons(video, tmp_path, monkeypatch):
    poses = tmp_path / "out" / "poses.npz"
    inputs = CaptureInputs(video=video, frames=slice(0, 8))
    person_tracking.track_person(inputs, poses, Console())
    monkeypatch.setattr(person_tracking, "SAME_PERSON", 0.0)
    monkeypatch.setattr(person_tracking, "make_tracker", lambda name, person: CountingTracker())
    monkeypatch.setattr(CountingTracker, "frames", 10)
    inputs = CaptureInputs(video=video, frames=slice(0, 10))
    person_tracking.track_person(inputs, poses, Console(), resume=True)
    assert CountingTracker.frames == 10 + 1 + 10  # all once more


@pytest.mark.slow
@pytest.mark.usefixtures("without_baking")
def test_given_poses_replace_tracked_ones(ingest_video, filmed):
    done, out = ingest_video("--frames", ":10")
    assert done.code == 0, done.err
    done, out = ingest_video("--poses", filmed / "poses.npz", "--overwrite")
    assert done.code == 0, done.err
    assert json.loads((out / "report.json").read_text())["tracking"] is None
    assert not (out / "tracking").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("without_baking")
def test_a_video_played_at_its_own_speed_is_tracked_meanwhile_and_learnt_from_given_masks(
    ingest_video, filmed, monkeypatch
):
    monkeypatch.setattr(MaskRefiner, "__call__", lambda *given: pytest.fail("a mask is refined"))
    done, out = ingest_video("--realtime", "--no-refine-masks", "--masks", filmed / "masks")
    assert done.code == 0, done.err
    report = json.loads((out / "report.json").read_text())
    assert report["stream"]["realtime"]
    assert report["recipe"]["masks"] == "masks"
    frames = report["frames"]
    learnt = frames["used"] + frames["held_out"] + frames["near_duplicates"]
    assert 2 <= learnt <= 10  # every second one, or fewer where the machine is busy


def test_person_must_be_a_number(ingest_video):
    assert "counted from left to right" in ingest_video("--person", "anna")[0].refusal()


# --- live sources: a stand-in writes the images while the person is tracked ---------------------

FRAMES = 10


@pytest.fixture
def watch(call, on_one_core, without_baking, monkeypatch, tmp_path):
    """Runs ia-ingest on a live source; returns its report."""

    def watch(*arguments):
        monkeypatch.setattr(train, "warm_up", warm_up)  # a live source waits for no compiler
        words = ("--out", tmp_path / "run", "--no-refine-poses", "--size", 96)
        ended = call(ingest, *arguments, *words)
        assert ended.code == 0, ended.err
        return json.loads((tmp_path / "run" / "report.json").read_text())

    return watch


@pytest.fixture
def studio(filmed, frames, tmp_path):
    """A folder that a camera begins to fill, and how it goes on."""
    folder = tmp_path / "studio"
    (folder / "images").mkdir(parents=True)
    shutil.copy(filmed / "cameras.npz", folder)

    def shoot(index):
        path = folder / "images" / f"{index:04d}.png"
        cv2.imwrite(str(path), frames[index][..., ::-1])
        return path

    began = time.time() - 10.0
    for index in range(6):
        os.utime(shoot(index), (began, began + 0.1 * index))

    def film_the_rest():
        for index in range(6, FRAMES):
            time.sleep(0.1)
            shoot(index)
        (folder / "images" / "DONE").touch()

    return folder, film_the_rest


def test_a_growing_folder_becomes_an_avatar(watch, studio):
    folder, film_the_rest = studio
    thread = threading.Thread(target=film_the_rest)
    thread.start()
    report = watch(folder, "--live", "--seconds", "600", "--idle-seconds", "5")
    thread.join()
    assert report["stream"]["realtime"]
    assert report["recipe"]["masks"] == "tracked"
    assert report["frames"]["read"] == FRAMES
    assert report["stream"]["inbox_dropped"] == 0
    assert report["training"]["steps"] > 0


@pytest.mark.slow
def test_a_live_source_that_goes_on_is_left_when_the_time_is_up(watch, studio):
    folder, _ = studio
    began = time.perf_counter()
    report = watch(folder, "--live", "--seconds", "0.5", "--idle-seconds", "3600")
    assert report["training"]["wall_seconds"] >= 0.5
    assert time.perf_counter() - began < 1800.0  # not an hour


@pytest.mark.slow
def test_a_camera_becomes_an_avatar(watch, filmed):
    """A file stands in for the camera, opened through the same class."""
    report = watch(f"camera:{filmed / 'video.mp4'}", "--seconds", "1.5")
    assert report["stream"]["realtime"]
    assert report["frames"]["used"] >= 2


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--realtime"], "--realtime"),
        (["--idle-seconds", "0.2"], "No image came"),
        (["--poses", "growing.jsonl"], "--poses"),
        (["--masks", "masks"], "--masks"),
        (["--cameras", "solve"], "--cameras solve"),
    ],
)
def test_what_a_live_source_cannot_have_is_refused(call_ingest, tmp_path, arguments, word):
    (tmp_path / "capture" / "images").mkdir(parents=True)
    words = ("--live", *arguments, "--out", tmp_path / "run")
    assert word in call_ingest(tmp_path / "capture", *words).refusal()
