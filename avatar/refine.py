"""Pose refinement: trackers' poses corrected while the avatar is learnt.

A tracker's jitter of 2° and 1 cm costs 5-8 dB, more than anything else on real people. The field's
gradient at a sample reaches the pose through the warp's implicit derivative, root included, as one
wrench per bone (`avatar.kernels.cpu_pose`). A few hundred rays of a frame make one Gauss-Newton
step (`avatar.pose_step`); exact poses are left alone, and soon asked about only seldom. What all
frames share is no error of a frame but a change of the canonical body, so the mean correction is
taken out again and again.
"""

import math
from typing import final

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from scipy.spatial.transform import Rotation
from torch import Tensor

from avatar.kernels.backend import Skin
from avatar.pose_prior import Neighbours
from avatar.pose_step import CHANCE, OVERSTEP, pose_step
from avatar.replay import RootCorrection
from avatar.rig import Rig
from preprocess.kinematics import body_from_rest, rotation_matrices
from preprocess.pose import BodyPose

ROWS = 512
"""Rays of a frame that are kept until its pose is corrected."""
ENOUGH_RAYS = 256
"""A frame's pose is corrected when this many of its rays have been seen since it last was."""
PULLING_M = 0.025
"""Only levels of the grid with cells as large as this pull at poses: finer ones say where to go
from a few millimetres away, and point anywhere from farther off."""
MEMORY = 0.95
"""Of the mean evidence, and of the share of corrections that moved a pose."""
SELDOM = 8
"""Steps from one pull to the next where poses are exact."""
FOLLOWED_M = 0.04
"""No joint moves farther at one correction: the frame's warp must be able to follow."""
STRAYED_M = 0.08
"""When a joint has moved this far since the frame's warp was solved, it is solved anew."""
MEAN_PULL = 0.2
"""Share of the mean correction taken out of a frame's at each of its corrections."""
BEGUN_AFTER_STEPS = 60
"""A frame's pose is corrected once its frame has been learnt from for so many steps: before, the
field does not know what is seen from there, and what is new looks like what is off."""
JUDGED_AFTER_STEPS, JUDGED_BY = 300, 3
"""A pose is judged once its frame has been learnt from for so many steps, by so many pulls."""
EXACT = 1.3
"""Mean evidence, the frame's and all frames' halves, below which a pose counts as exact and stays
as it is for good. Were it asked for ever, chance would move it, what it moves would blur the field,
and a blurred field moves the next: at 540 px that ran away after three thousand steps."""
SETTLED_AFTER_STEPS = 3000
"""Steps after which any pose stays as it is: what the field shows of it by then is as much its own
memory of that pose as evidence."""
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
    """

    def __init__(
        self, rig: Rig, capacity: int, device: torch.device, *, frozen: bool = False
    ) -> None:
        """A table without poses.

        Args:
            rig: Whose body.
            capacity: How many poses it may hold.
            device: Where gradients are gathered.
            frozen: Whether the avatar stays as it is, and only the poses are looked for: no pose
                can blur it then, so all move, and no farther than their rays ask; and what they
                share is no change of the canonical body.
        """
        self.rig = rig
        self._mean_pull, self._overstep = (0.0, 1.0) if frozen else (MEAN_PULL, OVERSTEP)
        self.corrections: Float[np.ndarray, "slots 25 3"] = np.zeros((capacity, 25, 3))
        self.bones: Float32[Tensor, "slots 24 12"] = torch.zeros(capacity, 24, 12, device=device)
        nodes = np.array(rig.weights.shape[:3], dtype=np.float32) - 1
        self.skin = Skin(
            torch.from_numpy(rig.weights).to(device),
            torch.from_numpy(rig.box_low).to(device),
            torch.from_numpy(nodes / (rig.box_high - rig.box_low)).to(device),
        )
        self._pulls = torch.zeros(capacity, ROWS, 24, 6, device=device)
        self._losses = torch.zeros(capacity, ROWS, device=device)
        self._rays = torch.zeros(capacity, dtype=torch.int64, device=device)
        self._given: list[BodyPose | None] = [None] * capacity
        self._posed = np.zeros((capacity, 24, 4, 4))
        self._solved_at = np.zeros((capacity, 24, 3))
        self._rest_from_canonical = np.linalg.inv(
            body_from_rest(rig.rest_joints, rig.parents, rig.canonical_rotations)
        )
        self._below = _subtrees(rig)
        self._moving, self._evidence = 1.0, math.inf if frozen else CHANCE
        self._since = np.zeros(capacity, dtype=np.int64)
        self._judged, self._settled = np.zeros((2, capacity), dtype=bool)
        self._asked, self._told = np.zeros((2, capacity))
        self._neighbours = Neighbours(capacity)
        self._open = torch.ones(capacity, dtype=torch.bool, device=device)

    def put(
        self,
        slot: int,
        pose: BodyPose,
        correction: Float[np.ndarray, "25 3"] | None = None,
        *,
        frame: int | None = None,
        step: int = 0,
    ) -> None:
        """Takes in a frame's given pose.

        Args:
            slot: Its place.
            pose: As the tracker has it.
            correction: If one is known.
            frame: Its number: poses of frames in a row err alike. None if nothing is in a row.
            step: Since when it is learnt from.
        """
        self._given[slot] = pose
        self._since[slot] = step
        self._open[slot] = True
        self._settled[slot] = False
        self._neighbours.put(slot, frame)
        self._asked[slot] = self._told[slot] = 0.0
        self.corrections[slot] = 0.0
        if correction is not None:
            self.corrections[slot] = correction
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

    def settle(self, step: int) -> bool:
        """Which poses may be corrected now; whether there are any.

        Those whose frames are new wait; those that proved exact, or were refined long enough, stay
        as they are for good.
        """
        held = np.array([pose is not None for pose in self._given])
        age = step - self._since
        self._judged = age >= JUDGED_AFTER_STEPS
        told = self._told / self._asked.clip(min=1)
        exact = (self._asked >= JUDGED_BY) & (0.5 * (told + self._evidence) < EXACT)
        self._settled |= exact | (age >= SETTLED_AFTER_STEPS)
        open_now = held & ~self._settled & (age >= BEGUN_AFTER_STEPS)
        self._open.copy_(torch.from_numpy(open_now))
        self._rays *= self._open
        return bool(open_now.any())

    def feel(
        self,
        slots: Int64[Tensor, "rays"],
        wrenches: Float32[Tensor, "rays 24 6"],
        loss: Float32[Tensor, "rays"],
    ) -> None:
        """Keeps what a step's rays exert on their frames' bones; slots ascend."""
        counts = torch.bincount(slots, minlength=len(self._rays))
        rank = torch.arange(len(slots), device=slots.device) - (counts.cumsum(0) - counts)[slots]
        place = self._rays[slots] + rank
        kept = (place < ROWS) & self._open[slots]
        self._pulls[slots[kept], place[kept]] = wrenches[kept]
        self._losses[slots[kept], place[kept]] = loss[kept]
        self._rays = (self._rays + counts * self._open).clamp(max=ROWS)

    def correct_one(self, *, rate: float) -> int | None:
        """Corrects the pose about which most has been found out; cells and rays must follow.

        Args:
            rate: Factor of the steps, in (0, 1].

        Returns:
            The slot, or None if no frame has seen enough rays or the pose stays as it is.
        """
        slot = int(self._rays.argmax())
        rows = int(self._rays[slot])
        if rows < ENOUGH_RAYS:
            return None
        loss = self._losses[slot, :rows].cpu().numpy()
        step = pose_step(
            self.gradients(slot), loss, self.corrections[slot], self._evidence,
            prior=self._neighbours.expected(slot, self.corrections), overstep=self._overstep,
        )  # fmt: skip
        self._rays[slot] = 0
        self._neighbours.tell(slot, step.alone)
        self._evidence = MEMORY * self._evidence + (1.0 - MEMORY) * step.evidence
        if self._judged[slot]:
            self._asked[slot] += 1.0
            self._told[slot] += step.evidence
        moves = bool(step.change.any())
        self._moving += (1.0 - MEMORY) * (moves - self._moving)
        if not moves:
            return None
        held = [i for i, pose in enumerate(self._given) if pose is not None]
        mean = self.corrections[held].mean(axis=0)
        moved = self.corrections[slot] + rate * step.change - self._mean_pull * mean
        self._correct(slot, np.clip(moved, -FARTHEST, FARTHEST))
        return slot

    @property
    def every(self) -> int:
        """Steps from one pull at poses to the next, 1 to 8: more where poses prove to be exact."""
        return min(max(round(0.5 / max(self._moving, 1e-3)), 1), SELDOM)

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

    def gradients(self, slot: int) -> Float[np.ndarray, "rays 25 3"]:
        """Gradient of each kept ray's loss for the slot's correction, from its bones' wrenches.

        A joint that turns by ω about its place c carries every bone below it:
        dL/dω = -Σ (M - c × F), in the axes of the body frame; here it is expressed in those of the
        joint, where the corrections live.
        """
        wrench = self._pulls[slot, : int(self._rays[slot])].cpu().numpy()
        felt = np.zeros((25, 3, 24, 6))
        across = np.cross(np.eye(3), self._joint_places(slot)[:, None])  # c × F = across @ F
        turned = self._posed[slot, :, :3, :3].swapaxes(1, 2)
        carried = np.concatenate([turned @ across, -turned], axis=2)
        felt[:24] = self._below[:, None, :, None] * carried[:, :, None]
        # the shift lives in the given body frame, the force in the corrected one
        felt[24, :, :, :3] = -rotation_matrices(self.corrections[slot, 0])[:, None]
        flat = felt.reshape(75, 144).astype(np.float32)
        return (wrench.reshape(-1, 144) @ flat.T).reshape(-1, 25, 3)

    def _correct(self, slot: int, correction: Float[np.ndarray, "25 3"]) -> None:
        """Moves a pose to its new correction, or as far towards it as its cells can follow."""
        before, places = self.corrections[slot].copy(), self._joint_places(slot)
        self.corrections[slot] = correction
        self._move(slot)
        moved = float(np.linalg.norm(self._joint_places(slot) - places, axis=1).max())
        if moved > FOLLOWED_M:
            self.corrections[slot] = before + FOLLOWED_M / moved * (correction - before)
            self._move(slot)

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
