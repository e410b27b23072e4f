"""The tracked video: skeleton, body and mask over each frame, and why a frame is doubtful."""

import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from capture.atomic_files import atomic_file
from capture.source import AlphaMask, RgbImage, shrink_to_longer_side
from capture.video_writer import H264, write_video
from preprocess.body.body_surface import SkinPoints
from preprocess.capture_session import Capture
from preprocess.observation import Observation

LONGER_SIDE_PX = 720
"""Longer side of the video, px."""
LETTER_PX, LINE_PX = 7, 16
"""Width of a letter and height of a line of text, px."""
MASK_COLOR, BODY_COLOR = (255, 255, 255), (255, 120, 0)
"""RGB colors of the outlines of mask and body."""
LEFT_COLOR, RIGHT_COLOR, MIDDLE_COLOR = (255, 150, 40), (60, 190, 255), (240, 240, 240)
"""RGB colors of the person's left and right limbs, and of trunk and head."""
LEFT_JOINTS = frozenset({1, 4, 7, 10, 13, 16, 18, 20, 22})
"""Joints of SMPL's tree on the person's left; the next one is that on the right."""


def write_tracked_video(path: Path, capture: Capture, doubts: Mapping[int, str]) -> int:
    """Draw skeleton, body and mask over each frame, and why a frame is doubtful.

    `doubts` are sentences by frame number; doubtful frames are drawn, even if they are left out of
    training. Return the number of frames drawn.
    """
    motion = capture.motion
    if motion.frames is not None and motion.keypoints is not None:
        doubtful = np.isin(motion.frames, np.intersect1d(list(doubts), motion.keypoints.frames))
        capture = replace(capture, motion=replace(motion, valid=motion.valid | doubtful))
    source = capture.source
    count, duration = source.frame_count or 1, source.duration_s
    fps = min(60.0, max(1.0, count / duration)) if duration else 10.0
    with atomic_file(path) as part:
        return write_video(part, _draw_frames(capture, doubts), fps, H264)


def _draw_frames(capture: Capture, doubts: Mapping[int, str]) -> Iterator[RgbImage]:
    skin = SkinPoints.of(capture.shaped)
    for item in capture.observations():
        if not isinstance(item, Observation):
            continue
        size_px = _video_size_px(item.frame.size_px)
        image = cv2.resize(item.frame.rgb, size_px, interpolation=cv2.INTER_AREA)
        camera = item.camera.resize(size_px)
        small = item.camera.resize(shrink_to_longer_side(item.camera.size_px, 256))
        drawn = skin.draw(item.pose, small).astype(np.float32)
        draw_outline(image, cv2.resize(item.alpha, size_px), MASK_COLOR, width_px=1)
        draw_outline(image, cv2.resize(drawn, size_px), BODY_COLOR, width_px=1)
        pixels = camera.project(capture.shaped.with_pose(item.pose).joints())
        for joint, parent in enumerate(capture.shaped.body.parents):
            if parent >= 0:
                _draw_bone(image, pixels[parent], pixels[joint], _joint_color(joint))
        doubt = doubts.get(item.frame.index, "")
        _draw_text(image, f"{item.frame.time_s:5.1f} s  {doubt}".rstrip(), bool(doubt))
        yield image


def _video_size_px(size_px: tuple[int, int]) -> tuple[int, int]:
    """Size of the video of frames of a size; even numbers, as encoders want."""
    scale = max(1.0, 320 / min(size_px))  # text on a smaller image cannot be read
    scale = min(scale, LONGER_SIDE_PX / max(size_px))
    width, height = (max(2, 2 * round(scale * side / 2)) for side in size_px)
    return width, height


def _joint_color(joint: int) -> tuple[int, int, int]:
    if joint in LEFT_JOINTS:
        return LEFT_COLOR
    return RIGHT_COLOR if joint - 1 in LEFT_JOINTS else MIDDLE_COLOR


def _draw_bone(
    image: RgbImage, one: np.ndarray, other: np.ndarray, color: tuple[int, int, int]
) -> None:
    ends = [tuple(int(v) for v in np.clip(16.0 * end, -1e6, 1e6)) for end in (one, other)]
    cv2.line(image, ends[0], ends[1], (20, 20, 20), 5, cv2.LINE_AA, shift=4)
    cv2.line(image, ends[0], ends[1], color, 3, cv2.LINE_AA, shift=4)


def draw_outline(
    image: RgbImage, alpha: AlphaMask, color: tuple[int, int, int], *, width_px: int
) -> None:
    """Draw the outline of a mask of the image's size."""
    inside = (alpha > 0.5).astype(np.uint8)
    found, _ = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, found, -1, color, width_px, cv2.LINE_AA)


def _draw_text(image: RgbImage, text: str, doubtful: bool) -> None:
    """Write lines at the top, on a dark ground, as many as the width asks for."""
    letters = max(12, (image.shape[1] - 12) // LETTER_PX)
    lines = textwrap.wrap(text, letters)
    ground = image[: 6 + LINE_PX * len(lines)]
    ground[:] = ground // 4
    color = (255, 60, 60) if doubtful else MASK_COLOR
    for row, line in enumerate(lines):
        at = (6, LINE_PX * (row + 1))
        cv2.putText(image, line, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, color, 1, cv2.LINE_AA)
