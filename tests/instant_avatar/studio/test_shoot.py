"""Filming the actor: a capture folder with ground truth, and the light on the actor."""

import shlex
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.atomic_files import LIST_NAME as LIST
from capture.camera import Camera
from capture.input_error import InputError
from capture.source_opening import open_source
from instant_avatar import sample
from instant_avatar.studio import staging
from instant_avatar.studio.actor import Actor
from instant_avatar.studio.lighting import NO_FACE, rasterize
from instant_avatar.studio.outfit import SKIN
from instant_avatar.studio.shoot import ShootConfig, film_capture
from instant_avatar.studio.staging import static_camera
from preprocess.body.body_pose import Motion
from preprocess.poses.pose_file import write_motion
from preprocess.poses.pose_format_registry import read_poses
from tests.avatar_fixtures import render_on_white

SMALL = ShootConfig(frames=5, size=64, turns=1.0)


@pytest.fixture(scope="module", params=[1, 2, 3])
def actor(request):
    return Actor.of(request.param)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shoot") / "capture"
    film_capture(folder, SMALL)
    return folder


def frames_of(path):
    return [frame.rgb for frame in open_source(path).frames()]


def test_skinning_is_the_bodys_own(actor):
    """The bare skin's vertices are the body's vertices, in any pose."""
    pose = staging.novel_poses(actor)[3]
    skin = np.unique(actor.faces[actor.materials == SKIN])
    body = actor.shaped.with_pose(pose).vertices()
    np.testing.assert_allclose(
        actor.vertices(pose)[skin], body[actor.body_vertices[skin]], atol=1e-5
    )


def test_a_track_in_a_cameras_axes_is_filmed_upright_on_the_spot(actor):
    turned = staging.turning_motion(actor, frames=8, fps=30.0, turns=1.0, seed=0)
    flip = Rotation.from_rotvec([np.pi, 0.0, 0.0])
    track = replace(
        turned,
        root_rotations=(flip * Rotation.from_rotvec(turned.root_rotations)).as_rotvec(),
        root_translations=turned.root_translations + np.array([0.0, 0.0, 5.0]),
    )
    motion = staging.tracked_motion(actor, track, frames=4, fps=30.0)
    assert len(motion) == 4
    np.testing.assert_allclose(motion.joint_rotations, turned.joint_rotations[[0, 2, 5, 7]])
    for row in range(4):
        skin = actor.vertices(motion[row])
        assert skin[:, 1].min() == pytest.approx(0.0, abs=0.02)  # the soles, and hardly anything
        assert skin[:, 1].max() > 1.4
        wanted = turned.root_rotations[[0, 2, 5, 7][row]]
        apart = Rotation.from_rotvec(wanted).inv() * Rotation.from_rotvec(
            motion.root_rotations[row]
        )
        assert apart.magnitude() < 1e-6


def nearest_pose_angles(novel: Motion, filmed: Motion) -> np.ndarray:
    """Each pose's distance to the nearest filmed one: the largest joint angle, radians."""
    gaps = []
    for pose in novel.joint_rotations:
        difference = Rotation.from_rotvec(filmed.joint_rotations.reshape(-1, 3)).inv()
        angle = (difference * Rotation.from_rotvec(np.tile(pose, (len(filmed), 1)))).magnitude()
        gaps.append(angle.reshape(len(filmed), 23).max(axis=1).min())
    return np.array(gaps)


def test_novel_poses_are_far_from_all_that_is_filmed(actor):
    novel = staging.novel_poses(actor)
    assert len(novel) == 12
    for act in (staging.turning_motion, staging.dancing_motion):
        filmed = act(actor, frames=60, fps=30.0, turns=2.0, seed=0)
        assert nearest_pose_angles(novel, filmed).min() > 0.35
        assert max(abs(actor.sole_height_m(filmed[row])) for row in range(0, 60, 7)) < 1e-9
    assert (nearest_pose_angles(novel, novel) < 1e-6).all()


def test_the_folder_is_a_native_capture(capture):
    names = ["video.mp4", "preview.mp4", "masks", "cameras.npz", "poses.npz", "dance.npz", "truth"]
    assert {path.name for path in capture.iterdir()} == {*names, LIST}
    assert len(list((capture / "masks").glob("*.png"))) == SMALL.frames
    with np.load(capture / "cameras.npz") as cameras:
        assert cameras["intrinsic"].shape == (3, 3)
        assert cameras["extrinsic"].shape == (4, 4)
        assert (cameras["height"], cameras["width"]) == (64, 64)
    poses = read_poses(capture / "poses.npz")
    assert (len(poses), poses.body_model, poses.valid.all()) == (SMALL.frames, "body24", True)
    assert poses.times_s is not None
    np.testing.assert_allclose(np.diff(poses.times_s), 1 / 30)
    assert len(read_poses(capture / "dance.npz")) == 150
    novel = capture / "truth" / "novel"
    assert len(read_poses(novel / "poses.npz")) == 12
    assert len(list((novel / "images").iterdir())) == len(list((novel / "masks").iterdir())) == 12


