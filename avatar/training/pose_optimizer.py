"""Pose refinement: corrects the tracker's poses during training.

A tracker's jitter of 2° and 1 cm costs 5-8 dB, more than anything else on real people. The field's
gradient at a sample reaches the pose through the warp's implicit derivative, root included, as one
wrench per bone (`avatar.kernels.numba_pose`). A few hundred rays of a frame make one
Gauss-Newton step (`pose_correction`), to which the rays of its last steps are added; exact poses do
not move, and are soon probed rarely.
A correction that all frames share is a change of the canonical body rather than an error of a
frame, so the mean correction is removed continually.
"""

import math
from typing import NamedTuple, final

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32
from scipy.spatial.transform import Rotation
from torch import Tensor

from avatar.kernels.numba_pose import largest_distance, move_pose, pose_joints
from avatar.kernels.operands import SkinningVolume
from avatar.rig import Rig
from avatar.training.pose_correction import (
    MIN_EVIDENCE,
    JointFrames,
    RaySums,
    TemporalPosePrior,
    gauss_newton_step,
)
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import body_from_rest, rotation_matrices

MIN_POSE_GRADIENT_CELL_M = 0.0105
"""Smallest cells of the hash levels whose gradient reaches the poses, metres. Finer levels point to
the right place from a few millimetres away only, and win nothing; without those below 37 mm poses
drift in long trainings, which costs 2 dB in new poses."""
EVIDENCE_EMA_DECAY = 0.95
"""Decay of the mean evidence and of the share of corrections that moved a pose."""
RESOLVE_DISTANCE_M = 0.08
"""Motion of a joint after which the frame's correspondences are solved again, metres."""
FIRST_CORRECTION_STEPS = 60
"""Training steps on a frame before its pose is first corrected. Earlier the field does not know the
view, and new content looks like a pose error."""
MIN_ESTIMATES_BEFORE_FREEZE = 3
"""Gauss-Newton estimates of a pose before it may be frozen as exact."""
FREEZE_AFTER_STEPS = 3000
"""Training steps on a frame after which its pose is frozen; by then the field has memorised it."""


class RootCorrection(NamedTuple):
    """Correction of a frame's root relative to the tracker's pose.

    A point x of the given body frame is at `pivot + rotationᵀ (x - pivot - shift)` in the corrected
    one, metres. The pivot is the pelvis in the rest pose.
    """

    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]
    pivot: Float[np.ndarray, "3"]


