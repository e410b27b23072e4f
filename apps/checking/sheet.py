"""A sheet of pictures to look at: mask and body drawn over frames, as they are and as mended."""

import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from apps.checking.examine import Examined
from capture.atomic_files import whole_file
from capture.file_list import FileList
from capture.frame import Frame
from preprocess.doctor.claim import Claim
from preprocess.doctor.evidence import Evidence, Witness
from preprocess.silhouette import silhouette

COLUMNS = 6
CELL_PX = 300
PATIENCE_S = 4.0
"""So long frames are decoded for the sheet; of a long video it shows the beginning."""
MASK, BODY, PAPER, INK = (255, 255, 255), (255, 120, 0), (245, 245, 245), (40, 40, 40)
LABEL_PX = 26

Rgb = UInt8[np.ndarray, "height width 3"]


def write_sheet(
    path: Path, examined: Examined, *, replace: bool | None = None, listed: bool = False
) -> bool:
    """Draws a few frames: white the mask's outline, orange the body's, and their agreement.

    The second row, if there is one, is what the named cures would make of it.

    Args:
        path: Where to.
        examined: What is drawn.
        replace: Whether a file that is there already may go, as of `whole_file`.
        listed: Whether the folder gets a list, by which a later sheet may replace this one.

    Returns:
        Whether there was anything to draw.

    Raises:
        OSError: If it cannot be written.
    """
    evidence = examined.evidence
    if evidence is None or examined.diagnosis is None:
        return False
    shown = _shown(examined, evidence)
    if not shown:
        return False
    rows = [_row(shown, examined.claim, evidence, "as it is")]
    if examined.diagnosis.cures:
        rows.append(_row(shown, examined.diagnosis.healed, evidence, "mended"))
    sheet = np.concatenate(rows)
    if listed:
        path.parent.mkdir(parents=True, exist_ok=True)
        FileList(path.parent).make()
    with whole_file(path, replace=replace) as part:
        _, code = cv2.imencode(
            path.suffix.lower() or ".png", np.ascontiguousarray(sheet[..., ::-1])
        )
        part.write_bytes(code.tobytes())
    return True


def _shown(examined: Examined, evidence: Evidence) -> list[tuple[Frame, Witness]]:
    """Frames that were looked at, spread over what can be decoded in a few seconds."""
    wanted = {witness.index: witness for witness in evidence.some(COLUMNS).witnesses}
    began, found = time.perf_counter(), []
    for frame in examined.recording.source.frames():
        if frame.index in wanted:
            found.append((frame, wanted.pop(frame.index)))
        if not wanted or time.perf_counter() - began > PATIENCE_S:
            break
    return found


def _row(
    shown: Sequence[tuple[Frame, Witness]], claim: Claim, evidence: Evidence, title: str
) -> Rgb:
    cells = [_cell(frame, witness, claim, evidence) for frame, witness in shown]
    label = np.full((LABEL_PX, sum(c.shape[1] for c in cells), 3), PAPER, np.uint8)
    scores = [evidence.score(claim, witness) for _, witness in shown]
    known = [score for score in scores if np.isfinite(score)]
    _write(label, f"{title}: agreement {np.mean(known) if known else 0.0:.2f}", 6)
    return np.concatenate([label, np.concatenate(cells, axis=1)])


def _cell(frame: Frame, witness: Witness, claim: Claim, evidence: Evidence) -> Rgb:
    """One frame with both outlines."""
    width, height = frame.size_px
    size = max(1, round(CELL_PX * width / height)), CELL_PX
    picture = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA)
    picture = (0.6 * picture + 0.4 * picture.mean()).astype(np.uint8)
    alpha = np.float32(1.0) - witness.alpha if claim.inverted else witness.alpha
    _outline(picture, alpha > 0.5, MASK)
    row = claim.row_of(witness.index)
    if row is not None:
        camera = claim.camera(witness.camera_row, evidence.size_px)
        _outline(picture, silhouette(evidence.posed(claim.motion, row), camera), BODY)
    score = "no pose" if row is None else f"{evidence.score(claim, witness):.2f}"
    _write(picture, f"{witness.index}: {score}", 4)
    return picture


def _outline(picture: Rgb, shape: Bool[np.ndarray, "_ _"], color: tuple[int, int, int]) -> None:
    large = cv2.resize(shape.astype(np.float32), picture.shape[1::-1]) > 0.5
    found, _ = cv2.findContours(large.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, found, -1, color, 2, cv2.LINE_AA)


def _write(picture: Rgb, words: str, x: int) -> None:
    y = LABEL_PX - 8
    for color, thick in ((PAPER, 3), (INK, 1)):
        cv2.putText(
            picture, words, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, thick, cv2.LINE_AA
        )
