"""Contact sheet: outlines of mask and body over frames, as stored and corrected."""

import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from apps.capture_validation import CaptureValidation
from capture.atomic_files import OutputFileList, atomic_file
from capture.camera import same_aspect_ratio
from capture.source import Frame
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.silhouette_objective import mean_score, spaced_indices
from preprocess.body.body_surface import SkinPoints, splat_silhouette

COLUMNS = 6
"""Frames per row."""
CELL_PX = 300
"""Height of a frame on the sheet."""
DECODE_BUDGET_S = 4.0
"""Decoding time for the sheet, seconds; a long video is shown up to where that ends."""
MASK_COLOR, BODY_COLOR = (255, 255, 255), (255, 120, 0)
PAPER_COLOR, INK_COLOR = (245, 245, 245), (40, 40, 40)
"""RGB colors of the sheet."""
LABEL_PX = 26
"""Height of a row's label."""

Rgb = UInt8[np.ndarray, "height width 3"]


def write_contact_sheet(
    path: Path, check: CaptureValidation, *, replace: bool | None = None, listed: bool = False
) -> bool:
    """Draw a few frames with the outlines of mask (white) and body (orange) and their IoU.

    A second row shows the corrected capture, if there are corrections. Without masks only the
    body's outline is drawn.

    Args:
        path: Image to write.
        check: The validated capture.
        replace: Whether an existing file may be replaced, as in `atomic_file`.
        listed: Whether to list the sheet in its folder, so that a later one may replace it.

    Returns:
        Whether any frame could be drawn.

    Raises:
        OSError: If the image cannot be written.
    """
    numbers, diagnosis = _choose_frames(check), check.diagnosis
    healed = diagnosis.corrected if diagnosis and diagnosis.corrections else None
    # a corrected video has its own frame numbers
    also = [healed.video_transform.video_frame(number) for number in numbers] if healed else []
    frames = _decode_frames(check, {*numbers, *also})
    rows = [_draw_row(check, numbers, frames, check.hypothesis, "as stored")]
    if healed is not None:
        rows.append(_draw_row(check, numbers, frames, healed, "corrected"))
    rows = [row for row in rows if row is not None]
    if not rows:
        return False
    width = max(row.shape[1] for row in rows)
    sheet = np.concatenate([_pad_row(row, width) for row in rows])
    if listed:
        path.parent.mkdir(parents=True, exist_ok=True)
        OutputFileList(path.parent).create()
    with atomic_file(path, replace=replace) as part:
        _, code = cv2.imencode(
            path.suffix.lower() or ".png", np.ascontiguousarray(sheet[..., ::-1])
        )
        part.write_bytes(code.tobytes())
    return True


def _choose_frames(check: CaptureValidation) -> list[int]:
    """Choose frames that have masks, else poses."""
    if check.sampled_masks is not None:
        return [witness.index for witness in check.sampled_masks.subset(COLUMNS).samples]
    source = check.recording.source
    chosen = range(source.frames_in_file)[source.selection.start :: source.selection.step]
    posed = [
        n
        for n in chosen
        if source.selection.contains(n) and check.hypothesis.row_for_frame(n) is not None
    ]
    return [posed[place] for place in spaced_indices(len(posed), COLUMNS)] if posed else []


def _decode_frames(check: CaptureValidation, frame_numbers: set[int]) -> dict[int, Frame]:
    """Decode the frames by number, as far as the time budget allows."""
    began, found = time.perf_counter(), {}
    for frame in check.recording.source.frames():
        if frame.index in frame_numbers:
            found[frame.index] = frame
        if len(found) == len(frame_numbers) or time.perf_counter() - began > DECODE_BUDGET_S:
            break
    return found


def _draw_row(
    check: CaptureValidation,
    numbers: Sequence[int],
    frames: dict[int, Frame],
    hypothesis: CaptureGeometry,
    title: str,
) -> Rgb | None:
    """Draw a row of the decoded frames; None if there are none."""
    shown = [(n, frames.get(hypothesis.video_transform.video_frame(n))) for n in numbers]
    cells = [_draw_cell(frame, n, check, hypothesis) for n, frame in shown if frame is not None]
    if not cells:
        return None
    label = np.full((LABEL_PX, sum(c.shape[1] for c in cells), 3), PAPER_COLOR, np.uint8)
    if check.sampled_masks is None:
        _draw_text(label, f"{title}: body outline (no masks)", 6)
    else:
        scores = check.sampled_masks.subset(COLUMNS).frame_scores(hypothesis)
        _draw_text(label, f"{title}: IoU {mean_score(scores):.2f}", 6)
    return np.concatenate([label, np.concatenate(cells, axis=1)])


def _pad_row(row: Rgb, width: int) -> UInt8[np.ndarray, "rows columns 3"]:
    """Pad a row on its right."""
    return np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=PAPER_COLOR[0])


def _draw_cell(
    frame: Frame, number: int, check: CaptureValidation, hypothesis: CaptureGeometry
) -> Rgb:
    """Draw one frame with both outlines.

    Args:
        frame: The decoded frame.
        number: Frame number of its mask and pose.
        check: Holds the masks.
        hypothesis: Poses, cameras and video transform.
    """
    picture, _ = hypothesis.video_transform.warp_to_mask(frame.rgb)
    height, width = picture.shape[:2]
    size = max(1, round(CELL_PX * width / height)), CELL_PX
    picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    picture = (0.6 * picture + 0.4 * picture.mean()).astype(np.uint8)
    evidence, row = check.sampled_masks, hypothesis.row_for_frame(number)
    score = "" if row is not None else ": no pose"
    if not same_aspect_ratio((width, height), check.recording.source.size_px):
        score = ""  # rotated by a quarter turn: the IoU would be that of another shape
    elif evidence is None:
        if row is not None:
            skin, camera = SkinPoints.of(check.recording.shaped), hypothesis.camera_at(number, size)
            _draw_outline(
                picture, splat_silhouette(skin.posed(hypothesis.motion[row]), camera), BODY_COLOR
            )
    else:
        witness = next(w for w in evidence.samples if w.index == number)
        alpha = np.float32(1.0) - witness.alpha if hypothesis.masks_inverted else witness.alpha
        alpha = (
            evidence.keep_person(hypothesis, number, alpha)
            if hypothesis.keeps_person_only
            else alpha
        )
        _draw_outline(picture, alpha > 0.5, MASK_COLOR)
        if row is not None:
            camera = hypothesis.camera_at(witness.camera_row, evidence.size_px)
            _draw_outline(
                picture,
                splat_silhouette(evidence.posed_points(hypothesis.motion, row), camera),
                BODY_COLOR,
            )
            score = f": {evidence.frame_score(hypothesis, witness):.2f}"
    _draw_text(picture, f"{frame.index}{score}", 4)
    return picture


def _draw_outline(
    picture: Rgb, silhouette_mask: Bool[np.ndarray, "_ _"], color: tuple[int, int, int]
) -> None:
    large = cv2.resize(silhouette_mask.astype(np.float32), picture.shape[1::-1]) > 0.5
    found, _ = cv2.findContours(large.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, found, -1, color, 2, cv2.LINE_AA)


def _draw_text(picture: Rgb, text: str, x: int) -> None:
    y = LABEL_PX - 8
    for color, thick in ((PAPER_COLOR, 3), (INK_COLOR, 1)):
        cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, thick, cv2.LINE_AA)
