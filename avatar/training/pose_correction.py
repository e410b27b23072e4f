"""Correction of one pose: a Gauss-Newton step by its rays, and a prior by neighboring frames.

The step is scaled by the agreement of the rays. Each ray's loss ℓ is half of a square, ℓ = ρ²/2, so
JᵀJ = Σ ∇ℓ ∇ℓᵀ / 2ℓ follows from the rays' own gradients. The same gradients measure the noise in
their sum: errors of the field point each ray's gradient another way, an error of the pose points
them all one way.

A tracker's error changes slowly from frame to frame. Where a frame's own rays leave its pose
undetermined, the corrections of neighboring frames are a better guess than none. Whether that holds
is measured on the corrections that the rays alone would make: if neighbors are uncorrelated,
nothing is shared.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float, Float32, Int64

MIN_NEIGHBOR_PAIRS = 12
"""Neighbor pairs below which their correlation cannot be measured."""
MAX_FRAME_GAP = 6
"""Distance in frames beyond which neighbors are ignored."""
MIN_CORRELATION = 0.1
"""Correlation of neighbors' errors up to which they are ignored."""
FULL_CORRELATION = 0.3
"""Correlation of neighbors' errors from which they have their full precision."""
NEIGHBOR_PRECISION = 8.0
"""Precision of all neighbors together, relative to that of the tracker's pose."""


class PosePrior(NamedTuple):
    """Prior of a correction, before the evidence of its frame's rays.

    Attributes:
        mean: Expected correction: radians, and metres in the last row.
        precision: Precision relative to that of a frame without neighbors.
    """

    mean: Float[np.ndarray, "25 3"]
    precision: float


UNINFORMATIVE_PRIOR = PosePrior(np.zeros((25, 3)), 1.0)
"""Prior without neighbors: the tracker's pose, with its own precision."""


@final
class TemporalPosePrior:
    """Estimates of the replay frames' corrections, as neighbors of one another."""

    def __init__(self, capacity: int) -> None:
        """Starts without frames, for a number of slots."""
        self._frames = np.zeros(capacity, dtype=np.int64)
        self._unregularized = np.zeros((capacity, 25, 3))
        self._is_sequential, self._has_estimate = np.zeros((2, capacity), dtype=bool)

    def set_frame(self, slot: int, frame: int | None) -> None:
        """Assigns a frame number to a slot; None if the frame has no neighbors."""
        self._is_sequential[slot], self._has_estimate[slot] = frame is not None, False
        self._frames[slot] = frame or 0

    def record_estimate(self, slot: int, unregularized: Float[np.ndarray, "25 3"]) -> None:
        """Records the correction that a slot's rays alone would make, in prior sigmas."""
        self._unregularized[slot], self._has_estimate[slot] = (
            unregularized,
            self._is_sequential[slot],
        )

    def prior_for(self, slot: int, corrections: Float[np.ndarray, "slots 25 3"]) -> PosePrior:
        """Prior of a slot's correction from the other slots."""
        row, asked = self._is_sequential, self._has_estimate
        if not row[slot]:
            return UNINFORMATIVE_PRIOR
        alike = neighbor_correlation(self._frames[asked], self._unregularized[asked])
        return prior_from_neighbors(
            int(self._frames[slot]), self._frames[row], corrections[row], alike
        )


def neighbor_correlation(
    frames: Int64[np.ndarray, "asked"], estimates: Float[np.ndarray, "asked 25 3"]
) -> float:
    """How alike the errors of neighbouring frames are, in [-1, 1]; 0 if too few tell.

    Args:
        frames: Indices of the frames, in any order.
        unregularized: Correction of each frame by its rays alone, in any unit.
    """
    order = np.argsort(frames, kind="stable")
    apart = np.diff(frames[order])
    near = np.flatnonzero((apart > 0) & (apart <= MAX_FRAME_GAP))
    if len(near) < MIN_NEIGHBOR_PAIRS:
        return 0.0
    one, other = estimates[order[near]], estimates[order[near + 1]]
    power = 0.5 * float((one**2).sum() + (other**2).sum())
    return float((one * other).sum()) / max(power, 1e-12)


def prior_from_neighbors(
    frame: int,
    frames: Int64[np.ndarray, "others"],
    corrections: Float[np.ndarray, "others 25 3"],
    error_correlation: float,
) -> PosePrior:
    """Prior of a correction: the mean of neighboring frames' corrections, weighted by nearness.

    Args:
        frame: Index of the frame.
        frames: Indices of its neighbors; its own is ignored.
        corrections: Corrections of the neighbors.
        error_correlation: Correlation of neighboring frames' errors.
    """
    share = min(
        max((error_correlation - MIN_CORRELATION) / (FULL_CORRELATION - MIN_CORRELATION), 0.0), 1.0
    )
    apart = np.abs(frames - frame)
    near = (apart > 0) & (apart <= MAX_FRAME_GAP)
    if share == 0.0 or not near.any():
        return UNINFORMATIVE_PRIOR
    weights = 1.0 / apart[near]
    mean = np.einsum("s,sja->ja", weights / weights.sum(), corrections[near])
    worth = share * NEIGHBOR_PRECISION
    return PosePrior(worth / (1.0 + worth) * mean, 1.0 + worth)


