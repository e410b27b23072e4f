"""Folders of pictures, whole and damaged."""

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from capture.input_error import InputError
from capture.source_opening import open_source


def test_pictures_come_in_natural_order_and_exactly(write_images):
    source = open_source(write_images(12))
    frames = list(source.frames())
    assert [frame.index for frame in frames] == list(range(12))
    assert [int(frame.rgb[0, 0, 0]) for frame in frames] == [20 + 11 * i for i in range(12)]
    assert frames[0].rgb[0, 60].tolist() == [220, 0, 0]
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(12) / 30)
    assert source.frame_count == source.count_frames() == 12
    assert not source.warnings


def test_a_selection_of_pictures_keeps_their_numbers(write_images):
    source = open_source(write_images(12), frames=slice(1, 10, 3))
    assert [frame.index for frame in source.frames()] == [1, 4, 7]
    assert source.frame_count == 3


def test_an_alpha_channel_comes_along(tmp_path):
    rgba = np.random.default_rng(0).integers(0, 255, (8, 6, 4), dtype=np.uint8)
    Image.fromarray(rgba).save(tmp_path / "0.png")
    source = open_source(tmp_path)
    (frame,) = source.frames()
    assert source.has_alpha
    np.testing.assert_array_equal(frame.rgb, rgba[..., :3])
    np.testing.assert_array_equal(frame.alpha, rgba[..., 3])


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
def test_a_cut_off_picture_is_left_out_and_told(write_images, suffix, capfd):
    folder = write_images(3, suffix=suffix)
    path = folder / f"shot_1{suffix}"
    path.write_bytes(path.read_bytes()[:-40])
    source = open_source(folder)
    assert [frame.index for frame in source.frames()] == [0, 2]
    assert "shot_1" in source.warnings[0]
    assert capfd.readouterr().err == ""


def test_a_picture_that_cannot_be_read_or_has_another_size_is_left_out(write_images, capfd):
    folder = write_images(5)
    (folder / "shot_1.png").write_bytes(b"no picture")
    (folder / "shot_2.png").write_bytes(b"")
    cv2.imwrite(str(folder / "shot_3.png"), np.zeros((10, 10, 3), np.uint8))
    source = open_source(folder)
    assert [frame.index for frame in source.frames()] == [0, 4]
    assert len(source.warnings) == 3
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


def test_a_folder_of_damaged_pictures_is_refused(tmp_path):
    for index in range(3):
        (tmp_path / f"{index}.png").write_bytes(b"\x89PNG")
    with pytest.raises(InputError, match=tmp_path.name):
        open_source(tmp_path)


def test_a_capture_folder_gives_its_images_or_its_only_video(write_images, write_video, tmp_path):
    video = write_video("video.mp4", frames=3)
    assert open_source(tmp_path).path == video
    folder = write_images(4, name="images")
    assert open_source(tmp_path).path == folder


def test_a_video_of_masks_and_hidden_files_are_not_the_film(write_video, tmp_path):
    film = write_video(frames=3)
    folder = tmp_path / "capture"
    folder.mkdir()
    for name in ("masks", "take"):
        (folder / f"{name}{film.suffix}").write_bytes(film.read_bytes())
    (folder / f"._take{film.suffix}").write_bytes(b"macOS")
    assert open_source(folder).path == folder / f"take{film.suffix}"
    (folder / f"take{film.suffix}").unlink()
    assert open_source(folder).path == folder / f"masks{film.suffix}"


def test_two_videos_in_a_folder_are_too_many(write_video, tmp_path):
    write_video("a.mp4", frames=2)
    write_video("b.mp4", frames=2)
    with pytest.raises(InputError, match=r"a\.mp4, b\.mp4"):
        open_source(tmp_path)


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


def test_an_alpha_channel_that_cuts_nothing_out_is_none(tmp_path):
    rgba = np.full((8, 6, 4), 255, np.uint8)
    Image.fromarray(rgba).save(tmp_path / "0.png")
    assert not open_source(tmp_path).has_alpha
