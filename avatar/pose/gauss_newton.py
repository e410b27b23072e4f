"""Gauss-Newton step of one pose from the gradients of its rays, scaled by their agreement.

Each ray's loss ℓ is half of a square, ℓ = ρ²/2, so JᵀJ = Σ ∇ℓ ∇ℓᵀ / 2ℓ follows from the rays' own
gradients. The same gradients measure the noise in their sum: errors of the field point each ray's
gradient another way, an error of the pose points them all one way.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from avatar.pose.temporal_prior import UNINFORMATIVE_PRIOR, PosePrior

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
    gradients: Float32[np.ndarray, "rays 25 3"],
    loss: Float32[np.ndarray, "rays"],
    correction: Float[np.ndarray, "25 3"],
    shared_evidence: float,
    *,
    prior: PosePrior = UNINFORMATIVE_PRIOR,
) -> GaussNewtonStep:
    """The step towards the pose at which the rays fit, in the directions that they determine.

    Args:
        gradients: Gradient of each ray's loss with respect to the correction.
        loss: Loss of each ray.
        correction: Current correction; undetermined directions return to the prior.
        shared_evidence: Mean evidence of all frames, which one tracker produced; infinite if the
            pose is to move in any case.
        prior: Prior of the correction.
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

    def asked(believed: PosePrior) -> Float[np.ndarray, "25 3"]:
        stiff = believed.precision * given
        back = stiff * ((correction - believed.mean) / scale).reshape(75)
        held = curvature + stiff * np.eye(75, dtype=np.float32)
        found = np.linalg.solve(held, scaled.sum(axis=0) + back)
        return found.reshape(25, 3).astype(np.float64)

    change = -share * scale * asked(prior)
    shortened = MAX_STEP / max(float(np.abs(change).max()), MAX_STEP)
    return GaussNewtonStep(
        shortened * change, evidence, correction / scale - asked(UNINFORMATIVE_PRIOR)
    )


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
