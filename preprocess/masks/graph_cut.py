"""GrabCut (Rother et al. 2004) in the crop around an uncertain band."""

import cv2
import numpy as np
from jaxtyping import Bool, UInt8


def cut_foreground(
    rgb: UInt8[np.ndarray, "height width 3"],
    labels: UInt8[np.ndarray, "height width"],
    near: Bool[np.ndarray, "height width"],
    margin_px: int,
    iterations: int,
) -> Bool[np.ndarray, "height width"] | None:
    """Segment an image in the crop around `near`; outside the crop all is background.

    Args:
        rgb: The image.
        labels: OpenCV's GC_BGD, GC_FGD, GC_PR_BGD or GC_PR_FGD of each pixel.
        near: Pixels that are or may be foreground.
        margin_px: Width of the background around them from which colors are learnt, px.
        iterations: Number of iterations.

    Returns:
        The foreground; None if the crop's labels hold only foreground or only background.
    """
    rows, columns = np.nonzero(near)
    if not len(rows):
        return None
    box = (
        slice(max(0, int(rows.min()) - margin_px), int(rows.max()) + margin_px + 1),
        slice(max(0, int(columns.min()) - margin_px), int(columns.max()) + margin_px + 1),
    )
    part = np.ascontiguousarray(labels[box])
    if not (part & 1).any() or (part & 1).all():
        return None
    cv2.setRNGSeed(0)  # GrabCut's k-means draws random numbers: equal images give equal masks
    models = np.zeros((1, 65)), np.zeros((1, 65))
    bgr = np.ascontiguousarray(rgb[box][..., ::-1])
    cv2.grabCut(bgr, part, (0, 0, 1, 1), *models, iterations, cv2.GC_INIT_WITH_MASK)
    foreground = np.zeros(labels.shape, dtype=bool)
    foreground[box] = (part & 1) > 0
    return foreground
