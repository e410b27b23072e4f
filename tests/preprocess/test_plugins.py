"""Tests of `preprocess/plugins.py`: trackers and segmenters by name, this project's and others."""

import pytest

from capture.input_error import InputError
from preprocess import plugins
from preprocess.plugins import PersonTracker, make_segmenter, make_tracker
from preprocess.tracking.blazepose import BlazePoseSegmenter, BlazePoseTracker


class Point:
    """An installed package's entry point."""

    def __init__(self, name, load):
        self.name, self.load = name, load


def test_another_packages_tracker_is_made_for_the_person(monkeypatch):
    def load():
        return lambda person: lambda rgb: (person, rgb)

    monkeypatch.setattr(plugins, "entry_points", lambda group: [Point(f"of {group}", load)])
    assert make_tracker("of instant_avatar.trackers", 2)(7) == (2, 7)
    with pytest.raises(InputError, match=r"--tracker vitpose: .*blazepose, of instant"):
        make_tracker("vitpose")


def test_the_projects_own_tracker_and_segmenter_need_no_entry_point(shaped):
    assert isinstance(make_segmenter("blazepose", shaped), BlazePoseSegmenter)
    tracker = make_tracker()
    assert isinstance(tracker, BlazePoseTracker)
    assert isinstance(tracker, PersonTracker)
    with pytest.raises(InputError, match="--person 0"):  # they are counted from one
        make_tracker(person=0)


def test_another_packages_segmenter_is_made_for_the_body(monkeypatch, shaped):
    made = []

    def load():
        return lambda body: made.append(body) or (lambda frame, pose, camera: frame)

    monkeypatch.setattr(plugins, "entry_points", lambda group: [Point("rembg", load)])
    assert make_segmenter("rembg", shaped)(1, None, None) == 1
    assert made == [shaped]
    with pytest.raises(InputError, match="installed are blazepose, rembg"):
        make_segmenter("sam", shaped)


def test_a_segmenter_that_cannot_be_loaded_is_named(monkeypatch, shaped):
    def load():
        raise ImportError("no module named rembg")

    monkeypatch.setattr(plugins, "entry_points", lambda group: [Point("rembg", load)])
    with pytest.raises(InputError, match="rembg"):
        make_segmenter("rembg", shaped)
