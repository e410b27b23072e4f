"""What ia-play renders: poses and cameras of a clip, its background, and its file.

Clips, animations, images and folders of frames are written over a background or with alpha.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageColor

from apps.animation.driving_motion import (
    FollowingCamera,
    ResampledMotion,
    canonical_pose_of,
    demo_motion,
    load_driving_motion,
)
from apps.animation.play_arguments import DEFAULT_SIZE_PX, PlayArguments
from apps.cli.console import Console
from apps.cli.shared_options import check_output_file, check_output_folder
from capture.atomic_files import atomic_file, atomic_folder
from capture.camera import Camera
from capture.image_folder import read_image, write_png
from capture.input_error import InputError
from capture.video import ClipEncoder, video_encoder
from export.player import Player
from preprocess.body.body_pose import BodyPose, Motion

TURNTABLE_FPS = 30.0
"""Frames per second of a turntable around a still pose."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderSequence:
    """Images to render.

    Attributes:
        poses: Pose of each image.
        cameras: Camera of each image.
        fps: Frames per second.
    """

    poses: tuple[BodyPose, ...]
    cameras: tuple[Camera, ...]
    fps: float

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.poses)

    def __iter__(self) -> Iterator[tuple[BodyPose, Camera]]:
        """Iterate over pairs of pose and camera."""
        return zip(self.poses, self.cameras, strict=True)


def plan_render(
    arguments: PlayArguments, player: Player, console: Console, *, max_fps: float = np.inf
) -> RenderSequence:
    """Plan the images that the arguments request.

    Args:
        arguments: Of ia-play.
        player: Player of the avatar.
        console: Shows notes and warnings about the poses.
        max_fps: Largest frame rate of the output format.

    Raises:
        InputError: If a file cannot be used, or the arguments do not match it.
    """
    if arguments.poses is None and arguments.turntable is not None:
        motion = _single_pose_motion(canonical_pose_of(player))
    elif arguments.poses is None:
        motion = demo_motion()
    else:
        motion = load_driving_motion(
            arguments.poses, player.manifest.rest_joints, console, person=arguments.person
        )
    one = arguments.still is not None or len(motion) == 1
    if one or arguments.output_path.suffix.lower() == ".png":
        row = arguments.still or 0
        if not (0 <= row < len(motion) and motion.valid[row]):
            raise InputError(
                f"--still is {row}, but must be a valid pose: {arguments.poses} holds "
                f"{len(motion)} poses, 0 to {len(motion) - 1}, {int(motion.valid.sum())} of them "
                "valid."
            )
        return _plan_single_pose(arguments, player, motion, row, max_fps)
    fps = arguments.fps and min(arguments.fps, max_fps)
    line = ResampledMotion.of(motion, fps=fps, speed=arguments.speed)
    if line.fps > max_fps:
        line = ResampledMotion.of(motion, fps=max_fps, speed=arguments.speed)
    poses = tuple(line.pose(picture) for picture in range(len(line)))
    rows = tuple(line.nearest_row(picture) for picture in range(len(line)))
    cameras = _plan_cameras(arguments, player, motion, rows, poses, line.fps)
    return RenderSequence(poses=poses, cameras=cameras, fps=line.fps)


def _single_pose_motion(pose: BodyPose) -> Motion:
    """Return a motion of one pose."""
    return Motion(
        root_rotations=pose.root_rotation[None],
        root_translations=pose.root_translation[None],
        joint_rotations=pose.joint_rotations[None],
        valid=np.ones(1, dtype=bool),
        betas=np.zeros(10),
        body_model="body24",
    )


def _plan_single_pose(
    arguments: PlayArguments, player: Player, motion: Motion, row: int, max_fps: float
) -> RenderSequence:
    """Plan one image of a pose, or a turntable around it."""
    fps = min(arguments.fps or TURNTABLE_FPS, max_fps)
    count = 1
    if arguments.turntable is not None and arguments.output_path.suffix.lower() != ".png":
        count = max(1, round(abs(arguments.turntable) * fps))
    poses = (motion[row],) * count
    valid = np.arange(len(motion)) == row
    held = replace(motion, valid=valid)  # the camera faces this pose
    return RenderSequence(
        poses=poses,
        cameras=_plan_cameras(arguments, player, held, (row,) * count, poses, fps),
        fps=fps,
    )


