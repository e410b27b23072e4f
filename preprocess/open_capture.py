"""Opening of a capture: read its parts, and align them with each other.

Of a stream that comes without poses, the person is tracked while its frames come.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from capture.input_error import InputError
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
from preprocess.body.parametric_body import (
    BodyModel,
    ShapedBody,
    load_body_model,
    read_shaped_body,
)
from preprocess.cameras.camera_file import CameraTrack, assume_static_camera
from preprocess.cameras.camera_orientation import assume_camera, read_upright_cameras
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_paths import (
    CapturePaths,
    MaskOrigin,
    choose_mask_origin,
    find_capture_paths,
    find_own_masks,
    find_own_poses,
    find_stream_cameras,
)
from preprocess.capture_session import Capture, Provenance, video_identity
from preprocess.masks.mask_files import Masks, open_masks, open_tracker_masks
from preprocess.masks.mask_refinement import GivenMaskRefiner
from preprocess.masks.mask_sources import (
    AlphaChannelMasks,
    EstimatedMasks,
    MaskSource,
    StoredMasks,
)
from preprocess.plugins import PersonTracker, make_segmenter, segmenter_name
from preprocess.poses.plausibility import (
    lost_pose_warnings,
    plausibility_warnings,
    require_plausible,
)
from preprocess.poses.pose_format_registry import read_poses
from preprocess.tracked_stream import (
    LiveTracking,
    TrackedMasks,
    TrackedObservations,
    TrackedStream,
)
from preprocess.tracking.video_tracking import MaskRefinement


@dataclass(frozen=True, eq=False, kw_only=True)
class ImportedCapture:
    """The parts of a recording as they were read or tracked, not aligned with each other yet.

    Attributes:
        motion: The poses, in the space and for the body of their file.
        stored_masks: The masks, if a file holds them.
        polarity_error: Why it is unclear which side of them is the person; empty if it is clear.
        provenance: Where the poses come from, if not from a file of the user.
    """

    inputs: CaptureInputs
    paths: CapturePaths
    source: FrameSource
    body: BodyModel
    motion: Motion
    mask_origin: MaskOrigin
    stored_masks: Masks | None
    polarity_error: str = ""
    provenance: tuple[Provenance, ...] = ()

    @property
    def identity(self) -> str:
        """Name of the video in a checkpoint."""
        return video_identity(self.source)

    def given_masks(self) -> StoredMasks | AlphaChannelMasks | None:
        """The masks of files or alpha channels; None if there are none."""
        refine = GivenMaskRefiner(enabled=self.inputs.refine_masks)
        if self.stored_masks is not None:
            return StoredMasks(self.stored_masks, self.source, refine)
        if self.mask_origin.uses_alpha_channel:
            return AlphaChannelMasks(self.source, refine)
        return None

    def transposed(self) -> "ImportedCapture":
        """The same with the video's width and height exchanged, as if it had been rotated."""
        return replace(self, source=TransposedSource(self.source))


def open_capture(
    inputs: CaptureInputs,
    *,
    size_px: int | None = None,
    skip_checks: bool = False,
    avatar_body: Path | None = None,
) -> Capture:
    """Read and align a recording with poses; see `align_capture`."""
    imported = read_capture(inputs)
    return align_capture(
        imported, size_px=size_px, skip_checks=skip_checks, avatar_body=avatar_body
    )


def read_capture(inputs: CaptureInputs) -> ImportedCapture:
    """Read the parts of a recording with poses.

    Raises:
        InputError: If a part is missing or unreadable.
    """
    named_masks = inputs.masks if segmenter_name(inputs.masks) is None else None
    paths = find_capture_paths(inputs.video, inputs.poses, named_masks, inputs.cameras)
    source = open_source(paths.video, frames=inputs.frames, rotate=inputs.rotate)
    body = load_body_model(inputs.body)
    motion = read_poses(paths.poses, default_model=body.family, person=inputs.person)
    return import_capture(inputs, paths, source, body, motion)


def import_capture(
    inputs: CaptureInputs, paths: CapturePaths, source: FrameSource, body: BodyModel, motion: Motion
) -> ImportedCapture:
    """Join poses with the masks of files or alpha channels, which may lie in the poses' file."""
    origin = choose_mask_origin(inputs.masks, paths.masks, has_alpha=source.has_alpha)
    masks, error = None, ""
    if origin.is_fallback:
        masks = open_tracker_masks(paths.poses, source, person=inputs.person)
        origin = origin if masks is None else MaskOrigin(path=masks.path)
    elif origin.path is not None:
        try:
            masks = open_masks(origin.path, invert=inputs.invert_masks, person=inputs.person)
        except InputError as unclear:
            if inputs.invert_masks is not None:
                raise
            masks = open_masks(origin.path, invert=False, person=inputs.person)
            error = str(unclear)
    return ImportedCapture(
        inputs=inputs, paths=replace(paths, masks=origin.path), source=source, body=body,
        motion=motion, mask_origin=origin, stored_masks=masks, polarity_error=error,
    )  # fmt: skip


