"""What ia-play draws: poses, each with the camera that sees it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from apps.playing.arguments import SIZE_PX, PlayArguments
from apps.playing.driving import driving_motion
from apps.playing.follow import FollowingCamera, standing_pose
from apps.playing.novel import novel_motion
from apps.playing.timeline import Timeline
from apps.terminal.console import Console
from capture.camera import Camera
from capture.errors import BadInput
from export.player import Player
from preprocess.pose import BodyPose, Motion

STILL_FPS = 30.0
"""Pictures a second of a turntable about a still pose."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Shots:
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


def shots_of(
    given: PlayArguments, player: Player, console: Console, *, most_fps: float = np.inf
) -> Shots:
    """The pictures that the arguments ask for.

    Args:
        given: The arguments.
        player: Of the avatar.
        console: Hears what the user should know about the poses.
        most_fps: Pictures a second that can be written.

    Raises:
        BadInput: If a file cannot be used, or the arguments do not fit it.
    """
    if given.poses is None and given.turntable is not None:
        motion = _held(standing_pose(player))
    elif given.poses is None:
        motion = novel_motion()
    else:
        motion = driving_motion(
            given.poses, player.manifest.rest_joints, console, person=given.person
        )
    one = given.still is not None or len(motion) == 1
    if one or given.clip.suffix.lower() == ".png":
        row = given.still or 0
        if not (0 <= row < len(motion) and motion.valid[row]):
            raise BadInput(
                f"--still {row}: {given.poses} holds {len(motion)} poses, 0 to {len(motion) - 1}, "
                f"{int(motion.valid.sum())} of them valid; this is none of them."
            )
        return _of_one(given, player, motion, row, most_fps)
    fps = given.fps and min(given.fps, most_fps)
    line = Timeline.of(motion, fps=fps, speed=given.speed)
    if line.fps > most_fps:
        line = Timeline.of(motion, fps=most_fps, speed=given.speed)
    poses = tuple(line.pose(picture) for picture in range(len(line)))
    rows = tuple(line.row(picture) for picture in range(len(line)))
    return Shots(poses=poses, cameras=_cameras(given, player, motion, rows, poses, line.fps),
                 fps=line.fps)  # fmt: skip


def _held(pose: BodyPose) -> Motion:
    """A motion of one pose."""
    return Motion(
        root_rotations=pose.root_rotation[None],
        root_translations=pose.root_translation[None],
        joint_rotations=pose.joint_rotations[None],
        valid=np.ones(1, dtype=bool),
        betas=np.zeros(10),
        model="body24",
    )


def _of_one(
    given: PlayArguments, player: Player, motion: Motion, row: int, most_fps: float
) -> Shots:
    """One pose: a picture, or all round it."""
    fps = min(given.fps or STILL_FPS, most_fps)
    count = 1
    if given.turntable is not None and given.clip.suffix.lower() != ".png":
        count = max(1, round(abs(given.turntable) * fps))
    poses = (motion[row],) * count
    valid = np.arange(len(motion)) == row
    held = replace(motion, valid=valid)  # so that the camera stands before this pose
    return Shots(
        poses=poses, cameras=_cameras(given, player, held, (row,) * count, poses, fps), fps=fps
    )


def _cameras(
    given: PlayArguments,
    player: Player,
    motion: Motion,
    rows: tuple[int, ...],
    poses: tuple[BodyPose, ...],
    fps: float,
) -> tuple[Camera, ...]:
    if given.camera is not None:
        return cameras_from(given.camera, len(motion), rows, given.size_px)
    following = FollowingCamera.of(player, motion, given.size_px or SIZE_PX, given.viewpoint)
    return tuple(following.at(pose, number / fps) for number, pose in enumerate(poses))


def cameras_from(
    path: Path, poses: int, rows: tuple[int, ...], size: int | tuple[int, int] | None
) -> tuple[Camera, ...]:
    """Cameras of a file, one for each of some rows, as pinholes of a size.

    Args:
        path: As ia-ingest takes it.
        poses: How many poses there are.
        rows: Those that are shown.
        size: Longer side, or width and height, pixels; the file's own if None.

    Raises:
        BadInput: If it cannot be read, or does not match poses or size.
    """
    from preprocess.camera_file import cameras_in, read_cameras

    path = cameras_in(path)
    track = read_cameras(path, _picture_size(path))
    if track.moves and len(track.cameras) != poses:
        raise BadInput(
            f"{path} holds {len(track.cameras)} cameras for {poses} poses; expected one, or one "
            "for each pose."
        )
    return tuple(_fitted(track[row], size) for row in rows)


def _picture_size(path: Path) -> tuple[int, int]:
    """Width and height that a camera file belongs to; twice its principal point if it is silent."""
    from preprocess.cameras.door import read_named
    from preprocess.cameras.rigs import find_rig, read_rig
    from preprocess.npz import read_npz

    rig = find_rig(path)
    if rig is not None:
        return read_rig(rig, None, None).size_px
    if path.suffix.lower() != ".npz":
        return read_named(path)[0].camera.size_px

    arrays = read_npz(path, ("width", "height", "intrinsic"))
    if {"width", "height"} <= arrays.keys():
        width, height = (float(arrays[key].reshape(-1)[0]) for key in ("width", "height"))
    elif "intrinsic" in arrays and arrays["intrinsic"].shape[-2:] == (3, 3):
        width, height = (2.0 * float(c) for c in arrays["intrinsic"].reshape(-1, 3, 3)[0, :2, 2])
    else:
        raise BadInput(f"{path} holds no camera: expected intrinsic (3, 3), height and width.")
    if not (1.0 <= width <= 16384.0 and 1.0 <= height <= 16384.0):
        raise BadInput(f"{path} belongs to pictures of {width:.0f}x{height:.0f} px; up to 16384.")
    return round(width), round(height)


def _fitted(camera: Camera, size: int | tuple[int, int] | None) -> Camera:
    """The camera as a pinhole of the size."""
    pinhole = replace(camera, distortion=())
    if not isinstance(size, tuple):
        return pinhole.fitted(size or max(camera.size_px))
    (width, height), (wide, high) = size, camera.size_px
    if abs(width * high - height * wide) > max(wide, high):
        raise BadInput(
            f"--size is {width}x{height}, but --camera takes pictures of {wide}x{high}: another "
            "shape. Give the longer side alone."
        )
    return pinhole.resized(size)
