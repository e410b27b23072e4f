"""Streams without poses: frames are tracked as they come, and late ones are left out."""

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from capture.input_error import InputError
from capture.source import Frame, FrameSelection, FrameSource
from preprocess import tracked_stream
from preprocess.body.body_surface import splat_silhouette
from preprocess.body.parametric_body import load_body_model
from preprocess.cameras.camera_file import CameraTrack, assume_camera, write_cameras
from preprocess.capture_inputs import CaptureInputs, CapturePaths
from preprocess.capture_session import Capture
from preprocess.fitting.tracked_frames import CHUNK_FRAMES
from preprocess.observation import DroppedFrame
from preprocess.open_capture import open_tracked_stream
from preprocess.tracked_stream import (
    LiveTracking,
    SkippedFrames,
    TrackedMasks,
    TrackedObservations,
    TrackedStream,
)
from preprocess.tracking.keypoints import CroppedMask, PersonKeypoints
from preprocess.tracking.video_tracking import NOT_FOUND

pytestmark = pytest.mark.usefixtures("one_iteration")  # key points and masks here are exact
COUNT = 24
SIZE = (180, 320)


class Pictures(FrameSource):
    """A source of empty frames; its clock is the test's."""

    paced, size_px = True, SIZE
    frames_in_file, frame_count, duration_s = COUNT, COUNT, COUNT / 30.0

    def __init__(self, due_s=None) -> None:
        super().__init__(Path("film.mp4"), FrameSelection())
        self._due_s = due_s

    def frames(self):
        for index in range(COUNT):
            rgb = np.full((SIZE[1], SIZE[0], 3), 80, np.uint8)
            yield Frame(index=index, time_s=index / 30.0, rgb=rgb, due_s=self._due_s)


@pytest.fixture(scope="module")
def standing(shaped):
    """Key points of the embedded body, who stands before the camera, from its own joints."""
    joints = shaped.joints * (1.0, -1.0, -1.0)  # facing the camera, whose y points down
    points = np.tile(joints[15], (33, 1))
    points[[11, 12, 13, 14, 15, 16]] = joints[16:22]
    points[[23, 24, 25, 26, 27, 28]] = joints[[1, 2, 4, 5, 7, 8]]
    points[17:23] = points[[15, 16] * 3]
    points[29:33] = joints[[7, 8, 10, 11]]
    camera = assume_camera(Path("film.mp4"), "static", Pictures())
    pixels = camera.project(points + np.array([0.0, 0.2, 2.6]))
    skin = shaped.vertices * (1.0, -1.0, -1.0) + np.array([0.0, 0.2, 2.6])
    silhouette = np.where(splat_silhouette(skin, camera), 255, 0).astype(np.uint8)
    return PersonKeypoints(
        image_px=pixels, world_m=points - joints[[1, 2]].mean(axis=0), visibility=np.ones(33),
        presence=1.0, mask=CroppedMask(values=silhouette, image_from_crop=np.eye(3)[:2]),
    )  # fmt: skip


class Tracker:
    """Finds the person in all frames but some."""

    def __init__(self, found, absent=()) -> None:
        self._found, self._absent, self.calls = found, absent, 0

    def __call__(self, rgb):
        self.calls += 1
        return None if self.calls - 1 in self._absent else self._found


def plain(rgb, mask, size_px):
    return mask.resample((rgb.shape[1], rgb.shape[0]), size_px)


def started(tracker, source=None, *advice):
    stream = TrackedStream(source or Pictures())
    tracking = LiveTracking(stream, tracker, *advice)
    camera = assume_camera(Path("film.mp4"), "static", stream)
    start = tracking.start(load_body_model(None).with_shape(), camera)
    return stream, tracking, start


def observations(stream, tracking, start):
    capture = Capture(
        paths=CapturePaths(video=stream.path, poses=stream.path, masks=None, cameras=None),
        source=stream, motion=start[0], masks=TrackedMasks(tracking, plain),
        cameras=start[2], shaped=start[1], size_px=max(SIZE), provenance=(),
    )  # fmt: skip
    return TrackedObservations(capture, tracking)


