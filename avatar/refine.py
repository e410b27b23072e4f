"""Pose refinement: trackers' poses corrected while the avatar is learnt.

A tracker's jitter of 2° and 1 cm costs 5-8 dB, more than anything else on real people. The field's
gradient at a sample reaches the pose through the warp's implicit derivative, root included, as one
wrench per bone (`avatar.kernels.cpu_pose`). What all frames share is no error of a frame but a
change of the canonical body, so the mean correction is taken out again and again.
"""

from typing import final

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from scipy.spatial.transform import Rotation
from torch import Tensor

from avatar.kernels.backend import Skin
from avatar.replay import RootCorrection
from avatar.rig import Rig
from preprocess.kinematics import body_from_rest, rotation_matrices
from preprocess.pose import BodyPose

STEP_M = 1.2e-2
"""How far a correction that is sure of itself moves what hangs on a joint, metres."""
MOMENTS = 0.9, 0.95
"""Memory of the gradient's mean and of its square, as Adam's. The mean starts at 0, uncorrected:
the first gradients, of a field that knows little, move nothing much."""
ENOUGH_RAYS = 256
"""A frame's pose moves when this many of its rays have been seen since it last did."""
STRAYED_M = 0.04
"""When a joint has moved this far since the frame's warp was solved, it is solved anew."""
MEAN_PULL = 0.2
"""Share of the mean correction taken out of a frame's at each of its corrections."""
FORGOTTEN = 0.03
"""Share of a correction that is given up at each step: what the pictures do not ask for goes."""
FARTHEST = 0.35
"""A correction never grows beyond this, in radians or metres: a pose that far off is lost."""


