"""Tests for cameras that a run solves: their world, their files, their report, their refusal."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.camera_accuracy import fit_similarity
from capture.input_error import InputError
from export.bake.bake_tables import ExportRefused
from instant_avatar.run import run_capture
from instant_avatar.studio.shoot import ShootConfig
from preprocess.cameras.camera_file import read_cameras, write_cameras
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_session import Capture
from preprocess.open_capture import open_capture
from preprocess.poses.pose_format_registry import read_poses
from preprocess.sfm.camera_solution import CameraSolution
from preprocess.sfm.camera_solver import (
    apply_camera_solution,
    make_person_mask,
    solve_capture_cameras,
)
from tests.instant_avatar.conftest import film_without_novel_views

FRAMES = 14


@pytest.fixture(scope="module")
def walkaround(tmp_path_factory) -> Path:
    """A phone is carried around the actor; where it was, only truth/ knows."""
    folder = tmp_path_factory.mktemp("walkaround") / "capture"
    film_without_novel_views(
        folder, ShootConfig(frames=FRAMES, size=256, motion="walkaround", background="room")
    )
    return folder


def inputs_of(capture: Path, **parts) -> CaptureInputs:
    return CaptureInputs(
        video=capture / "video.mp4", poses=capture / "poses.npz", masks=capture / "masks",
        cameras="solve", **parts,
    )  # fmt: skip


def joints_px(capture: Capture) -> np.ndarray:
    """Where some of its images show the body's joints."""
    places = []
    for row in (0, 6, 13):
        joints = capture.shaped.with_pose(capture.motion[row]).joints()
        places.append(capture.cameras[row].project(joints))
    return np.stack(places)


@pytest.fixture(scope="module")
def solution(walkaround) -> CameraSolution:
    """What is solved from the video."""
    plain = open_capture(inputs_of(walkaround))
    return solve_capture_cameras(plain, seed=0, threads=1, report_progress=lambda share: None)


@pytest.fixture
def ingest_walk(walkaround, solution, call_ingest, monkeypatch, tmp_path):
    """Runs ia-ingest with cameras that are solved, or whose solving raises an error."""

    def call(raised: BaseException | None = None):
        def solve(capture, *, seed, threads, report_progress):
            if raised is not None:
                raise raised
            return solution

        monkeypatch.setattr(run_capture, "solve_capture_cameras", solve)
        return call_ingest(
            walkaround / "video.mp4", "--poses", walkaround / "poses.npz", "--cameras", "solve",
            "--out", tmp_path / "run", "--threads", 1, "--no-refine-poses",
        )  # fmt: skip

    return call


def test_a_capture_comes_to_stand_in_a_metric_world(walkaround, solution):
    still = open_capture(inputs_of(walkaround))
    found = apply_camera_solution(still, solution)
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
    # and each picture shows the body where it did; the focal length was solved, too
    np.testing.assert_allclose(joints_px(still), joints_px(found), atol=1.5)
    lenses = [each.cameras[0].focal_px[0] for each in (still, found)]
    assert lenses[1] == pytest.approx(lenses[0], rel=1e-9)  # stated, and near what was solved
    assert found.figures("cameras")["verdict"] == "solved"
    assert found.figures("cameras")["frames"]["key"] == FRAMES
    assert set(found.figures("cameras")["scale"]["cues"]) <= {"ground", "in place"}


def test_poses_of_an_unknown_lens_are_right_for_the_solved_one(
    walkaround, solution, changed, tmp_path
):
    poses = tmp_path / "poses.npz"
    poses.write_bytes((walkaround / "poses.npz").read_bytes())
    changed(poses, K=None)
    stated, silent = (
        open_capture(replace(inputs_of(walkaround), **parts))
        for parts in ({}, {"poses": poses, "masks": Path("segmenter:blazepose")})
    )
    assert silent.cameras[0].focal_px[0] > 1.2 * stated.cameras[0].focal_px[0]  # a phone's
    seen = [joints_px(apply_camera_solution(each, solution)) for each in (stated, silent)]
    np.testing.assert_allclose(*seen, atol=0.5)


