"""Tests of `preprocess/tracking/tracker_registry.py`."""

import pytest

from capture.input_error import InputError
from preprocess import plugins
from preprocess.blazepose.blazepose_tracker import BlazePoseTracker
from preprocess.tracking.person_tracker import PersonTracker
from preprocess.tracking.tracker_registry import make_tracker


class FakeEntryPoint:
    """Another package's tracker, which finds no person."""

    name = "empty_room"

    def __init__(self, group):
        self.group = group

    def load(self):
        return lambda person: lambda rgb: (self.group, person, rgb)


def test_another_packages_tracker_is_made_for_the_person(monkeypatch):
    monkeypatch.setattr(plugins, "entry_points", lambda group: [FakeEntryPoint(group)])
    assert make_tracker("empty_room", 2)(7) == ("instant_avatar.trackers", 2, 7)
    with pytest.raises(
        InputError, match=r"--tracker vitpose: .*installed are blazepose, empty_room"
    ):
        make_tracker("vitpose")


def test_the_projects_own_tracker_needs_no_entry_point():
    tracker = make_tracker()
    assert isinstance(tracker, BlazePoseTracker)
    assert isinstance(tracker, PersonTracker)


def test_persons_are_counted_from_one():
    with pytest.raises(InputError, match="--person 0: persons are counted from 1"):
        make_tracker(person=0)
