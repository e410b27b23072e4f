"""Finds, opens and checks the parts of a recording."""

from dataclasses import replace
from pathlib import Path

from apps.recording.notes import describe_capture
from apps.recording.person import fit_live_person, fit_person
from apps.recording.recording import Capture
from apps.recording.wanted import CaptureInputs
from capture.camera_device import camera_address
from capture.errors import InputError
from capture.opening import open_live_source, open_source
from capture.pace import PacingClock
from capture.source import FrameSource
from capture.transposed import TransposedSource
from capture.video import VideoFile
from preprocess.body import ShapedBody
from preprocess.body_file import load_body_model
from preprocess.camera_file import CameraTrack, assume_static_camera
from preprocess.capture_folder import CapturePaths, find_capture_paths, find_live_capture_paths
from preprocess.fit.family import detect_body_model
from preprocess.focal import estimate_focal_length
from preprocess.live import LiveInputs
from preprocess.masks.choice import MaskOrigin, choose_mask_origin
from preprocess.masks.files import Masks, open_tracker_masks, open_masks
from preprocess.masks.segmenter import Segmenter, make_segmenter, segmenter_name
from preprocess.plausibility import plausibility_warnings, require_plausible
from preprocess.pose import Motion
from preprocess.poses import read_poses
from preprocess.poses.place import place_in_camera_world
from preprocess.shape import shape_for_motion
from preprocess.upright import read_upright_cameras


def open_capture(
    inputs: CaptureInputs,
    *,
    size_px: int | None = None,
    skip_checks: bool = False,
    avatar_body: Path | None = None,
) -> Capture:
    """A recording, or a live source whose first picture and first pose are waited for.

    Args:
        wanted: What the user named.
        size_px: Longer side that training will see.
        doubtful: Leaves out whether the parts fit together, for somebody who wants to find out.
        avatars: The person of a finished avatar, as a file, to whom the poses are to belong.

    Raises:
        InputError: If a part is missing or unreadable, or they do not fit together.
    """
    camera = camera_address(inputs.video)
    if inputs.live or camera is not None:
        return _open_live(inputs, camera, size_px, avatar_body)
    recording = _open_recorded(inputs, size_px, avatar_body, doubtful=skip_checks)
    if not skip_checks:
        recording.check()
    return recording


def _open_recorded(
    wanted: CaptureInputs, size_px: int | None, avatars: Path | None, *, doubtful: bool
) -> Capture:
    paths = find_capture_paths(wanted.video, wanted.poses, _mask_file(wanted.masks), wanted.cameras)
    source, body = open_source(paths.video, frames=wanted.frames), load_body_model(wanted.body)
    source = TransposedSource(source) if wanted.transposed else source
    motion = read_poses(paths.poses, default_model=body.family, person=wanted.person)
    doubts: tuple[str, ...] = ()
    if not doubtful:  # ia-check wants the numbers as they are, and says what is odd by itself
        doubts, motion = tuple(plausibility_warnings(motion)), require_plausible(motion, paths.poses)
    choice, masks = _open_masks(paths, source, wanted)
    paths = replace(paths, masks=choice.path)
    cameras, given = _read_or_assume_cameras(paths, motion, source), paths.cameras is not None
    motion = detect_body_model(motion, body, cameras, source, masks, cameras_given=given)
    shaped = shape_for_motion(body, motion)
    motion = place_in_camera_world(motion, shaped, cameras, cameras_given=given)
    if not given and motion.intrinsic is None and motion.assumed_focal is None:
        cameras = estimate_focal_length(cameras, motion, shaped, source, masks)
    fit = fit_person(
        motion, shaped, cameras, source, masks, avatar_body=avatars, height_m=wanted.height_m
    )
    return Capture(
        paths=paths,
        source=source,
        motion=fit.motion,
        masks=masks,
        cameras=cameras,
        shaped=fit.shaped,
        size_px=size_px,
        notes=(*describe_capture(fit, masks, cameras, choice, unread_alpha_video=_unread_alpha(source)), *doubts),
        segment=_make_segmenter(choice, fit.shaped),
        refit=fit.placement,
    )


def _open_live(
    wanted: CaptureInputs, camera: str | None, size_px: int | None, avatars: Path | None
) -> Capture:
    if wanted.cameras == "solve" or wanted.height_m is not None:
        raise InputError(
            "--cameras solve and --height-cm need a recording; of a live source the camera "
            "stands still (--cameras static), and nobody knows its poses yet."
        )
    paths = find_live_capture_paths(wanted.video, wanted.poses, _mask_file(wanted.masks), wanted.cameras)
    body, pace = load_body_model(wanted.body), PacingClock()
    source = open_live_source(paths.video, camera, wanted.frames, pace, idle_s=wanted.idle_s)
    live = LiveInputs.open(
        paths, source, pace, family=body.family, invert=wanted.invert_masks,
        first_within_s=wanted.idle_s, given_masks=wanted.masks,
    )  # fmt: skip
    choice, looked_for = live.choice, paths.masks
    paths = replace(paths, masks=choice.path)
    source.has_alpha = choice.uses_alpha_channel
    motion = live.poses.motion
    doubts = tuple(plausibility_warnings(motion))
    cameras, given = _read_or_assume_cameras(paths, motion, source), paths.cameras is not None
    shaped = shape_for_motion(body, motion)
    live.poses.set_placement(lambda read: place_in_camera_world(read, shaped, cameras, cameras_given=given))
    fit, growing_fit = fit_live_person(
        live.poses.motion, shaped, avatar_body=avatars, has_masks=choice.segmenter is None
    )
    recording = Capture(
        paths=paths,
        source=source,
        motion=fit.motion,
        masks=None,
        cameras=cameras,
        shaped=fit.shaped,
        size_px=size_px,
        notes=(*describe_capture(fit, None, cameras, choice, expected_masks=looked_for), *doubts),
        live=live,
        segment=_make_segmenter(choice, fit.shaped),
        live_fit=growing_fit,
    )
    recording.check()
    return recording


def _mask_file(masks: Path | None) -> Path | None:
    """What --masks names, unless it is a segmenter."""
    return masks if segmenter_name(masks) is None else None


def _make_segmenter(choice: MaskOrigin, shaped: ShapedBody) -> Segmenter | None:
    return None if choice.segmenter is None else make_segmenter(choice.segmenter, shaped)


def _unread_alpha(source: FrameSource) -> Path | None:
    """The video, if it has an alpha channel, which is not read."""
    return source.path if isinstance(source, VideoFile) and source.leaves_alpha else None


def _open_masks(
    paths: CapturePaths, source: FrameSource, wanted: CaptureInputs
) -> tuple[MaskOrigin, Masks | None]:
    """Which masks are used; and those, if a file holds them, which may be that of the poses."""
    choice = choose_mask_origin(wanted.masks, paths.masks, has_alpha=source.has_alpha)
    source.has_alpha = choice.uses_alpha_channel
    if choice.is_fallback:
        masks = open_tracker_masks(paths.poses, source, person=wanted.person)
        return (choice, None) if masks is None else (MaskOrigin(path=masks.path), masks)
    if choice.path is None:
        return choice, None
    return choice, open_masks(choice.path, invert=wanted.invert_masks, person=wanted.person)


def _read_or_assume_cameras(paths: CapturePaths, motion: Motion, source: FrameSource) -> CameraTrack:
    """Cameras of their own file, or what the poses say."""
    if paths.cameras is not None:
        return read_upright_cameras(paths.cameras, source)
    return assume_static_camera(motion, source.size_px)
