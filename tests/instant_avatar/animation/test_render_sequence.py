"""ia-play's turntables, stills, backgrounds and workers, and motions of other people's programs."""

import os
import signal

import numpy as np
import pytest
from PIL import Image

from export.player import Player
from instant_avatar.animation.driving_motion import FollowingCamera, canonical_pose_of, demo_motion
from instant_avatar.animation.play_arguments import Viewpoint
from preprocess.body.kinematics import axis_angles_from_matrices, rotation_matrices
from preprocess.poses.pose_format_registry import read_poses

SIZE = 96


@pytest.fixture(scope="session")
def package(run):
    return run / "avatar.iavatar"


@pytest.fixture(scope="session")
def player(package):
    return Player.load(package)


@pytest.fixture(scope="session")
def novel(film):
    """Twelve poses that the film does not show, thirty a second."""
    return film / "truth" / "novel" / "poses.npz"


@pytest.fixture
def frames(call_play, package, tmp_path):
    """What ia-play draws into a folder, as pictures."""

    def frames(*arguments, code=0):
        out = tmp_path / "frames"
        outcome = call_play(package, *arguments, "--out", out, "--size", SIZE)
        assert outcome.code == code, outcome.err
        files = sorted(out.glob("*.png"))
        return np.stack([np.asarray(Image.open(file)).astype(int) for file in files])

    return frames


def test_a_turntable_shows_all_sides_and_ends_where_it_began(frames, player):
    drawn = frames("--turntable", "2", "--fps", "6")
    assert len(drawn) == 12
    pose = canonical_pose_of(player)
    for picture, degrees in ((0, 0.0), (3, 90.0), (6, 180.0), (11, 330.0)):
        view = Viewpoint(orbit_deg=degrees)
        camera = FollowingCamera.of(player, demo_motion(2), SIZE, view).camera_for(pose)
        assert np.abs(drawn[picture] - player.render(pose, camera)).mean() < 0.1


def test_a_turntable_s_seconds_may_be_left_out(frames, monkeypatch):
    assert len(frames("--turntable", "--fps", "2")) == 12
    assert len(frames("--turntable", "-3", "--fps", "2")) == 6


def test_a_turntable_turns_about_a_motion_while_it_plays(frames, player, novel):
    still, turning = frames("--poses", novel), frames("--poses", novel, "--turntable", "4")
    assert len(still) == len(turning) == 12
    np.testing.assert_array_equal(turning[0], still[0])
    motion = read_poses(novel)
    view = Viewpoint(orbit_deg=360.0 * (6 / 30) / 4)
    camera = FollowingCamera.of(player, motion, SIZE, view).camera_for(motion[6])
    assert np.abs(turning[6] - player.render(motion[6], camera)).mean() < 0.1


def test_one_pose_is_one_picture(call_play, package, player, novel, tmp_path):
    out = tmp_path / "still.png"
    wishes = ["--still", 5, "--orbit", "-40", "--elevation", "20", "--size", "80x60"]
    assert call_play(package, "--poses", novel, "--out", out, *wishes).code == 0
    motion = read_poses(novel)
    held = read_poses(novel)
    held.valid[:] = np.arange(12) == 5
    view = Viewpoint(orbit_deg=-40.0, elevation_deg=20.0)
    camera = FollowingCamera.of(player, held, (80, 60), view).camera_for(motion[5])
    with Image.open(out) as picture:
        np.testing.assert_array_equal(np.asarray(picture), player.render(motion[5], camera))


def test_without_a_name_a_still_lies_beside_the_package(call_play, package, novel):
    outcome = call_play(package, "--poses", novel, "--still", 3, "--size", SIZE)
    assert outcome.out.strip() == str(package.parent / "poses-3.png")
    (package.parent / "poses-3.png").unlink()


@pytest.mark.slow
def test_without_poses_it_moves_all_the_same(call_play, package):
    outcome = call_play(package, "--size", 32, "--tier", "lite")
    assert outcome.code == 0
    assert outcome.out.strip() == str(package.parent / "avatar.mp4")
    assert "90 frames" in outcome.err
    assert "at 30 fps" in outcome.err
    (package.parent / "avatar.mp4").unlink()


@pytest.mark.parametrize(
    ("wishes", "count"),
    [(["--still", 20], 1), (["--still", 20, "--turntable", "2"], 4), (["--turntable", "2"], 4)],
)
def test_without_poses_a_still_and_a_turntable_show_the_built_in_motion(frames, wishes, count):
    assert len(frames(*wishes, "--close-up", "head", "--fps", "2")) == count