def observe_all(stream, tracking, start):
    source = observations(stream, tracking, start)
    return [source.join(frame) for frame in stream.frames()]


def test_every_frame_waits_for_later_ones_and_lost_ones_are_dropped_and_reported(standing):
    tracker, seen = Tracker(standing, absent={10, 11}), {}
    stream, tracking, start = started(tracker)
    source = observations(stream, tracking, start)
    for number, frame in enumerate(stream.frames()):
        assert tracker.calls >= min(COUNT, number + 1 + CHUNK_FRAMES)
        seen[frame.index] = source.join(frame)
    assert list(seen) == list(range(COUNT))
    for lost in (10, 11):
        assert seen.pop(lost) == DroppedFrame(index=lost, reason=NOT_FOUND)
    places = np.array([item.pose.root_translation for item in seen.values()])
    assert np.abs(np.diff(places, axis=0)).max() < 0.02
    assert all(item.alpha.max() > 0.9 for item in seen.values())
    (note,) = tracking.notes()
    assert "not found in 2 of 24 frames, between 0.3 and 0.4 s" in note


class Filmed(Pictures):
    """What is being filmed, by a tracker that is busy with a frame until seven more have come."""

    skippable = True

    def __init__(self, found) -> None:
        super().__init__(due_s=0.0)
        self._found, self.looked_at = found, []
        self._begun, self._free = threading.Semaphore(0), threading.Semaphore(0)

    def frames(self):
        for frame in super().frames():
            yield frame
            if frame.index % 7 == 0:  # the newest one
                if frame.index:
                    self._free.release()
                assert self._begun.acquire(timeout=10.0)
        self._free.release(COUNT)

    def __call__(self, rgb):
        self._begun.release()
        assert self._free.acquire(timeout=10.0)
        return self._found


def test_the_tracker_looks_at_the_newest_frame_and_at_skipped_ones_when_filming_is_over(standing):
    source, looked_at = Filmed(standing), []
    advise = lambda frame, found: looked_at.append(frame.index)  # noqa: E731
    stream, tracking, start = started(source, source, advise)
    seen = observe_all(stream, tracking, start)
    order = [item.frame.index for item in seen]
    assert stream.all_came  # rates fall from then on, while skipped frames follow
    assert looked_at == order[:5] == [0, 7, 14, 21, 23]  # advice is about now
    assert order[5:] == sorted(order[5:])
    assert np.diff(sorted(order)).max() <= 4
    assert np.diff(sorted(order)).min() >= 2
    places = np.array([item.pose.root_translation for item in seen])
    assert np.abs(np.diff(places, axis=0)).max() < 0.06  # of 3.3 m; rounding of processors: 0.051
    assert f"{len(order)} of 24 frames were tracked, {len(order) - 5}" in next(tracking.notes())


def test_no_skipped_frame_is_kept_once_enough_are_tracked(standing, monkeypatch):
    monkeypatch.setattr(tracked_stream, "LEAST_FRAMES", 2)
    source = Filmed(standing)
    stream = TrackedStream(source)
    stream.search = lambda frame, is_new: source(frame.rgb)
    tracked = [stream.take_next() for _ in range(3)]
    assert tracked == [True] * 3
    assert not stream._skipped._kept  # 160 MiB of them, of a film that goes on
    assert not any(frame.due_s is None for frame in stream.frames())  # none follows


