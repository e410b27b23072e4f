"""Correction of one pose: a Gauss-Newton step by its rays, and a prior by neighboring frames.

The step is scaled by the agreement of the rays. Each ray's loss ℓ is half of a square, ℓ = ρ²/2, so
JᵀJ = Σ ∇ℓ ∇ℓᵀ / 2ℓ follows from the rays' own gradients. The same gradients measure the noise in
their sum: errors of the field point each ray's gradient another way, an error of the pose points
them all one way.

A tracker's error changes slowly from frame to frame. Where a frame's own rays leave its pose
undetermined, the corrections of neighboring frames are a better guess than none.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Int64

from avatar.kernels import numba_pose
from avatar.kernels.kernel_compiler import FAST_MATH, compile_kernel
from avatar.kernels.threads import run_threads

MAX_FRAME_GAP = 6
"""Distance in frames beyond which neighbors are ignored."""
NEIGHBOR_PRECISION = 8.0
"""Precision of all neighbors together, relative to that of the tracker's pose."""


class PosePrior(NamedTuple):
    """Prior of a correction, before the evidence of its frame's rays.

    The mean has radians, and metres in the last row; the precision is relative to that of a frame
    without neighbors.
    """

    mean: Float[np.ndarray, "25 3"]
    precision: float


UNINFORMATIVE_PRIOR = PosePrior(np.zeros((25, 3)), 1.0)
"""Prior without neighbors: the tracker's pose, with its own precision."""


@final
class TemporalPosePrior:
    """The replay frames as neighbors of one another."""

    def __init__(self, capacity: int) -> None:
        """Starts without frames."""
        self._frames = np.zeros(capacity, dtype=np.int64)
        self._is_sequential = np.zeros(capacity, dtype=bool)

    def set_frame(self, slot: int, frame: int | None) -> None:
        """Assigns a frame number to a slot; None if the frame has no neighbors."""
        self._is_sequential[slot], self._frames[slot] = frame is not None, frame or 0

    def prior_for(self, slot: int, corrections: Float[np.ndarray, "slots 25 3"]) -> PosePrior:
        """Prior of a slot's correction from the other slots."""
        row = self._is_sequential
        if not row[slot]:
            return UNINFORMATIVE_PRIOR
        return prior_from_neighbors(int(self._frames[slot]), self._frames, corrections, row)


@compile_kernel(**FAST_MATH)
def _add_up_neighbors(frame, frames, corrections, held, total):
    """Adds neighbors' corrections, weighted by nearness, to a total; returns the weights' sum."""
    weights = 0.0
    for row in range(frames.shape[0]):
        apart = abs(frames[row] - frame)
        if held[row] and 0 < apart <= MAX_FRAME_GAP:
            weights += 1.0 / apart
            for j in range(25):
                for a in range(3):
                    total[j, a] += corrections[row, j, a] / apart
    return weights


def prior_from_neighbors(
    frame: int,
    frames: Int64[np.ndarray, "frames"],
    corrections: Float[np.ndarray, "frames 25 3"],
    held: Bool[np.ndarray, "frames"],
) -> PosePrior:
    """Prior of a correction: the mean of neighboring frames' corrections, weighted by nearness.

    Frames that are not `held`, and `frame` itself, are ignored.
    """
    total = np.zeros((25, 3))
    weights = _add_up_neighbors(frame, frames, corrections, held, total)
    if weights == 0.0:
        return UNINFORMATIVE_PRIOR
    # product of two Gaussians: the tracker's pose (mean 0, precision 1) and the neighbors' mean
    precision = 1.0 + NEIGHBOR_PRECISION
    return PosePrior(NEIGHBOR_PRECISION / precision / weights * total, precision)


def interpolate_correction(
    frame: int, corrections: Mapping[int, Float[np.ndarray, "25 3"]]
) -> Float[np.ndarray, "25 3"]:
    """The correction of a frame that was never learnt from, by those of other frames' poses."""
    if not corrections:
        return UNINFORMATIVE_PRIOR.mean
    frames, found = np.array(list(corrections)), np.array(list(corrections.values()))
    return prior_from_neighbors(frame, frames, found, np.ones(len(frames), dtype=bool)).mean


PRIOR_SIGMA_RAD = 0.05
"""Prior standard deviation of a tracker's rotations, radians."""
PRIOR_SIGMA_M = 0.025
"""Prior standard deviation of the root's position, metres."""
MIN_EVIDENCE = 1.5
"""Evidence, averaged over the frame and all frames, up to which a pose does not move. Of exact
poses 5 % reach 1.8, with a mean of 1.2; poses off by 2° reach 3 to 6."""
FULL_EVIDENCE = 2.0
"""Evidence from which a pose makes the full step."""
MIN_RAY_LOSS = 1e-3
"""Floor of a ray's loss in the curvature: an error of 0.014 in one channel."""
MAX_STEP = 0.1
"""Largest change of a parameter in one step, radians or metres."""


SIGMA_OF_ROW = np.append(np.full(24, PRIOR_SIGMA_RAD), PRIOR_SIGMA_M)
"""Prior standard deviation of each row of a correction."""


class NormalEquations(NamedTuple):
    """Normal equations of a pose, in prior sigmas; rows are padded with zeros.

    Attributes:
        curvature: Sum of the rays' curvatures ∇ℓ ∇ℓᵀ / 2ℓ.
        gradient: Sum of their gradients ∇ℓ.
        moments: Sum of ∇ℓ ∇ℓᵀ; None if the rays' agreement is not needed.
        ray_stiffness: Curvature of a mean ray.
    """

    curvature: Float32[np.ndarray, "75 80"]
    gradient: Float32[np.ndarray, "80"]
    moments: Float32[np.ndarray, "75 80"] | None
    ray_stiffness: float


