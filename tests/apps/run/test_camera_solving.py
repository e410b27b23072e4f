"""Tests for cameras that a run solves: its process, its folder, its report, its end."""

import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import threading
import time
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console as RichConsole

from apps.cli.command_line import CommandExit
from apps.cli.console import Console
from apps.run import solver_process
from apps.run.missing_inputs import CameraSolving, apply_camera_solution
from apps.run.run_folder import RunFolder
from apps.run.solver_process import SolveJob, SolverProcess, StageProgress, make_person_mask
from capture.input_error import InputError
from export.bake.bake_tables import ExportRefused
from preprocess.alignment.mask_alignment import body_height_m
from preprocess.cameras.camera_file import read_cameras, write_cameras
from preprocess.capture_session import CaptureInputs
from preprocess.open_capture import open_capture
from preprocess.poses.pose_file import read_motion
from preprocess.sfm.camera_solution import CameraSolution, fit_similarity
from studio.shoot import ShootConfig, film_capture

FRAMES = 14


@pytest.fixture(scope="module")
def walkaround(tmp_path_factory) -> Path:
    """A phone is carried around the actor; where it was, only truth/ knows."""
    folder = tmp_path_factory.mktemp("walkaround") / "capture"
    film_capture(
        folder, ShootConfig(frames=FRAMES, size=256, motion="walkaround", background="room")
    )
    return folder


def job_of(capture: Path, **paths) -> SolveJob:
    named = CaptureInputs(
        video=capture / "video.mp4", poses=capture / "poses.npz", masks=capture / "masks",
        cameras="solve", **paths,
    )  # fmt: skip
    return SolveJob(paths=named, seed=0, threads=1)


@pytest.fixture(scope="module")
def solved_run(walkaround, tmp_path_factory) -> Path:
    """A run's folder in which the process has solved the cameras."""
    run = tmp_path_factory.mktemp("solved") / "run"
    with SolverProcess(job_of(walkaround), run) as solving:
        assert solving.wait(quiet()) is not None
        assert not solving.running
    return run


def quiet() -> Console:
    return Console(RichConsole(file=StringIO()))


def solved_of(run: Path) -> CameraSolution:
    return CameraSolution.load(next((run / "cameras").iterdir()))


def test_a_capture_comes_to_stand_in_a_metric_world(walkaround, solved_run):
    still = open_capture(job_of(walkaround).paths)
    found = apply_camera_solution(still, solved_of(solved_run))
    true = read_cameras(walkaround / "truth" / "cameras.npz", still.source.size_px)
    centers, truth = (
        np.stack([camera.center_world for camera in track.cameras])
        for track in (found.cameras, true)
    )
    scale, turn, shift = fit_similarity(centers, truth)
    assert np.linalg.norm(scale * centers @ turn.T + shift - truth, axis=1).max() < 0.03
    assert scale == pytest.approx(1.0, abs=0.03)
    assert np.degrees(np.arccos((turn @ [0.0, 1.0, 0.0])[1])) < 1.0  # y is up
    np.testing.assert_allclose(centers[:, 1], truth[:, 1], atol=0.08)  # the floor is at 0
    for row in (0, 6, 13):  # and each picture shows the body where it did
        before, after = (
            recording.cameras[row].project(
                recording.shaped.with_pose(recording.motion[row]).joints()
            )
            for recording in (still, found)
        )
        np.testing.assert_allclose(before, after, atol=1.5)  # the focal length was solved, too
    lenses = [each.cameras[0].focal_px[0] for each in (still, found)]
    assert lenses[1] == pytest.approx(lenses[0], rel=1e-9)  # stated, and near what was solved
    assert found.camera_report["verdict"] == "solved"
    assert found.camera_report["frames"]["key"] == FRAMES
    assert set(found.camera_report["scale"]["cues"]) <= {"ground", "in place"}


def test_poses_of_an_unknown_lens_are_right_for_the_solved_one(
    walkaround, solved_run, changed, tmp_path
):
    poses = tmp_path / "poses.npz"
    poses.write_bytes((walkaround / "poses.npz").read_bytes())
    changed(poses, K=None)
    stated, silent = (
        open_capture(replace(job_of(walkaround).paths, **parts))
        for parts in ({}, {"poses": poses, "masks": Path("segmenter:blazepose")})
    )
    assert silent.cameras[0].focal_px[0] > 1.2 * stated.cameras[0].focal_px[0]  # a phone's
    one, other = (apply_camera_solution(each, solved_of(solved_run)) for each in (stated, silent))
    for row in (0, 9):
        seen = [
            each.cameras[row].project(each.shaped.with_pose(each.motion[row]).joints())
            for each in (one, other)
        ]
        np.testing.assert_allclose(*seen, atol=0.5)