def test_a_camera_that_only_turns_stays_in_one_place_of_a_metric_world(walkaround, solution):
    still = open_capture(inputs_of(walkaround))
    turned = solution.camera_from_solved.copy()
    turned[:, :3, 3] = 0.0
    model = replace(solution.model, only_turns=True)
    found = apply_camera_solution(still, replace(solution, camera_from_solved=turned, model=model))
    centers = np.stack([camera.center_world for camera in found.cameras.cameras])
    np.testing.assert_allclose(centers, centers[:1].repeat(FRAMES, axis=0), atol=1e-9)
    assert 1.2 < centers[0, 1] < 1.7  # held by a person, above a floor below the soles
    np.testing.assert_allclose(joints_px(still), joints_px(found), atol=1.5)
    assert found.figures("cameras")["scale"]["cues"] == ["the person"]
    assert "the camera only turns, by" in found.notes[-1]


def test_a_stated_height_is_the_size_of_everything(walkaround, solution):
    plain = open_capture(inputs_of(walkaround))
    tall = plain.shaped.height_m
    taller = open_capture(inputs_of(walkaround, height_m=1.1 * tall))
    assert taller.shaped.height_m == pytest.approx(1.1 * tall)
    pixels = joints_px(taller), joints_px(plain)
    np.testing.assert_allclose(*pixels, atol=1e-6)  # they cannot tell
    one, other = (apply_camera_solution(recording, solution) for recording in (plain, taller))
    ratio = (
        other.figures("cameras")["scale"]["metres_per_unit"]
        / one.figures("cameras")["scale"]["metres_per_unit"]
    )
    assert ratio == pytest.approx(1.1, rel=1e-3)


def test_a_camera_that_stood_stays_where_it_is(walkaround, solution):
    recording = open_capture(inputs_of(walkaround))
    standing = replace(solution, is_static=True, background_motion=0.001, model=None, gates=())
    found = apply_camera_solution(recording, standing)
    assert found.cameras is recording.cameras
    assert found.motion is recording.motion
    assert found.figures("cameras")["verdict"] == "still"
    assert "stood still" in found.notes[-1]


def test_without_masks_the_posed_body_says_where_the_person_is(walkaround):
    masked, posed = (
        open_capture(replace(inputs_of(walkaround), masks=masks))
        for masks in (walkaround / "masks", Path("segmenter:blazepose"))
    )
    frame = next(masked.source.frames())
    mask = make_person_mask(masked)(frame, (160, 90))
    around = make_person_mask(posed)(frame, (160, 90))
    assert mask.sum() > 200
    assert (around | ~mask).mean() > 0.998  # all of the person
    assert around.sum() < 2.5 * mask.sum()


@pytest.mark.slow
def test_a_run_learns_in_the_world_of_its_solved_cameras_and_keeps_them_without_an_avatar(
    walkaround, ingest_walk, tmp_path, monkeypatch
):
    def refuse(*_, **__):
        raise ExportRefused("The player would not draw it.")

    monkeypatch.setattr("instant_avatar.run.snapshot_writer.export_avatar", refuse)
    outcome, out = ingest_walk(), tmp_path / "run"
    assert outcome.code == 1
    assert "cameras.npz" in outcome.err
    page = (out / "report.html").read_text()
    assert "cameras.npz and poses.npz hold" in page
    assert "ia-play" not in page
    report = json.loads((out / "report.json").read_text())
    assert report["cameras"]["verdict"] == "solved"
    assert report["cameras"]["gates"]["followed_px"]["value"] < 3.0
    assert report["cameras"]["cpu_seconds"] > 0.0
    track = read_cameras(out / "cameras.npz", (256, 144))
    motion = read_poses(out / "poses.npz")
    assert len(track.cameras) == len(motion) == FRAMES
    again = open_capture(
        CaptureInputs(
            video=walkaround / "video.mp4", poses=out / "poses.npz",
            cameras=str(out / "cameras.npz"), masks=walkaround / "masks",
        )
    )  # fmt: skip
    heights = [again.shaped.with_pose(motion[row]).vertices()[:, 1].min() for row in range(FRAMES)]
    assert np.abs(heights).max() < 0.06  # the floor is y = 0


@pytest.mark.parametrize(
    ("raised", "code"), [(InputError("The cameras: a reason."), 2), (KeyboardInterrupt(), 130)]
)
def test_nothing_is_learnt_or_written_without_the_cameras(ingest_walk, tmp_path, raised, code):
    assert ingest_walk(raised).code == code
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


def test_a_height_contradicts_cameras_that_have_a_world(walkaround):
    with pytest.raises(InputError, match="--height-cm contradicts"):
        open_capture(
            replace(
                inputs_of(walkaround), height_m=1.8,
                cameras=str(walkaround / "truth" / "cameras.npz"),
            )
        )  # fmt: skip