class JointFrames(NamedTuple):
    """Rotations and places, metres, of the joints of the slots' corrected poses, in body frames.

    `root_turns` are the corrections of the roots' rotations.
    """

    turns: Float32[np.ndarray, "slots 24 3 3"]
    places: Float32[np.ndarray, "slots 24 3"]
    root_turns: Float[np.ndarray, "slots 3 3"]


@final
class RaySums:
    """Sums over the rays of each slot, of which its pose's normal equations consist.

    `counts` has the rays since each slot's last correction.
    """

    def __init__(
        self, parents: Int64[np.ndarray, "24"], capacity: int, *, with_moments: bool
    ) -> None:
        """Starts without rays; moments are for the rays' agreement. Parents precede children."""
        self._parents = parents
        self.counts = np.zeros(capacity, dtype=np.int64)
        self._gradients = np.zeros((capacity, numba_pose.PADDED), dtype=np.float32)
        square = (75, numba_pose.PADDED)
        self._curvatures = np.zeros((capacity, *square), dtype=np.float32)
        self._moments = np.zeros((capacity if with_moments else 0, *square), dtype=np.float32)
        self._powers = np.zeros((capacity, 2), dtype=np.float32)

    def add(
        self,
        slots: Int32[np.ndarray, "rays"],
        wrenches: Float32[np.ndarray, "rays 24 6"],
        loss: Float32[np.ndarray, "rays"],
        room: Int64[np.ndarray, "slots"],
        joints: JointFrames,
    ) -> None:
        """Adds rays by their bones' wrenches at the poses of `joints`, at most `room` of a slot."""
        run_threads(
            numba_pose.add_rays,
            slots, wrenches, loss, MIN_RAY_LOSS, (PRIOR_SIGMA_RAD, PRIOR_SIGMA_M), room,
            self._parents, *joints, self.counts, self._gradients, self._curvatures,
            self._moments, self._powers,
        )  # fmt: skip

    def equations(self, slot: int) -> NormalEquations:
        """The normal equations of a slot's pose; views, which later rays change."""
        power, weighted = self._powers[slot].tolist()
        moments = self._moments[slot] if len(self._moments) else None
        # the prior's stiffness in units of the curvature: one sigma weighs as much as a mean ray
        stiffness = power / (weighted + 1e-12) + 1e-12
        return NormalEquations(self._curvatures[slot], self._gradients[slot], moments, stiffness)

    def fade(self, slot: int, moved: Float[np.ndarray, "25 3"], decay: float) -> None:
        """Lets a slot's rays count less, linearized where its correction has moved since.

        The count starts again from 0; the rays so far weigh `decay`, in [0, 1).
        """
        moments = self._moments[slot] if len(self._moments) else self._moments[:, 0]
        numba_pose.fade(
            self._curvatures[slot], self._gradients[slot], moments, moved, SIGMA_OF_ROW,
            np.float32(decay),
        )  # fmt: skip
        self.counts[slot], self._powers[slot] = 0, 0.0

    def clear(self, slot: int) -> None:
        """Forgets a slot's rays."""
        self.fade(slot, np.zeros((25, 3)), 0.0)


class GaussNewtonStep(NamedTuple):
    """Step of one pose correction.

    Attributes:
        change: Change of the correction: radians, and metres in the last row.
        evidence: Mean of (Σ g)² / Σ g² over the directions that the rays determine: about 1 if
            their gradients g are noise, about the number of rays if all agree.
    """

    change: Float[np.ndarray, "25 3"]
    evidence: float


def gauss_newton_step(
    rays: NormalEquations,
    correction: Float[np.ndarray, "25 3"],
    shared_evidence: float,
    *,
    prior: PosePrior = UNINFORMATIVE_PRIOR,
) -> GaussNewtonStep:
    """The step towards the pose at which the rays fit, in the directions that they determine.

    Undetermined directions of the current `correction` return to the prior. `shared_evidence` is
    the mean evidence of all frames, which one tracker produced; infinite if the pose is to move in
    any case, and `moments` are not needed.
    """
    evidence, share = math.inf, 1.0
    if math.isfinite(shared_evidence):
        evidence = _agreement(rays)
        full = FULL_EVIDENCE - MIN_EVIDENCE
        share = min(max((0.5 * (evidence + shared_evidence) - MIN_EVIDENCE) / full, 0.0), 1.0)

    change = np.empty((25, 3))
    numba_pose.gauss_newton(
        rays.curvature, rays.gradient, rays.ray_stiffness, correction, prior.mean,
        float(prior.precision), SIGMA_OF_ROW, share, MAX_STEP, change,
    )  # fmt: skip
    return GaussNewtonStep(change, evidence)


def _agreement(rays: NormalEquations) -> float:
    """Mean agreement of the rays (`GaussNewtonStep.evidence`)."""
    assert rays.moments is not None
    determined, axes = np.linalg.eigh(rays.curvature[:, :75])
    axes = axes[:, determined > rays.ray_stiffness]
    if not axes.size:
        return 0.0
    # (Σ g)² and Σ g² along each determined axis
    along = rays.gradient[:75] @ axes
    power = ((rays.moments[:, :75] @ axes) * axes).sum(axis=0)
    return float(np.mean(along**2 / (power + 1e-12)))