def test_a_stated_height_is_the_size_of_everything(walkaround, solved_run):
    plain = open_capture(job_of(walkaround).paths)
    tall = body_height_m(plain.shaped)
    taller = open_capture(job_of(walkaround, height_m=1.1 * tall).paths)
    assert body_height_m(taller.shaped) == pytest.approx(1.1 * tall)
    for row in (0, 9):  # pictures cannot tell
        np.testing.assert_allclose(
            taller.cameras[0].project(taller.shaped.with_pose(taller.motion[row]).joints()),
            plain.cameras[0].project(plain.shaped.with_pose(plain.motion[row]).joints()),
            atol=1e-6,
        )
    one, other = (
        apply_camera_solution(recording, solved_of(solved_run)) for recording in (plain, taller)
    )
    ratio = (
        other.camera_report["scale"]["metres_per_unit"]
        / one.camera_report["scale"]["metres_per_unit"]
    )
    assert ratio == pytest.approx(1.1, rel=1e-3)


def test_a_camera_that_stood_stays_where_it_is(walkaround, solved_run):
    recording = open_capture(job_of(walkaround).paths)
    standing = replace(
        solved_of(solved_run), is_static=True, background_motion=0.001, model=None, gates=()
    )
    found = apply_camera_solution(recording, standing)
    assert found.cameras is recording.cameras
    assert found.motion is recording.motion
    assert found.camera_report["verdict"] == "still"
    assert "stood still" in found.notes[-1]


def test_the_same_job_is_not_solved_twice(walkaround, solved_run, monkeypatch):
    monkeypatch.setattr(solver_process, "_environment_of_child", None)  # nothing is started
    with SolverProcess(job_of(walkaround), solved_run) as solving:
        assert (
            solving.wait(quiet()).frame_status.tolist()
            == solved_of(solved_run).frame_status.tolist()
        )


def test_another_job_has_another_folder(walkaround, tmp_path):
    job = job_of(walkaround)
    assert replace(job, threads=2).key() == job.key()  # threads change nothing
    others = [
        replace(job, seed=1),
        replace(job, paths=replace(job.paths, frames=slice(0, 10, 2))),
        replace(job, paths=replace(job.paths, masks=None)),
    ]
    assert len({job.key(), *(other.key() for other in others)}) == 4
    copy = tmp_path / "poses.npz"
    copy.write_bytes((walkaround / "poses.npz").read_bytes())
    moved = replace(job, paths=replace(job.paths, poses=copy))
    before = moved.key()
    copy.write_bytes(copy.read_bytes() + b" ")
    assert moved.key() != before


def test_what_is_stopped_leaves_no_process_and_is_taken_up_again(walkaround, tmp_path):
    stop = threading.Event()
    with SolverProcess(job_of(walkaround), tmp_path) as solving:
        process = solving._process
        while not (solving.folder / "key frames").exists() and process.is_alive():
            time.sleep(0.05)
        stop.set()
        assert solving.wait(quiet(), stop) is None
        assert not process.is_alive()
    assert (solving.folder / "key frames").exists()
    assert not (solving.folder / "solved.json").exists()
    with pytest.raises(ProcessLookupError):
        os.kill(process.pid, 0)


def test_the_process_ends_with_a_parent_that_is_killed(walkaround, tmp_path):
    job = job_of(walkaround)
    code = (
        "import os, pathlib, sys; from apps.run.solver_process import *\n"
        "paths = dict(zip(('video', 'poses', 'masks'), map(pathlib.Path, sys.argv[2:])))\n"
        "job = SolveJob(paths=CaptureInputs(cameras='solve', **paths), seed=0, threads=1)\n"
        "solving = SolverProcess(job, pathlib.Path(sys.argv[1]))\n"
        "print(solving._process.pid, flush=True)\n"
        "os.kill(os.getpid(), 9)"
    )
    named = [job.paths.video, job.paths.poses, job.paths.masks]
    words = [sys.executable, "-c", code, str(tmp_path), *map(str, named)]
    child = int(subprocess.run(words, check=False, capture_output=True, text=True).stdout)
    deadline = time.monotonic() + 30.0
    while Path(f"/proc/{child}").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not Path(f"/proc/{child}").exists()


