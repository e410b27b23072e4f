"""The solving process: `python -m apps.solving.worker FOLDER`, with job.json in the folder.

It writes a line of JSON to stdout whenever it has come further, and ends when its stdin is closed:
so it never outlives who started it.
"""

import json
import os
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from apps.recording.opening import open_capture
from apps.recording.recording import Capture
from apps.solving.job import SolveJob
from capture.errors import InputError
from capture.frame import Frame
from preprocess.masks.outline import MeshSilhouette
from preprocess.observe import associate_masks, associate_poses, alpha_channel_mask
from preprocess.solve.keyframes import PersonMaskFn
from preprocess.solve.solved import CameraSolution
from preprocess.solve.solver import SolverSettings, solve_cameras
from preprocess.solve.stages import StageProgressFn

EXIT_REFUSED = 2
REPORT_INTERVAL_S = 0.2
BODY_MARGIN = 0.06
"""How far clothes and hair may stick out of the body, in the person's height in the picture."""
SOLUTION_FILE = "solved.json"
KEPT_FILES = frozenset({"job.json", SOLUTION_FILE, "solved.npz", "model.npz", "stages.json", "log.txt"})


def main() -> int:
    """The process; returns its exit code."""
    folder = Path(sys.argv[1])
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    job = SolveJob.of(json.loads((folder / "job.json").read_text(encoding="utf-8")))
    try:
        run_job(job, folder, _ProgressPrinter())
    except InputError as refusal:
        (folder / "refused.txt").write_text_atomically(str(refusal), encoding="utf-8")
        return EXIT_REFUSED
    return 0


def run_job(job: SolveJob, folder: Path, told: StageProgressFn) -> CameraSolution:
    """Solves a capture's cameras into a folder; takes up what lies there.

    Raises:
        InputError: If they cannot be solved with certainty.
    """
    cv2.setNumThreads(job.threads)
    recording = open_capture(job.paths, skip_checks=True)
    intrinsic, longer = recording.cameras[0].intrinsic, max(recording.source.size_px)
    known = recording.motion.intrinsic is not None
    settings = SolverSettings(
        focal_ratio=float(intrinsic[0, 0]) / longer if known else None,
        seed=job.seed,
        threads=job.threads,
    )
    solved = solve_cameras(recording.source, make_person_mask(recording), folder, settings, told)
    solved.save(folder)
    return solved


def make_person_mask(recording: Capture) -> PersonMaskFn:
    """Where the person is: by the masks, or by the posed body with room for clothes."""
    source = recording.source
    if recording.masks is not None or source.has_alpha:
        row_of = associate_masks(recording.masks, source)

        def by_mask(frame: Frame, size_px: tuple[int, int]) -> Bool[np.ndarray, "_ _"] | None:
            try:
                if recording.masks is None:
                    return alpha_channel_mask(frame, size_px) > 0.2
                return recording.masks.alpha(row_of(frame.index), size_px) > 0.2
            except InputError:  # one damaged mask
                return None

        return by_mask
    outline, pose_row = MeshSilhouette(recording.shaped), associate_poses(recording.motion, source)

    def by_body(frame: Frame, size_px: tuple[int, int]) -> Bool[np.ndarray, "_ _"] | None:
        row = pose_row(frame)
        if row is None or not recording.motion.valid[row]:
            return None
        body = outline.draw_pose(recording.motion[row], recording.cameras[0].resize(size_px))
        rows = np.flatnonzero(body.any(axis=1))
        if not len(rows):
            return None
        side = 2 * max(2, round(BODY_MARGIN * (rows[-1] - rows[0]))) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        return cv2.dilate(body.astype(np.uint8), disc) > 0

    return by_body


class _ProgressPrinter:
    """Tells stdout, not too often."""

    def __init__(self) -> None:
        self._at, self._stage = 0.0, ""

    def __call__(self, stage: str, share: float) -> None:
        now = time.monotonic()
        if stage == self._stage and share < 1.0 and now - self._at < REPORT_INTERVAL_S:
            return
        self._at, self._stage = now, stage
        print(json.dumps({"stage": stage, "share": share}), flush=True)  # noqa: T201 - the wire


def _exit_with_parent() -> None:
    while os.read(0, 1):  # not sys.stdin, whose lock a thread must not hold at the end
        pass
    os._exit(130)


if __name__ == "__main__":
    sys.exit(main())
