"""Scores of a trained system: in the poses given, and in poses fitted to the scored pictures."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from avatar.evaluation.held_out import HeldOutFrame, coarse_to_fine_order, score_rendering
from avatar.evaluation.image_metrics import composite_on_white, ground_truth_on_white
from baselines.systems.compared_capture import ComparedCapture
from baselines.systems.compared_systems import ComparedSystem
from baselines.systems.pose_alignment import RENDERINGS, align_pose
from capture.image_folder import write_png

CURVE_FRAMES, CURVE_RENDERINGS = 3, 4
"""Frames that a point of the curve is scored on, and small pictures to fit the pose of each: novel
poses where there are any. The end scores all frames of both kinds, with more pictures."""
MEANS = ("psnr", "psnr_mask", "ssim")
"""Scores whose means are kept."""


@dataclass(frozen=True, kw_only=True)
class CurvePsnr:
    """Mean PSNR on white after some training, in fitted poses, dB.

    Attributes:
        core_seconds, steps: Spent so far.
        held_out, novel: Of a few novel poses, or of held-out frames where there are none.
    """

    core_seconds: float
    steps: int
    held_out: float | None
    novel: float | None


def curve_point(system: ComparedSystem, data: ComparedCapture, spent: float) -> CurvePsnr:
    """Scores a few frames in the midst of training."""
    frames = coarse_to_fine_order(data.novel or data.held_out)[:CURVE_FRAMES]
    found = _score(system, _align(system, frames, data, CURVE_RENDERINGS), None)["psnr"]
    held_out, novel = (None, found) if data.novel else (found, None)
    return CurvePsnr(core_seconds=spent, steps=system.steps, held_out=held_out, novel=novel)


def score_all(system: ComparedSystem, data: ComparedCapture, folder: Path) -> dict[str, Any]:
    """Scores all held-out frames and novel poses, given and fitted, and writes their pictures.

    Returns:
        By kind, `held_out`, `held_out_fitted`, `novel` and `novel_fitted`: the means, None without
        frames, and each frame's scores. The folder has pictures on white by the same names; the
        truth lies with those in given poses.
    """
    found = {}
    for kind, frames in (("held_out", data.held_out), ("novel", data.novel)):
        found[kind] = _score(system, frames, folder / kind)
        fitted = _align(system, frames, data, RENDERINGS)
        found[f"{kind}_fitted"] = _score(system, fitted, folder / f"{kind}_fitted")
        for frame in frames:
            truth = ground_truth_on_white(frame.observation)
            _write(folder / kind / "truth", frame, truth)
    return found


def _align(
    system: ComparedSystem, frames: list[HeldOutFrame], data: ComparedCapture, renderings: int
) -> list[HeldOutFrame]:
    """The frames in poses fitted to them (`align_pose`)."""
    person, found = data.capture.shaped, []
    for frame in frames:
        seen = align_pose(system.render, frame.observation, person, renderings=renderings)
        found.append(replace(frame, observation=seen))
    return found


def _score(
    system: ComparedSystem, frames: list[HeldOutFrame], folder: Path | None
) -> dict[str, Any]:
    """Mean scores and those of each frame; a folder gets the pictures on white."""
    scores = []
    for frame in frames:
        rendering = system.render(frame.observation)
        scores.append(score_rendering(rendering, frame))
        if folder is not None:
            _write(folder, frame, composite_on_white(rendering))
    means = {
        key: float(np.mean([getattr(score, key) for score in scores])) if scores else None
        for key in MEANS
    }
    return {**means, "frames": [asdict(score) for score in scores]}


def _write(folder: Path, frame: HeldOutFrame, image: Float32[np.ndarray, "height width 3"]) -> None:
    """Writes a picture in [0, 1] under the frame's number."""
    folder.mkdir(parents=True, exist_ok=True)
    pixels = np.rint(255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)
    name = f"{frame.observation.frame.index:04d}.png"
    write_png(folder / name, pixels)
