"""Correction of one pose: a Gauss-Newton step by its rays, and a prior by neighboring frames.

The step is scaled by the agreement of the rays. Each ray's loss ℓ is half of a square, ℓ = ρ²/2, so
JᵀJ = Σ ∇ℓ ∇ℓᵀ / 2ℓ follows from the rays' own gradients. The same gradients measure the noise in
their sum: errors of the field point each ray's gradient another way, an error of the pose points
them all one way.

A tracker's error changes slowly from frame to frame. Where a frame's own rays leave its pose
undetermined, the corrections of neighboring frames are a better guess than none. How good a guess
is measured on the corrections that the rays alone would make: how alike they are in neighboring
frames, and how fast that fades, tells the noise of the rays from errors that change.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from avatar.kernels import numba_pose
from avatar.kernels.kernel_compiler import FAST_MATH, compile_kernel
from avatar.kernels.threads import run_threads

MIN_NEIGHBOR_TRIPLES = 12
"""Frames between two neighbors below which nothing is known about neighbors' errors."""
MAX_FRAME_GAP = 6
"""Distance in frames beyond which neighbors are ignored."""
MIN_CORRELATION = 0.1
"""Correlation of neighbors' estimates up to which they are ignored."""
FULL_CORRELATION = 0.3
"""Correlation of neighbors' estimates from which they have their full precision."""
NEIGHBOR_PRECISION = 16.0
"""Precision of all neighbors together, relative to that of the tracker's pose, where the noise of
an estimate is as large as the error that neighbors leave unknown."""
MIN_NOISE_SHARE = 0.1
"""Least share of noise in the estimates' power."""
PRIORS_PER_PRECISION = 8
"""Priors for which the neighbors' precision, a sum over all frames, is measured once."""
MAX_PERSISTENCE = 0.9
"""Largest correlation of neighbors' errors that is believed."""


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
    """Estimates of the replay frames' corrections, as neighbors of one another."""

    def __init__(self, capacity: int) -> None:
        """Starts without frames."""
        self._frames = np.zeros(capacity, dtype=np.int64)
        self._precision, self._priors = 0.0, 0
        self._unregularized = np.zeros((capacity, 25, 3))
        self._is_sequential, self._has_estimate = np.zeros((2, capacity), dtype=bool)

    def set_frame(self, slot: int, frame: int | None) -> None:
        """Assigns a frame number to a slot; None if the frame has no neighbors."""
        self._is_sequential[slot], self._has_estimate[slot] = frame is not None, False
        self._frames[slot] = frame or 0
        self._priors = 0

    def record_estimate(self, slot: int, unregularized: Float[np.ndarray, "25 3"]) -> None:
        """Records the correction that a slot's rays alone would make, in prior sigmas."""
        self._unregularized[slot], self._has_estimate[slot] = (
            unregularized,
            self._is_sequential[slot],
        )

    def prior_for(self, slot: int, corrections: Float[np.ndarray, "slots 25 3"]) -> PosePrior:
        """Prior of a slot's correction from the other slots."""
        row = self._is_sequential
        if not row[slot]:
            return UNINFORMATIVE_PRIOR
        if self._priors % PRIORS_PER_PRECISION == 0:
            self._precision = neighbor_precision(
                self._frames, self._unregularized, self._has_estimate
            )
        self._priors += 1
        frame = int(self._frames[slot])
        return prior_from_neighbors(frame, self._frames, corrections, row, self._precision)