def align_capture(
    imported: ImportedCapture,
    *,
    size_px: int | None = None,
    skip_checks: bool = False,
    avatar_body: Path | None = None,
) -> Capture:
    """Align frames, poses, masks and cameras with each other.

    Args:
        size_px: Longer side of the training images; None for the frames' own.
        skip_checks: Takes the parts as they are even if they do not fit together, for ia-check.
        avatar_body: File of a finished avatar's person, to whom the poses belong.

    Raises:
        InputError: If they do not fit together.
    """
    inputs, source, motion = imported.inputs, imported.source, imported.motion
    warnings: tuple[str, ...] = ()
    if not skip_checks:
        warnings = tuple(plausibility_warnings(motion))
        motion = require_plausible(motion, imported.paths.poses)
        if imported.polarity_error:
            raise InputError(imported.polarity_error)
    given = imported.given_masks()
    cameras, cameras_given = _read_or_assume_cameras(imported), imported.paths.cameras is not None
    evidence = CaptureEvidence(source, given, cameras)
    motion, shaped = place_motion(motion, imported.body, evidence, cameras_given=cameras_given)
    if not cameras_given and motion.intrinsic is None and motion.assumed_focal is None:
        cameras = estimate_focal_length(evidence, motion, shaped)
        evidence = evidence._replace(cameras=cameras)
    fit = fit_person(motion, shaped, evidence, avatar_body=avatar_body, height_m=inputs.height_m)
    masks = given or _estimated_masks(imported.mask_origin, fit.shaped)
    capture = Capture(
        paths=imported.paths,
        source=source,
        motion=fit.motion,
        masks=masks,
        cameras=cameras,
        shaped=fit.shaped,
        size_px=size_px or max(source.size_px),
        provenance=(
            *imported.provenance,
            _pose_provenance(imported.paths.poses, fit.motion, warnings),
            Provenance(part="cameras", origin=cameras.source, notes=_given(cameras.note)),
            _mask_provenance(masks, imported.mask_origin, source),
            _body_provenance(fit),
        ),
    )
    if not skip_checks:
        capture.check()
    return capture


def _pose_provenance(poses: Path, motion: Motion, warnings: tuple[str, ...]) -> Provenance:
    return Provenance(
        part="poses",
        origin=poses.name,
        uncertainty=0.0 if motion.proportions is None else 1.0,
        notes=(*_given(motion.note), *lost_pose_warnings(motion), *warnings),
    )


def _body_provenance(fit: BodyAlignment) -> Provenance:
    family, note = fit.shaped.body.family, fit.description
    if fit.motion.body_model != family:
        note = (
            f"The poses were made for the body model {fit.motion.body_model!r}, but {family!r} is "
            f"used (--body), with joints where the mean shape has them. {note}".strip()
        )
    figures = {} if fit.placement is None else fit.placement.as_json()
    return Provenance(part="body", origin=family, notes=_given(note), figures=figures)


def _mask_provenance(masks: MaskSource, origin: MaskOrigin, source: FrameSource) -> Provenance:
    return Provenance(
        part="masks",
        origin=masks.origin,
        uncertainty=0.0 if masks.is_given else 1.0,
        notes=tuple(_mask_notes(masks, origin, source)),
    )


def _mask_notes(masks: MaskSource, origin: MaskOrigin, source: FrameSource) -> Iterator[str]:
    if origin.segmenter is not None:
        yield (
            "Masks are estimated from the pictures and the poses "
            f"(segmenter:{origin.segmenter}); a segmenter's own masks (--masks) are sharper "
            "around hair and hands."
        )
    if origin.is_fallback and isinstance(source, VideoFile) and source.has_unread_alpha:
        yield (
            f"{source.path} has an alpha channel, which is not read from videos. If it cuts "
            "the person out, write its frames as PNG images (ffmpeg), and learn from their folder."
        )
    if origin.uses_alpha_channel:
        yield "The pictures' own alpha channel is used as their masks."
    if isinstance(masks, StoredMasks) and masks.files.inverted:
        yield f"The masks in {masks.files.path} show the background (white); they were inverted."


def _given(note: str | None) -> tuple[str, ...]:
    return () if not note else (note,)


def _estimated_masks(origin: MaskOrigin, shaped: ShapedBody) -> EstimatedMasks:
    assert origin.segmenter is not None
    return EstimatedMasks(make_segmenter(origin.segmenter, shaped))


