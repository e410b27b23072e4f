"""Trackers: networks that find one person's key points and mask, frame by frame.

This project's own is BlazePose; another package may register one as an entry point.
"""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from preprocess.tracking.keypoints import PersonKeypoints


@runtime_checkable
class PersonTracker(Protocol):
    """Follows one person, frame by frame, in the order of the frames."""

    def __call__(self, rgb: UInt8[np.ndarray, "height width 3"]) -> PersonKeypoints | None:
        """Find the person in the next frame; None where there is none."""
        ...
