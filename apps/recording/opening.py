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
from capture.transposed import Transposed
from capture.video import VideoFile
from preprocess.body import ShapedBody
from preprocess.body_file import load_body
from preprocess.camera_file import CameraTrack, default_cameras
from preprocess.capture_folder import CapturePaths, find_capture, find_live_capture
from preprocess.fit.family import with_family
from preprocess.focal import focal_from_masks
from preprocess.live import LiveParts
from preprocess.masks.choice import MaskChoice, choose_masks
from preprocess.masks.files import Masks, masks_in_poses, open_masks
from preprocess.masks.segmenter import Segmenter, make_segmenter, segmenter_name
from preprocess.plausibility import oddities, plausible
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
    recording = _recorded(wanted, size_px, avatars, doubtful=doubtful)
    if not doubtful:
        recording.check()
    return recording


def _recorded(
    wanted: RecordingPaths, size_px: int | None, avatars: Path | None, *, doubtful: bool
) -> Recording:
    paths = find_capture(wanted.video, wanted.poses, _file(wanted.masks), wanted.cameras)
    source, body = open_source(paths.video, frames=wanted.frames), load_body(wanted.body)
    source = Transposed(source) if wanted.transposed else source
    motion = read_poses(paths.poses, default_model=body.family, person=wanted.person)
    doubts: tuple[str, ...] = ()
    if not doubtful:  # ia-check wants the numbers as they are, and says what is odd by itself
        doubts, motion = tuple(oddities(motion)), plausible(motion, paths.poses)
    choice, masks = _masks(paths, source, wanted)
    paths = replace(paths, masks=choice.path)
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
        notes=(*notes_of(fit, masks, cameras, choice, unread=_unread_alpha(source)), *doubts),
        segment=_segmenter(choice, fit.shaped),
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
    paths = find_live_capture(wanted.video, wanted.poses, _file(wanted.masks), wanted.cameras)
    body, pace = load_body(wanted.body), Pace()
    source = open_live(paths.video, camera, wanted.frames, pace, idle_s=wanted.idle_s)
    live = LiveParts.open(
        paths, source, pace, family=body.family, invert=wanted.mask_invert,
        first_within_s=wanted.idle_s, given_masks=wanted.masks,
    )  # fmt: skip
    choice, looked_for = live.choice, paths.masks
    paths = replace(paths, masks=choice.path)
    source.has_alpha = choice.alpha
    motion = live.poses.motion
    doubts = tuple(oddities(motion))
    cameras, given = _cameras(paths, motion, source), paths.cameras is not None
    shaped = shaped_for(body, motion)
    live.poses.place(lambda read: placed(read, shaped, cameras, cameras_given=given))
    fit, growing_fit = live_person(
        live.poses.motion, shaped, avatars=avatars, masked=choice.segmenter is None
    )
    recording = Recording(
        paths=paths,
        source=source,
        motion=fit.motion,
        masks=None,
        cameras=cameras,
        shaped=fit.shaped,
        size_px=size_px,
        notes=(*notes_of(fit, None, cameras, choice, looked_for=looked_for), *doubts),
        live=live,
        segment=_segmenter(choice, fit.shaped),
        growing_fit=growing_fit,
    )
    recording.check()
    return recording


def _file(masks: Path | None) -> Path | None:
    """What --masks names, unless it is a segmenter."""
    return masks if segmenter_name(masks) is None else None


def _segmenter(choice: MaskChoice, shaped: ShapedBody) -> Segmenter | None:
    return None if choice.segmenter is None else make_segmenter(choice.segmenter, shaped)


def _unread_alpha(source: Source) -> Path | None:
    """The video, if it has an alpha channel, which is not read."""
    return source.path if isinstance(source, VideoFile) and source.leaves_alpha else None


def _masks(
    paths: CapturePaths, source: Source, wanted: RecordingPaths
) -> tuple[MaskChoice, Masks | None]:
    """Which masks are used; and those, if a file holds them, which may be that of the poses."""
    choice = choose_masks(wanted.masks, paths.masks, has_alpha=source.has_alpha)
    source.has_alpha = choice.alpha
    if choice.fallback:
        masks = masks_in_poses(paths.poses, source, person=wanted.person)
        return (choice, None) if masks is None else (MaskChoice(path=masks.path), masks)
    if choice.path is None:
        return choice, None
    return choice, open_masks(choice.path, invert=wanted.mask_invert, person=wanted.person)


def _cameras(paths: CapturePaths, motion: Motion, source: Source) -> CameraTrack:
    """Cameras of their own file, or what the poses say."""
    if paths.cameras is not None:
        return upright_cameras(paths.cameras, source)
    return default_cameras(motion, source.size_px)