def test_a_broken_solver_process_is_reported_with_its_log(walkaround, tmp_path):
    with SolverProcess(job_of(walkaround), tmp_path) as solving:
        solving._process.kill()
        with pytest.raises(InputError, match=r"(?s)ended with -9.*log\.txt"):
            solving.wait(quiet())


def test_without_masks_the_posed_body_says_where_the_person_is(walkaround):
    masked, posed = (
        open_capture(replace(job_of(walkaround).paths, masks=masks))
        for masks in (walkaround / "masks", Path("segmenter:blazepose"))
    )
    frame = next(masked.source.frames())
    mask = make_person_mask(masked)(frame, (160, 90))
    around = make_person_mask(posed)(frame, (160, 90))
    assert mask.sum() > 200
    assert (around | ~mask).mean() > 0.998  # all of the person
    assert around.sum() < 2.5 * mask.sum()


def test_a_run_learns_beside_the_solving_and_tells_of_both(
    walkaround, solved_run, call_ingest, tmp_path, without_baking
):
    out = tmp_path / "run"
    (out / "cameras").parent.mkdir(parents=True)
    (solved_run / "cameras").rename(out / "cameras")  # solved before: the same job
    try:
        outcome = call_ingest(
            walkaround / "video.mp4", "--poses", walkaround / "poses.npz", "--cameras", "solve",
            "--out", out, "--threads", 1,
        )  # fmt: skip
    finally:
        (out / "cameras").rename(solved_run / "cameras")
    assert outcome.code == 0, outcome.err
    report = json.loads((out / "report.json").read_text())
    assert report["cameras"]["verdict"] == "solved"
    assert report["cameras"]["gates"]["agreement"]["value"] < 0.01
    assert report["cameras"]["cpu_seconds"] > 0.0
    track = read_cameras(out / "cameras.npz", (256, 144))
    motion = read_motion(out / "poses.npz")
    assert len(track.cameras) == len(motion) == FRAMES
    again = open_capture(
        CaptureInputs(
            video=walkaround / "video.mp4", poses=out / "poses.npz",
            cameras=str(out / "cameras.npz"), masks=walkaround / "masks",
        )
    )  # fmt: skip
    heights = [again.shaped.with_pose(motion[row]).vertices()[:, 1].min() for row in range(FRAMES)]
    assert np.abs(heights).max() < 0.06  # the floor is y = 0


@pytest.mark.slow
def test_cameras_are_kept_when_the_avatar_is_refused(
    walkaround, solved_run, call_ingest, tmp_path, monkeypatch
):
    def refuse(*_, **__):
        raise ExportRefused("The player would not draw it.")

    monkeypatch.setattr("apps.run.snapshot_writer.export_avatar", refuse)
    out = tmp_path / "run"
    shutil.copytree(solved_run / "cameras", out / "cameras")  # solved before: the same job
    outcome = call_ingest(
        walkaround / "video.mp4", "--poses", walkaround / "poses.npz", "--cameras", "solve",
        "--out", out, "--threads", 1,
    )  # fmt: skip
    assert outcome.code == 1
    assert "cameras.npz" in outcome.err
    assert len(read_cameras(out / "cameras.npz", (256, 144)).cameras) == FRAMES
    assert len(read_motion(out / "poses.npz")) == FRAMES
    page = (out / "report.html").read_text()
    assert "cameras.npz and poses.npz hold" in page
    assert "ia-play" not in page


@pytest.fixture
def attempt(monkeypatch):
    """An attempt whose process has solved this by now, or nothing."""

    def make(solved, *, beside):
        def wait(self, console, stop=None):
            assert stop is not None
            assert stop.is_set()  # the run is over
            return solved

        monkeypatch.setattr(SolverProcess, "wait", wait)
        return CameraSolving(SolverProcess.__new__(SolverProcess), beside=beside)

    return make


def fails_in(block, error):
    with block:
        raise error


@pytest.mark.parametrize(
    "end", [CommandExit("a reason", 1), KeyboardInterrupt(), OSError(28, "full")]
)
@pytest.mark.parametrize("finished", [True, False])
def test_cameras_that_were_solved_by_then_outlive_any_end(
    walkaround, solved_run, attempt, tmp_path, end, finished
):
    recording, run = open_capture(job_of(walkaround).paths), RunFolder(path=tmp_path / "run")
    begun = attempt(solved_of(solved_run) if finished else None, beside=True)
    with pytest.raises(type(end)):
        fails_in(begun.save_on_exit(recording, run, quiet()), end)
    assert run.cameras.exists() == run.poses.exists() == finished