def _plan_cameras(
    arguments: PlayArguments,
    player: Player,
    motion: Motion,
    rows: tuple[int, ...],
    poses: tuple[BodyPose, ...],
    fps: float,
) -> tuple[Camera, ...]:
    if arguments.camera is not None:
        return load_cameras(arguments.camera, len(motion), rows, arguments.size_px)
    following = FollowingCamera.of(
        player, motion, arguments.size_px or DEFAULT_SIZE_PX, arguments.viewpoint
    )
    return tuple(following.camera_for(pose, number / fps) for number, pose in enumerate(poses))


def load_cameras(
    path: Path, poses: int, rows: tuple[int, ...], size: int | tuple[int, int] | None
) -> tuple[Camera, ...]:
    """Read the cameras of some poses as pinhole cameras of a size.

    Args:
        path: Camera file, as in ia-ingest.
        poses: Number of poses of the motion.
        rows: Poses that are shown.
        size: Longer side, or width and height, pixels; None for the file's own.

    Raises:
        InputError: If the file cannot be read, or does not match poses or size.
    """
    from preprocess.cameras.camera_file import read_cameras

    track = read_cameras(path, None)
    if track.is_moving and len(track.cameras) != poses:
        raise InputError(
            f"{path} holds {len(track.cameras)} cameras for {poses} poses, but must hold one, or "
            "one per pose."
        )
    return tuple(_resize_camera(track[row], size) for row in rows)


def _resize_camera(camera: Camera, size: int | tuple[int, int] | None) -> Camera:
    """Return the camera as a pinhole camera of a size."""
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


TRANSPARENT = "transparent"
"""Value of --background that keeps alpha."""
CLIP_SUFFIXES = (".webm", ".mp4", ".gif", ".webp", ".png")
"""Suffixes of the files that can be written; a name without one is a folder of frames."""
MAX_GIF_FPS = 50.0
"""Frame rate above which browsers slow a GIF down."""

Rgba = UInt8[np.ndarray, "height width 4"]
Rgb = UInt8[np.ndarray, "height width 3"]
BackgroundBlend = Callable[[Rgba], Rgb]
"""Composites an image with straight alpha over a background."""


