"""Poses and cameras of the images that ia-play renders."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from capture.camera import Camera
from capture.input_error import InputError
from capture.source import ASSUMED_FPS
from export.player import Player
from instant_avatar.animation.driving_motion import (
    FollowingCamera,
    ResampledMotion,
    demo_motion,
    load_driving_motion,
)
from instant_avatar.animation.play_arguments import DEFAULT_SIZE_PX, PlayArguments
from instant_avatar.cli.console import Console
from preprocess.body.body_pose import BodyPose

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