def test_cameras_that_are_solved_first_are_written_before_anything_is_learnt(
    walkaround, solved_run, attempt, tmp_path
):
    found = apply_camera_solution(open_capture(job_of(walkaround).paths), solved_of(solved_run))
    run = RunFolder(path=tmp_path / "run")
    with attempt(None, beside=False).save_on_exit(found, run, quiet()):
        assert len(read_motion(run.poses)) == len(read_cameras(run.cameras, (256, 144)).cameras)


def test_what_is_solved_when_the_run_is_stopped_counts(walkaround, solved_run, tmp_path):
    """Its process has ended; what it said on its way was not read yet."""
    shutil.copytree(solved_run / "cameras", tmp_path / "cameras")
    stop = threading.Event()
    stop.set()
    with SolverProcess(job_of(walkaround), tmp_path) as solving:
        ended = multiprocessing.get_context("spawn").Process(target=int)
        ended.start()
        ended.join()
        solving._process = ended
        solving._messages.put(StageProgress("frames between", 1.0))
        solving._messages.put(None)
        assert solving.wait(quiet(), stop) is not None


@pytest.mark.slow
def test_the_avatar_is_kept_when_its_cameras_are_refused(
    walkaround, call_ingest, tmp_path, without_baking, monkeypatch
):
    def refuse(self, console, stop=None):
        raise InputError("The cameras could not be solved with certainty: a reason.")

    monkeypatch.setattr(SolverProcess, "__init__", lambda self, job, run, gently: None)
    monkeypatch.setattr(SolverProcess, "wait", refuse)
    monkeypatch.setattr(SolverProcess, "stop", lambda self: None)
    outcome = call_ingest(walkaround, "--cameras", "solve", "--out", tmp_path / "run")
    assert outcome.code == 2
    assert "a reason" in outcome.complaint()
    assert "avatar was trained" in outcome.complaint()
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["cameras"]["verdict"] == "refused"
    assert (tmp_path / "run" / "avatar.iavatar").exists()
    assert not (tmp_path / "run" / "cameras.npz").exists()


def test_an_unknown_focal_length_is_solved_first(
    walkaround, call_ingest, changed, tmp_path, monkeypatch
):
    """And if that fails, nothing is learnt."""

    def refuse(self, console, stop=None):
        raise InputError("The cameras could not be solved with certainty: a reason.")

    monkeypatch.setattr(SolverProcess, "__init__", lambda self, job, run, gently: None)
    monkeypatch.setattr(SolverProcess, "wait", refuse)
    monkeypatch.setattr(SolverProcess, "stop", lambda self: None)
    poses = tmp_path / "poses.npz"
    poses.write_bytes((walkaround / "poses.npz").read_bytes())
    changed(poses, K=None)
    outcome = call_ingest(
        walkaround / "video.mp4", "--poses", poses, "--masks", walkaround / "masks",
        "--cameras", "solve", "--out", tmp_path / "run",
    )  # fmt: skip
    assert outcome.code == 2
    assert "a reason" in outcome.complaint()
    assert not (tmp_path / "run").exists()


def test_cameras_are_read_as_they_were_written(walkaround, tmp_path):
    true = read_cameras(walkaround / "truth" / "cameras.npz", (256, 144))
    bent = [replace(camera, distortion=(-0.1, 0.0, 0.0, 0.0)) for camera in true.cameras]
    track = replace(true, cameras=tuple(bent), frames_without_camera=frozenset({3, 5}))
    write_cameras(tmp_path / "cameras.npz", track)
    again = read_cameras(tmp_path / "cameras.npz", (256, 144))
    assert again.frames_without_camera == {3, 5}
    for one, other in zip(bent, again.cameras, strict=True):
        assert one.distortion == other.distortion
        np.testing.assert_array_equal(one.camera_from_world, other.camera_from_world)
        np.testing.assert_array_equal(one.intrinsic, other.intrinsic)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--height-cm", 12), "--height-cm is 12"),
        (("--height-cm", 900), "--height-cm is 900"),
    ],
)
def test_impossible_heights_are_refused(walkaround, call_ingest, tmp_path, words, said):
    outcome = call_ingest(walkaround, *words, "--out", tmp_path / "run")
    assert outcome.code == 2
    assert said in outcome.complaint()


def test_a_height_contradicts_cameras_that_have_a_world(walkaround):
    with pytest.raises(InputError, match="--height-cm contradicts"):
        open_capture(
            replace(
                job_of(walkaround).paths, height_m=1.8,
                cameras=str(walkaround / "truth" / "cameras.npz"),
            )
        )  # fmt: skip