@final
class PoseOptimizer:
    """Poses of the replay frames and their corrections.

    A correction has 75 numbers: axis-angle rotations of the root and of 23 joints, each applied in
    its own frame before the tracker's rotation, and the root's shift in the given body frame, m.

    Attributes:
        min_gradient_cell_m: Smallest cells of the hash levels whose gradient reaches the poses.
        bones: Body-from-canonical transforms of the corrected poses.
    """

    def __init__(
        self,
        rig: Rig,
        capacity: int,
        *,
        poses_may_be_exact: bool = True,
        rays_per_frame: int = 512,
        prior_precision: float = 1.0,
        equation_decay: float = 0.85,  # the noise of 512 rays alone is as large as what is left
    ) -> None:
        """Starts without poses.

        Args:
            poses_may_be_exact: Whether a pose moves only where its rays agree that it is wrong, and
                then by half steps. Otherwise, with estimated poses or a fixed avatar, every pose
                makes whole steps.
            rays_per_frame: Most rays of a frame that one correction of its pose follows.
            prior_precision: Precision of the given poses, relative to that of a tracker's.
            equation_decay: Factor of a pose's earlier normal equations at each correction, in
                [0, 1); not used where poses may be exact.
        """
        self.rig = rig
        self._rays_per_frame, self._prior_precision = rays_per_frame, prior_precision
        self._equation_decay = 0.0 if poses_may_be_exact else equation_decay
        self._parents = np.array(rig.parents, dtype=np.int64)
        self._rays = RaySums(self._parents, capacity, with_moments=poses_may_be_exact)
        self.poses_may_be_exact = poses_may_be_exact
        self.min_gradient_cell_m = MIN_POSE_GRADIENT_CELL_M
        self.corrections: Float[np.ndarray, "slots 25 3"] = np.zeros((capacity, 25, 3))
        self.bones: Float32[Tensor, "slots 24 12"] = torch.zeros(capacity, 24, 12)
        self.skinning = SkinningVolume(
            torch.from_numpy(rig.weights),
            torch.from_numpy(rig.box_low),
            torch.from_numpy(rig.nodes_per_m),
        )
        self._tracker_poses: list[BodyPose | None] = [None] * capacity
        self._given_turns = np.zeros((capacity, 23, 3, 3))
        self._joints = JointFrames(
            np.zeros((capacity, 24, 3, 3), dtype=np.float32),
            np.zeros((capacity, 24, 3), dtype=np.float32),
            np.zeros((capacity, 3, 3)),
        )
        self._joints_at_solve = np.zeros((capacity, 24, 3), dtype=np.float32)
        self._rest_from_canonical = np.linalg.inv(
            body_from_rest(rig.rest_joints, rig.parents, rig.canonical_rotations)
        )
        self._moved_share, self._evidence = 1.0, MIN_EVIDENCE
        self._added_at_step = np.zeros(capacity, dtype=np.int64)
        self._can_freeze, self._is_frozen = np.zeros((2, capacity), dtype=bool)
        self._estimate_count, self._evidence_sum = np.zeros((2, capacity))
        self._temporal_prior = TemporalPosePrior(capacity)
        self._is_correctable = np.ones(capacity, dtype=bool)
        self._is_held = np.zeros(capacity, dtype=bool)

    def set_pose(
        self,
        slot: int,
        pose: BodyPose,
        correction: Float[np.ndarray, "25 3"] | None = None,
        *,
        frame: int | None = None,
        step: int = 0,
    ) -> None:
        """Assigns the tracker's pose of a frame, trained on from `step`, to a slot.

        Neighbors by the index `frame` have similar errors; None if the frame has no neighbors.
        """
        self._tracker_poses[slot] = pose
        self._added_at_step[slot] = step
        self._is_correctable[slot] = self._is_held[slot] = True
        self._is_frozen[slot] = False
        self._temporal_prior.set_frame(slot, frame)
        self._estimate_count[slot] = self._evidence_sum[slot] = 0.0
        self.corrections[slot] = 0.0
        if correction is not None:
            self.corrections[slot] = correction
        self._given_turns[slot] = rotation_matrices(pose.joint_rotations)
        self._rays.clear(slot)
        self._update_bones(slot)
        self._joints_at_solve[slot] = self._joints.places[slot]

    def pose(self, slot: int) -> BodyPose:
        """The corrected pose."""
        given = self._tracker_poses[slot]
        assert given is not None
        turn, *joints = self.corrections[slot, :24]
        shift = self.corrections[slot, 24]
        root = Rotation.from_rotvec(given.root_rotation)
        turned = root * Rotation.from_rotvec(turn)
        place = root.apply(shift) + given.root_translation
        return BodyPose(
            root_rotation=turned.as_rotvec(),
            root_translation=place,
            joint_rotations=(
                Rotation.from_rotvec(given.joint_rotations) * Rotation.from_rotvec(np.array(joints))
            ).as_rotvec(),
        )

    def freeze_converged(self, step: int) -> bool:
        """Freezes converged poses, and returns whether any pose may be corrected now.

        Poses of new frames wait; poses that proved exact, or that may be exact and were refined
        long enough, are frozen.
        """
        age = step - self._added_at_step
        self._can_freeze = age >= 300
        if self.poses_may_be_exact:
            evidence = self._evidence_sum / self._estimate_count.clip(min=1)
            # else noise moves it, the motion blurs the field, and the field moves the next pose
            exact = (self._estimate_count >= MIN_ESTIMATES_BEFORE_FREEZE) & (
                0.5 * (evidence + self._evidence) < 1.3
            )
            self._is_frozen |= exact | (age >= FREEZE_AFTER_STEPS)
        open_now = self._is_held & ~self._is_frozen & (age >= FIRST_CORRECTION_STEPS)
        self._is_correctable = open_now
        self._rays.counts *= open_now
        return bool(open_now.any())

    def accumulate(
        self,
        slots: Int32[Tensor, "rays"],
        wrenches: Float32[Tensor, "rays 24 6"],
        loss: Float32[Tensor, "rays"],
    ) -> None:
        """Accumulates the wrenches of a step's rays on their frames' bones."""
        self._rays.add(
            slots.numpy(), wrenches.numpy(), loss.numpy(),
            self._rays_per_frame * self._is_correctable, self._joints,
        )  # fmt: skip

    def correct_next(self, *, rate: float) -> int | None:
        """Corrects the pose with the most accumulated rays; its roots and rays have to follow.

        Returns its slot, or None if no frame has enough rays or the pose does not move.
        """
        slot = int(self._rays.counts.argmax())
        if self._rays.counts[slot] < 0.5 * self._rays_per_frame:
            return None
        evidence = self._evidence if self.poses_may_be_exact else math.inf
        prior = self._temporal_prior.prior_for(slot, self.corrections)
        step = gauss_newton_step(
            self._rays.equations(slot),
            self.corrections[slot],
            evidence,
            prior=prior._replace(precision=self._prior_precision * prior.precision),
        )
        self._evidence = (
            EVIDENCE_EMA_DECAY * self._evidence + (1.0 - EVIDENCE_EMA_DECAY) * step.evidence
        )
        if self._can_freeze[slot]:
            self._estimate_count[slot] += 1.0
            self._evidence_sum[slot] += step.evidence
        change = step.change
        moves = bool(change.any())
        self._moved_share += (1.0 - EVIDENCE_EMA_DECAY) * (moves - self._moved_share)
        change *= rate
        if moves and self.poses_may_be_exact:
            mean = self.corrections[self._is_held].mean(axis=0)
            # gradients are up to fifty steps old, and steps too long turn the field to fog;
            # estimated poses gain more from whole steps, though
            change *= 0.5
            change -= 0.2 * mean
        if moves:
            self._move_pose(slot, change)
        self._rays.fade(slot, change, self._equation_decay)
        return slot if moves else None

    def correction_interval(self, rate: float) -> int:
        """Steps between pose gradients: more where poses prove to be exact, or steps are short."""
        if self.poses_may_be_exact:
            return min(max(round(0.5 / max(self._moved_share, 1e-3)), 1), 8)
        return min(max(round(0.5 / max(rate, 1e-3)), 1), 4)

    def needs_resolve(self, slot: int) -> bool:
        """Checks if the slot's pose is too far from the one its correspondences were solved for.

        The caller is expected to solve them when the answer is True.
        """
        places = self._joints.places[slot]
        moved = largest_distance(places, self._joints_at_solve[slot])
        if moved > RESOLVE_DISTANCE_M:
            self._joints_at_solve[slot] = places
        return moved > RESOLVE_DISTANCE_M

    def root_correction(self, slot: int) -> RootCorrection:
        """Motion of the slot's rays by its root correction."""
        turn, shift = self._joints.root_turns[slot], self.corrections[slot, 24]
        return RootCorrection(rotation=turn, shift=shift, pivot=self.rig.rest_joints[0])

    def _move_pose(self, slot: int, change: Float[np.ndarray, "25 3"]) -> None:
        """Changes a correction as far as the frame's roots can follow; writes how far it did."""
        turns, places, root_turns = self._joints
        move_pose(
            # at most 0.35 rad or m, else it cannot be recovered; a step of 4 cm: roots must follow
            self.corrections[slot], change, 0.35, 0.04,
            self._given_turns[slot], self.rig.rest_joints, self._parents,
            self._rest_from_canonical, turns[slot], places[slot], self.bones.numpy()[slot],
            root_turns[slot],
        )  # fmt: skip

    def _update_bones(self, slot: int) -> None:
        turns, places, root_turns = self._joints
        pose_joints(
            self._given_turns[slot], self.corrections[slot], self.rig.rest_joints, self._parents,
            self._rest_from_canonical, turns[slot], places[slot], self.bones.numpy()[slot],
            root_turns[slot],
        )  # fmt: skip
