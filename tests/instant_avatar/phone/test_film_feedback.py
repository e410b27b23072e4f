"""What the page says of frames that are tracked."""

from types import SimpleNamespace

import numpy as np
import pytest

from avatar.evaluation.coverage import Coverage
from capture.source import Frame
from instant_avatar.phone.film_feedback import CROWDED, CROWDED_LOOKS, FilmFeedback
from instant_avatar.phone.film_queue import Film
from instant_avatar.run.session_events import Tracked
from preprocess.body.parametric_body import load_body_model
from preprocess.tracking.keypoints import CroppedMask, PersonKeypoints


@pytest.fixture
def advice():
    """The sentences for the film's page."""
    return []


@pytest.fixture
def reader(advice, tmp_path, monkeypatch):
    film = Film("a browser", tmp_path / "anna", ".mp4", size=None, adds=False)

    def tell(kind, **content):
        if kind == "advice":
            advice.append(content["text"])

    monkeypatch.setattr(film, "tell", tell)
    return FilmFeedback(film)


@pytest.fixture
def look(reader):
    """Shows the reader a frame of a person who stands whole in the middle."""
    count = iter(range(1000))

    def look(*, level=200, found=True, crowded=False, shift=0.0):
        points = np.column_stack([np.linspace(50, 70, 33), np.linspace(20, 140, 33) + shift])
        values = np.zeros((160, 120), np.uint8)
        values[int(20 + shift) :, 50:70] = 255 if shift else 0
        mask = CroppedMask(values=values, image_from_crop=np.eye(3)[:2])
        person = PersonKeypoints(
            image_px=points, world_m=np.zeros((33, 3)), visibility=np.ones(33), presence=1.0,
            mask=mask, crowded=crowded,
        )  # fmt: skip
        rgb = np.full((160, 120, 3), level, np.uint8)
        number = next(count)
        frame = Frame(index=number, time_s=number / 15.0, rgb=rgb)
        reader(Tracked(frame=frame, person=person if found else None))

    return look


@pytest.mark.parametrize(
    ("seen", "said"),
    [
        ({}, "turn round slowly"),
        ({"level": 20}, "too dark"),
        ({"found": False}, "Step into the picture"),
        ({"shift": 40.0}, "your feet are cut off"),
    ],
)
def test_two_frames_alike_are_spoken_of_once(look, advice, seen, said):
    look(**seen)
    assert advice == []
    look(**seen)
    look(**seen)
    (sentence,) = advice
    assert said in sentence


def test_no_advice_about_skin_before_a_frame_is_learnt(look, advice, reader):
    coverage = Coverage(load_body_model(None).with_shape())
    reader._started = SimpleNamespace(coverage=coverage)
    look()
    look()
    assert advice == ["Good. Now turn round slowly."]


def test_another_person_is_named_once_the_tracker_has_seen_it_twice(look, advice):
    for _ in range(CROWDED_LOOKS - 1):  # as long as one look of the tracker's counts
        look(crowded=True)
    look()
    assert CROWDED not in advice
    for _ in range(CROWDED_LOOKS):
        look(crowded=True)
    assert advice[-1] == CROWDED
