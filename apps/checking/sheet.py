"""A sheet of pictures to look at: mask and body drawn over frames, as they are and corrected."""

import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from apps.checking.examine import Examined
from capture.atomic_files import whole_file
from capture.camera import same_shape
from capture.file_list import FileList
from capture.frame import Frame
from preprocess.doctor.claim import Claim
from preprocess.doctor.diagnosis import mean
from preprocess.doctor.evidence import spread
from preprocess.silhouette import SkinPoints, silhouette

COLUMNS = 6
CELL_PX = 300
PATIENCE_S = 4.0
"""Seconds for which frames are decoded for the sheet; of a long video it shows the beginning."""
MASK, BODY, PAPER, INK = (255, 255, 255), (255, 120, 0), (245, 245, 245), (40, 40, 40)
LABEL_PX = 26

Rgb = UInt8[np.ndarray, "height width 3"]


def write_sheet(
    path: Path, examined: Examined, *, replace: bool | None = None, listed: bool = False
) -> bool:
    """Draws a few frames: white the mask's outline, orange the body's, and their agreement.

    The second row, if there is one, is what the named cures would make of it. Without masks only
    the body's outline is drawn.

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
    numbers, diagnosis = _numbers(examined), examined.diagnosis
    healed = diagnosis.healed if diagnosis and diagnosis.cures else None
    # A cured film shows the masks' frames under numbers of its own.
    also = [healed.film.frame(number) for number in numbers] if healed else []
    frames = _decoded(examined, {*numbers, *also})
    rows = [_row(examined, numbers, frames, examined.claim, "as it is")]
    if healed is not None:
        rows.append(_row(examined, numbers, frames, healed, "corrected"))
    rows = [row for row in rows if row is not None]
    if not rows:
        return False
    width = max(row.shape[1] for row in rows)
    sheet = np.concatenate([_widened(row, width) for row in rows])
    if listed:
        path.parent.mkdir(parents=True, exist_ok=True)
        FileList(path.parent).make()
    with whole_file(path, replace=replace) as part:
        _, code = cv2.imencode(
            path.suffix.lower() or ".png", np.ascontiguousarray(sheet[..., ::-1])
        )
        part.write_bytes(code.tobytes())
    return True


def _numbers(examined: Examined) -> list[int]:
    """Numbers of the frames that are shown: those of masks, else of poses."""
    if examined.evidence is not None:
        return [witness.index for witness in examined.evidence.some(COLUMNS).witnesses]
    source = examined.recording.source
    chosen = range(source.frames_in_file)[source.selection.start :: source.selection.step]
    posed = [
        n for n in chosen if source.selection.wants(n) and examined.claim.row_of(n) is not None
    ]
    return [posed[place] for place in spread(len(posed), COLUMNS)] if posed else []


def _decoded(examined: Examined, wanted: set[int]) -> dict[int, Frame]:
    """The wanted frames by their numbers, as far as they are decoded in a few seconds."""
    began, found = time.perf_counter(), {}
    for frame in examined.recording.source.frames():
        if frame.index in wanted:
            found[frame.index] = frame
        if len(found) == len(wanted) or time.perf_counter() - began > PATIENCE_S:
            break
    return found


def _row(
    examined: Examined, numbers: Sequence[int], frames: dict[int, Frame], claim: Claim, title: str
) -> Rgb | None:
    """A row of the frames that are there; None if none is."""
    shown = [(n, frames.get(claim.film.frame(n))) for n in numbers]
    cells = [_cell(frame, n, examined, claim) for n, frame in shown if frame is not None]
    if not cells:
        return None
    label = np.full((LABEL_PX, sum(c.shape[1] for c in cells), 3), PAPER, np.uint8)
    if examined.evidence is None:
        _write(label, f"{title}: the body's outline; there are no masks", 6)
    else:
        scores = examined.evidence.some(COLUMNS).scores(claim)
        _write(label, f"{title}: agreement {mean(scores):.2f}", 6)
    return np.concatenate([label, np.concatenate(cells, axis=1)])


def _widened(row: Rgb, width: int) -> UInt8[np.ndarray, "rows columns 3"]:
    """A row with paper on its right."""
    return np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=PAPER[0])


def _cell(frame: Frame, number: int, examined: Examined, claim: Claim) -> Rgb:
    """One frame with both outlines.

    Args:
        frame: The film's picture.
        number: The frame number that its mask and pose have.
        examined: The masks.
        claim: Poses, cameras and film.
    """
    picture, _ = claim.film.on_mask(frame.rgb)
    height, width = picture.shape[:2]
    size = max(1, round(CELL_PX * width / height)), CELL_PX
    picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    picture = (0.6 * picture + 0.4 * picture.mean()).astype(np.uint8)
    evidence, row = examined.evidence, claim.row_of(number)
    score = "" if row is not None else ": no pose"
    if not same_shape((width, height), examined.recording.source.size_px):
        score = ""  # rotated by a quarter turn: outlines belong to pictures of another shape
    elif evidence is None:
        if row is not None:
            skin, camera = SkinPoints.of(examined.recording.shaped), claim.camera(number, size)
            _outline(picture, silhouette(skin.posed(claim.motion[row]), camera), BODY)
    else:
        witness = next(w for w in evidence.witnesses if w.index == number)
        alpha = np.float32(1.0) - witness.alpha if claim.inverted else witness.alpha
        alpha = evidence.person_of(claim, number, alpha) if claim.alone else alpha
        _outline(picture, alpha > 0.5, MASK)
        if row is not None:
            camera = claim.camera(witness.camera_row, evidence.size_px)
            _outline(picture, silhouette(evidence.posed(claim.motion, row), camera), BODY)
            score = f": {evidence.score(claim, witness):.2f}"
    _write(picture, f"{frame.index}{score}", 4)
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
