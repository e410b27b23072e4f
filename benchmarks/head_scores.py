"""How well an avatar shows a head in the resolution in which it was filmed."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32

from avatar.evaluation.held_out import HeldOutFrame
from avatar.evaluation.image_metrics import (
    MASK_THRESHOLD,
    composite_on_white,
    ground_truth_on_white,
    psnr_of_errors,
)
from avatar.render import render
from avatar.training.held_out_pose_fitting import fit_test_poses
from avatar.training.trainer import Trainer
from avatar.training.training_pixels import head_box

BORDER_SHARE = 1 / 12
"""Width of the border of the person that is left out of `HeadScore.inside`, in heads: about a
centimetre, where masks of two resolutions differ."""


class HeadScore(NamedTuple):
    """Mean PSNR of heads in poses fitted to held-out frames, dB, where the person is.

    Attributes:
        whole: Up to the border of the mask.
        inside: Without the border: eyes, mouth, hair.
    """

    whole: float
    inside: float


def score_heads(trainer: Trainer, filmed: list[HeldOutFrame]) -> HeadScore | None:
    """Scores the heads of frames in the film's own resolution; None where none shows a head."""
    scores = []
    for frame in fit_test_poses(trainer, filmed):
        seen = frame.observation
        left, top, right, bottom = head_box(seen.camera, seen.pose, trainer.avatar.rig)
        part = slice(top, bottom), slice(left, right)
        person = (seen.alpha[part] > MASK_THRESHOLD).astype(np.uint8)
        side = 2 * round(0.5 * BORDER_SHARE * max(person.shape)) + 1
        kernel = np.ones((side, side), dtype=np.uint8)
        inside = cv2.erode(person, kernel, borderValue=1) if person.size else person
        if not inside.any():
            continue
        camera = seen.camera.crop((left, top), (right - left, bottom - top))
        picture = render(trainer.avatar, seen.pose, camera, shaded=True)
        errors = _squared_errors(frame.expose(picture), ground_truth_on_white(seen)[part])
        scores.append([psnr_of_errors(errors[mask > 0]) for mask in (person, inside)])
    return HeadScore(*np.mean(scores, axis=0).tolist()) if scores else None


def _squared_errors(
    picture: Float32[np.ndarray, "height width 4"], truth: Float32[np.ndarray, "height width 3"]
) -> Float32[np.ndarray, "height width 3"]:
    return (np.clip(composite_on_white(picture), 0.0, 1.0) - truth) ** 2
