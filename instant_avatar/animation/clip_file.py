"""Clips: a background behind rendered images, and the files that they are written to."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageColor

from capture.atomic_files import atomic_file, atomic_folder
from capture.camera import Camera
from capture.image_folder import read_image, write_png
from capture.input_error import InputError
from capture.source import ASSUMED_FPS, RgbImage
from capture.video_writer import H264, VP9, VP9_ALPHA, write_video
from export.player import Player
from instant_avatar.animation.driving_motion import (
    FollowingCamera,
    ResampledMotion,
    demo_motion,
    load_driving_motion,
)
from instant_avatar.animation.play_arguments import DEFAULT_SIZE_PX, PlayArguments
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import check_output_file, check_output_folder
from preprocess.body.body_pose import BodyPose

TRANSPARENT = "transparent"
"""Value of --background that keeps alpha."""
CLIP_SUFFIXES = (".webm", ".mp4", ".gif", ".webp", ".png")
"""Suffixes of the files that can be written; a name without one is a folder of frames."""
MAX_GIF_FPS = 50.0
"""Frame rate above which browsers slow a GIF down."""
Rgba = UInt8[np.ndarray, "height width 4"]
BackgroundBlend = Callable[[Rgba], RgbImage]
"""Composites an image with straight alpha over a background."""


def background_compositor(color_or_path: str) -> BackgroundBlend:
    """Return a function that composites images with straight alpha over a background.

    A color ("white", "#203040", "rgb(10, 20, 30)"), or an image file, of which the center is shown.
    """
    try:
        color = np.array(ImageColor.getrgb(color_or_path)[:3], dtype=np.uint8)
    except ValueError:
        color = None
    if color is not None:
        return lambda rgba: _composite_over(rgba, np.broadcast_to(color, (*rgba.shape[:2], 3)))
    path = Path(color_or_path)
    if not path.is_file():
        raise InputError(
            f"--background {color_or_path} is neither a color (white, #203040), nor {TRANSPARENT}, "
            "nor an existing image."
        )
    image, _ = read_image(path)
    cropped = lru_cache(1)(lambda width, height: _crop_to_cover(image, width, height))
    return lambda rgba: _composite_over(rgba, cropped(rgba.shape[1], rgba.shape[0]))


def _composite_over(rgba: Rgba, behind: RgbImage) -> RgbImage:
    alpha = rgba[..., 3:].astype(np.uint16)
    mixed = rgba[..., :3] * alpha + behind * (255 - alpha) + 127
    return (mixed // 255).astype(np.uint8)


def _crop_to_cover(image: UInt8[np.ndarray, "_ _ 3"], width: int, height: int) -> RgbImage:
    rows, columns = image.shape[:2]
    scale = max(width / columns, height / rows)
    wide, high = max(width, round(columns * scale)), max(height, round(rows * scale))
    interpolation = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    scaled = cv2.resize(image, (wide, high), interpolation=interpolation)
    left, top = (wide - width) // 2, (high - height) // 2
    return scaled[top : top + height, left : left + width]


def check_clip_path(path: Path, inputs: Iterable[Path], *, overwrite: bool) -> None:
    """Check that a clip can be written."""
    if path.suffix.lower() in CLIP_SUFFIXES:
        check_output_file(path, "--out", inputs, overwrite=overwrite)
    elif path.suffix and not path.is_dir():
        raise InputError(
            f"{path} ends in {path.suffix!r}, but a clip must end in {', '.join(CLIP_SUFFIXES)}; "
            "a name without a suffix is a folder for PNG frames."
        )
    else:
        check_output_folder(path, "--out", inputs)


@dataclass(frozen=True, kw_only=True)
class ClipFormat:
    """A way to write a clip, with a description for the user.

    `write` takes the path, images of one size (RGB, or RGBA with straight alpha) and the frame
    rate; it returns the number of images written.
    """

    description: str
    write: Callable[[Path, Iterator[RgbImage | Rgba], float], int]


def clip_format(path: Path, *, transparent: bool) -> ClipFormat:
    """Return the format that the suffix of a path selects."""
    suffix = path.suffix.lower()
    if suffix == ".mp4" and transparent:
        raise InputError(
            "--background transparent: an .mp4 has no transparency; .webp, .webm, .gif and a "
            "folder of frames have."
        )
    if suffix in (".mp4", ".webm"):
        codec = H264 if suffix == ".mp4" else VP9_ALPHA if transparent else VP9
        codec.check_available()  # before anything is rendered
        return ClipFormat(description=codec.description, write=partial(write_video, codec=codec))
    if suffix == ".gif":
        description = "a GIF of 256 colors per frame" + ", binary transparency" * transparent
        return ClipFormat(description=description, write=_write_gif)
    if suffix == ".webp":
        return ClipFormat(description="animated WebP", write=_write_webp)
    if suffix == ".png":
        return ClipFormat(description="PNG", write=_write_image)
    return ClipFormat(description="PNG frames", write=_write_frames)


def write_clip(
    path: Path,
    images: Iterable[Rgba],
    *,
    fps: float,
    blend: BackgroundBlend | None,
    replace: bool | None = None,
) -> int:
    """Encode images as a clip, whole or not at all; return their number.

    The images, at least one, are of one size and have straight alpha; it is kept without `blend`.
    `replace` is that of `atomic_file`.
    """
    encoding = clip_format(path, transparent=blend is None)
    is_file = path.suffix.lower() in CLIP_SUFFIXES
    with atomic_file(path, replace=replace) if is_file else atomic_folder(path) as part:
        shown = (image if blend is None else blend(image) for image in images)
        return encoding.write(part, iter(shown), fps)


def _write_image(path: Path, images: Iterator[RgbImage | Rgba], fps: float) -> int:
    write_png(path, next(images))
    return 1


def _write_frames(folder: Path, images: Iterator[RgbImage | Rgba], fps: float) -> int:
    count = 0
    for image in images:
        write_png(folder / f"{count:04d}.png", image)
        count += 1
    return count


def _write_gif(path: Path, images: Iterator[RgbImage | Rgba], fps: float) -> int:
    """Write a palette per frame: 46 dB on white, against 38 dB with one palette for all."""
    frames = [Image.fromarray(_binarize_alpha(image)) for image in images]
    disposal = 2 if frames[0].mode == "RGBA" else 0
    return _save_animation(path, frames, min(fps, MAX_GIF_FPS), tick_ms=10, disposal=disposal)


def _binarize_alpha(image: RgbImage | Rgba) -> RgbImage | Rgba:
    if image.shape[2] == 3:
        return image
    opaque = image[..., 3:] > 127
    return np.where(opaque, image | np.array([0, 0, 0, 255], np.uint8), np.uint8(0))


def _write_webp(path: Path, images: Iterator[RgbImage | Rgba], fps: float) -> int:
    frames = [Image.fromarray(image) for image in images]
    return _save_animation(path, frames, fps, tick_ms=1, quality=90, method=3)


def _save_animation(
    path: Path, frames: list[Image.Image], fps: float, *, tick_ms: int, **options: Any
) -> int:
    """Save frames whose durations are whole ticks, which together keep the frame rate."""
    ends = np.round(1000.0 / tick_ms / fps * np.arange(1 + len(frames)))
    durations_ms = [max(1, int(ticks)) * tick_ms for ticks in np.diff(ends)]
    if len(frames) > 1:
        options |= {"duration": durations_ms, "loop": 0}
    frames[0].save(path, save_all=True, append_images=frames[1:], **options)
    return len(frames)


Shot = tuple[BodyPose, Camera]
"""Pose and camera of one image."""


def plan_render(
    arguments: PlayArguments, player: Player, console: Console, *, max_fps: float = np.inf
) -> tuple[list[Shot], float]:
    """Return the images that the arguments request, and their frame rate."""
    if arguments.poses is not None:
        motion = load_driving_motion(
            arguments.poses, player.manifest.rest_joints, console, person=arguments.person
        )
    elif arguments.turntable is not None and arguments.still is None:
        canonical = player.manifest.canonical_rotations
        motion = replace(demo_motion(1), joint_rotations=canonical[None])
    else:
        motion = demo_motion()
    is_image = arguments.output_path.suffix.lower() == ".png"
    if arguments.still is not None or len(motion) == 1 or is_image:
        row = arguments.still or 0
        if not (0 <= row < len(motion) and motion.valid[row]):
            raise InputError(
                f"--still is {row}, but must be a valid pose: {arguments.poses or 'the motion'} "
                f"holds {len(motion)} poses, 0 to {len(motion) - 1}, {int(motion.valid.sum())} of "
                "them valid."
            )
        motion = replace(motion, valid=np.arange(len(motion)) == row)  # the camera faces this pose
        fps, count = min(arguments.fps or ASSUMED_FPS, max_fps), 1
        if arguments.turntable is not None and not is_image:
            count = max(1, round(abs(arguments.turntable) * fps))
        poses, rows = [motion[row]] * count, [row] * count
    else:
        line = ResampledMotion.of(motion, fps=arguments.fps, speed=arguments.speed, max_fps=max_fps)
        fps = line.fps
        poses = [line.pose(frame) for frame in range(len(line))]
        rows = [line.nearest_row(frame) for frame in range(len(line))]
    if arguments.camera is not None:
        cameras = load_cameras(arguments.camera, len(motion), rows, arguments.size_px)
    else:
        size_px = arguments.size_px or DEFAULT_SIZE_PX
        following = FollowingCamera.of(player, motion, size_px, arguments.viewpoint)
        cameras = [following.camera_for(pose, frame / fps) for frame, pose in enumerate(poses)]
    return list(zip(poses, cameras, strict=True)), fps


def load_cameras(
    path: Path, poses: int, rows: list[int], size: int | tuple[int, int] | None
) -> list[Camera]:
    """Read the cameras of some rows of a motion of `poses` poses as pinhole cameras.

    `size` is the longer side, or width and height, in pixels; None for the file's own.
    """
    from preprocess.cameras.camera_file import read_cameras

    track = read_cameras(path, None)
    if track.is_moving and len(track.cameras) != poses:
        raise InputError(
            f"{path} holds {len(track.cameras)} cameras for {poses} poses, but must hold one, or "
            "one per pose."
        )
    return [_resize_camera(track[row], size) for row in rows]


def _resize_camera(camera: Camera, size: int | tuple[int, int] | None) -> Camera:
    pinhole = replace(camera, distortion=())
    if not isinstance(size, tuple):
        return pinhole.resize_longer_side(size or max(camera.size_px))
    (width, height), (wide, high) = size, camera.size_px
    if abs(width * high - height * wide) > max(wide, high):
        raise InputError(
            f"--size is {width}x{height}, but --camera has images of {wide}x{high}, another aspect "
            "ratio. Give the longer side alone."
        )
    return pinhole.resize(size)
