"""Opens a stream that comes without poses: its person is tracked while its frames come."""

from collections.abc import Callable
from pathlib import Path

from capture.camera_device import camera_address
from capture.input_error import InputError
from capture.source import FrameSource, PacingClock, RealtimePlayback
from capture.source_opening import open_live_source, open_source
from preprocess.alignment.capture_alignment import BodyAlignment
from preprocess.body.parametric_body import load_body_model, read_shaped_body
from preprocess.cameras.camera_orientation import assume_camera
from preprocess.capture_paths import (
    CapturePaths,
    MaskOrigin,
    choose_mask_origin,
    find_own_masks,
    find_stream_cameras,
)
from preprocess.capture_session import Capture, CaptureInputs
from preprocess.live_inputs import LiveMasks, check_mask_folder
from preprocess.masks.mask_files import open_masks
from preprocess.observation import alpha_channel_mask, associate_masks
from preprocess.open_capture import describe_capture, make_mask_refiner
from preprocess.plugins import PersonTracker, make_segmenter
from preprocess.tracked_stream import LiveTracking, MaskReader, TrackedStream
from preprocess.tracking.video_tracking import MaskRefinement


def open_tracked_stream(
    wanted: CaptureInputs,
    tracker: PersonTracker,
    make_refinement: Callable[[tuple[int, int]], MaskRefinement],
    poses: Path,
    *,
    avatar_body: Path | None = None,
) -> Capture:
    """Open a live source, or a recording that is played at its own speed, and find the person.

    Masks that are named, lie beside the video or are the pictures' alpha channel are learnt from;
    only without any are the tracker's.

    Args:
        wanted: What the user named; without poses.
        tracker: Follows the person.
        make_refinement: From the frames' width and height to what makes masks from the tracker's.
        poses: File to which the poses will be written in the end.
        avatar_body: File of a finished avatar's person, who is filmed again.

    Raises:
        InputError: If it cannot be read, or no person is found in it.
    """
    if wanted.cameras == "solve" or wanted.height_m is not None:
        raise InputError(
            "--cameras solve and --height-cm need the poses of the whole recording. Run ia-track "
            "first, and give its poses; or leave out --realtime."
        )
    pace = PacingClock()
    source = _open_source(wanted, pace)
    choice, given = _open_masks(wanted, source, pace)
    stream = TrackedStream(source)
    tracking = LiveTracking(stream, tracker, make_refinement(stream.size_px), given)
    shaped = load_body_model(wanted.body).with_shape()
    if avatar_body is not None:
        shaped = read_shaped_body(avatar_body, shaped.body)
    found = tracking.start(
        shaped,
        assume_camera(wanted.video, wanted.cameras, stream),
        fixed_body=avatar_body is not None,
        stated_focal=find_stream_cameras(wanted.video, wanted.cameras) is not None,
    )
    segment, notes = None, ()
    if not choice.is_fallback:
        fit = BodyAlignment(shaped=found.shaped, motion=found.motion)
        notes = tuple(describe_capture(fit, None, found.cameras, choice))
        if choice.segmenter is not None:
            segment = make_segmenter(choice.segmenter, found.shaped)
    return Capture(
        paths=CapturePaths(video=wanted.video, poses=poses, masks=choice.path, cameras=None),
        source=stream,
        motion=found.motion,
        masks=None,
        cameras=found.cameras,
        shaped=found.shaped,
        size_px=None,
        notes=notes,
        live=tracking, segment=segment, mask_refiner=make_mask_refiner(wanted),
    )  # fmt: skip


def _open_masks(
    wanted: CaptureInputs, source: FrameSource, pace: PacingClock
) -> tuple[MaskOrigin, MaskReader | None]:
    """Which masks are used, and what reads them; a fallback means the tracker's.

    Raises:
        InputError: If masks that were named cannot be used.
    """
    camera = camera_address(wanted.video)
    choice = choose_mask_origin(
        wanted.masks, find_own_masks(wanted.video), has_alpha=source.has_alpha
    )
    source.has_alpha = choice.uses_alpha_channel
    if choice.path is None:
        return choice, alpha_channel_mask if choice.uses_alpha_channel else None
    if wanted.live or camera is not None:
        check_mask_folder(wanted.masks)
        return choice, LiveMasks(choice.path, pace, invert=wanted.invert_masks).wait_for_mask
    stored = open_masks(choice.path, invert=wanted.invert_masks)
    row = associate_masks(stored, source)
    return choice, lambda frame, size_px: stored.alpha(row(frame.index), size_px)


def _open_source(wanted: CaptureInputs, pace: PacingClock) -> FrameSource:
    camera = camera_address(wanted.video)
    if wanted.live or camera is not None:
        return open_live_source(wanted.video, camera, wanted.frames, pace, idle_s=wanted.idle_s)
    return RealtimePlayback(open_source(wanted.video, frames=wanted.frames), pace)
