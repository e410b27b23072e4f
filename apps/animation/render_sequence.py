"""What ia-play draws: poses, each with the camera that sees it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from apps.animation.driving_motion import ResampledMotion, demo_motion, load_driving_motion
from apps.animation.following_camera import FollowingCamera, canonical_pose_of
from apps.animation.play_arguments import DEFAULT_SIZE_PX, PlayArguments
from apps.cli.console import Console
from capture.camera import Camera
from capture.input_error import InputError
from export.player import Player
from preprocess.body.body_pose import BodyPose, Motion

TURNTABLE_FPS = 30.0
"""Pictures a second of a turntable about a still pose."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderSequence:
    """Pictures that are still to be drawn.

    Attributes:
        poses, cameras: One each for every picture.
        fps: Pictures a second.
    """

    poses: tuple[BodyPose, ...]
    cameras: tuple[Camera, ...]
    fps: float

    def __len__(self) -> int:
        """How many there are."""
        return len(self.poses)

    def __iter__(self) -> Iterator[tuple[BodyPose, Camera]]:
        """Pose and camera, in order."""
        return zip(self.poses, self.cameras, strict=True)


def plan_render(
    arguments: PlayArguments, player: Player, console: Console, *, max_fps: float = np.inf
) -> RenderSequence:
    """The pictures that the arguments ask for.

    Args:
        given: The arguments.
        player: Of the avatar.
        console: Hears what the user should know about the poses.
        max_fps: Pictures a second that can be written.

    Raises:
        InputError: If a file cannot be used, or the arguments do not fit it.
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
                f"--still {row}: {arguments.poses} holds {len(motion)} poses, 0 to {len(motion) - 1}, "
                f"{int(motion.valid.sum())} of them valid; this is none of them."
            )
        return _plan_single_pose(arguments, player, motion, row, max_fps)
    fps = arguments.fps and min(arguments.fps, max_fps)
    line = ResampledMotion.of(motion, fps=fps, speed=arguments.speed)
    if line.fps > max_fps:
        line = ResampledMotion.of(motion, fps=max_fps, speed=arguments.speed)
    poses = tuple(line.pose(picture) for picture in range(len(line)))
    rows = tuple(line.nearest_row(picture) for picture in range(len(line)))
    return RenderSequence(poses=poses, cameras=_plan_cameras(arguments, player, motion, rows, poses, line.fps),
                 fps=line.fps)  # fmt: skip


def _single_pose_motion(pose: BodyPose) -> Motion:
    """A motion of one pose."""
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
    """One pose: a picture, or all round it."""
    fps = min(arguments.fps or TURNTABLE_FPS, max_fps)
    count = 1
    if arguments.turntable is not None and arguments.output_path.suffix.lower() != ".png":
        count = max(1, round(abs(arguments.turntable) * fps))
    poses = (motion[row],) * count
    valid = np.arange(len(motion)) == row
    held = replace(motion, valid=valid)  # so that the camera stands before this pose
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
    """Cameras of a file, one for each of some rows, as pinholes of a size.

    Args:
        path: As ia-ingest takes it.
        poses: How many poses there are.
        rows: Those that are shown.
        size: Longer side, or width and height, pixels; the file's own if None.

    Raises:
        InputError: If it cannot be read, or does not match poses or size.
    """
    from preprocess.cameras.camera_file import read_cameras, resolve_camera_path

    path = resolve_camera_path(path)
    track = read_cameras(path, _camera_image_size(path))
    if track.is_moving and len(track.cameras) != poses:
        raise InputError(
            f"{path} holds {len(track.cameras)} cameras for {poses} poses; expected one, or one "
            "for each pose."
        )
    return tuple(_resize_camera(track[row], size) for row in rows)


def _camera_image_size(path: Path) -> tuple[int, int]:
    """Width and height that a camera file belongs to; twice its principal point if it is silent."""
    from preprocess.cameras.camera_registry import read_named_cameras
    from preprocess.cameras.multi_view_cameras import (
        find_multi_view_cameras,
        read_multi_view_camera,
    )
    from preprocess.file_content import read_npz

    rig = find_multi_view_cameras(path)
    if rig is not None:
        return read_multi_view_camera(rig, None, None).size_px
    if path.suffix.lower() != ".npz":
        return read_named_cameras(path)[0].camera.size_px

    arrays = read_npz(path, ("width", "height", "intrinsic"))
    if {"width", "height"} <= arrays.keys():
        width, height = (float(arrays[key].reshape(-1)[0]) for key in ("width", "height"))
    elif "intrinsic" in arrays and arrays["intrinsic"].shape[-2:] == (3, 3):
        width, height = (2.0 * float(c) for c in arrays["intrinsic"].reshape(-1, 3, 3)[0, :2, 2])
    else:
        raise InputError(f"{path} holds no camera: expected intrinsic (3, 3), height and width.")
    if not (1.0 <= width <= 16384.0 and 1.0 <= height <= 16384.0):
        raise InputError(f"{path} belongs to pictures of {width:.0f}x{height:.0f} px; up to 16384.")
    return round(width), round(height)


def _resize_camera(camera: Camera, size: int | tuple[int, int] | None) -> Camera:
    """The camera as a pinhole of the size."""
    pinhole = replace(camera, distortion=())
    if not isinstance(size, tuple):
        return pinhole.resize_longer_side(size or max(camera.size_px))
    (width, height), (wide, high) = size, camera.size_px
    if abs(width * high - height * wide) > max(wide, high):
        raise InputError(
            f"--size is {width}x{height}, but --camera takes pictures of {wide}x{high}: another "
            "shape. Give the longer side alone."
        )
    return pinhole.resize(size)
