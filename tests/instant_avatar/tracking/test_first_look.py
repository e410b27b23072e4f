"""The first look: a few frames tell what is wrong with a film before minutes are spent on it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from capture.source import Frame
from capture.source_opening import open_source
from instant_avatar.run import run_capture
from preprocess.tracking.first_look import CameraMotion, camera_motion, look_at
from preprocess.tracking.video_tracking import TrackingProblem


@pytest.fixture
def look(tmp_path):
    """Looks at a film of some frames, at a few a second, so that it lasts."""

    def look(frames):
        for index, frame in enumerate(frames):
            cv2.imwrite(str(tmp_path / f"{index:04d}.png"), frame[..., ::-1])
        return look_at(open_source(tmp_path))

    return look


def seen_through_a_turning_camera(frames, degrees):
    """What a camera sees that turns on the spot while the frames hang on the wall before it."""
    height, width = frames[0].shape[:2]
    lens = np.array([[height, 0.0, width / 2], [0.0, height, height / 2], [0.0, 0.0, 1.0]])
    for place, frame in enumerate(frames):
        turn = np.deg2rad(degrees * (place / len(frames) - 0.5))
        cosine, sine = np.cos(turn), np.sin(turn)
        turned = lens @ [[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]] @ np.linalg.inv(lens)
        yield cv2.warpPerspective(frame, turned, (width, height), borderMode=cv2.BORDER_REFLECT)


def test_a_good_film_needs_no_advice(look, frames):
    seen = look(frames)
    assert (seen.frames, seen.found, seen.rotation, seen.crowded) == (6, 6, 0, 0)
    assert seen.motion is CameraMotion.STILL
    assert not list(seen.advice())
    assert "a person in 6, no other person, from head to feet, the camera stands still" in (
        seen.describe()
    )


@pytest.mark.parametrize("rotate", [90, 180])
def test_a_turned_film_is_named_with_the_option_that_turns_it_upright(look, frames, rotate):
    seen = look([np.rot90(frame, rotate // 90) for frame in frames])
    assert seen.rotation == rotate
    (advice,) = seen.advice()
    assert f"--rotate {rotate}" in advice


def test_another_person_is_named(look, frames):
    near = [frame[:, 58:198] for frame in frames]
    seen = look([np.hstack([a, b]) for a, b in zip(near, near[::-1], strict=True)])
    assert seen.crowded >= 4
    assert "Another person is in" in next(seen.advice())


def test_feet_that_are_cut_off_are_named(look, frames):
    seen = look([frame[: int(0.7 * len(frame))] for frame in frames])
    assert seen.cut[TrackingProblem.BOTTOM] >= 4
    assert any("lower border in" in each and "refused" in each for each in seen.advice())


def test_a_dark_film_is_named_with_its_brightness(look, frames):
    seen = look([(0.06 * frame).astype(np.uint8) for frame in frames])
    assert seen.level < 20.0
    assert seen.found == seen.frames
    assert any(f"reach {seen.level:.0f} of 255" in advice for advice in seen.advice())


def test_a_camera_that_turns_on_the_spot_is_no_camera_that_stands(look, frames):
    seen = look(list(seen_through_a_turning_camera(frames, 80.0)))
    assert seen.motion is CameraMotion.TURNS
    assert "--cameras solve finds how it turns, and its focal" in list(seen.advice())[-1]


def test_a_camera_before_a_plain_wall_stands_if_its_few_corners_do():
    """Too few are left beside the person to recognize one place in the next."""
    wall = np.full((480, 480, 3), 200, np.uint8)
    for row in range(40, 480, 80):
        wall[row : row + 20, 20:40] = 40
    pairs = [(Frame(index=0, time_s=0.0, rgb=wall), Frame(index=1, time_s=0.2, rgb=wall))] * 6
    hidden = [np.full((480, 480), 255, np.uint8) for _ in range(6)]
    for k, mask in enumerate(hidden):
        mask[160 * (k % 2) : 160 * (k % 2 + 1)] = 0
    motion, shift = camera_motion(pairs, hidden)
    assert motion is CameraMotion.STILL
    assert shift < 1e-4


def test_a_camera_that_is_carried_past_near_and_far_things_walks():
    noise = np.random.default_rng(0).integers(0, 256, (60, 240, 3), dtype=np.uint8)
    wall = cv2.resize(noise, (1920, 480), interpolation=cv2.INTER_CUBIC)

    def frame(index):
        rows = [wall[120 * k : 120 * (k + 1), 8 * index * (k + 1) :][:, :480] for k in range(4)]
        return Frame(index=index, time_s=0.2 * index, rgb=np.vstack(rows))

    pairs = [(frame(6 * place), frame(6 * place + 1)) for place in range(6)]
    motion, shift = camera_motion(pairs, [np.full((480, 480), 255, np.uint8)] * 6)
    assert motion is CameraMotion.WALKS
    assert 8 / 480 < shift < 32 / 480


def test_a_title_that_stands_over_a_pan_is_no_camera_that_stands():
    """Its corners are the strongest ones by far, but cover a small part of the picture."""
    noise = np.random.default_rng(0).integers(90, 150, (60, 480), dtype=np.uint8)
    ground = cv2.resize(noise, (3840, 480), interpolation=cv2.INTER_CUBIC)

    def frame(index):
        rgb = np.repeat(ground[:, 40 * index :][:, :480, None].copy(), 3, axis=2)
        cv2.putText(rgb, "FINAL 100 m", (10, 40), cv2.FONT_HERSHEY_SIMPLEX, 1.2, (255,) * 3, 6)
        return Frame(index=index, time_s=0.2 * index, rgb=rgb)

    pairs = [(frame(12 * place), frame(12 * place + 1)) for place in range(6)]
    motion, shift = camera_motion(pairs, [np.full((480, 480), 255, np.uint8)] * 6)
    assert motion is CameraMotion.TURNS
    assert shift == pytest.approx(40 / 480, abs=1e-3)


@pytest.mark.slow
@pytest.mark.usefixtures("without_baking")
def test_a_film_with_poses_is_looked_at_too(
    look, frames, filmed, call_ingest, tmp_path, monkeypatch
):
    seen = replace(
        look(frames), rotations={180: 6}, crowded=3, cut={TrackingProblem.BOTTOM: 5},
        motion=CameraMotion.TURNS,
    )  # fmt: skip
    monkeypatch.setattr(run_capture, "look_at", lambda source: seen)
    done = call_ingest(filmed, "--out", tmp_path / "run")
    assert done.code == 0, done.err
    for words in (
        "--rotate 180", "Another person is in 3 of 6 frames. The one whom the poses follow",
        "What is outside is a guess", "The camera turns on the spot", "Poses must be in each frame",
    ):  # fmt: skip
        assert words in " ".join(done.err.split())
    assert "is refused" not in done.err
    assert done.err.index("First look") < done.err.index("Training for")