@final
class PoseTable:
    """The poses of the frames in replay, each with its correction.

    A correction is 75 numbers: axis-angles of the root and of 23 joints, applied in each one's own
    frame before the given rotation, and the root's shift in the given body frame, metres.

    Attributes:
        corrections: (slots, 25, 3): root rotation, joint rotations, root shift.
        bones: Body-from-canonical matrices of the corrected poses.
        wrenches: What has been found out about each slot since its pose last moved.
    """

    def __init__(
        self, rig: Rig, capacity: int, device: torch.device, *, mean_pull: float = MEAN_PULL
    ) -> None:
        """A table without poses.

        Args:
            rig: Whose body.
            capacity: How many poses it may hold.
            device: Where gradients are gathered.
            mean_pull: Share of the mean correction taken out at each correction; 0 where the
                canonical body is known already.
        """
        self.rig = rig
        self._mean_pull = mean_pull
        self.corrections: Float[np.ndarray, "slots 25 3"] = np.zeros((capacity, 25, 3))
        self.bones: Float32[Tensor, "slots 24 12"] = torch.zeros(capacity, 24, 12, device=device)
        nodes = np.array(rig.weights.shape[:3], dtype=np.float32) - 1
        self.skin = Skin(
            torch.from_numpy(rig.weights).to(device),
            torch.from_numpy(rig.box_low).to(device),
            torch.from_numpy(nodes / (rig.box_high - rig.box_low)).to(device),
        )
        self.wrenches: Float32[Tensor, "slots 24 6"] = torch.zeros(capacity, 24, 6, device=device)
        self._rays = torch.zeros(capacity, dtype=torch.int64, device=device)
        self._given: list[BodyPose | None] = [None] * capacity
        self._first = np.zeros((capacity, 25, 3))
        self._second = np.zeros((capacity, 25, 3))
        self._times = np.zeros(capacity, dtype=int)
        self._posed = np.zeros((capacity, 24, 4, 4))
        self._solved_at = np.zeros((capacity, 24, 3))
        self._rest_from_canonical = np.linalg.inv(
            body_from_rest(rig.rest_joints, rig.parents, rig.canonical_rotations)
        )
        self._below = _subtrees(rig)
        self._lever = np.append(_levers(rig, self._below), 1.0)

    def put(
        self, slot: int, pose: BodyPose, correction: Float[np.ndarray, "25 3"] | None = None
    ) -> None:
        """Takes in a frame's given pose, and its correction if one is known."""
        self._given[slot] = pose
        for values in (self.corrections, self._first, self._second, self._times):
            values[slot] = 0
        if correction is not None:
            self.corrections[slot] = correction
        self.wrenches[slot] = 0.0
        self._rays[slot] = 0
        self._move(slot)
        self._solved_at[slot] = self._joint_places(slot)

    def pose(self, slot: int) -> BodyPose:
        """The corrected pose."""
        given = self._given[slot]
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

    def count(self, slots: Int64[Tensor, "rays"]) -> None:
        """Counts a step's rays, after their pull has been added to `wrenches`."""
        self._rays += torch.bincount(slots, minlength=len(self._rays))

    def correct_one(self, *, rate: float) -> int | None:
        """Corrects the pose about which most has been found out; cells and rays must follow.

        Args:
            rate: Factor of the steps, in (0, 1].

        Returns:
            The slot, or None if no frame has seen enough rays.
        """
        slot = int(self._rays.argmax())
        if int(self._rays[slot]) < ENOUGH_RAYS:
            return None
        gradient = self.gradient(slot)
        self.wrenches[slot] = 0.0
        self._rays[slot] = 0
        self._descend(slot, gradient, rate)
        self._move(slot)
        return slot

    def strayed(self, slot: int) -> bool:
        """Whether the slot's pose has left the one for which its warp was last solved.

        Saying so counts as solving it anew.
        """
        places = self._joint_places(slot)
        moved = np.linalg.norm(places - self._solved_at[slot], axis=1).max()
        if moved > STRAYED_M:
            self._solved_at[slot] = places
        return bool(moved > STRAYED_M)

    def root(self, slot: int) -> RootCorrection:
        """How the slot's rays move."""
        turn, shift = self.corrections[slot, 0], self.corrections[slot, 24]
        return RootCorrection(
            rotation=rotation_matrices(turn), shift=shift, pivot=self.rig.rest_joints[0]
        )

    def gradient(self, slot: int) -> Float[np.ndarray, "25 3"]:
        """Gradient of the loss for a slot's correction, from its bones' wrenches.

        A joint that turns by ω about its place c carries every bone below it:
        dL/dω = -Σ (M - c × F), in the axes of the body frame; here it is expressed in those of the
        joint, where the corrections live.
        """
        wrench = self.wrenches[slot].double().cpu().numpy()
        total = self._below @ wrench
        force, moment = total[:, :3], total[:, 3:]
        turning = -(moment - np.cross(self._joint_places(slot), force))
        gradient = np.empty((25, 3))
        gradient[:24] = np.einsum("jba,jb->ja", self._posed[slot, :, :3, :3], turning)
        gradient[24] = -wrench[:, :3].sum(axis=0)
        # the shift lives in the given body frame, the force in the corrected one
        gradient[24] = rotation_matrices(self.corrections[slot, 0]) @ gradient[24]
        return gradient

    def _descend(self, slot: int, gradient: Float[np.ndarray, "25 3"], rate: float) -> None:
        first, second = self._first[slot], self._second[slot]
        self._times[slot] += 1
        times = self._times[slot]
        first *= MOMENTS[0]
        first += (1.0 - MOMENTS[0]) * gradient
        second *= MOMENTS[1]
        second += (1.0 - MOMENTS[1]) * gradient**2
        # how sure the step is, in [-1, 1]: noise has |s| of about 0.2, and moves by its square
        surely = first / (np.sqrt(second / (1.0 - MOMENTS[1] ** times)) + 1e-12)
        step = surely * np.abs(surely) * STEP_M * rate / self._lever[:, None]
        held = [i for i, pose in enumerate(self._given) if pose is not None]
        mean = self.corrections[held].mean(axis=0)
        moved = (1.0 - FORGOTTEN) * self.corrections[slot] - step - self._mean_pull * mean
        self.corrections[slot] = np.clip(moved, -FARTHEST, FARTHEST)

    def _joint_places(self, slot: int) -> Float[np.ndarray, "24 3"]:
        """Where the joints are, body frame, metres."""
        posed = self._posed[slot]
        turned = np.einsum("jab,jb->ja", posed[:, :3, :3], self.rig.rest_joints)
        return turned + posed[:, :3, 3]

    def _move(self, slot: int) -> None:
        """Lets the slot's joints and bones follow its correction."""
        rig = self.rig
        self._posed[slot] = body_from_rest(
            rig.rest_joints, rig.parents, self.pose(slot).joint_rotations
        )
        bones = (self._posed[slot] @ self._rest_from_canonical)[:, :3].reshape(24, 12)
        self.bones[slot] = torch.from_numpy(bones.astype(np.float32)).to(self.bones.device)


def _subtrees(rig: Rig) -> Float[np.ndarray, "24 24"]:
    """1 where a joint (row) moves a bone (column)."""
    below = np.eye(24)
    for bone in range(24):
        joint = int(rig.parents[bone])
        while joint >= 0:
            below[joint, bone] = 1.0
            joint = int(rig.parents[joint])
    return below


def _levers(rig: Rig, below: Float[np.ndarray, "24 24"]) -> Float[np.ndarray, "24"]:
    """How far from each joint the farthest joint is that it moves, and a hand's width, metres."""
    gap = np.linalg.norm(rig.rest_joints[:, None] - rig.rest_joints[None], axis=-1)
    return (gap * below).max(axis=1) + 0.15
