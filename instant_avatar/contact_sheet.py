"""Contact sheet: outlines of mask and body over frames, as stored and corrected."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from capture.atomic_files import OutputFileList, atomic_file
from capture.camera import same_aspect_ratio
from capture.input_error import InputError
from capture.source import AlphaMask, RgbImage
from instant_avatar.capture_validation import CaptureValidation
from instant_avatar.tracked_video import BODY_COLOR, MASK_COLOR, draw_outline
from preprocess.alignment.capture_geometry import FULL_WINDOW, CaptureGeometry
from preprocess.alignment.keypoint_objective import TrackedImage
from preprocess.alignment.silhouette_objective import components_touching, spaced_indices
from preprocess.body.body_surface import DENSE_SKIN_POINTS, SkinPoints, soft_iou
from preprocess.masks.mask_sources import StoredMasks

COLUMNS = 6
"""Frames per row."""
KEYPOINT_COLOR, PAPER_COLOR, INK_COLOR = (0, 220, 220), (245, 245, 245), (40, 40, 40)
"""RGB colors of the sheet."""
LABEL_PX = 26
"""Height of a row's label."""


def write_contact_sheet(
    path: Path, check: CaptureValidation, *, replace: bool | None = None, listed: bool = False
) -> bool:
    """Draw a few frames with the outlines of mask (white) and body (orange) and their IoU.

    Tracked key points are cyan. A second row shows the corrected capture, if there are corrections.
    `replace` is that of `atomic_file`; a `listed` sheet may be replaced by a later one.

    Returns:
        False if no frame could be drawn.
    """
    if not check.images:
        return False
    rows = [_draw_row(check, check.geometry, "as stored", check.stored_iou)]
    if check.causes:
        corrected = check.diagnosis.corrected
        rows.append(_draw_row(check, corrected, "corrected", check.corrected_iou))
    width = max(row.shape[1] for row in rows)
    paper = [np.full((len(row), width - row.shape[1], 3), PAPER_COLOR, np.uint8) for row in rows]
    sheet = np.concatenate([np.hstack(pair) for pair in zip(rows, paper, strict=True)])
    if listed:
        path.parent.mkdir(parents=True, exist_ok=True)
        OutputFileList(path.parent).create()
    with atomic_file(path, replace=replace) as part:
        code = cv2.imencode(path.suffix.lower() or ".png", np.ascontiguousarray(sheet[..., ::-1]))
        part.write_bytes(code[1].tobytes())
    return True


def _draw_row(
    check: CaptureValidation, geometry: CaptureGeometry, title: str, iou: float
) -> RgbImage:
    skin = SkinPoints.of(check.capture.shaped, DENSE_SKIN_POINTS)
    masks = check.capture.masks
    mask_of = masks.in_order_at_worst().read if isinstance(masks, StoredMasks) else None
    chosen = [check.images[place] for place in spaced_indices(len(check.images), COLUMNS)]
    seen = geometry.in_video_frames(check.capture.source.frames_in_file)
    cells = [_draw_cell(image, geometry, seen, skin, mask_of) for image in chosen]
    label = np.full((LABEL_PX, sum(c.shape[1] for c in cells), 3), PAPER_COLOR, np.uint8)
    score = "body outline (no masks)" if np.isnan(iou) else f"IoU {iou:.2f}"
    _draw_text(label, f"{title}: {score}", 6)
    return np.concatenate([label, np.concatenate(cells, axis=1)])


def _draw_cell(
    image: TrackedImage,
    geometry: CaptureGeometry,
    seen: CaptureGeometry,
    skin: SkinPoints,
    mask_of: Callable[[int, tuple[int, int]], AlphaMask] | None,
) -> RgbImage:
    """Draw one frame with both outlines.

    `seen` is `geometry` in the video's own frame numbers (`CaptureGeometry.in_video_frames`).
    """
    video = geometry.video_transform
    picture = image.thumbnail.copy()
    for point in image.image_px[image.confidence > 0.0] / image.size_px * picture.shape[1::-1]:
        cv2.circle(picture, tuple(point.round().astype(int).tolist()), 2, KEYPOINT_COLOR, -1)
    picture = video.reorient(picture)
    size = picture.shape[1], picture.shape[0]
    row, label = seen.row_for_frame(image.index), str(image.index)
    drawn, alpha = None, image.alpha
    if row is None:
        label += ": no pose"
    elif same_aspect_ratio(size, seen.size_px):
        drawn = skin.draw(seen.motion[row], seen.camera_at(image.index, size))
        draw_outline(picture, drawn.astype(np.float32), BODY_COLOR, width_px=2)
    if mask_of is not None and video.window == FULL_WINDOW:
        try:
            alpha = mask_of(video.first_frame + image.index, size)
        except InputError:  # this frame has none
            alpha = None
    if alpha is not None:
        alpha = np.float32(1.0) - alpha if geometry.masks_inverted else alpha
        if geometry.keeps_person_only and drawn is not None:
            alpha = components_touching(alpha, drawn)
        draw_outline(picture, alpha, MASK_COLOR, width_px=2)
        label += "" if drawn is None else f": {soft_iou(drawn, alpha):.2f}"
    _draw_text(picture, label, 4)
    return picture


def _draw_text(picture: RgbImage, text: str, x: int) -> None:
    y = LABEL_PX - 8
    for color, thick in ((PAPER_COLOR, 3), (INK_COLOR, 1)):
        cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, thick, cv2.LINE_AA)