def test_given_poses_are_the_truth_without_noise_and_not_with_it_also_of_a_track(capture, tmp_path):
    given, truth = (read_poses(capture / p) for p in ("poses.npz", "truth/poses.npz"))
    np.testing.assert_array_equal(given.joint_rotations, truth.joint_rotations)
    write_motion(tmp_path / "track.npz", truth)
    track = ShootConfig(frames=2, size=32, track=tmp_path / "track.npz")
    noisy = replace(track, pose_noise_deg=2.0, mask_noise_px=1.0)
    film_capture(tmp_path / "noisy", noisy)
    given = read_poses(tmp_path / "noisy" / "poses.npz")
    truth = read_poses(tmp_path / "noisy" / "truth" / "poses.npz")
    assert len(truth) == 2
    assert np.abs(given.joint_rotations - truth.joint_rotations).max() > 0.01
    np.testing.assert_array_equal(given.root_translations, truth.root_translations)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"motion": "walkaround", "background": "plain"}, "room or tiles"),
        ({"motion": "walkaround", "background": "clutter"}, "room or tiles"),
        ({"like_a_phone": True, "motion": "walkaround"}, "--like-a-phone"),
        ({"like_a_phone": True, "background": "room"}, "--like-a-phone"),
        ({"like_a_phone": True, "pose_noise_deg": 1.0}, "--like-a-phone"),
        ({"track": Path("track.npz"), "motion": "dance"}, "--track replaces the turn"),
        ({"frames": 0}, "--frames"),
        ({"size": 3}, "--size"),
        ({"fps": np.nan}, "--fps"),
        ({"mask_noise_px": -1.0}, "--mask-noise-px"),
    ],
)
def test_what_cannot_be_filmed_is_refused(tmp_path, wrong, told):
    with pytest.raises(InputError, match=told):
        film_capture(tmp_path / "c", ShootConfig(**wrong))
    assert list(tmp_path.iterdir()) == []


def test_the_video_is_exact_and_masks_fit_it(capture):
    """Drawing the truth again gives the very frames: the codec and the files cost nothing."""
    actor = Actor.of(1)
    camera = static_camera(actor, 64)
    truth = read_poses(capture / "truth" / "poses.npz")
    frames = frames_of(capture / "video.mp4")
    assert len(frames) == SMALL.frames
    for row, frame in enumerate(frames):
        rgb, alpha = render_on_white(actor, truth[row], camera)
        mask = cv2.imread(str(capture / "masks" / f"{row:04d}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(mask, alpha)
        np.testing.assert_array_equal(frame[mask == 255], rgb[mask == 255])


def test_a_preview_shows_the_film_to_browsers(capture):
    exact, shown = (frames_of(capture / n) for n in ("video.mp4", "preview.mp4"))
    assert len(shown) == SMALL.frames
    off = np.abs(np.stack(shown).astype(float) - np.stack(exact))
    assert off.mean() < 12.0  # of 255: colors at half the resolution
    assert (capture / "preview.mp4").read_bytes()[:64].find(b"ftyp") > 0
    assert open_source(capture).path == capture / "video.mp4"


def test_the_same_seed_films_the_same_and_another_seed_does_not(capture, tmp_path, monkeypatch):
    novel = staging.novel_poses(Actor.of(1))
    one = novel.select_rows(np.arange(1), np.arange(1))  # the video shows none of these
    monkeypatch.setattr(staging, "novel_poses", lambda actor: one)
    film_capture(tmp_path / "again", SMALL)
    film_capture(tmp_path / "other", ShootConfig(frames=5, size=64, turns=1.0, seed=1))
    first, again, other = (
        (folder / "video.mp4").read_bytes()
        for folder in (capture, tmp_path / "again", tmp_path / "other")
    )
    assert first == again
    assert first != other


def test_ia_sample_says_what_comes_next_and_replaces_its_own_folder_on_request(call, tmp_path):
    out = tmp_path / "my [c]" / ("long" * 30)
    words = (sample, out, "--frames", 2, "--size", 32, "--background", "plain")
    ended = call(*words)
    assert ended.code == 0, ended.err
    assert (out / "video.mp4").exists()
    assert shlex.split(ended.err.splitlines()[-1]) == [
        "ia-ingest", str(out / "video.mp4"), "--poses", str(out / "poses.npz")
    ]  # fmt: skip
    assert "--overwrite" in call(*words).refusal()
    assert call(*words, "--overwrite").code == 0


SIZE = 40


@pytest.fixture
def camera():
    return Camera.at(np.zeros(3), np.eye(3), 50.0, (SIZE, SIZE))


def rectangle(left, right, top, bottom, depth):
    """Two triangles at one depth, whose corners project to the given pixels."""
    corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
    points = [((x - SIZE / 2) / 50 * depth, (y - SIZE / 2) / 50 * depth, depth) for x, y in corners]
    return np.array(points), np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def test_a_tilted_plane_is_as_deep_as_its_equation_says(camera):
    normal, offset = np.array([0.5, -0.3, 1.0]), 2.0  # normal · x = offset
    points = np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [0.0, 20.0, 0.0]]) * 0.05
    points[:, 2] = offset - points[:, :2] @ normal[:2]
    seen = rasterize(points, np.array([[0, 1, 2]], dtype=np.int32), camera, supersampling=2)
    rows, columns = np.nonzero(seen.face != NO_FACE)
    assert len(rows) > 100
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1) / 2
    rays = np.concatenate([(pixels - SIZE / 2) / 50, np.ones((len(rows), 1))], axis=1)
    expected = offset / (rays @ normal)
    np.testing.assert_allclose(seen.depth[rows, columns], expected, rtol=1e-4)


def test_the_nearer_of_two_triangles_is_seen_whatever_their_order(camera):
    near, faces = rectangle(10, 30, 10, 30, 1.0)
    far, _ = rectangle(5, 35, 5, 35, 2.0)
    for first, second, nearer in ((near, far, (0, 1)), (far, near, (2, 3))):
        seen = rasterize(
            np.concatenate([first, second]), np.concatenate([faces, faces + 4]), camera
        )
        middle = seen.face[20 * 4 : 21 * 4, 12 * 4 : 28 * 4]
        assert np.isin(middle, nearer).all()
        assert np.isin(seen.face[7 * 4, 6 * 4 : 34 * 4], [2 - nearer[0], 3 - nearer[0]]).all()
