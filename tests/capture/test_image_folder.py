"""Folders of pictures, whole, damaged, and growing."""

import os
import shutil
import threading

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from capture.input_error import InputError
from capture.live_sources import WatchedImageFolder
from capture.source import FrameSelection, PacingClock
from capture.source_opening import open_source
from preprocess.tracked_stream import TrackedStream


def test_pictures_come_in_natural_order_and_exactly(write_images):
    source = open_source(write_images(12))
    frames = list(source.frames())
    assert [frame.index for frame in frames] == list(range(12))
    assert [int(frame.rgb[0, 0, 0]) for frame in frames] == [20 + 11 * i for i in range(12)]
    assert frames[0].rgb[0, 60].tolist() == [220, 0, 0]
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(12) / 30)
    assert source.frame_count == source.count_frames() == 12
    assert not source.warnings
    some = open_source(source.path, frames=slice(1, 10, 3))
    assert [frame.index for frame in some.frames()] == [1, 4, 7]
    assert some.frame_count == 3


@pytest.mark.parametrize("ending", ["png", "webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_colors_and_alpha_are_rotated_together(tmp_path, ending, orientation):
    """Each pixel is as opaque as it is red, however the file is turned or mirrored."""
    ramp = np.arange(128, 248, dtype=np.uint8).reshape(10, 12)
    rgba = np.stack([ramp, ramp // 2, 255 - ramp, ramp], axis=-1)
    exif = Image.Exif()
    exif[0x0112] = orientation
    lossless = {"lossless": True} if ending == "webp" else {}
    Image.fromarray(rgba).save(tmp_path / f"0.{ending}", exif=exif, **lossless)
    source = open_source(tmp_path)
    (frame,) = source.frames()
    shown = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / f"0.{ending}")))
    np.testing.assert_array_equal(frame.alpha, shown[..., 3])
    np.testing.assert_array_equal(frame.rgb, shown[..., :3])


def test_grey_and_16_bit_pictures_become_8_bit_rgb(tmp_path):
    grey = np.arange(48, dtype=np.uint8).reshape(6, 8)
    cv2.imwrite(str(tmp_path / "0.png"), grey)
    cv2.imwrite(str(tmp_path / "1.png"), grey.astype(np.uint16) * 257)
    for frame in open_source(tmp_path).frames():
        np.testing.assert_array_equal(frame.rgb, np.repeat(grey[..., None], 3, axis=2))


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_picture_that_cannot_be_read_or_has_another_size_is_left_out(write_images, suffix, capfd):
    folder = write_images(5, suffix=suffix)
    cut_off = folder / f"shot_1{suffix}"
    cut_off.write_bytes(cut_off.read_bytes()[:-40])
    (folder / f"shot_2{suffix}").write_bytes(b"")
    cv2.imwrite(str(folder / f"shot_3{suffix}"), np.zeros((10, 10, 3), np.uint8))
    source = open_source(folder)
    assert [frame.index for frame in source.frames()] == [0, 4]
    assert len(source.warnings) == 3
    assert "shot_1" in source.warnings[0]
    assert "10x10" in source.warnings[2]
    assert len(list(source.frames())) == 2
    assert len(source.warnings) == 3
    assert capfd.readouterr().err == ""


def test_a_folder_without_pictures_is_refused(tmp_path):
    with pytest.raises(InputError, match=tmp_path.name):
        open_source(tmp_path)
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(InputError, match=r"\.txt"):
        open_source(tmp_path)
    for index in range(3):
        (tmp_path / f"{index}.png").write_bytes(b"\x89PNG")
    with pytest.raises(InputError, match=tmp_path.name):
        open_source(tmp_path)


def test_a_folder_gives_its_images_or_the_only_video_that_is_not_of_masks(
    write_images, write_video, tmp_path
):
    masks = write_video("masks.mp4", frames=2)
    assert open_source(tmp_path).path == masks
    film = write_video("a.mp4", frames=2)
    (tmp_path / "._b.mp4").write_bytes(b"macOS")
    assert open_source(tmp_path).path == film
    write_video("b.mp4", frames=2)
    with pytest.raises(InputError, match=r"a\.mp4, b\.mp4"):
        open_source(tmp_path)
    images = write_images(4, name="images")
    assert open_source(tmp_path).path == images


@pytest.mark.parametrize(
    "name",
    ["{}.png", "{:06d}.jpg", "frame_{:04d}.JPG", "IMG_{}.JPEG", "image-{}.webp", "f{}.bmp",
     "color_{:03d}.tiff", "clip.{:04d}.png", "rgb {} (1).png"],
)  # fmt: skip
def test_pictures_of_any_common_name_come_in_the_order_of_their_numbers(tmp_path, name):
    for index in (10, 2, 0, 9, 1, 11, 3, 8, 4, 7, 5, 6):
        grey = np.full((16, 16, 3), 20 * index, np.uint8)
        Image.fromarray(grey).save(tmp_path / name.format(index))
    (tmp_path / "Thumbs.db").write_bytes(b"no picture")
    (tmp_path / ("._" + name.format(0))).write_bytes(b"no picture either")
    frames = list(open_source(tmp_path).frames())
    assert [round(float(frame.rgb.mean()) / 20) for frame in frames] == list(range(12))


class Writer:
    """Writes images into a folder while the clock, which stands still otherwise, is waited on."""

    def __init__(self, folder) -> None:
        self.folder, self.now_s = folder, 0.0
        self.pace = PacingClock(clock=self.clock, wait=self.wait)
        self._plan, self._lock = [], threading.Lock()

    def clock(self):
        return self.now_s

    def wait(self, seconds):
        """Pass time; what is due meanwhile is done, whichever thread waits."""
        with self._lock:
            self.now_s += seconds
            while self._plan and self._plan[0][0] <= self.now_s:
                self._plan.pop(0)[1]()

    def at(self, seconds, work):
        self._plan.append((seconds, work))

    def write(self, index, content=None, written_s=None):
        data = cv2.imencode(".png", np.full((6, 8, 3), index, np.uint8))[1].tobytes()
        path = self.folder / f"shot_{index}.png"
        path.write_bytes(data if content is None else content(data))
        if written_s is not None:
            os.utime(path, (written_s, written_s))

    def watch(self, *, idle_s=3.0, selection=None, watch_s=None):
        selection = selection or FrameSelection()
        return WatchedImageFolder(self.folder, selection, self.pace, idle_s=idle_s, watch_s=watch_s)


@pytest.fixture
def writer(tmp_path):
    return Writer(tmp_path)


def greys(frames):
    return [int(frame.rgb[0, 0, 0]) for frame in frames]


def cut_off(data):
    return data[:30]


def test_images_come_as_they_are_written_and_in_natural_order(writer):
    for index in range(14):
        writer.at(0.2 * index, lambda index=index: writer.write(index))
    writer.at(3.0, (writer.folder / "DONE").touch)
    source = writer.watch(idle_s=20.0)
    frames = list(source.frames())
    assert writer.now_s < 10.0  # DONE ended it, not the wait for another image
    assert greys(frames) == [frame.index for frame in frames] == list(range(14))
    times = [frame.time_s for frame in frames]
    assert times == sorted(set(times))
    assert source.paced
    assert source.waited_s > 2.0


@pytest.mark.parametrize("stamps", ["as written", "kept by mv", "all the same", "descending"])
def test_none_of_65_images_is_lost_however_late_its_turn_and_whatever_its_time_stamp(
    writer, stamps
):
    """They come at 2.5 a second, and tracking takes twice as long as that for each."""
    kept = {
        "as written": lambda index: None,
        "kept by mv": lambda index: 1e9 + 0.04 * index,
        "all the same": lambda index: 1e9,
        "descending": lambda index: 1e9 - index,
    }[stamps]
    for index in range(65):
        writer.at(0.4 * index, lambda index=index: writer.write(index, written_s=kept(index)))
    stream, taken = TrackedStream(writer.watch(idle_s=6.0)), []
    for frame in stream.frames():
        taken.append(frame)
        writer.wait(0.8)
    assert greys(taken) == [frame.index for frame in taken] == list(range(65))
    assert stream.dropped == 0
    assert not stream.warnings
    assert (np.diff([frame.time_s for frame in taken]) > 0.03).all()


def test_images_that_came_together_are_as_far_apart_as_they_were_filmed(writer):
    for index in range(5):
        writer.write(index, written_s=1e9 + 0.25 * index)
    times = [frame.time_s for frame in writer.watch().frames()]
    assert np.allclose(times, 0.25 * np.arange(5))


def test_an_image_whose_name_comes_before_earlier_ones_is_taken_when_it_comes(writer):
    writer.write(5)
    writer.at(1.0, lambda: writer.write(3))
    writer.at(2.0, lambda: writer.write(9))
    frames = list(writer.watch().frames())
    assert greys(frames) == [5, 3, 9]
    assert [frame.index for frame in frames] == [0, 1, 2]


def test_it_ends_when_nothing_new_comes_although_images_still_wait(writer):
    for index in range(8):
        writer.write(index)
    taken = []
    for frame in writer.watch(idle_s=2.0).frames():
        taken.append(frame)
        writer.wait(1.0)
    assert greys(taken) == list(range(8))
    assert writer.now_s < 8.5


def test_what_comes_after_the_time_is_not_waited_for(writer):
    for index in range(20):
        writer.at(float(index), lambda index=index: writer.write(index))
    frames = greys(writer.watch(watch_s=5.5).frames())
    assert frames == list(range(len(frames)))
    assert 5 <= len(frames) <= 7


def test_a_folder_that_stays_empty_is_refused(writer, tmp_path):
    with pytest.raises(InputError, match="No image came into"):
        writer.watch(idle_s=0.1)
    with pytest.raises(InputError, match="no folder"):
        Writer(tmp_path / "none").watch()


def test_a_half_written_image_is_waited_for_although_its_time_stamp_is_old(writer):
    writer.write(0)
    writer.write(1, content=cut_off, written_s=1e9)

    def finish():
        writer.write(1, written_s=1e9)
        writer.write(2)

    writer.at(1.5, finish)
    source = writer.watch()
    assert greys(source.frames()) == [0, 1, 2]
    assert not source.warnings


def test_an_image_that_stays_damaged_is_left_out_and_named(writer):
    for index in range(3):
        writer.write(index, content=cut_off if index == 1 else None)
    source = writer.watch()
    assert [frame.index for frame in source.frames()] == [0, 2]
    assert "shot_1.png" in source.warnings[0]


def test_a_folder_that_is_unplugged_ends_the_stream(writer):
    for index in range(3):
        writer.write(index)
    source = writer.watch(idle_s=30.0)
    frames = source.frames()
    assert next(frames).index == 0
    shutil.rmtree(writer.folder)
    assert [frame.index for frame in frames] == []
    assert any("no longer be read" in warning for warning in source.warnings)


def test_closing_ends_the_watch_at_once(writer):
    writer.write(0)
    source = writer.watch(idle_s=3600.0)
    writer.at(1.0, source.close)
    assert greys(source.frames()) == [0]
    assert writer.now_s < 2.0


def test_a_selection_counts_images_in_the_order_of_arrival(writer):
    for index in range(12):
        writer.write(index)
    source = writer.watch(selection=FrameSelection(start=1, stop=9, step=3))
    assert greys(source.frames()) == [1, 4, 7]
    assert source.count_frames() == 12