def _read_or_assume_cameras(imported: ImportedCapture) -> CameraTrack:
    """Cameras of their own file, or those that the poses state."""
    if imported.paths.cameras is not None:
        return read_upright_cameras(imported.paths.cameras, imported.source)
    return assume_static_camera(imported.motion, imported.source.size_px)


def open_tracked_stream(
    inputs: CaptureInputs,
    tracker: PersonTracker,
    make_refinement: Callable[[tuple[int, int]], MaskRefinement],
    poses: Path,
    *,
    longer_side_px: Callable[[FrameSource], int] = lambda source: max(source.size_px),
    avatar_body: Path | None = None,
) -> TrackedObservations:
    """Open a live source, or a recording that is played at its own speed, and find the person.

    Masks of a recording that are named or lie beside it, an installed segmenter's, and the images'
    alpha channel are learnt from; only without any are the tracker's.

    Args:
        inputs: The inputs of the user; without poses.
        make_refinement: Makes the refinement of the tracker's masks for a width and height.
        poses: File to which the poses will be written in the end.
        longer_side_px: Longer side of the training images for a source.
        avatar_body: File of a finished avatar's person, who is filmed again.

    Raises:
        InputError: If it cannot be read, or no person is found in it.
    """
    if inputs.cameras == "solve" or inputs.height_m is not None:
        raise InputError(
            "--cameras solve and --height-cm need the poses of the whole recording. Run ia-track "
            "first, and give its poses; or leave out --realtime."
        )
    source = _open_stream_source(inputs)
    origin, given = _open_stream_masks(inputs, source)
    tracking = LiveTracking(TrackedStream(source), tracker)
    shaped = load_body_model(inputs.body).with_shape()
    if avatar_body is not None:
        shaped = read_shaped_body(avatar_body, shaped.body)
    start = tracking.start(
        shaped,
        assume_camera(inputs.video, inputs.cameras, tracking.stream),
        fixed_body=avatar_body is not None,
        stated_focal=find_stream_cameras(inputs.video, inputs.cameras) is not None,
    )
    masks: MaskSource = TrackedMasks(tracking, make_refinement(source.size_px))
    made = Provenance(part="masks", origin=masks.origin, uncertainty=1.0)
    if not origin.is_fallback:
        masks = given or _estimated_masks(origin, start.shaped)
        made = _mask_provenance(masks, origin, source)
    unread = tuple(_unread_live_parts(inputs))
    capture = Capture(
        paths=CapturePaths(video=inputs.video, poses=poses, masks=origin.path, cameras=None),
        source=tracking.stream, motion=start.motion, masks=masks, cameras=start.cameras,
        shaped=start.shaped, size_px=longer_side_px(source),
        provenance=(
            Provenance(part="poses", origin="tracked", uncertainty=1.0, notes=unread),
            Provenance(part="cameras", origin=start.cameras.source, uncertainty=1.0),
            made,
        ),
    )  # fmt: skip
    return TrackedObservations(capture, tracking)


def _open_stream_masks(
    inputs: CaptureInputs, source: FrameSource
) -> tuple[MaskOrigin, MaskSource | None]:
    """The origin of the masks (a fallback means the tracker), and given ones, if there are any."""
    own = None if inputs.is_live else find_own_masks(inputs.video)
    origin = choose_mask_origin(inputs.masks, own, has_alpha=source.has_alpha)
    refine = GivenMaskRefiner(enabled=inputs.refine_masks)
    if origin.uses_alpha_channel:
        return origin, AlphaChannelMasks(source, refine)
    if origin.path is None:
        return origin, None
    given = StoredMasks(open_masks(origin.path, invert=inputs.invert_masks), source, refine)
    given.check()
    return origin, given


def _unread_live_parts(inputs: CaptureInputs) -> Iterator[str]:
    """Name poses and masks that lie in a live source's folder, and are not read."""
    if inputs.is_live and inputs.video.is_dir():
        own = (find_own_poses(inputs.video), find_own_masks(inputs.video))
        for path in filter(None, own):
            yield f"{path} is not read: poses and masks of a live source are tracked."


def _open_stream_source(inputs: CaptureInputs) -> FrameSource:
    pace = PacingClock()
    if inputs.is_live:
        return open_live_source(
            inputs.video, inputs.camera, inputs.frames, pace,
            idle_s=inputs.idle_s, watch_s=inputs.watch_s, rotate=inputs.rotate,
        )  # fmt: skip
    source = open_source(inputs.video, frames=inputs.frames, rotate=inputs.rotate)
    return RealtimePlayback(source, pace)