def interpolate_correction(
    frame: int, corrections: Mapping[int, Float[np.ndarray, "25 3"]]
) -> Float[np.ndarray, "25 3"]:
    """The correction of a frame that was never learnt from, by those of its neighbors.

    Args:
        frame: Its number.
        corrections: Of frames' poses, by their numbers.
    """
    if not corrections:
        return UNINFORMATIVE_PRIOR.mean
    frames, found = np.array(list(corrections)), np.array(list(corrections.values()))
    return prior_from_neighbors(frame, frames, found, neighbor_correlation(frames, found)).mean


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


class NormalEquations(NamedTuple):
    """Normal equations of a pose from the rays of its last corrections, in prior sigmas.

    Attributes:
        curvature: Sum of the rays' curvatures.
        gradient: Sum of their gradients at `correction`.
        correction: Correction at which they are linearized.
    """

    curvature: Float32[np.ndarray, "75 75"]
    gradient: Float32[np.ndarray, "75"]
    correction: Float32[np.ndarray, "75"]

    def plus(self, earlier: "NormalEquations", decay: float) -> "NormalEquations":
        """The sum of these and `decay` times earlier ones, which are linearized here, too."""
        moved = earlier.gradient + earlier.curvature @ (self.correction - earlier.correction)
        return NormalEquations(
            self.curvature + decay * earlier.curvature,
            self.gradient + decay * moved,
            self.correction,
        )


class GaussNewtonStep(NamedTuple):
    """Step of one pose correction.

    Attributes:
        change: Change of the correction: radians, and metres in the last row.
        equations: The normal equations that it solves, without the prior.
        evidence: Mean of (Σ g)² / Σ g² over the directions that the rays determine: about 1 if
            their gradients g are noise, about the number of rays if all agree.
        unregularized: Correction that the rays alone would converge to, in prior sigmas.
    """

    change: Float[np.ndarray, "25 3"]
    equations: NormalEquations
    evidence: float
    unregularized: Float[np.ndarray, "25 3"]


def gauss_newton_step(
    gradients: Float32[np.ndarray, "rays 25 3"],
    loss: Float32[np.ndarray, "rays"],
    correction: Float[np.ndarray, "25 3"],
    shared_evidence: float,
    *,
    prior: PosePrior = UNINFORMATIVE_PRIOR,
    earlier: NormalEquations | None = None,
    decay: float = 0.0,
) -> GaussNewtonStep:
    """The step towards the pose at which the rays fit, in the directions that they determine.

    Args:
        gradients: Gradient of each ray's loss with respect to the correction.
        loss: Loss of each ray.
        correction: Current correction; undetermined directions return to the prior.
        shared_evidence: Mean evidence of all frames, which one tracker produced; infinite if the
            pose is to move in any case.
        prior: Prior of the correction.
        earlier: Normal equations of the pose's last step; None if there was none.
        decay: Factor of those, which are added to the rays' own.
    """
    scale = np.full((25, 3), PRIOR_SIGMA_RAD, dtype=np.float32)
    scale[24] = PRIOR_SIGMA_M
    scaled = (gradients * scale).reshape(-1, 75)
    curvature = (scaled / (2.0 * (loss.clip(min=0.0) + MIN_RAY_LOSS))[:, None]).T @ scaled
    # the prior's stiffness in units of the curvature: one sigma weighs as much as a mean ray
    given = float((scaled**2).sum() / (np.trace(curvature) + 1e-12) + 1e-12)
    evidence, share = math.inf, 1.0
    if math.isfinite(shared_evidence):
        evidence = _agreement(scaled, curvature, given)
        full = FULL_EVIDENCE - MIN_EVIDENCE
        share = min(max((0.5 * (evidence + shared_evidence) - MIN_EVIDENCE) / full, 0.0), 1.0)

    here = (correction / scale).astype(np.float32).reshape(75)
    equations = NormalEquations(curvature, scaled.sum(axis=0), here)
    if earlier is not None:
        equations = equations.plus(earlier, decay)

    def asked(believed: PosePrior) -> Float[np.ndarray, "25 3"]:
        stiff = believed.precision * given
        back = stiff * ((correction - believed.mean) / scale).reshape(75)
        held = equations.curvature + stiff * np.eye(75, dtype=np.float32)
        found = np.linalg.solve(held, equations.gradient + back)
        return found.reshape(25, 3).astype(np.float64)

    change = -share * scale * asked(prior)
    shortened = MAX_STEP / max(float(np.abs(change).max()), MAX_STEP)
    alone = correction / scale - asked(UNINFORMATIVE_PRIOR)
    return GaussNewtonStep(shortened * change, equations, evidence, alone)


def _agreement(
    scaled: Float32[np.ndarray, "rays 75"], curvature: Float32[np.ndarray, "75 75"], given: float
) -> float:
    """`GaussNewtonStep.evidence` of gradients in prior sigmas.

    Args:
        scaled: The gradients.
        curvature: Their curvature.
        given: Curvature from which the rays determine a direction.
    """
    determined, axes = np.linalg.eigh(curvature)
    along = (scaled @ axes)[:, determined > given]
    if not along.size:
        return 0.0
    return float(np.mean(along.sum(axis=0) ** 2 / ((along**2).sum(axis=0) + 1e-12)))
