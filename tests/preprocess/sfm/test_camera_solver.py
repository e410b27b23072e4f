"""Tests for the whole solution of a little room: right, refused, or not needed."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.camera_accuracy import fit_similarity
from capture.input_error import InputError
from capture.source_opening import open_source
from preprocess.sfm import camera_solver, colmap_mapping
from preprocess.sfm.camera_solution import INTERPOLATED, KEY, PLACED
from preprocess.sfm.camera_solver import SolverSettings, solve_cameras
from preprocess.sfm.colmap_mapping import select_keyframes
from preprocess.sfm.point_tracking import resect_intermediate_frames
from tests.preprocess.sfm.conftest import walked

SIZE, FOCAL_PX = (320, 240), 260.0
FRAMES, KEYS = 11, 8


def no_person(frame, size_px):
    return np.zeros(size_px[::-1], dtype=bool)


def filmed(folder, pictures):
    folder.mkdir(exist_ok=True)
    for index, rgb in enumerate(pictures):
        cv2.imwrite(str(folder / f"{index:03d}.png"), rgb[..., ::-1])
    return open_source(folder)


@pytest.fixture(scope="module")
def walk(room, tmp_path_factory):
    """True cameras, their film, its solution, and the progress that was reported."""
    folder = tmp_path_factory.mktemp("walk")
    cameras = walked(FRAMES, degrees=64, size_px=(240, 180), focal_px=0.75 * FOCAL_PX)
    source = filmed(folder / "film", [room.seen(camera) for camera in cameras])
    shares = []
    settings = SolverSettings(max_keyframes=KEYS)
    return cameras, source, solve_cameras(source, no_person, settings, shares.append), shares


def test_cameras_of_a_walk_are_solved_to_millimetres(walk):
    cameras, _, solved, shares = walk
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
    assert np.degrees(angles.magnitude()).max() < 0.4  # 240 px see less than 960
    assert solved.lens(SIZE).focal_px[0] == pytest.approx(FOCAL_PX, rel=0.01)
    assert solved.lens((640, 480)).focal_px[0] == pytest.approx(520.0, rel=0.01)
    assert all(gate.passed for gate in solved.gates)
    assert {gate.name for gate in solved.gates} >= {"followed_px", "registered"}
    assert shares == sorted(shares)
    assert 0.9 < shares[-1] <= 1.0
    assert solved.costs.keys() >= {"cpu_seconds", "peak_memory_mb"}


def test_a_frame_that_shows_nothing_is_interpolated(walk, tmp_path):
    _, source, solved, _ = walk
    lost = int(np.flatnonzero(solved.frame_status == PLACED)[1])
    pictures = [frame.rgb for frame in source.frames()]
    keys = list(select_keyframes(source, no_person, lambda share: None, KEYS))
    pictures[lost] = np.full_like(pictures[lost], 90)
    spoilt = filmed(tmp_path / "film", pictures)
    between = resect_intermediate_frames(spoilt, solved.model, keys, lambda share: None)
    _, status = camera_solver._cameras_of_all_frames(spoilt, solved.model, between)
    assert np.flatnonzero(status == INTERPOLATED).tolist() == [lost]


def test_pictures_that_have_nothing_in_common_are_refused(tmp_path, rng):
    noise = [rng.integers(0, 255, (12, 16, 3), dtype=np.uint8) for _ in range(8)]
    source = filmed(tmp_path / "film", [cv2.resize(picture, (160, 120)) for picture in noise])
    with pytest.raises(
        InputError, match="with certainty: the pictures have hardly anything in common"
    ):
        solve_cameras(source, no_person, SolverSettings(), lambda share: None)


def turning(here, degrees, shake_m=0.0):
    """Cameras that turn about the vertical where `here` is, in an unsteady hand."""
    rng = np.random.default_rng(4)
    cameras = []
    for angle in degrees:
        view = np.eye(4)
        view[:3, :3] = Rotation.from_euler("yz", [angle, 0.05 * angle], degrees=True).as_matrix()
        view = view @ here.camera_from_world
        view[:3, 3] += shake_m * rng.normal(size=3)
        cameras.append(replace(here, camera_from_world=view))
    return cameras


@pytest.mark.parametrize(
    ("shake_m", "most_deg"), [(0.0, 0.1), pytest.param(0.01, 0.4, marks=pytest.mark.slow)]
)
def test_a_camera_that_turns_on_the_spot_is_solved_as_one(
    room, tmp_path, monkeypatch, shake_m, most_deg
):
    monkeypatch.setattr(colmap_mapping, "extract_features", None)  # no need of it
    here = walked(1, degrees=0.0, size_px=SIZE, focal_px=FOCAL_PX)[0]
    cameras = turning(here, np.linspace(-24.0, 24.0, 14), shake_m)
    source = filmed(tmp_path / "film", [room.seen(camera) for camera in cameras])
    settings = SolverSettings(max_keyframes=KEYS)
    solved = solve_cameras(source, no_person, settings, lambda share: None)
    assert solved.model.only_turns
    assert not (solved.frame_status < PLACED).any()
    views = solved.camera_from_solved
    assert not views[:, :3, 3].any()
    rotations = np.stack([camera.camera_from_world[:3, :3] for camera in cameras])
    from_first = rotations @ rotations[0].T @ views[0, :3, :3]
    angles = Rotation.from_matrix(from_first @ views[:, :3, :3].transpose(0, 2, 1)).magnitude()
    assert np.degrees(angles).max() < most_deg
    assert solved.lens(SIZE).focal_px[0] == pytest.approx(FOCAL_PX, rel=0.02)
    stated = replace(settings, focal_ratio=1.01 * FOCAL_PX / SIZE[0])
    again = solve_cameras(source, no_person, stated, lambda share: None)
    assert again.lens(SIZE).focal_px[0] == pytest.approx(1.01 * FOCAL_PX)


def test_a_walk_along_a_flat_wall_is_not_taken_for_a_turn(room, tmp_path, monkeypatch):
    def goes_on(*given):
        raise InputError("solved as a path")

    monkeypatch.setattr(camera_solver, "_solve_path", goes_on)
    here = walked(1, degrees=0.0, size_px=SIZE, focal_px=400.0)[0]
    cameras = turning(here, np.zeros(KEYS))
    for camera, aside in zip(cameras, np.linspace(-0.6, 0.6, KEYS), strict=True):
        camera.camera_from_world[0, 3] += aside
    with pytest.raises(InputError, match="solved as a path"):
        solve_cameras(
            filmed(tmp_path / "film", [room.seen(camera) for camera in cameras]), no_person,
            SolverSettings(), lambda share: None,
        )  # fmt: skip


@pytest.mark.slow
def test_a_turn_that_tells_no_focal_length_is_not_believed(room, tmp_path):
    here = walked(1, degrees=0.0, size_px=SIZE, focal_px=FOCAL_PX)[0]
    cameras = turning(here, np.linspace(-1.5, 1.5, KEYS))
    with pytest.raises(InputError, match="does not just turn by 5°"):
        solve_cameras(
            filmed(tmp_path / "film", [room.seen(camera) for camera in cameras]), no_person,
            SolverSettings(), lambda share: None,
        )  # fmt: skip


def test_a_wrong_world_is_refused_by_points_that_are_followed(walk, monkeypatch):
    """Even one that passes all gates of its own."""
    _, source, solved, _ = walk
    lift = np.linspace(0.0, 0.4, KEYS)[:, None] * [0.0, 1.0, 0.0]
    bent = solved.model.camera_from_world.copy()
    bent[:, :3, 3] += np.einsum("cab,cb->ca", bent[:, :3, :3], lift)
    wrong = replace(solved.model, camera_from_world=bent)
    for name in ("extract_features", "match_features"):
        monkeypatch.setattr(colmap_mapping, name, lambda *given: None)
    monkeypatch.setattr(colmap_mapping, "parallax_fraction", lambda database: (KEYS, 1.0))
    monkeypatch.setattr(colmap_mapping, "map_incrementally", lambda *given: wrong)
    monkeypatch.setattr(camera_solver, "solve_turning_camera", lambda *given: None)
    monkeypatch.setattr(camera_solver, "evaluate_gates", lambda model, keys: [])
    with pytest.raises(InputError, match="beside where they should"):
        solve_cameras(source, no_person, SolverSettings(max_keyframes=KEYS), lambda share: None)


def test_a_tripod_needs_no_solution(room, tmp_path, monkeypatch):
    monkeypatch.setattr(colmap_mapping, "extract_features", None)
    camera = walked(1, degrees=0.0, size_px=SIZE, focal_px=FOCAL_PX)[0]
    source = filmed(tmp_path / "film", [room.seen(camera)] * 9)
    solved = solve_cameras(source, no_person, SolverSettings(), lambda share: None)
    assert solved.is_static
    assert solved.model is None


def test_a_missing_pycolmap_is_reported(monkeypatch, tmp_path):
    monkeypatch.setattr(colmap_mapping.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pycolmap.*\[learn\]"):
        colmap_mapping.require_pycolmap()
