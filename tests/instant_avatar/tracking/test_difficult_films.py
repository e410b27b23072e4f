"""Films that are hard to track: ia-track says what is wrong with them, and when."""

import json

import cv2
import numpy as np
import pytest

from instant_avatar import track
from instant_avatar.studio import painted_surfaces
from instant_avatar.studio.actor import Actor
from instant_avatar.studio.lighting import composite_over
from instant_avatar.studio.staging import static_camera, turning_motion

FPS = 15.0


@pytest.fixture(scope="module")
def frames(filmed):
    """The frames of the actor's film, BGR."""
    video = cv2.VideoCapture(str(filmed / "video.mp4"))
    found = []
    while (read := video.read())[0]:
        found.append(read[1])
    video.release()
    return found


@pytest.fixture
def track_film(tmp_path, capsys):
    """Tracks a film of some frames; returns exit code, grades (None without) and messages."""

    def call(frames, *words):
        path = tmp_path / "film.mp4"
        height, width = frames[0].shape[:2]
        code = cv2.VideoWriter.fourcc(*"FFV1")
        writer = cv2.VideoWriter(str(path), code, FPS, (width, height))
        for frame in frames:
            writer.write(np.ascontiguousarray(frame))
        writer.release()
        out = tmp_path / "out" / "poses.npz"
        ended = track.main([str(path), "--out", str(out), "--no-film", *words])
        told = capsys.readouterr().err
        assert "Traceback" not in told
        file = out.with_name("grade.json")
        return ended, json.loads(file.read_text()) if file.exists() else None, told

    return call


def reasons(grade):
    return {each["reason"] for each in grade["doubtful"]}


def test_legs_below_the_picture_are_named(track_film, frames):
    code, grade, told = track_film([frame[: int(0.7 * len(frame))] for frame in frames])
    assert code == 1
    assert "the person is cut by the picture's lower border" in reasons(grade)
    assert "100% of the frames are doubtful" in told


def test_a_picture_on_its_side_is_tracked(track_film, frames):
    code, grade, _ = track_film([cv2.rotate(each, cv2.ROTATE_90_CLOCKWISE) for each in frames])
    assert code == 0
    assert grade["iou_mean"] > 0.75


def test_a_dark_film_is_bad_input(track_film, frames):
    noise = np.random.default_rng(0)
    dark = [
        np.clip(0.04 * each + noise.normal(0, 3, each.shape), 0, 255).astype(np.uint8)
        for each in frames
    ]
    code, grade, told = track_film(dark)
    assert (code, grade) == (2, None)
    assert "in good light" in told


def test_a_picture_that_stands_still_shows_one_side_only(track_film, frames):
    code, grade, told = track_film(frames[:1] * 12)
    assert code == 0
    assert grade["directions_seen"] < 0.2  # one of twelve, two if it lies between them
    assert "The sides that the camera never saw will be guesses" in told


def test_a_mirror_is_another_person(track_film, frames):
    near = [each[:, 58:198] for each in frames]
    _, grade, _ = track_film([np.hstack([each, each[:, ::-1]]) for each in near], "--person", "1")
    assert "another person is so near that the two may be mixed up" in reasons(grade)


def test_a_person_who_leaves_and_returns_is_lost_meanwhile(track_film):
    code, grade, _ = track_film(walk_past_the_plant_and_back())
    assert code == 0
    lost = [each for each in grade["doubtful"] if each["reason"] == "the person was not found"]
    assert len(lost) == 1
    # frames 17 to 26 show the plant alone
    assert lost[0]["start_s"] <= 18 / FPS
    assert lost[0]["end_s"] >= 25 / FPS


def walk_past_the_plant_and_back():
    """The actor slides out of the picture past a plant, is away for ten frames, and returns."""
    actor = Actor.of(1, 0)
    camera = static_camera(actor, 270)
    behind = painted_surfaces.paint_backdrop("clutter", camera, np.random.default_rng([0, 4]))
    motion = turning_motion(actor, frames=2, fps=FPS, turns=0.02, seed=0)
    drawn = [actor.render_rgb_alpha(motion[row], camera) for row in range(2)]
    out = list(range(20, 160, 20))
    places = [0] * 10 + out + [300] * 10 + out[::-1] + [0] * 20
    pictures = []
    for number, place in enumerate(places):
        moved = np.array([[1.0, 0.0, place], [0.0, 1.0, 0.0]])
        rgb, alpha = (cv2.warpAffine(each, moved, (270, 270)) for each in drawn[number % 2])
        pictures.append(composite_over(rgb, alpha, behind)[..., ::-1])
    return pictures
