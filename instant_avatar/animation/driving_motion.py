"""Motions that drive an avatar, read or built in and resampled, and the camera that follows."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from capture.camera import Camera
from capture.input_error import InputError, counted
from capture.source import ASSUMED_FPS
from export.player import Player
from instant_avatar.animation.play_arguments import CLOSE_UP_ZOOM, Viewpoint
from instant_avatar.cli.console import Console
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.kinematics import (
    JOINT_NAMES,
    body_from_rest,
    rotation_matrices,
    world_from_body,
)
from preprocess.poses.motion_builder import anchor_at_pelvis
from preprocess.poses.plausibility import plausibility_warnings, require_plausible
from preprocess.poses.pose_format_registry import read_poses


def pose_rate(motion: Motion) -> float:
    """Return the poses per second of a motion, by its times; 30 without plausible times."""
    if motion.times_s is None or len(motion) < 2:
        return ASSUMED_FPS
    step = float(np.median(np.diff(motion.times_s)))
    return round(1.0 / step, 3) if 1.0 / 240.0 <= step <= 10.0 else ASSUMED_FPS


# limbs that the built-in motion moves, and their SMPL joints
L_HIP, R_HIP, L_KNEE, R_KNEE, L_SHOULDER, R_SHOULDER, L_ELBOW, R_ELBOW = range(8)
_JOINTS = np.array([1, 2, 4, 5, 16, 17, 18, 19]) - 1


def demo_motion(frames: int = 90) -> Motion:
    """Turn once at the world's origin, wave and lift the knees; the motion is a loop."""
    phase = np.linspace(0.0, 2.0 * np.pi, frames, endpoint=False)
    steps = np.sin(2.0 * phase)
    joints = np.zeros((frames, 23, 3))
    limbs = np.zeros((frames, 8, 3))
    left, right = np.maximum(steps, 0.0), np.maximum(-steps, 0.0)
    limbs[:, L_HIP, 0], limbs[:, R_HIP, 0] = -0.9 * left, -0.9 * right
    limbs[:, L_KNEE, 0], limbs[:, R_KNEE, 0] = 1.3 * left, 1.3 * right
    limbs[:, L_HIP, 2], limbs[:, R_HIP, 2] = 0.08, -0.08
    limbs[:, L_SHOULDER, 2] = -0.85 + 0.75 * (1.0 - np.cos(phase))
    limbs[:, R_SHOULDER, 2] = 0.85 - 0.35 * (1.0 - np.cos(2.0 * phase))
    limbs[:, L_ELBOW, 2] = 0.35 + 0.3 * np.sin(4.0 * phase)
    limbs[:, R_ELBOW, 1] = 0.5 * (1.0 - np.cos(phase))
    joints[:, _JOINTS] = limbs
    root = np.zeros((frames, 3))
    root[:, 1] = phase
    return Motion(
        root_rotations=root,
        root_translations=np.zeros((frames, 3)),
        joint_rotations=joints,
        valid=np.ones(frames, dtype=bool),
        betas=np.zeros(10),
        body_model="body24",
        times_s=np.arange(frames) / ASSUMED_FPS,
    )


def load_driving_motion(
    path: Path,
    rest_joints: Float[np.ndarray, "24 3"],
    console: Console,
    *,
    person: str | None = None,
) -> Motion:
    """Read poses from a file and anchor them at the avatar's pelvis."""
    read = require_plausible(read_poses(path, person=person, prefer_world=True), path)
    motion = anchor_at_pelvis(read, rest_joints)
    if motion.note is not None:
        console.info(f"note: {motion.note}")
    for sentence in plausibility_warnings(read):
        console.warning(sentence)
    lost = int((~motion.valid).sum())
    if lost == len(motion):
        raise InputError(f"None of the {len(motion)} poses in {path} is valid.")
    if lost:
        console.warning(f"Skipped: {lost} of {counted(len(motion), 'pose')}, not valid.")
    return motion


@dataclass(frozen=True, eq=False, kw_only=True)
class ResampledMotion:
    """A motion sampled at a constant frame rate.

    Attributes:
        valid_rows: Rows of the valid poses, in order.
        positions: Position of each frame in `valid_rows`; fractional between two rows.
    """

    motion: Motion
    valid_rows: Int[np.ndarray, "valid"]
    fps: float
    positions: Float[np.ndarray, "frames"]

    @classmethod
    def of(
        cls, motion: Motion, *, fps: float | None, speed: float = 1.0, max_fps: float = np.inf
    ) -> "ResampledMotion":
        """Resample a motion with a valid pose; without times, it has one pose per frame.

        Without `fps` the motion's own rate is used, divided by an integer to stay within `MAX_FPS`.
        `speed` is a factor on the speed of the motion; `max_fps` limits the result.
        """
        rows, rate = np.flatnonzero(motion.valid), pose_rate(motion)
        # of motion capture at 120 Hz every second pose is shown
        pace = min(fps or rate / float(np.ceil(rate / 60.0 - 1e-6)), max_fps)
        step = speed if motion.times_s is None else speed * rate / pace
        step = 1.0 if abs(step - 1.0) < 1e-3 else step
        count = int((len(rows) - 1) / step + 1e-6) + 1
        return cls(motion=motion, valid_rows=rows, fps=pace, positions=step * np.arange(count))

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.positions)

    def pose(self, frame: int) -> BodyPose:
        """Return the pose of a frame."""
        before, share = self._split_position(frame)
        first = self.motion[int(self.valid_rows[before])]
        if share < 1e-6:
            return first
        return first.towards(self.motion[int(self.valid_rows[before + 1])], share)

    def nearest_row(self, frame: int) -> int:
        """Return the row of the motion nearest to a frame."""
        before, share = self._split_position(frame)
        return int(self.valid_rows[before + (share >= 0.5)])

    def _split_position(self, frame: int) -> tuple[int, float]:
        place = min(float(self.positions[frame]), len(self.valid_rows) - 1.0)
        before = int(place + 1e-6)
        return before, max(0.0, place - before)


