"""Clips: what is written of pictures, with what, and of which poses."""

import base64
import json
import os
import signal

import av
import numpy as np
import pytest
from PIL import Image

from capture.input_error import InputError
from export.player import Player
from instant_avatar import play
from instant_avatar.animation.clip_file import (
    background_compositor,
    clip_format,
    write_clip,
)
from instant_avatar.animation.driving_motion import FollowingCamera, canonical_pose_of, demo_motion
from instant_avatar.animation.play_arguments import Viewpoint
from preprocess.poses.pose_format_registry import read_poses
from tests.instant_avatar.browser import Browser, with_chromium


def disc(count, *, height=60, width=80):
    """A soft orange disc that moves to the right, straight alpha."""
    y, x = np.mgrid[:height, :width]
    for number in range(count):
        away = np.hypot(x - 25.0 - 4.0 * number, y - 30.0)
        picture = np.zeros((height, width, 4), dtype=np.uint8)
        picture[..., :3] = [230, 130, 40]
        picture[..., 3] = np.clip((18.0 - away) * 60.0, 0, 255)
        yield picture


def written(path, pictures, *, blend, fps=25.0):
    return write_clip(path, pictures, fps=fps, blend=blend)


@pytest.mark.parametrize(("suffix", "codec"), [(".webm", "vp9"), (".mp4", "h264")])
@pytest.mark.parametrize("color", ["#808080", "#4080c0", "#c8d2dc"])
def test_a_video_has_the_colors_that_were_drawn_at_any_size_and_pace(
    tmp_path, suffix, codec, color
):
    path, blend = tmp_path / f"clip{suffix}", background_compositor(color)
    pictures = list(disc(6, height=61, width=79))
    assert written(path, pictures, blend=blend, fps=23.976) == 6
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        assert stream.codec_context.name == codec
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert int(stream.codec_context.colorspace) == 1  # BT.709, as it is written
        assert float(stream.average_rate) == pytest.approx(23.976, rel=1e-3)
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(stream)]
    assert np.shape(frames) == (6, 62, 80, 3)
    for frame, rgba in zip(frames, pictures, strict=True):
        expected = blend(rgba).astype(float)
        off = frame[:61, :79] - expected
        assert np.abs(off.mean(axis=(0, 1))).max() < 3.5
        assert np.abs(off[:8].mean(axis=(0, 1))).max() < 3.5


def test_an_mp4_begins_with_its_index_so_that_it_plays_while_it_comes(tmp_path):
    path = tmp_path / "a.mp4"
    written(path, disc(3), blend=background_compositor("white"))
    content = path.read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")


@pytest.mark.parametrize("suffix", [".mp4", ".webm"])
def test_a_build_without_the_encoder_says_so_before_anything_is_drawn(
    tmp_path, monkeypatch, suffix
):
    monkeypatch.setattr(av, "codecs_available", {"mpeg4", "h264"})
    with pytest.raises(InputError, match=r"PyAV .* built without lib(x264|vpx-vp9).*--only-binary"):
        clip_format(tmp_path / f"a{suffix}", transparent=False)


SHOWN_IN_A_PAGE = """(async (url, kind) => {
  const clip = document.createElement(kind), canvas = document.createElement("canvas");
  await new Promise((done, fail) => {
    if (clip.requestVideoFrameCallback) clip.requestVideoFrameCallback(done);
    else clip.onload = done;
    clip.onerror = () => fail(new Error(clip.error?.message ?? "no picture"));
    Object.assign(clip, { muted: true, src: url });
    clip.play?.();
  });
  clip.pause?.();
  canvas.width = clip.videoWidth ?? clip.naturalWidth;
  canvas.height = clip.videoHeight ?? clip.naturalHeight;
  const paint = canvas.getContext("2d");
  paint.drawImage(clip, 0, 0);
  return [canvas.width, canvas.height, clip.duration ?? 0,
          [...paint.getImageData(30, 30, 1, 1).data], [...paint.getImageData(2, 2, 1, 1).data]];
})"""
"""Size, seconds, and two pixels: in the disc, and outside of it."""