@compile_kernel(**FAST_MATH)
def neighbor_correlations(
    order: Int64[np.ndarray, "frames"],
    frames: Int64[np.ndarray, "frames"],
    estimates: Float[np.ndarray, "frames 25 3"],
    known: Bool[np.ndarray, "frames"],
) -> tuple[float, float]:
    """Correlations of estimates one frame apart, and two, in [-1, 1]; zeros if there are too few.

    `order` sorts the frames, and the next known one counts as one apart. `estimates` are each
    frame's correction by its rays alone, in any unit.
    """
    triples, power, one_apart, two_apart, first, middle = 0, 0.0, 0.0, 0.0, -1, -1
    for last in order:
        if not known[last]:
            continue
        if middle >= 0 and frames[last] - frames[middle] > MAX_FRAME_GAP:
            middle = -1
        if middle >= 0 and first >= 0:
            triples += 1
            for j in range(25):
                for a in range(3):
                    x, y, z = estimates[first, j, a], estimates[middle, j, a], estimates[last, j, a]
                    power += (x * x + y * y + z * z) / 3.0
                    one_apart += 0.5 * y * (x + z)
                    two_apart += x * z
        first, middle = middle, last
    if triples < MIN_NEIGHBOR_TRIPLES:
        return 0.0, 0.0
    return one_apart / max(power, 1e-12), two_apart / max(power, 1e-12)


def neighbor_precision(
    frames: Int64[np.ndarray, "frames"],
    estimates: Float[np.ndarray, "frames 25 3"],
    known: Bool[np.ndarray, "frames"],
) -> float:
    """Precision of what neighbors tell about a frame's error, relative to the tracker's pose's.

    An estimate is the error of a pose and the noise of its rays. Noise differs from frame to frame,
    while errors change gradually, in the simplest case with correlations r, r² at one, two frames
    apart. So r is the ratio of the estimates' correlations, the share of noise is what is missing
    to 1 at distance 0, and neighbors leave (1 - r²) / (1 + r²) of the errors' power unknown.
    """
    one_apart, two_apart = neighbor_correlations(np.argsort(frames), frames, estimates, known)
    share = (one_apart - MIN_CORRELATION) / (FULL_CORRELATION - MIN_CORRELATION)
    if share <= 0.0:
        return 0.0
    # with e the errors' share of the power, the correlations are e r and e r²
    persistence = min(max(two_apart / one_apart, one_apart), MAX_PERSISTENCE)
    errors = one_apart / persistence
    unknown = errors * (1.0 - persistence**2) / (1.0 + persistence**2)
    return min(share, 1.0) * NEIGHBOR_PRECISION * max(1.0 - errors, MIN_NOISE_SHARE) / unknown


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
    precision: float,
) -> PosePrior:
    """Prior of a correction: the mean of neighboring frames' corrections, weighted by nearness.

    Frames that are not `held`, and `frame` itself, are ignored. `precision` is that of all
    neighbors together, relative to that of the tracker's pose.
    """
    total = np.zeros((25, 3))
    weights = _add_up_neighbors(frame, frames, corrections, held, total)
    if precision == 0.0 or weights == 0.0:
        return UNINFORMATIVE_PRIOR
    # product of two Gaussians: the tracker's pose (mean 0, precision 1) and the neighbors' mean
    return PosePrior(precision / (1.0 + precision) / weights * total, 1.0 + precision)


def interpolate_correction(
    frame: int, corrections: Mapping[int, Float[np.ndarray, "25 3"]]
) -> Float[np.ndarray, "25 3"]:
    """The correction of a frame that was never learnt from, by those of other frames' poses."""
    if not corrections:
        return UNINFORMATIVE_PRIOR.mean
    frames, found = np.array(list(corrections)), np.array(list(corrections.values()))
    held = np.ones(len(frames), dtype=bool)
    precision = neighbor_precision(frames, found, held)
    return prior_from_neighbors(frame, frames, found, held, precision).mean


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
PRIOR_SIGMAS = SIGMA_OF_ROW[:, None]
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
        slots: Int64[np.ndarray, "rays"],
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
        unregularized: Correction that the rays alone would converge to, in prior sigmas.
    """

    change: Float[np.ndarray, "25 3"]
    evidence: float
    unregularized: Float[np.ndarray, "25 3"]


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

    change, alone = np.empty((2, 25, 3))
    numba_pose.gauss_newton(
        rays.curvature, rays.gradient, rays.ray_stiffness, correction, prior.mean,
        float(prior.precision), SIGMA_OF_ROW, share, MAX_STEP, change, alone,
    )  # fmt: skip
    return GaussNewtonStep(change, evidence, alone)


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