def test_frames_are_clear_unless_a_background_is_wished(frames, novel, tmp_path, rng):
    wall = rng.integers(0, 256, (SIZE, 2 * SIZE, 3), dtype=np.uint8)
    Image.fromarray(wall).save(tmp_path / "wall.png")
    clear = frames("--poses", novel, "--still", 0)[0]
    behind = clear[..., 3] == 0
    assert clear.shape[2] == 4
    assert behind.any()
    on_wall = frames("--poses", novel, "--still", 0, "--background", tmp_path / "wall.png")[0]
    np.testing.assert_array_equal(on_wall[behind], wall[:, 48:144][behind])
    on_red = frames("--poses", novel, "--still", 0, "--background", "red")[0]
    assert (on_red[behind] == [255, 0, 0]).all()
    inside = clear[..., 3] == 255
    np.testing.assert_array_equal(on_red[inside], clear[inside][:, :3])
    same = frames("--poses", novel, "--still", 0, "--background", "transparent")[0]
    np.testing.assert_array_equal(same, clear)


def test_pictures_do_not_depend_on_the_workers(frames, novel):
    one, three = (frames("--poses", novel, "--workers", n) for n in (1, 3))
    np.testing.assert_array_equal(one, three)
    assert len(one) == 12


@pytest.mark.parametrize("workers", [1, 3])
def test_ctrl_c_keeps_what_was_drawn(frames, novel, monkeypatch, workers):
    whole, render, drawn = frames("--poses", novel), Player.render, []

    def interrupted(*arguments, **keywords):
        drawn.append(render(*arguments, **keywords))
        if len(drawn) == 6:
            os.kill(os.getpid(), signal.SIGINT)
        return drawn[-1]

    monkeypatch.setattr(Player, "render", interrupted)
    kept = frames("--poses", novel, "--workers", workers, code=130)
    assert 1 <= len(kept) < 12
    np.testing.assert_array_equal(kept, whole[: len(kept)])


def test_ctrl_c_leaves_a_clip_that_plays(call_play, package, novel, tmp_path, monkeypatch):
    render, drawn = Player.render, []

    def interrupted(*arguments, **keywords):
        drawn.append(None)
        if len(drawn) == 6:
            os.kill(os.getpid(), signal.SIGINT)
        return render(*arguments, **keywords)

    monkeypatch.setattr(Player, "render", interrupted)
    out = tmp_path / "clip.webp"
    outcome = call_play(package, "--poses", novel, "--out", out, "--workers", 1, "--size", SIZE)
    assert outcome.code == 130
    with Image.open(out) as clip:
        assert 1 <= clip.n_frames < 12
        assert f"Rendered {clip.n_frames} of 12 frames" in outcome.err
    assert [file.name for file in tmp_path.iterdir()] == ["clip.webp"]


def amass(motion, pelvis, folder):
    """AMASS, SMPL+H: hands after 22 joints, 120 poses a second, z up."""
    up = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    roots = axis_angles_from_matrices(up @ rotation_matrices(motion.root_rotations))
    joints = motion.joint_rotations[:, :21].reshape(len(motion), 63)
    path = folder / "walk_poses.npz"
    np.savez(
        path,
        poses=np.column_stack([roots, joints, np.zeros((len(motion), 90))]),
        trans=(pelvis + motion.root_translations) @ up.T - pelvis,
        betas=np.zeros(16),
        gender=np.array("male"),
        mocap_framerate=np.array(120.0),
    )
    return path, ["--fps", "120"]


def animation(motion, pelvis, folder):
    """InstantAvatar's dances: SMPL's 72 numbers, and nothing about time."""
    path = folder / "dance.npz"
    joints = motion.joint_rotations.reshape(len(motion), 69)
    poses = np.column_stack([motion.root_rotations, joints])
    np.savez(path, poses=poses.astype(np.float32), trans=motion.root_translations)
    return path, []


def test_motion_capture_of_120_poses_shows_every_second_one(frames, player, novel, tmp_path):
    path, _ = amass(read_poses(novel), player.manifest.rest_joints[0], tmp_path)
    fast, usual = frames("--poses", path, "--fps", "120"), frames("--poses", path)
    np.testing.assert_array_equal(usual, fast[::2])
