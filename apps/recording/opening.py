"""Finds, opens and checks the parts of a recording."""

from dataclasses import replace
from pathlib import Path

from apps.recording.notes import notes_of
from apps.recording.person import live_person, person_of
from apps.recording.recording import Recording
from apps.recording.wanted import RecordingPaths
from capture.camera_device import camera_address
from capture.errors import BadInput
from capture.opening import open_live, open_source
from capture.pace import Pace
from capture.source import Source
from preprocess.body_file import load_body
from preprocess.camera_file import CameraTrack, default_cameras
from preprocess.capture_folder import CapturePaths, find_capture, find_live_capture
from preprocess.fit.family import with_family
from preprocess.focal import focal_from_masks
from preprocess.live import LiveParts
from preprocess.masks.files import Masks, masks_in_poses, open_masks
from preprocess.masks.segmenter import OURS, make_segmenter, segmenter_name
from preprocess.pose import Motion
from preprocess.poses import read_poses
from preprocess.poses.place import placed
from preprocess.shape import shaped_for
from preprocess.upright import upright_cameras


def open_recording(
    wanted: RecordingPaths,
    *,
    size_px: int | None = None,
    doubtful: bool = False,
    avatars: Path | None = None,
) -> Recording:
    """A recording, or a live source whose first picture and first pose are waited for.

    Args:
        wanted: What the user named.
        size_px: Longer side that training will see.
        doubtful: Leaves out whether the parts fit together, for somebody who wants to find out.
        avatars: The person of a finished avatar, as a file, to whom the poses are to belong.

    Raises:
        BadInput: If a part is missing or unreadable, or they do not fit together.
    """
    camera = camera_address(wanted.video)
    if wanted.live or camera is not None:
        return _live(wanted, camera, size_px, avatars)
    recording = _recorded(wanted, size_px, avatars)
    if not doubtful:
        recording.check()
    return recording


def _recorded(wanted: RecordingPaths, size_px: int | None, avatars: Path | None) -> Recording:
    segmenter = segmenter_name(wanted.masks)
    given_masks = wanted.masks if segmenter is None else None
    paths = find_capture(wanted.video, wanted.poses, given_masks, wanted.cameras)
    if segmenter is not None:
        paths = replace(paths, masks=None)
    source, body = open_source(paths.video, frames=wanted.frames), load_body(wanted.body)
    motion = read_poses(paths.poses, default_model=body.family, person=wanted.person)
    masks = None if segmenter is not None else _masks(paths, source, wanted)
    if segmenter is None and masks is None and not source.has_alpha:
        segmenter = OURS
    cameras, given = _cameras(paths, motion, source), paths.cameras is not None
    motion = with_family(motion, body, cameras, source, masks, cameras_given=given)
    shaped = shaped_for(body, motion)
    motion = placed(motion, shaped, cameras, cameras_given=given)
    if not given and motion.intrinsic is None and motion.lens is None:
        cameras = focal_from_masks(cameras, motion, shaped, source, masks)
    fit = person_of(
        motion, shaped, cameras, source, masks, avatars=avatars, height_m=wanted.height_m
    )
    return Recording(
        paths=paths,
        source=source,
        motion=fit.motion,
        masks=masks,
        cameras=cameras,
        shaped=fit.shaped,
        size_px=size_px,
        notes=tuple(notes_of(fit, masks, cameras, segment=segmenter)),
        segment=None if segmenter is None else make_segmenter(segmenter, fit.shaped),
        refit=fit.refit,
    )


def _live(
    wanted: RecordingPaths, camera: str | None, size_px: int | None, avatars: Path | None
) -> Recording:
    if wanted.cameras == "solve" or wanted.height_m is not None:
        raise BadInput(
            "--cameras solve and --height-cm need a recording; of a live source the camera "
            "stands still (--cameras static), and nobody knows its poses yet."
        )
    segmenter = segmenter_name(wanted.masks)
    given_masks = wanted.masks if segmenter is None else None
    paths = find_live_capture(wanted.video, wanted.poses, given_masks, wanted.cameras)
    body, pace = load_body(wanted.body), Pace()
    source = open_live(paths.video, camera, wanted.frames, pace, idle_s=wanted.idle_s)
    live = LiveParts.open(
        paths, source, pace, family=body.family, invert=wanted.mask_invert,
        first_within_s=wanted.idle_s, estimated=segmenter is not None,
    )  # fmt: skip
    motion = live.poses.motion
    cameras, given = _cameras(paths, motion, source), paths.cameras is not None
    shaped = shaped_for(body, motion)
    live.poses.place(lambda read: placed(read, shaped, cameras, cameras_given=given))
    fit, growing_fit = live_person(
        live.poses.motion, shaped, avatars=avatars, masked=segmenter is None
    )
    recording = Recording(
        paths=paths,
        source=source,
        motion=fit.motion,
        masks=None,
        cameras=cameras,
        shaped=fit.shaped,
        size_px=size_px,
        notes=tuple(notes_of(fit, None, cameras, segment=segmenter)),
        live=live,
        segment=None if segmenter is None else make_segmenter(segmenter, fit.shaped),
        growing_fit=growing_fit,
    )
    recording.check()
    return recording


def _masks(paths: CapturePaths, source: Source, wanted: RecordingPaths) -> Masks | None:
    """Masks of their own file, or beside the poses; None if there are none, or the pictures'."""
    if paths.masks is not None:
        return open_masks(paths.masks, invert=wanted.mask_invert, person=wanted.person)
    if source.has_alpha:
        return None
    return masks_in_poses(paths.poses, source, person=wanted.person)


def _cameras(paths: CapturePaths, motion: Motion, source: Source) -> CameraTrack:
    """Cameras of their own file, or what the poses say."""
    if paths.cameras is not None:
        return upright_cameras(paths.cameras, source)
    return default_cameras(motion, source.size_px)
