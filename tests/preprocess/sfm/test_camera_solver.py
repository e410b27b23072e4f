"""Tests for the whole solution of a little room: right, refused, taken up again, or not needed."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.input_error import InputError
from capture.source_opening import open_source
from preprocess.sfm import camera_solver, colmap_mapping
from preprocess.sfm.camera_solution import (
    INTERPOLATED,
    KEY,
    PLACED,
    CameraSolution,
    SparseModel,
    fit_similarity,
)
from preprocess.sfm.camera_solver import SolverSettings, solve_cameras

SIZE = (320, 240)
FRAMES, KEYS = 20, 10


def no_person(frame, size_px):
    return np.zeros(size_px[::-1], dtype=bool)


def filmed(folder, pictures):
    folder.mkdir(exist_ok=True)
    for index, rgb in enumerate(pictures):
        cv2.imwrite(str(folder / f"{index:03d}.png"), rgb[..., ::-1])
    return open_source(folder)


@pytest.fixture(scope="module")
def walk(room, walked, tmp_path_factory):
    """True cameras, their film, and its solution with the folder that it was made in."""
    folder = tmp_path_factory.mktemp("walk")
    cameras = walked(FRAMES, degrees=80, size_px=SIZE, focal_px=260.0)
    source = filmed(folder / "film", [room.seen(camera) for camera in cameras])
    told = []
    settings = SolverSettings(max_keyframes=KEYS)
    solved = solve_cameras(
        source, no_person, folder / "work", settings, lambda *what: told.append(what)
    )
    return cameras, source, solved, folder / "work", told


def test_cameras_of_a_walk_are_solved_to_millimetres(walk):
    cameras, _, solved, _, _ = walk
    assert not solved.is_static
    assert (
        np.bincount(solved.frame_status, minlength=4)[[PLACED, KEY]] == [FRAMES - KEYS, KEYS]
    ).all()
    views = solved.camera_from_solved
    centers = -np.einsum("cba,cb->ca", views[:, :3, :3], views[:, :3, 3])
    true = np.stack([camera.center_world for camera in cameras])
    scale, turn, shift = fit_similarity(centers, true)
    off = np.linalg.norm(scale * centers @ turn.T + shift - true, axis=1)
    assert off.max() < 0.01
    rotations = np.stack([camera.camera_from_world[:3, :3] for camera in cameras])
    angles = Rotation.from_matrix(rotations @ (views[:, :3, :3] @ turn.T).transpose(0, 2, 1))
    assert np.degrees(angles.magnitude()).max() < 0.4  # 320 px see less than 960
    assert solved.lens(SIZE).focal_px[0] == pytest.approx(260.0, rel=0.01)
    assert solved.lens((640, 480)).focal_px[0] == pytest.approx(520.0, rel=0.01)
    assert all(gate.passed for gate in solved.gates)
    assert {gate.name for gate in solved.gates} >= {"agreement", "followed_px", "registered"}


def test_every_stage_reports_progress_and_cost(walk):
    *_, solved, _, told = walk
    stages = list(dict.fromkeys(name for name, _ in told))
    assert stages == [
        "key frames", "features", "matches", "global mapping 0", "incremental mapping 0",
        "frames between",
    ]  # fmt: skip
    assert all((name, 1.0) in told for name in stages)
    assert solved.costs["cpu_seconds"] > 0.5
    assert solved.costs["peak_memory_mb"] > 50.0


def test_what_is_finished_is_not_done_again(walk, tmp_path, monkeypatch):
    _, source, solved, work, _ = walk
    shutil.copytree(work, tmp_path / "work")
    for name in ("extract_features", "match_features", "map_global", "map_incremental"):
        monkeypatch.setattr(colmap_mapping, name, None)  # calling it would be an error
    monkeypatch.setattr(camera_solver, "resect_intermediate_frames", None)
    again = solve_cameras(
        source, no_person, tmp_path / "work", SolverSettings(max_keyframes=KEYS), lambda *what: None
    )
    np.testing.assert_array_equal(again.camera_from_solved, solved.camera_from_solved)
    assert again.gates == solved.gates


def test_an_interrupted_stage_is_repeated(walk, tmp_path):
    _, source, solved, work, _ = walk
    shutil.copytree(work, tmp_path / "work")
    (tmp_path / "work" / "frames between").rename(tmp_path / "work" / "part.frames between")
    again = solve_cameras(
        source, no_person, tmp_path / "work", SolverSettings(max_keyframes=KEYS), lambda *what: None
    )
    np.testing.assert_allclose(again.camera_from_solved, solved.camera_from_solved, atol=1e-9)


def test_a_solution_is_read_as_it_was_written(walk, tmp_path):
    *_, solved, _, _ = walk
    solved.save(tmp_path)
    again = CameraSolution.load(tmp_path)
    np.testing.assert_array_equal(again.camera_from_solved, solved.camera_from_solved)
    np.testing.assert_array_equal(again.frame_status, solved.frame_status)
    np.testing.assert_array_equal(
        again.model.reprojection_errors_px(), solved.model.reprojection_errors_px()
    )
    assert again.gates == solved.gates
    assert again.costs == solved.costs


def test_a_frame_that_shows_nothing_is_interpolated(walk, tmp_path):
    _, source, solved, work, _ = walk
    shutil.copytree(work, tmp_path / "work")
    lost = int(np.flatnonzero(solved.frame_status == PLACED)[4])
    pictures = [frame.rgb for frame in source.frames()]
    pictures[lost] = np.full_like(pictures[lost], 90)
    spoilt = filmed(tmp_path / "film", pictures)
    (tmp_path / "work" / "frames between").unlink()
    again = solve_cameras(
        spoilt, no_person, tmp_path / "work", SolverSettings(max_keyframes=KEYS), lambda *what: None
    )
    assert again.frame_status[lost] == INTERPOLATED
    assert (again.frame_status == INTERPOLATED).sum() == 1


def test_pictures_that_have_nothing_in_common_are_refused(tmp_path, rng):
    noise = [rng.integers(0, 255, (12, 16, 3), dtype=np.uint8) for _ in range(8)]
    source = filmed(tmp_path / "film", [cv2.resize(picture, (160, 120)) for picture in noise])
    with pytest.raises(
        InputError, match="with certainty: the pictures have hardly anything in common"
    ):
        solve_cameras(source, no_person, tmp_path / "work", SolverSettings(), lambda *what: None)


def test_a_camera_that_turns_on_the_spot_is_refused_by_name(room, walked, tmp_path, monkeypatch):
    monkeypatch.setattr(colmap_mapping, "map_global", None)  # before anything is mapped
    here = walked(1, degrees=0.0, size_px=SIZE, focal_px=260.0)[0]
    pictures = []
    for degrees in np.linspace(-14.0, 14.0, 8):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
        view = turn @ here.camera_from_world
        pictures.append(room.seen(replace(here, camera_from_world=view)))
    with pytest.raises(InputError, match="turns on the spot"):
        solve_cameras(
            filmed(tmp_path / "film", pictures),
            no_person,
            tmp_path / "w",
            SolverSettings(),
            lambda *w: 0,
        )


def test_two_ways_of_solving_that_differ_are_refused(walk, tmp_path, monkeypatch):
    """Whichever of them is wrong: here the incremental one is bent, with both seeds."""
    _, source, _, work, _ = walk
    shutil.copytree(work, tmp_path / "work")
    costs = json.loads((tmp_path / "work" / "stages.json").read_text())
    for seed in (0, 1):
        for kind in ("global", "incremental"):
            model = SparseModel.load(work / f"{kind} mapping 0" / "model.npz")
            if kind == "incremental":
                lift = np.linspace(0.0, 0.3, len(model.frames))[:, None] * [0.0, 1.0, 0.0]
                turned = model.camera_from_world[:, :3, :3]
                model.camera_from_world[:, :3, 3] += np.einsum("cab,cb->ca", turned, lift)
            name = f"{kind} mapping {seed}"
            (tmp_path / "work" / name).mkdir(exist_ok=True)
            model.save(tmp_path / "work" / name / "model.npz")
            costs[name] = costs["matches"]
    (tmp_path / "work" / "stages.json").write_text(json.dumps(costs))
    monkeypatch.setattr(
        camera_solver, "evaluate_gates", lambda model, keys: []
    )  # each passes by itself
    with pytest.raises(InputError, match="contradict each other"):
        solve_cameras(
            source,
            no_person,
            tmp_path / "work",
            SolverSettings(max_keyframes=KEYS),
            lambda *what: None,
        )


def test_a_tripod_needs_no_solution(room, walked, tmp_path, monkeypatch):
    monkeypatch.setattr(colmap_mapping, "extract_features", None)
    camera = walked(1, degrees=0.0, size_px=SIZE, focal_px=260.0)[0]
    source = filmed(tmp_path / "film", [room.seen(camera)] * 9)
    solved = solve_cameras(
        source, no_person, tmp_path / "work", SolverSettings(), lambda *what: None
    )
    assert solved.is_static
    solved.save(tmp_path / "work")
    assert CameraSolution.load(tmp_path / "work").is_static


def test_a_missing_pycolmap_is_reported(monkeypatch, tmp_path):
    monkeypatch.setattr(colmap_mapping.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="pip install pycolmap"):
        colmap_mapping.require_pycolmap()