@pytest.mark.slow
@with_chromium
def test_clips_play_in_a_browser_with_their_alpha(tmp_path):
    white = background_compositor("white")
    with Browser(tmp_path / "browser") as browser:
        for name, blend in (
            ("a.mp4", white),
            ("a.webm", None),
            ("b.webm", white),
            ("a.webp", None),
        ):
            path = tmp_path / name
            written(path, list(disc(1)) * 10, blend=blend)
            kind = "img" if path.suffix == ".webp" else "video"
            mime = {".webp": "image/webp"}.get(path.suffix, f"video/{path.suffix[1:]}")
            url = f"data:{mime};base64,{base64.b64encode(path.read_bytes()).decode()}"
            shown = browser.run(f"{SHOWN_IN_A_PAGE}({json.dumps(url)}, {json.dumps(kind)})")
            width, height, seconds, inside, outside = shown
            assert (width, height) == (80, 60)
            assert seconds == pytest.approx(0.0 if kind == "img" else 10 / 25, abs=0.05)
            np.testing.assert_allclose(inside, [230, 130, 40, 255], atol=8)
            np.testing.assert_allclose(outside, [0] * 4 if blend is None else [255] * 4, atol=3)


def test_a_webm_keeps_soft_alpha(tmp_path):
    path = tmp_path / "a.webm"
    written(path, disc(4), blend=None)
    decoder, frames = av.CodecContext.create("libvpx-vp9", "r"), []
    with av.open(str(path)) as file:
        assert file.streams.video[0].metadata["alpha_mode"] == "1"
        for packet in file.demux(file.streams.video[0]):
            frames += decoder.decode(packet)
    assert len(frames) == 4
    for frame, rgba in zip(frames, disc(4), strict=True):
        alpha = frame.to_ndarray(format="rgba")[..., 3].astype(int)
        assert np.abs(alpha - rgba[..., 3]).mean() < 2.0


@pytest.mark.parametrize(("suffix", "mean_or_max"), [(".webp", np.mean), (".gif", np.max)])
def test_a_picture_that_moves_keeps_its_pace_and_is_clear_where_nothing_is(
    tmp_path, suffix, mean_or_max
):
    """WebP's alpha is soft and exact; a pixel of a GIF is clear or opaque."""
    path, lasted_ms = tmp_path / f"a{suffix}", 0
    assert written(path, disc(7), blend=None, fps=30.0) == 7
    with Image.open(path) as clip:
        assert clip.n_frames == 7
        for number, rgba in enumerate(disc(7)):
            clip.seek(number)
            frame = np.asarray(clip.convert("RGBA")).astype(int)
            lasted_ms += clip.info["duration"]
            if suffix == ".webp":
                np.testing.assert_array_equal(frame[..., 3], rgba[..., 3])
            else:
                np.testing.assert_array_equal(frame[..., 3], 255 * (rgba[..., 3] > 127))
            inside = frame[..., 3] == 255
            assert mean_or_max(np.abs(frame[inside][:, :3] - [230, 130, 40])) <= 4.0
    assert lasted_ms == pytest.approx(7 / 30 * 1000, abs=5)


def test_a_png_is_one_picture_exactly(tmp_path):
    (picture,) = disc(1)
    for blend, expected in (
        (None, picture),
        (background_compositor("teal"), background_compositor("teal")(picture)),
    ):
        path = tmp_path / "a.png"
        assert written(path, disc(1), blend=blend) == 1
        with Image.open(path) as image:
            np.testing.assert_array_equal(np.asarray(image), expected)


SIZE = 64


@pytest.fixture(scope="module")
def frames(package, tmp_path_factory):
    """What ia-play draws into a folder, as pictures."""
    out = tmp_path_factory.mktemp("drawn") / "frames"

    def frames(*arguments, code=0):
        words = [package, *arguments, "--out", out, "--size", SIZE]
        assert play.main([str(word) for word in words]) == code
        files = sorted(out.glob("*.png"))
        return np.stack([np.asarray(Image.open(file)).astype(int) for file in files])

    return frames