@given(st.lists(st.booleans(), min_size=1, max_size=120), st.integers(1, 30))
@settings(max_examples=30, deadline=None)
def test_skipped_frames_that_are_taken_make_no_gap_larger(tracked, count):
    skipped = SkippedFrames()
    picture = np.zeros((1, 1, 3), np.uint8)
    for number, is_tracked in enumerate(tracked):
        frame = Frame(index=number, time_s=number / 5.0, rgb=picture)
        skipped.mark(frame.time_s) if is_tracked else skipped.add(frame)
    before = gaps([i for i, mark in enumerate(tracked) if mark], len(tracked))
    taken = [frame.index for frame in skipped.take(count)]
    assert taken == sorted(taken)
    assert len(taken) == min(count, len(tracked) - sum(tracked))
    after = gaps(sorted([*taken, *(i for i, m in enumerate(tracked) if m)]), len(tracked))
    assert max(after) <= max(before)


def gaps(places, count):
    return np.diff([-1, *places, count]) if places else np.array([count + 1])


def test_skipped_frames_keep_to_their_memory(monkeypatch):
    picture = np.zeros((8, 8, 3), np.uint8)
    monkeypatch.setattr(tracked_stream, "KEPT_BYTES", 10 * picture.nbytes)
    skipped = SkippedFrames()
    for number in range(200):
        skipped.add(Frame(index=number, time_s=number / 5.0, rgb=picture))
    taken = [frame.index for frame in skipped.take(100)]
    assert 5 <= len(taken) <= 10
    assert np.diff([*taken, 200]).max() <= 40


def test_of_a_fast_camera_every_second_frame_is_taken(standing):
    stream, tracking, start = started(Tracker(standing), Pictures(due_s=90.0))
    seen = observe_all(stream, tracking, start)
    assert [item.frame.index for item in seen] == list(range(0, COUNT, 2))
    assert stream.dropped == 0


def test_a_stream_without_a_person_is_bad_input(standing):
    with pytest.raises(InputError, match="24 frames searched"):
        started(Tracker(standing, absent=set(range(COUNT))))


def test_a_finished_avatars_person_keeps_the_body(standing, shaped):
    stream = TrackedStream(Pictures())
    tracking = LiveTracking(stream, Tracker(standing))
    person = replace(shaped, joints=1.1 * shaped.joints, vertices=1.1 * shaped.vertices)
    camera = assume_camera(Path("film.mp4"), "static", stream)
    _, kept, _ = tracking.start(person, camera, fixed_body=True)
    assert np.allclose(kept.joints, person.joints)


def test_a_stated_focal_length_changes_less_than_an_assumed_one(standing, shaped):
    changes = []
    for stated in (False, True):
        stream = TrackedStream(Pictures())
        tracking = LiveTracking(stream, Tracker(standing))
        guess = assume_camera(Path("film.mp4"), "static", stream).scale_focal(1.3)
        _, _, cameras = tracking.start(shaped, guess, stated_focal=stated)
        changes.append(abs(np.log(cameras[0].focal_px[0] / guess.focal_px[0])))
    assert changes[1] < 0.5 * changes[0]


def test_a_live_folder_takes_the_focal_length_of_a_camera_file(standing, tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for number in range(tracked_stream.START_FRAMES):
        Image.new("RGB", SIZE, (80, 80, 80)).save(folder / f"{number:04d}.png")
    (folder / "DONE").touch()
    assumed = assume_camera(folder, "static", Pictures())
    stated = assumed.scale_focal(1.3)
    for file in (folder / "cameras.npz", tmp_path / "named.npz"):
        write_cameras(file, CameraTrack(cameras=(stated,), source="file"))

    def off(cameras: str | None) -> float:
        named = CaptureInputs(video=folder, live=True, cameras=cameras)
        opened = open_tracked_stream(named, Tracker(standing), lambda size: plain, tmp_path / "p")
        return abs(np.log(opened.capture.cameras[0].focal_px[0] / stated.focal_px[0]))

    assert max(off(None), off(str(tmp_path / "named.npz"))) < 0.5 * off("static")


def test_a_camera_has_no_files_beside_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.savez("cameras.npz", intrinsic=np.eye(3))
    camera = assume_camera(Path("camera:0"), None, Pictures())
    assert camera.focal_px == assume_camera(Path("film.mp4"), "static", Pictures()).focal_px
