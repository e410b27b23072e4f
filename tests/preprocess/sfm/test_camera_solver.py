"""Tests for the solution of a little room and its parts: right, refused, or not needed."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.camera_accuracy import fit_similarity
from capture.input_error import InputError
from capture.source_opening import open_source
from preprocess.sfm import camera_solver, colmap_mapping
from preprocess.sfm.camera_solution import (
    INTERPOLATED,
    KEY,
    PLACED,
    evaluate_gates,
    find_outlier_cameras,
)
from preprocess.sfm.camera_solver import SolverSettings, solve_cameras
from preprocess.sfm.colmap_mapping import dilate_person, select_keyframes, write_keyframes
from preprocess.sfm.point_tracking import resect_intermediate_frames
from tests.preprocess.sfm.conftest import exact_model, filmed, walked

SIZE, FOCAL_PX = (320, 240), 260.0
FRAMES, KEYS = 11, 8


def no_person(frame, size_px):
    return np.zeros(size_px[::-1], dtype=bool)


def solve(source, report=lambda share: None, **settings):
    return solve_cameras(source, no_person, SolverSettings(**settings), report)


@pytest.fixture
def here():
    """One camera in the room."""
    return walked(1, degrees=0.0, size_px=SIZE, focal_px=FOCAL_PX)[0]


@pytest.fixture(scope="module")
def walk(room, tmp_path_factory):
    """True cameras, their film, its solution, and the progress that was reported."""
    cameras = walked(FRAMES, degrees=64, size_px=(240, 180), focal_px=0.75 * FOCAL_PX)
    source, shares = room.film(tmp_path_factory.mktemp("walk"), cameras), []
    return cameras, source, solve(source, shares.append, max_keyframes=KEYS), shares


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
        solve(source)


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
    room, here, tmp_path, monkeypatch, shake_m, most_deg
):
    monkeypatch.setattr(colmap_mapping, "extract_features", None)  # no need of it
    cameras = turning(here, np.linspace(-24.0, 24.0, 14), shake_m)
    source = room.film(tmp_path / "film", cameras)
    solved = solve(source, max_keyframes=KEYS)
    assert solved.model.only_turns
    assert not (solved.frame_status < PLACED).any()
    views = solved.camera_from_solved
    assert not views[:, :3, 3].any()
    rotations = np.stack([camera.camera_from_world[:3, :3] for camera in cameras])
    from_first = rotations @ rotations[0].T @ views[0, :3, :3]
    angles = Rotation.from_matrix(from_first @ views[:, :3, :3].transpose(0, 2, 1)).magnitude()
    assert np.degrees(angles).max() < most_deg
    assert solved.lens(SIZE).focal_px[0] == pytest.approx(FOCAL_PX, rel=0.02)
    again = solve(source, max_keyframes=KEYS, focal_ratio=1.01 * FOCAL_PX / SIZE[0])
    assert again.lens(SIZE).focal_px[0] == pytest.approx(1.01 * FOCAL_PX)


def test_a_walk_along_a_flat_wall_is_not_taken_for_a_turn(room, here, tmp_path, monkeypatch):
    def goes_on(*given):
        raise InputError("solved as a path")

    monkeypatch.setattr(camera_solver, "_solve_path", goes_on)
    cameras = turning(here.scale_focal(400.0 / FOCAL_PX), np.zeros(KEYS))
    for camera, aside in zip(cameras, np.linspace(-0.6, 0.6, KEYS), strict=True):
        camera.camera_from_world[0, 3] += aside
    with pytest.raises(InputError, match="solved as a path"):
        solve(room.film(tmp_path / "film", cameras))


@pytest.mark.slow
def test_a_turn_that_tells_no_focal_length_is_not_believed(room, here, tmp_path):
    cameras = turning(here, np.linspace(-1.5, 1.5, KEYS))
    with pytest.raises(InputError, match="does not just turn by 5°"):
        solve(room.film(tmp_path / "film", cameras))


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
        solve(source, max_keyframes=KEYS)


def test_a_tripod_needs_no_solution(room, here, tmp_path, monkeypatch):
    monkeypatch.setattr(colmap_mapping, "extract_features", None)
    solved = solve(filmed(tmp_path / "film", [room.seen(here)] * 9))
    assert solved.is_static
    assert solved.model is None


def test_a_missing_pycolmap_is_reported(monkeypatch):
    monkeypatch.setattr(colmap_mapping.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pycolmap.*\[learn\]"):
        colmap_mapping.require_pycolmap()


# --- key frames -----------------------------------------------------------------------------------

SHARP = (1, 5, 6, 11, 13, 17, 18, 22, 25, 29, 32, 35)


@pytest.fixture
def film(tmp_path, rng):
    """Noise, blurred in all frames but every third, which are all over the place."""
    pictures = rng.integers(0, 255, (36, 48, 64, 3), dtype=np.uint8)
    for index in set(range(36)) - set(SHARP):
        pictures[index] = cv2.GaussianBlur(pictures[index], None, 2.0)
    return filmed(tmp_path / "film", pictures)


def test_the_sharpest_frame_of_each_stretch_is_chosen(film):
    shares = []
    keys = list(select_keyframes(film, no_person, shares.append, 12))
    assert tuple(key.index for key in keys) == SHARP
    assert shares[-1] == 1.0
    assert shares == sorted(shares)


def test_only_wanted_frames_are_chosen(film):
    part = open_source(film.path, frames=slice(6, 30, 2))
    chosen = select_keyframes(part, no_person, lambda share: None, 60)
    assert {key.index for key in chosen} == set(range(6, 30, 2))


def test_frames_without_a_known_person_are_skipped(film):
    def sometimes(frame, size_px):
        return None if frame.index in (5, 6) else no_person(frame, size_px)

    chosen = [key.index for key in select_keyframes(film, sometimes, lambda share: None, 12)]
    assert not {5, 6} & set(chosen)
    assert len(chosen) == 12


def test_the_person_is_left_out_with_a_margin():
    person = np.zeros((200, 300), dtype=bool)
    person[50:150, 100:140] = True
    around = dilate_person(person)
    rows, columns = np.nonzero(around)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (46, 153, 96, 143)


def test_colmap_does_not_look_at_the_person(film, tmp_path):
    def left_half(frame, size_px):
        person = no_person(frame, size_px)
        person[:, : size_px[0] // 2] = True
        return person

    chosen = select_keyframes(film, left_half, lambda share: None, 12)
    assert len(write_keyframes(chosen, tmp_path / "images", tmp_path / "masks")) == 12
    mask = cv2.imread(str(tmp_path / "masks" / "000001.png.png"), cv2.IMREAD_GRAYSCALE)
    assert not mask[:, :32].any()  # it looks where a mask is not 0
    assert (mask[:, 40:] == 255).all()


def test_too_few_key_frames_are_refused(film, tmp_path):
    chosen = select_keyframes(film, no_person, lambda share: None, 5)
    with pytest.raises(InputError, match="Only 5 frames"):
        write_keyframes(chosen, tmp_path / "images", tmp_path / "masks")


# --- gates ----------------------------------------------------------------------------------------


def failed(gates) -> list[str]:
    return [gate.name for gate in gates if not gate.passed]


def transformed(model, *, scale=0.37, turn=(0.3, -0.8, 0.2), shift=(1.0, 2.0, -3.0)):
    """The same solution in a world of another size, turned and shifted."""
    rotation, shift = Rotation.from_rotvec(turn).as_matrix(), np.array(shift)
    centers = scale * model.camera_centers() @ rotation.T + shift
    cameras = model.camera_from_world.copy()
    cameras[:, :3, :3] = cameras[:, :3, :3] @ rotation.T
    cameras[:, :3, 3] = -np.einsum("cab,cb->ca", cameras[:, :3, :3], centers)
    points = scale * model.points @ rotation.T + shift
    return replace(model, camera_from_world=cameras, points=points)


def turned(model, row: int, degrees: float):
    """The same with one camera turned about its own centre."""
    cameras = model.camera_from_world.copy()
    turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    cameras[row, :3] = turn @ cameras[row, :3]
    return replace(model, camera_from_world=cameras)


def test_an_exact_solution_passes_whatever_its_world(model):
    for one in (model, transformed(model)):
        gates = evaluate_gates(one, len(one.frames))
        assert failed(gates) == []
        assert next(g.value for g in gates if g.name == "reprojection_px") < 1e-9
        assert not find_outlier_cameras(one).any()


def test_noise_of_pixels_is_measured(cameras, room_points):
    noisy = exact_model(cameras, room_points, noise_px=1.0)
    gates = evaluate_gates(noisy, len(cameras))
    assert failed(gates) == ["reprojection_px"]
    (error_px,) = (gate.value for gate in gates if gate.name == "reprojection_px")
    # the length of a vector of two normal numbers is sqrt(pi / 2) on average
    assert error_px == pytest.approx(np.sqrt(np.pi / 2), rel=0.02)


def test_key_frames_that_are_missing_are_counted(model):
    assert failed(evaluate_gates(model, round(len(model.frames) / 0.89))) == ["registered"]


@pytest.mark.parametrize(("share", "bound"), [(0.3, "0.5"), (2.6, "2")])
def test_an_impossible_focal_length_is_refused(cameras, room_points, share, bound):
    focal = share * 640
    lenses = [replace(camera, focal_px=(focal, focal)) for camera in cameras]
    gates = evaluate_gates(exact_model(lenses, room_points), len(cameras))
    assert "focal" in failed(gates)
    (focal_gate,) = (gate for gate in gates if gate.name == "focal")
    assert focal_gate.describe_failure().endswith(f"the bound is {bound})")


def test_a_camera_that_hardly_moves_is_refused(room_points):
    still = walked(24, degrees=0.2, size_px=(640, 480), focal_px=520.0)
    eye = still[0].camera_from_world[:3, 3]
    close = []
    for camera in still:
        near = camera.camera_from_world.copy()
        near[:3, 3] = eye + 0.02 * (near[:3, 3] - eye)
        close.append(replace(camera, camera_from_world=near))
    assert "angle_deg" in failed(evaluate_gates(exact_model(close, room_points), len(close)))


@pytest.mark.parametrize("row", [1, 11, 22])
def test_one_camera_that_looks_elsewhere_is_found(model, row):
    found = find_outlier_cameras(turned(model, row, 8.0))
    assert found.nonzero()[0].tolist() == [row]


def test_a_camera_placed_by_a_few_points_is_found(model):
    few = model.observations_of_camera(7)[20:]
    kept = np.setdiff1d(np.arange(len(model.pixels)), few)
    thinned = replace(
        model, observation_camera=model.observation_camera[kept],
        observation_point=model.observation_point[kept], pixels=model.pixels[kept],
    )  # fmt: skip
    assert find_outlier_cameras(thinned).nonzero()[0].tolist() == [7]
    rest = thinned.without_cameras(find_outlier_cameras(thinned))
    assert rest.frames.tolist() == [i for i in range(24) if i != 7]
    assert rest.reprojection_errors_px().max() < 1e-9
