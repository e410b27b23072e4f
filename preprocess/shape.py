"""Which shape coefficients a motion gives a body."""

import numpy as np
from jaxtyping import Float

from preprocess.body import Body
from preprocess.pose import Motion


def betas_for(body: Body, motion: Motion) -> Float[np.ndarray, "betas"]:
    """The motion's betas if they were made for this family of bodies, else zeros.

    Betas are coordinates in one model's shape space and mean nothing in another's.
    """
    if motion.model == body.family:
        return motion.betas
    return np.zeros(body.shape_directions.shape[-1])
