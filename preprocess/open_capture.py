"""Find, open and align the parts of a capture, and describe the assumptions that were made.

Of a stream that comes without poses, the person is tracked while its frames come.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from capture.input_error import InputError
from capture.live_sources import camera_address
from capture.source import FrameSource, PacingClock, RealtimePlayback, TransposedSource
from capture.source_opening import open_live_source, open_source
from capture.video import VideoFile
from preprocess.alignment.capture_alignment import (
    BodyAlignment,
    estimate_focal_length,
    fit_person,
    place_motion,
)
from preprocess.alignment.capture_evidence import CaptureEvidence
from preprocess.body.body_pose import Motion
from preprocess.body.parametric_body import ShapedBody, load_body_model, read_shaped_body
from preprocess.cameras.camera_file import CameraTrack, assume_static_camera
from preprocess.cameras.camera_orientation import assume_camera, read_upright_cameras
from preprocess.capture_paths import (
    CapturePaths,
    MaskOrigin,
    choose_mask_origin,
    find_capture_paths,
    find_own_masks,
    find_own_poses,
    find_stream_cameras,
)
from preprocess.capture_session import Capture, CaptureInputs
from preprocess.masks.mask_files import Masks, open_masks, open_tracker_masks
from preprocess.masks.mask_refinement import GivenMaskRefiner
from preprocess.observation import alpha_channel_mask, associate_masks
from preprocess.plugins import PersonTracker, Segmenter, make_segmenter, segmenter_name
from preprocess.poses.plausibility import (
    lost_pose_warnings,
    plausibility_warnings,
    require_plausible,
)
from preprocess.poses.pose_format_registry import read_poses
from preprocess.tracked_stream import LiveTracking, MaskReader, TrackedStream
from preprocess.tracking.video_tracking import MaskRefinement


def describe_capture(
    fit: BodyAlignment,
    masks: Masks | None,
    cameras: CameraTrack,
    mask_origin: MaskOrigin,
    *,
    unread_alpha_video: Path | None = None,
) -> Iterator[str]:
    """Sentences about the poses, body, masks and cameras that were opened.

    `masks` is None unless a file holds them; `unread_alpha_video` is the video if it has an alpha
    channel that is not read.
    """
    motion, family = fit.motion, fit.shaped.body.family
    if motion.note is not None:
        yield motion.note
    if cameras.note is not None:
        yield cameras.note
    if mask_origin.segmenter is not None:
        yield (
            "Masks are estimated from the pictures and the poses "
            f"(segmenter:{mask_origin.segmenter}); a segmenter's own masks (--masks) are sharper "
            "around hair and hands."
        )
    if mask_origin.is_fallback and unread_alpha_video is not None:
        yield (
            f"{unread_alpha_video} has an alpha channel, which is not read from videos. If it cuts "
            "the person out, write its frames as PNG images (ffmpeg), and learn from their folder."
        )
    if mask_origin.uses_alpha_channel:
        yield "The pictures' own alpha channel is used as their masks."
    if masks is not None and masks.inverted:
        yield f"The masks in {masks.path} show the background (white); they were inverted."
    if motion.body_model != family:
        yield (
            f"The poses were made for the body model {motion.body_model!r}, but {family!r} is used "
            f"(--body), with joints where the mean shape has them. {fit.description}".strip()
        )
    elif fit.description:
        yield fit.description
    yield from lost_pose_warnings(motion)


def open_capture(
    inputs: CaptureInputs,
    *,
    size_px: int | None = None,
    skip_checks: bool = False,
    avatar_body: Path | None = None,
) -> Capture:
    """Open a recording: its frames, poses, masks and cameras, aligned with each other.

    Args:
        size_px: Longer side of the training images.
        skip_checks: Opens the parts even if they do not fit together, to find out why.
        avatar_body: File of a finished avatar's person, to whom the poses belong.

    Raises:
        InputError: If a part is missing or unreadable, or they do not fit together.
    """
    paths = find_capture_paths(inputs.video, inputs.poses, _mask_file(inputs.masks), inputs.cameras)
    source = open_source(paths.video, frames=inputs.frames, rotate=inputs.rotate)
    body = load_body_model(inputs.body)
    source = TransposedSource(source) if inputs.transposed else source
    motion = read_poses(paths.poses, default_model=body.family, person=inputs.person)
    warnings: tuple[str, ...] = ()
    if not skip_checks:  # ia-check wants the numbers as they are, and says what is odd by itself
        warnings = tuple(plausibility_warnings(motion))
        motion = require_plausible(motion, paths.poses)
    mask_origin, masks = _open_masks(paths, source, inputs)
    paths = replace(paths, masks=mask_origin.path)
    cameras, given = _read_or_assume_cameras(paths, motion, source), paths.cameras is not None
    evidence = CaptureEvidence(source, masks, cameras)
    motion, shaped = place_motion(motion, body, evidence, cameras_given=given)
    if not given and motion.intrinsic is None and motion.assumed_focal is None:
        cameras = estimate_focal_length(evidence, motion, shaped)
        evidence = evidence._replace(cameras=cameras)
    fit = fit_person(motion, shaped, evidence, avatar_body=avatar_body, height_m=inputs.height_m)
    unread_alpha = _unread_alpha(source)
    notes = describe_capture(fit, masks, cameras, mask_origin, unread_alpha_video=unread_alpha)
    capture = Capture(
        paths=paths,
        source=source,
        motion=fit.motion,
        masks=masks,
        cameras=cameras,
        shaped=fit.shaped,
        size_px=size_px,
        notes=(*notes, *warnings),
        segment=_make_segmenter(mask_origin, fit.shaped),
        mask_refiner=make_mask_refiner(inputs),
        refit=fit.placement,
    )
    if not skip_checks:
        capture.check()
    return capture


def _mask_file(masks: Path | None) -> Path | None:
    """The value of --masks, unless it is a segmenter."""
    return masks if segmenter_name(masks) is None else None


def _make_segmenter(mask_origin: MaskOrigin, shaped: ShapedBody) -> Segmenter | None:
    return None if mask_origin.segmenter is None else make_segmenter(mask_origin.segmenter, shaped)


def make_mask_refiner(inputs: CaptureInputs) -> GivenMaskRefiner | None:
    """Make the refinement of given masks; None if they stay as they are."""
    return GivenMaskRefiner() if inputs.refine_masks else None


def _unread_alpha(source: FrameSource) -> Path | None:
    """The video, if it has an alpha channel, which is not read."""
    return source.path if isinstance(source, VideoFile) and source.has_unread_alpha else None


def _open_masks(
    paths: CapturePaths, source: FrameSource, inputs: CaptureInputs
) -> tuple[MaskOrigin, Masks | None]:
    """The origin of the masks; and the masks, if a file holds them, which may be the pose file."""
    mask_origin = choose_mask_origin(inputs.masks, paths.masks, has_alpha=source.has_alpha)
    source.has_alpha = mask_origin.uses_alpha_channel
    if mask_origin.is_fallback:
        masks = open_tracker_masks(paths.poses, source, person=inputs.person)
        return (mask_origin, None) if masks is None else (MaskOrigin(path=masks.path), masks)
    if mask_origin.path is None:
        return mask_origin, None
    return mask_origin, open_masks(
        mask_origin.path, invert=inputs.invert_masks, person=inputs.person
    )


def _read_or_assume_cameras(
    paths: CapturePaths, motion: Motion, source: FrameSource
) -> CameraTrack:
    """Cameras of their own file, or those that the poses state."""
    if paths.cameras is not None:
        return read_upright_cameras(paths.cameras, source)
    return assume_static_camera(motion, source.size_px)


def open_tracked_stream(
    inputs: CaptureInputs,
    tracker: PersonTracker,
    make_refinement: Callable[[tuple[int, int]], MaskRefinement],
    poses: Path,
    *,
    avatar_body: Path | None = None,
) -> Capture:
    """Open a live source, or a recording that is played at its own speed, and find the person.

    Masks of a recording that are named or lie beside it, an installed segmenter's, and the images'
    alpha channel are learnt from; only without any are the tracker's.

    Args:
        inputs: The inputs of the user; without poses.
        make_refinement: Makes the refinement of the tracker's masks for a width and height.
        poses: File to which the poses will be written in the end.
        avatar_body: File of a finished avatar's person, who is filmed again.

    Raises:
        InputError: If it cannot be read, or no person is found in it.
    """
    if inputs.cameras == "solve" or inputs.height_m is not None:
        raise InputError(
            "--cameras solve and --height-cm need the poses of the whole recording. Run ia-track "
            "first, and give its poses; or leave out --realtime."
        )
    pace = PacingClock()
    source = _open_stream_source(inputs, pace)
    mask_origin, given = _open_stream_masks(inputs, source)
    stream = TrackedStream(source)
    tracking = LiveTracking(stream, tracker, make_refinement(stream.size_px), given)
    shaped = load_body_model(inputs.body).with_shape()
    if avatar_body is not None:
        shaped = read_shaped_body(avatar_body, shaped.body)
    found = tracking.start(
        shaped,
        assume_camera(inputs.video, inputs.cameras, stream),
        fixed_body=avatar_body is not None,
        stated_focal=find_stream_cameras(inputs.video, inputs.cameras) is not None,
    )
    segment, notes = None, [*_unread_live_parts(inputs)]
    if not mask_origin.is_fallback:
        fit = BodyAlignment(shaped=found.shaped, motion=found.motion)
        notes += describe_capture(fit, None, found.cameras, mask_origin)
        if mask_origin.segmenter is not None:
            segment = make_segmenter(mask_origin.segmenter, found.shaped)
    return Capture(
        paths=CapturePaths(video=inputs.video, poses=poses, masks=mask_origin.path, cameras=None),
        source=stream,
        motion=found.motion,
        masks=None,
        cameras=found.cameras,
        shaped=found.shaped,
        size_px=None,
        notes=tuple(notes),
        live=tracking, segment=segment, mask_refiner=make_mask_refiner(inputs),
    )  # fmt: skip


def _open_stream_masks(
    inputs: CaptureInputs, source: FrameSource
) -> tuple[MaskOrigin, MaskReader | None]:
    """The masks that are used, and their reader; a fallback means the tracker's."""
    own = None if inputs.is_live else find_own_masks(inputs.video)
    mask_origin = choose_mask_origin(inputs.masks, own, has_alpha=source.has_alpha)
    source.has_alpha = mask_origin.uses_alpha_channel
    if mask_origin.path is None:
        return mask_origin, alpha_channel_mask if mask_origin.uses_alpha_channel else None
    stored = open_masks(mask_origin.path, invert=inputs.invert_masks)
    row = associate_masks(stored, source)
    return mask_origin, lambda frame, size_px: stored.alpha(row(frame.index), size_px)


def _unread_live_parts(inputs: CaptureInputs) -> Iterator[str]:
    """Name poses and masks that lie in a live source's folder, and are not read."""
    if inputs.is_live and inputs.video.is_dir():
        own = (find_own_poses(inputs.video), find_own_masks(inputs.video))
        for path in filter(None, own):
            yield f"{path} is not read: poses and masks of a live source are tracked."


def _open_stream_source(inputs: CaptureInputs, pace: PacingClock) -> FrameSource:
    if inputs.is_live:
        camera = camera_address(inputs.video)
        return open_live_source(
            inputs.video, camera, inputs.frames, pace,
            idle_s=inputs.idle_s, watch_s=inputs.watch_s, rotate=inputs.rotate,
        )  # fmt: skip
    source = open_source(inputs.video, frames=inputs.frames, rotate=inputs.rotate)
    return RealtimePlayback(source, pace)