PERSON_HEIGHT_SHARE = 0.8
"""Height of the standing person as a fraction of the image height."""
DISTANCE_HEIGHTS = 3.5
"""Distance of the camera, in heights of the person."""
MEASURING_PX = 192
"""Size of the image in which the person is measured."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FollowingCamera:
    """A camera in front of the first pose of a motion, upright as that pose is.

    Trackers do not know the vertical; the first pose of a body mostly shows it.

    Attributes:
        level_axes: Rows: right, down and forward of a level image from the front, in the world.
        height_m: Height of the standing person.
        center_above_pelvis_m: Height of the person's center above the pelvis.
    """

    size_px: tuple[int, int]
    level_axes: Float[np.ndarray, "3 3"]
    player: Player
    height_m: float
    center_above_pelvis_m: float
    viewpoint: Viewpoint

    @classmethod
    def of(
        cls,
        player: Player,
        motion: Motion,
        size_px: int | tuple[int, int],
        viewpoint: Viewpoint | None = None,
    ) -> "FollowingCamera":
        """Build the camera for a motion; measure the person in a small image of a standing pose.

        The first valid pose defines front and up. One number for `size_px` is the side of a square.
        """
        first = int(np.flatnonzero(motion.valid)[0])
        guess = cls(
            size_px=(MEASURING_PX, MEASURING_PX),
            level_axes=np.diag([1.0, -1.0, -1.0]),
            player=player,
            height_m=2.2,
            center_above_pelvis_m=0.0,
            viewpoint=Viewpoint(),
        )
        standing = canonical_pose_of(player)
        rows = np.flatnonzero(
            (player.render(standing, guess.camera_for(standing))[..., 3] > 127).any(1)
        )
        if not len(rows):  # nothing visible: keep the guess
            rows = np.array([0, MEASURING_PX - 1])
        # the guess shows 2.2 m at `PERSON_HEIGHT_SHARE` of the image: meters per pixel
        metres = 2.2 / PERSON_HEIGHT_SHARE / MEASURING_PX
        return replace(
            guess,
            size_px=(size_px, size_px) if isinstance(size_px, int) else size_px,
            level_axes=np.diag([1.0, -1.0, -1.0])
            @ rotation_matrices(motion.root_rotations[first]).T,
            height_m=float(rows[-1] + 1 - rows[0]) * metres,
            center_above_pelvis_m=float(MEASURING_PX - rows[0] - rows[-1] - 1) / 2.0 * metres,
            viewpoint=viewpoint or Viewpoint(),
        )

    def camera_for(self, pose: BodyPose, seconds: float = 0.0) -> Camera:
        """Return the camera for a pose, `seconds` after the first frame."""
        width, height = self.size_px
        away = DISTANCE_HEIGHTS * self.height_m
        # smaller in a tall image, so that arms fit in
        person_px = PERSON_HEIGHT_SHARE * min(height, 1.5 * width)
        zoom = 1.0 if self.viewpoint.joint is None else CLOSE_UP_ZOOM
        # similar triangles: person_px / focal = height_m / away
        focal = person_px * away / self.height_m * zoom
        axes = self.viewpoint.rotation_at(seconds) @ self.level_axes
        return Camera.at(self._look_at_point(pose) - away * axes[2], axes, focal, self.size_px)

    def _look_at_point(self, pose: BodyPose) -> Float[np.ndarray, "3"]:
        manifest, joint = self.player.manifest, self.viewpoint.joint
        pelvis = manifest.rest_joints[0]
        if joint is None:
            return pelvis + pose.root_translation - self.center_above_pelvis_m * self.level_axes[1]
        number = JOINT_NAMES.index(joint)
        body = body_from_rest(manifest.rest_joints, manifest.parents, pose.joint_rotations)
        world = world_from_body(pelvis, pose.root_rotation, pose.root_translation) @ body[number]
        return world[:3, :3] @ manifest.rest_joints[number] + world[:3, 3]


def canonical_pose_of(player: Player) -> BodyPose:
    """Return the canonical pose of an avatar: upright, arms slightly away from the body."""
    return replace(BodyPose.rest(), joint_rotations=player.manifest.canonical_rotations)