def background_compositor(color_or_path: str) -> BackgroundBlend:
    """Return a function that composites images with straight alpha over a background.

    Args:
        color_or_path: A color ("white", "#203040", "rgb(10, 20, 30)"), or the path of an image, of
            which the center is shown.

    Raises:
        InputError: If it is neither.
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
    picture, _ = read_image(path)
    fitted = lru_cache(1)(lambda width, height: _crop_to_cover(picture, width, height))
    return lambda rgba: _composite_over(rgba, fitted(rgba.shape[1], rgba.shape[0]))


def _composite_over(rgba: Rgba, behind: Rgb) -> Rgb:
    alpha = rgba[..., 3:].astype(np.uint16)
    mixed = rgba[..., :3] * alpha + behind * (255 - alpha) + 127
    return (mixed // 255).astype(np.uint8)


def _crop_to_cover(
    picture: UInt8[np.ndarray, "_ _ 3"], width: int, height: int
) -> UInt8[np.ndarray, "height width 3"]:
    rows, columns = picture.shape[:2]
    scale = max(width / columns, height / rows)
    wide, high = max(width, round(columns * scale)), max(height, round(rows * scale))
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    scaled = cv2.resize(picture, (wide, high), interpolation=how)
    left, top = (wide - width) // 2, (high - height) // 2
    return scaled[top : top + height, left : left + width]


def check_clip_path(path: Path, inputs: Iterable[Path], *, overwrite: bool) -> None:
    """Check that a clip can be written.

    Args:
        path: A clip, an image, or a folder for frames.
        inputs: Files that are read and must not be written to.
        overwrite: Whether an existing file may be replaced.

    Raises:
        InputError: If the suffix is unknown, or the path may not be written.
    """
    if path.suffix and path.suffix.lower() not in CLIP_SUFFIXES and not path.is_dir():
        raise InputError(
            f"{path} ends in {path.suffix!r}, but a clip must end in {', '.join(CLIP_SUFFIXES)}; "
            "a name without a suffix is a folder for PNG frames."
        )
    if path.is_dir():
        if path.suffix.lower() in CLIP_SUFFIXES:
            raise InputError(
                f"{path} is a folder, but its name is that of a clip. Choose another name."
            )
    elif path.exists() and path.suffix.lower() not in CLIP_SUFFIXES:
        raise InputError(f"{path} is a file, but must be a folder for PNG frames.")
    if path.suffix.lower() in CLIP_SUFFIXES:
        check_output_file(path, "--out", inputs, overwrite=overwrite)
    else:
        check_output_folder(path, "--out", inputs)


def choose_encoder(path: Path, blend: BackgroundBlend | None) -> ClipEncoder:
    """Choose the encoder by the suffix of a path.

    Args:
        path: Clip to write.
        blend: The background; None keeps alpha.

    Raises:
        InputError: If the format has no alpha.
    """
    suffix = path.suffix.lower()
    if suffix == ".gif":
        hard = ", binary transparency" if blend is None else ""
        return ClipEncoder(description=f"a GIF of 256 colors per frame{hard}", write=_write_gif)
    if suffix == ".webp":
        return ClipEncoder(description="animated WebP", write=_write_webp)
    if suffix == ".png":
        return ClipEncoder(description="PNG", write=_write_image)
    if suffix not in CLIP_SUFFIXES:
        return ClipEncoder(description="PNG frames", write=_write_frames)
    return video_encoder(suffix, transparent=blend is None)


def write_clip(
    path: Path,
    images: Iterable[Rgba],
    *,
    fps: float,
    blend: BackgroundBlend | None,
    encoder: ClipEncoder,
    replace: bool | None = None,
) -> int:
    """Encode images as a clip, whole or not at all.

    Args:
        path: File or folder to write.
        images: With straight alpha, all of one size; at least one.
        fps: Frames per second.
        blend: The background; None keeps alpha.
        encoder: From `choose_encoder`.
        replace: Whether an existing file may be replaced, as in `atomic_file`.

    Returns:
        The number of frames written.

    Raises:
        OSError: If the disk is full; then nothing is written.
    """
    is_file = path.suffix.lower() in CLIP_SUFFIXES
    with atomic_file(path, replace=replace) if is_file else atomic_folder(path) as part:
        shown = (picture if blend is None else blend(picture) for picture in images)
        return encoder.write(part, iter(shown), fps)


def _write_image(path: Path, pictures: Iterator[Rgba | Rgb], fps: float) -> int:
    write_png(path, next(pictures))
    return 1


def _write_frames(folder: Path, pictures: Iterator[Rgba | Rgb], fps: float) -> int:
    count = 0
    for picture in pictures:
        write_png(folder / f"{count:04d}.png", picture)
        count += 1
    return count


def _write_gif(path: Path, pictures: Iterator[Rgba | Rgb], fps: float) -> int:
    """Write a palette per frame: 46 dB on white, against 38 dB with one palette for all."""
    first, *others = [_binarize_alpha(picture) for picture in pictures]
    ends = np.round(
        100.0 * np.arange(2 + len(others)) / min(fps, MAX_GIF_FPS)
    )  # hundredths of seconds
    frame_ms = [int(10 * step) for step in np.diff(ends)]
    moving = {"save_all": True, "append_images": others, "duration": frame_ms, "loop": 0}
    first.save(path, disposal=2 if first.mode == "RGBA" else 0, **moving)
    return 1 + len(others)


def _binarize_alpha(picture: Rgba | Rgb) -> Image.Image:
    if picture.shape[2] == 3:
        return Image.fromarray(picture)
    hard = picture.copy()
    hard[..., 3] = np.where(hard[..., 3] > 127, 255, 0)
    hard[hard[..., 3] == 0] = 0
    return Image.fromarray(hard)


def _write_webp(path: Path, pictures: Iterator[Rgba | Rgb], fps: float) -> int:
    first, *others = [Image.fromarray(picture) for picture in pictures]
    ends = np.round(1000.0 * np.arange(2 + len(others)) / fps)
    frame_ms = [max(1, int(step)) for step in np.diff(ends)]
    moving = {"save_all": True, "append_images": others, "duration": frame_ms, "loop": 0}
    first.save(path, format="WEBP", quality=90, method=3, **(moving if others else {}))
    return 1 + len(others)
