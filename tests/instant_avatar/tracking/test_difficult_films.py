"""Films that are hard to track: ia-track says what is wrong with them, and when."""

import json

import av
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


def test_a_film_that_breaks_off_after_two_frames_is_named_so(frames, tmp_path, capsys):
    whole, path = tmp_path / "whole.mp4", tmp_path / "film.mp4"
    sizes = []
    with av.open(str(whole), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("mjpeg", rate=15)  # each frame is whole
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuvj420p"
        for place in range(300):
            frame = av.VideoFrame.from_ndarray(frames[place % 20], format="bgr24")
            for packet in stream.encode(frame):
                sizes.append(packet.size)
                container.mux(packet)
    data = whole.read_bytes()
    path.write_bytes(data[: data.index(b"mdat") + 4 + sum(sizes[:2])])
    assert track.main([str(path), "--out", str(tmp_path / "out" / "poses.npz"), "--no-film"]) == 2
    assert "breaks off after 2 of 300 frames" in " ".join(capsys.readouterr().err.split())


def test_legs_below_the_picture_are_the_first_cause_of_the_verdict(track_film, frames):
    code, grade, told = track_film([frame[: int(0.7 * len(frame))] for frame in frames[::2]])
    assert code == 1
    cut = "the person is cut by the picture's lower border"
    assert cut in reasons(grade)
    assert f"Good enough for an avatar: no, because {cut} in 10 of 10 frames" in told


def test_a_picture_on_its_side_is_tracked(track_film, frames):
    code, grade, _ = track_film([cv2.rotate(each, cv2.ROTATE_90_CLOCKWISE) for each in frames])
    assert code == 0
    assert grade["iou_mean"] > 0.75


def test_a_dark_film_is_bad_input(track_film, frames):
    noise = np.random.default_rng(0)
    dark = [
        np.clip(0.04 * each + noise.normal(0, 3, each.shape), 0, 255).astype(np.uint8)
        for each in frames[::2]
    ]
    code, grade, told = track_film(dark)
    assert (code, grade) == (2, None)
    assert "in good light" in told


def test_a_picture_that_stands_still_shows_one_side_only(track_film, frames):
    code, grade, told = track_film(frames[:1] * 8)
    assert code == 0
    assert grade["directions_seen"] < 0.2  # one of twelve, two if it lies between them
    assert "The sides that the camera never saw will be guesses" in told


def test_a_mirror_is_another_person(track_film, frames):
    near = [each[:, 58:198] for each in frames[::2]]
    _, grade, _ = track_film([np.hstack([each, each[:, ::-1]]) for each in near], "--person", "1")
    assert "another person is so near that the two may be mixed up" in reasons(grade)


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_person_who_passes_in_front_is_named_and_in_no_mask_that_is_learnt_from(
    track_film, tmp_path
):
    """The detector, which looks for others in every fifth frame, sees the person alone in each."""
    code, grade, _ = track_film(someone_passes_in_front())
    assert code == 0
    assert "another person is so near that the two may be mixed up" in reasons(grade)
    poses = np.load(tmp_path / "out" / "poses.npz")
    masks = sorted((tmp_path / "out" / "masks").glob("*.png"))
    areas = np.array([(cv2.imread(str(path), 0) > 127).sum() for path in masks])
    learnt = areas[poses["frame"][poses["valid"]]]
    assert len(learnt) > 55  # of 72: the other is near in a few frames only
    assert learnt.max() < 1.1 * np.median(learnt)


def someone_passes_in_front():
    """One actor stands; another, a little larger, crosses the picture within eight frames."""
    size = 270
    actors = [Actor.of(seed, 0) for seed in (1, 2)]
    camera = static_camera(actors[0], size)
    behind = painted_surfaces.paint_backdrop("clutter", camera, np.random.default_rng([0, 4]))
    motion = turning_motion(actors[0], frames=2, fps=FPS, turns=0.02, seed=0)
    drawn = [[actor.render_rgb_alpha(motion[row], camera) for row in range(2)] for actor in actors]
    pictures = []
    for number in range(72):
        picture = composite_over(*drawn[0][number % 2], behind)
        moved = np.array([[1.15, 0.0, 45.0 * (number - 18) - 290], [0.0, 1.15, -22.0]])
        rgb, alpha = (cv2.warpAffine(each, moved, (size, size)) for each in drawn[1][number % 2])
        pictures.append(composite_over(rgb, alpha, picture)[..., ::-1])
    return pictures
