"""A pose's step: Gauss-Newton on what its rays ask for, and none where they do not agree.

Each ray's loss ℓ is half of a square, ℓ = ρ²/2, so that JᵀJ = Σ ∇ℓ ∇ℓᵀ / 2ℓ needs nothing but the
rays' own gradients. The same gradients tell how much of their sum is chance: what the field does
not show well yet pulls each ray another way, a pose that is off pulls them all one way.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from avatar.pose.temporal_prior import UNINFORMATIVE_PRIOR, PosePrior

PRIOR_SIGMA_RAD = 0.05
"""How far a tracker's rotations are off, give or take: what no picture determines stays there."""
PRIOR_SIGMA_M = 0.025
"""The same of the root's place, metres."""
OVERRELAXATION = 1.6
"""Steps longer than Gauss-Newton's: the field that a pose is compared with follows the pose."""
MIN_EVIDENCE, FULL_EVIDENCE = 1.5, 2.0
"""Evidence, the frame's and all frames' halves, up to which a pose stays, and from which it moves
wholly. Of exact poses 5 % show 1.8, and all together 1.2; poses off by 2° show 3 to 6."""
MIN_RAY_LOSS = 1e-3
"""Of a ray: an error of 0.014 in one channel. What is smaller counts no more than this."""
MAX_STEP = 0.1
"""No number changes by more at once, in radians or metres."""


class GaussNewtonStep(NamedTuple):
    """What a frame's rays ask its pose to do.

    Attributes:
        change: Of the correction: radians, and metres in the last row.
        evidence: Mean of (Σ g)² / Σ g² over the directions that the rays determine: about 1 if
            their gradients g are chance, about their number if all say the same.
        alone: The correction that the rays would end at without neighbours, in units of its spread.
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
    overrelaxation: float = OVERRELAXATION,
) -> GaussNewtonStep:
    """The step that brings a pose to where its rays fit, as far as they determine it.

    Args:
        gradients: Of each ray's loss for the correction.
        loss: Of each ray.
        correction: As it is; directions that the rays leave open go back to what is expected.
        common: Mean evidence of all frames: they were tracked alike. Infinite where a pose is to
            move in any case.
        prior: What is believed of the correction before these rays are asked.
        overstep: Length of the step, in Gauss-Newton's.
    """
    scale = np.full((25, 3), PRIOR_SIGMA_RAD, dtype=np.float32)
    scale[24] = PRIOR_SIGMA_M
    scaled = (gradients * scale).reshape(-1, 75)
    curvature = (scaled / (2.0 * (loss.clip(min=0.0) + MIN_RAY_LOSS))[:, None]).T @ scaled
    determined, axes = np.linalg.eigh(curvature)
    determined = determined.clip(min=0.0)
    along = scaled @ axes
    chance, wish = (along**2).sum(axis=0), along.sum(axis=0)
    # what one unit of curvature is worth beside one spread of the prior: the rays' mean 2ℓ
    given = chance.sum() / (determined.sum() + 1e-12) + 1e-12
    told = determined > given
    evidence = float(np.mean(wish[told] ** 2 / (chance[told] + 1e-12))) if told.any() else 0.0
    share = min(
        max(
            (0.5 * (evidence + shared_evidence) - MIN_EVIDENCE) / (FULL_EVIDENCE - MIN_EVIDENCE),
            0.0,
        ),
        1.0,
    )

    def asked(length: float, believed: PosePrior) -> Float[np.ndarray, "25 3"]:
        stiff = believed.precision * given
        back = stiff * (axes.T @ ((correction - believed.mean) / scale).reshape(75))
        found = axes @ ((length * wish + back) / (determined + stiff))
        return found.reshape(25, 3).astype(np.float64)

    change = -share * scale * asked(overrelaxation, prior)
    shortened = MAX_STEP / max(float(np.abs(change).max()), MAX_STEP)
    return GaussNewtonStep(
        shortened * change, evidence, correction / scale - asked(1.0, UNINFORMATIVE_PRIOR)
    )
