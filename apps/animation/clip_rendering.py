"""Poses and cameras of the images that ia-play renders."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from apps.animation.driving_motion import (
    FollowingCamera,
    ResampledMotion,
    canonical_pose_of,
    demo_motion,
    load_driving_motion,
)
from apps.animation.play_arguments import DEFAULT_SIZE_PX, PlayArguments
from apps.cli.console import Console
from capture.camera import Camera
from capture.input_error import InputError
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
    """Plan the images that the arguments request."""
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
