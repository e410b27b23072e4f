"""How fast a motion goes by its own times."""

import numpy as np

from preprocess.pose import Motion


def pose_rate(motion: Motion) -> float:
    """By the times of its poses; 30 if it has none that can be."""
    if motion.times_s is None or len(motion) < 2:
        return 30.0
    step = float(np.median(np.diff(motion.times_s)))
    return round(1.0 / step, 3) if 1.0 / 240.0 <= step <= 10.0 else 30.0
