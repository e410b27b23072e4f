"""Small masks of frames spread over a capture: given, refined or estimated."""

from contextlib import suppress
from dataclasses import replace

from capture.input_error import InputError
from capture.source_opening import reopen
from capture.work_ahead import read_ahead
from preprocess.alignment.silhouette_objective import MaskSample, reduce_masks, sample_masks
from preprocess.body.body_surface import SkinPoints
from preprocess.capture_session import Capture
from preprocess.fitting.outlines import OUTLINE_PERSON_PX
from preprocess.observation import Observation, associate_cameras

START_FRAMES = 16
"""Frames of the first masks, spread evenly."""


def read_first_silhouettes(capture: Capture) -> tuple[MaskSample, ...]:
    """Masks as they are given, or as the beginning of the video shows them; none without any."""
    with suppress(InputError):
        if capture.masks.is_given:
            return _read_given(capture, START_FRAMES)
        total = min(capture.source.frame_count or 1, 240)  # decoding takes longest
        small = replace(capture, size_px=min(capture.size_px, 320))
        return _observe(small, START_FRAMES, total)
    return ()


def read_silhouettes(capture: Capture, count: int) -> tuple[MaskSample, ...]:
    """Masks as training sees them, of evenly spread frames; none without any.

    Frames are decoded where masks are estimated or refined. What refines masks then knows the
    background from the video's first frame on.
    """
    masks, tracked = capture.masks, capture.motion.keypoints is not None
    with suppress(InputError):
        if not masks.is_given or (masks.needs_all_frames and not tracked):
            samples = _observe(capture, count, capture.source.frame_count or 1)
            if masks.is_refined or not masks.is_given:
                return samples
        return _read_given(capture, count)
    return ()


def _read_given(capture: Capture, count: int) -> tuple[MaskSample, ...]:
    skin = SkinPoints.of(capture.shaped, 1)
    return sample_masks(
        capture.source, capture.masks, capture.cameras, skin,
        count=count, person_px=OUTLINE_PERSON_PX, track=capture.motion.keypoints,
    ).samples  # fmt: skip


def _observe(capture: Capture, count: int, total: int) -> tuple[MaskSample, ...]:
    """Masks of at most `count` of the first `total` frames; ends once none needs to be decoded."""
    source, masks = capture.source, capture.masks
    observe, camera_row = capture.observation_builder(), associate_cameras(capture.cameras, source)
    chosen = source.selection
    stride = chosen.step * max(1, -(-total // count))
    start = chosen.start + stride // 2 // chosen.step * chosen.step
    stop = chosen.start + total * chosen.step if total < (source.frame_count or 1) else chosen.stop
    samples = []
    frames = reopen(source, slice(start, stop, stride)).frames()
    for each in map(observe, read_ahead(frames)):
        if isinstance(each, Observation):
            index = each.frame.index
            longer, is_whole = max(each.frame.size_px), each.filmed_rgb is None
            # for the key points, whose network sees them at 256 px; 50 of 960 px take 80 MB
            keeps = longer <= 960 and (is_whole or longer >= 480)
            samples.append(
                MaskSample(
                    index=index, camera_row=camera_row(index), alpha=each.alpha,
                    picture=each.frame if keeps else None,
                )
            )  # fmt: skip
        if not masks.needs_all_frames:
            break
    return reduce_masks(samples, source.size_px, OUTLINE_PERSON_PX) if samples else ()