@pytest.fixture(scope="module")
def whole(frames, novel):
    """All of a motion, drawn by one worker."""
    return frames("--poses", novel, "--workers", 1)


def test_a_turntable_shows_all_sides_and_ends_where_it_began(frames, player):
    drawn = frames("--turntable", "2", "--fps", "4")
    assert len(drawn) == 8
    pose = canonical_pose_of(player)
    for picture, degrees in ((0, 0.0), (2, 90.0), (4, 180.0), (7, 315.0)):
        view = Viewpoint(orbit_deg=degrees)
        camera = FollowingCamera.of(player, demo_motion(2), SIZE, view).camera_for(pose)
        assert np.abs(drawn[picture] - player.render(pose, camera)).mean() < 0.1


def test_a_turntable_turns_about_a_motion_while_it_plays(frames, whole, player, novel):
    turning = frames("--poses", novel, "--turntable", "4")
    assert len(whole) == len(turning) == 12
    np.testing.assert_array_equal(turning[0], whole[0])
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


@pytest.mark.parametrize(
    ("wishes", "count"),
    [
        ("--turntable --fps 1", 6),
        ("--turntable -3 --fps 1", 3),
        ("--turntable 2 --fps 2 --close-up head", 4),
        ("--still 20 --close-up head", 1),
        ("--still 20 --turntable 2 --fps 2", 4),
    ],
)
def test_without_poses_a_still_and_a_turntable_show_the_built_in_motion(frames, wishes, count):
    assert len(frames(*wishes.split())) == count


def test_frames_are_clear_unless_a_background_is_wished(frames, novel, tmp_path, rng):
    wall = rng.integers(0, 256, (SIZE, 2 * SIZE, 3), dtype=np.uint8)
    middle = wall[:, SIZE // 2 : -SIZE // 2]
    Image.fromarray(wall).save(tmp_path / "wall.png")
    clear = frames("--poses", novel, "--still", 0)[0]
    behind = clear[..., 3] == 0
    assert clear.shape[2] == 4
    assert behind.any()
    on_wall = frames("--poses", novel, "--still", 0, "--background", tmp_path / "wall.png")[0]
    np.testing.assert_array_equal(on_wall[behind], middle[behind])
    on_red = frames("--poses", novel, "--still", 0, "--background", "red")[0]
    assert (on_red[behind] == [255, 0, 0]).all()
    inside = clear[..., 3] == 255
    np.testing.assert_array_equal(on_red[inside], clear[inside][:, :3])
    same = frames("--poses", novel, "--still", 0, "--background", "transparent")[0]
    np.testing.assert_array_equal(same, clear)


def test_pictures_do_not_depend_on_the_workers(frames, whole, novel):
    np.testing.assert_array_equal(frames("--poses", novel, "--workers", 3), whole)


@pytest.fixture
def interrupted(monkeypatch):
    """Ctrl-C is pressed in the sixth picture of a player."""
    render, drawn = Player.render, []

    def interrupt(*arguments, **keywords):
        drawn.append(None)
        if len(drawn) == 6:
            os.kill(os.getpid(), signal.SIGINT)
        return render(*arguments, **keywords)

    monkeypatch.setattr(Player, "render", interrupt)


def test_ctrl_c_keeps_what_several_workers_drew(frames, whole, novel, interrupted):
    kept = frames("--poses", novel, "--workers", 3, code=130)
    assert 1 <= len(kept) < 12
    np.testing.assert_array_equal(kept, whole[: len(kept)])


def test_ctrl_c_leaves_a_clip_that_plays(call_play, package, novel, tmp_path, interrupted):
    out = tmp_path / "clip.webp"
    outcome = call_play(package, "--poses", novel, "--out", out, "--workers", 1, "--size", SIZE)
    assert outcome.code == 130
    with Image.open(out) as clip:
        assert 1 <= clip.n_frames < 12
        assert f"Rendered {clip.n_frames} of 12 frames" in outcome.err
    assert [file.name for file in tmp_path.iterdir()] == ["clip.webp"]
