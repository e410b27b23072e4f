"""Opening of a capture: read its parts, and align them with each other.

Of a stream that comes without poses, the person is tracked while its frames come.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from capture.input_error import InputError
from capture.source import Frame, FrameSource, PacingClock, RealtimePlayback, WrappedSource
from capture.source_opening import open_live_source, open_source
from preprocess.alignment.capture_geometry import CaptureGeometry, rescale_motion
from preprocess.body.body_pose import Motion
from preprocess.body.parametric_body import BodyModel, ShapedBody, load_body_model, read_shaped_body
from preprocess.body.proportion_space import shape_for_motion
from preprocess.cameras.camera_file import (
    ASSUMED_CAMERA_SOURCE,
    CameraTrack,
    assume_camera,
    assume_static_camera,
    read_cameras,
    tracker_intrinsic_matrix,
)
from preprocess.capture_inputs import (
    CaptureInputs,
    CapturePaths,
    find_cameras,
    find_own_masks,
    find_own_poses,
)
from preprocess.capture_session import Capture, Provenance
from preprocess.fitting.coarse_start import start_distances, start_focal_length
from preprocess.masks.mask_files import Masks, open_masks
from preprocess.masks.mask_refinement import GivenMaskRefiner
from preprocess.masks.mask_sources import (
    AlphaChannelMasks,
    EstimatedMasks,
    GivenMasks,
    MaskSource,
    StoredMasks,
)
from preprocess.plugins import (
    DEFAULT_SEGMENTER,
    DEFAULT_TRACKER,
    PersonTracker,
    make_segmenter,
    segmenter_name,
)
from preprocess.poses.motion_builder import place_in_camera_world
from preprocess.poses.plausibility import (
    lost_pose_warnings,
    plausibility_warnings,
    require_plausible,
)
from preprocess.poses.pose_format_registry import read_poses
from preprocess.tracked_stream import LiveTracking, TrackedMasks, TrackedObservations, TrackedStream
from preprocess.tracking.keypoints import PersonKeypoints
from preprocess.tracking.video_tracking import MaskRefinement


@dataclass(frozen=True, eq=False, kw_only=True)
class ImportedCapture:
    """The parts of a recording as they were read or tracked, not aligned with each other yet.

    Attributes:
        motion: The poses, in the space and for the body of their file.
        stored_masks: The masks, if a file holds them.
        segmenter: Name of the segmenter that estimates them; None if they are given.
        provenance: Where the poses come from, if not from a file of the user.
    """

    inputs: CaptureInputs
    paths: CapturePaths
    source: FrameSource
    body: BodyModel
    motion: Motion
    stored_masks: Masks | None
    segmenter: str | None
    provenance: tuple[Provenance, ...] = ()

    def given_masks(self) -> GivenMasks | None:
        """The masks of files or alpha channels; None if there are none."""
        if self.segmenter is not None:
            return None
        return _given_masks(self.stored_masks, self.source, self.inputs)

    def transposed(self) -> "ImportedCapture":
        """Exchange the width and height of the video, as if it had not been rotated afterwards.

        With them masks and cameras of upright images are opened; the frames are unchanged.
        """
        source = WrappedSource(self.source)
        source.size_px = self.source.size_px[1], self.source.size_px[0]
        return replace(self, source=source)


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
    """Read the parts of a recording with poses."""
    paths = inputs.find_paths()
    source = open_source(paths.video, frames=inputs.frames, rotate=inputs.rotate)
    body = load_body_model(inputs.body)
    motion = read_poses(paths.poses, person=inputs.person)
    return import_capture(inputs, paths, source, body, motion)


def import_capture(
    inputs: CaptureInputs, paths: CapturePaths, source: FrameSource, body: BodyModel, motion: Motion
) -> ImportedCapture:
    """Join poses with the masks of files or alpha channels."""
    segmenter = _choose_segmenter(inputs, paths.masks, source)
    masks, path = None, inputs.masks or paths.masks
    if segmenter is None and path is not None:
        masks = open_masks(path, invert=inputs.invert_masks)
    paths = replace(paths, masks=None if masks is None else masks.path)
    return ImportedCapture(
        inputs=inputs, paths=paths, source=source, body=body, motion=motion,
        stored_masks=masks, segmenter=segmenter,
    )  # fmt: skip


def _choose_segmenter(inputs: CaptureInputs, found: Path | None, source: FrameSource) -> str | None:
    """The segmenter of the masks: the named one, or the built-in one if none are named or found."""
    if inputs.masks is not None:
        return segmenter_name(inputs.masks)
    return None if found is not None or source.has_alpha else DEFAULT_SEGMENTER


def align_capture(
    imported: ImportedCapture,
    *,
    size_px: int | None = None,
    skip_checks: bool = False,
    avatar_body: Path | None = None,
) -> Capture:
    """Align frames, poses, masks and cameras with each other.

    `size_px` is the longer side of the training images, None the frames' own; `skip_checks` takes
    the parts even if they do not fit together, for ia-check. `avatar_body` is the file of a
    finished avatar's person, to whom the poses belong.
    """
    motion = imported.motion
    warnings: tuple[str, ...] = ()
    if not skip_checks:
        warnings = tuple(plausibility_warnings(motion))
        motion = require_plausible(motion, imported.paths.poses)
    capture = _place(imported, motion, avatar_body, size_px or max(imported.source.size_px))
    if not any(each.part == "tracking" for each in imported.provenance):  # its grade names them
        warnings = (*lost_pose_warnings(imported.motion), *warnings)
    poses = Provenance(
        "poses",
        imported.paths.poses.name,
        (motion.note, *warnings),
        uncertainty=1.0 if motion.is_fitted else 0.0,
    )
    cameras = Provenance("cameras", capture.cameras.source, (capture.cameras.note,))
    masks = _mask_provenance(capture.masks, imported.segmenter)
    made = (*imported.provenance, poses, cameras, masks, *capture.provenance)
    capture = replace(capture, provenance=made)
    if not skip_checks:
        capture.check()
    return capture


def _place(
    imported: ImportedCapture, motion: Motion, avatar_body: Path | None, size_px: int
) -> Capture:
    """Join the parts in the cameras' world, with the person, distances and focal length meant.

    Poses of another body model have another size, and those of an added video another person's.
    """
    source, named = imported.source, imported.paths.cameras
    cameras = assume_static_camera(motion, source.size_px)
    if named is not None:
        cameras = read_cameras(named, source.size_px, source)
    if motion.is_fitted and not cameras.is_moving:  # with the focal length, at its distances
        intrinsic = tracker_intrinsic_matrix(motion, source.size_px)
        if intrinsic is not None:
            cameras = cameras.scale_focal(float(intrinsic[0, 0]) / cameras[0].focal_px[0])
    posed = shape_for_motion(imported.body, motion)
    motion = place_in_camera_world(motion, posed, cameras, cameras_given=named is not None)
    person = _find_person(posed, imported.inputs, cameras, avatar_body)
    is_foreign = posed.body.family not in ("smpl", motion.body_model)
    is_other = not person.is_same_person(posed)
    if is_other:
        motion = rescale_motion(CaptureGeometry.of(motion, cameras, source), posed, person)
    given = imported.given_masks()
    capture = Capture(
        paths=imported.paths, source=source, motion=motion,
        masks=given or _estimated_masks(imported.segmenter, person),
        cameras=cameras, shaped=person, size_px=size_px, provenance=(),
    )  # fmt: skip
    note, figures = "", None
    if is_other and avatar_body is not None and not is_foreign:
        note = _describe_difference(posed, person)
    if is_foreign:
        note = (
            f"The poses were made for the body model {motion.body_model!r}, but "
            f"{posed.body.family!r} is used (--body), with joints where the mean shape has them."
        )
    if is_foreign or (is_other and avatar_body is not None and given is not None):
        own = None if is_other else posed.body.with_shape()
        capture, start_note, figures = start_distances(capture, own=own)
        note = f"{note} {start_note}".strip()
    elif given is not None and cameras.source == ASSUMED_CAMERA_SOURCE:
        capture = start_focal_length(capture)
    if given is None and is_foreign:  # those estimated before do not count
        capture = replace(capture, masks=_estimated_masks(imported.segmenter, capture.shaped))
    return replace(
        capture, provenance=(Provenance("body", person.body.family, (note,), figures=figures),)
    )


def _find_person(
    posed: ShapedBody, inputs: CaptureInputs, cameras: CameraTrack, avatar_body: Path | None
) -> ShapedBody:
    """The person of a finished avatar, or that of the poses, of a height that may be stated."""
    height_m = inputs.height_m
    if avatar_body is None:
        if height_m is None:
            return posed
        if not cameras.is_moving:
            return posed.scaled_to(height_m)
        raise InputError(
            f"--height-cm contradicts {cameras.source}, whose cameras move through a world of a "
            "size of its own. Leave one of them out."
        )
    person = read_shaped_body(avatar_body, posed.body)
    if height_m is not None and abs(height_m - person.height_m) > 0.015:  # metres
        raise InputError(
            f"--height-cm is {100.0 * height_m:.0f}, but the avatar in --out is "
            f"{100.0 * person.height_m:.0f} cm tall, which was settled by its first video. Leave "
            "it out, or train it from the start (--overwrite)."
        )
    return person


def _describe_difference(posed: ShapedBody, person: ShapedBody) -> str:
    """Describe how the poses' body differs from the avatar's."""
    ratio = posed.height_m / person.height_m
    doubt = " Is it the same person?" if abs(ratio - 1.0) > 0.08 else ""
    return (
        f"The body of these poses is {100.0 * posed.height_m:.0f} cm tall, the avatar's "
        f"{100.0 * person.height_m:.0f} cm: it keeps its own, and these poses follow.{doubt}"
    )


def _mask_provenance(masks: MaskSource, segmenter: str | None) -> Provenance:
    notes = []
    if segmenter is not None:
        notes.append(
            f"Masks are estimated from the images and the poses (segmenter:{segmenter}); a "
            "segmenter's own masks (--masks) are sharper around hair and hands."
        )
    if isinstance(masks, AlphaChannelMasks):
        notes.append("The images' own alpha channel is used as their masks.")
    if isinstance(masks, StoredMasks) and masks.files.inverted:
        path = masks.files.path
        notes.append(f"The masks in {path} show the background (white); they were inverted.")
    return Provenance("masks", masks.origin, tuple(notes), 0.0 if masks.is_given else 1.0)


def _estimated_masks(segmenter: str | None, shaped: ShapedBody) -> EstimatedMasks:
    assert segmenter is not None
    return EstimatedMasks(make_segmenter(segmenter, shaped))


def open_tracked_stream(
    inputs: CaptureInputs,
    tracker: PersonTracker,
    make_refinement: Callable[[tuple[int, int]], MaskRefinement],
    poses: Path,
    *,
    longer_side_px: Callable[[FrameSource], int] = lambda source: max(source.size_px),
    avatar_body: Path | None = None,
    on_tracked: Callable[[Frame, PersonKeypoints | None], object] = lambda *_: None,
) -> TrackedObservations:
    """Open a live source, or a recording at its own speed, and find the person.

    Masks of a recording that are named or lie beside it, an installed segmenter's, and the images'
    alpha channel are learnt from; only without any are the tracker's, refined for a width and
    height by `make_refinement`. To `poses` the poses will be written in the end, `avatar_body` is
    the file of a finished avatar's person who is filmed again, and `on_tracked` receives each frame
    that was searched, and the person in it.
    """
    if inputs.cameras == "solve" or inputs.height_m is not None:
        raise InputError(
            "--cameras solve and --height-cm need the poses of the whole recording. Run ia-track "
            "first, and give its poses; or leave out --realtime."
        )
    source = _open_stream_source(inputs)
    own = None if inputs.is_live else find_own_masks(inputs.video)
    segmenter, given, path = _choose_segmenter(inputs, own, source), None, inputs.masks or own
    if segmenter is None:
        stored = None if path is None else open_masks(path, invert=inputs.invert_masks)
        given = _given_masks(stored, source, inputs)
        given.check()
    tracking = LiveTracking(TrackedStream(source), tracker, on_tracked)
    mean = load_body_model(inputs.body).with_shape()
    shaped = mean if avatar_body is None else read_shaped_body(avatar_body, mean.body)
    motion, person, cameras = tracking.start(
        shaped,
        assume_camera(inputs.video, inputs.cameras, tracking.stream),
        fixed_body=avatar_body is not None,
        stated_focal=find_cameras(inputs.video, inputs.cameras) is not None,
    )
    masks: MaskSource = TrackedMasks(tracking, make_refinement(source.size_px))
    made = Provenance("masks", masks.origin, uncertainty=1.0)
    if segmenter is None or inputs.masks is not None:
        masks = given or _estimated_masks(segmenter, person)
        made = _mask_provenance(masks, segmenter)
    capture = Capture(
        paths=CapturePaths(video=inputs.video, poses=poses, masks=own, cameras=None),
        source=tracking.stream, motion=replace(motion, program=inputs.tracker or DEFAULT_TRACKER),
        masks=masks, cameras=cameras, shaped=person, size_px=longer_side_px(source),
        provenance=(
            Provenance("poses", "tracked", tuple(_unread_live_parts(inputs)), uncertainty=1.0),
            Provenance("cameras", cameras.source, uncertainty=1.0),
            made,
        ),
    )  # fmt: skip
    return TrackedObservations(capture, tracking)


def _given_masks(stored: Masks | None, source: FrameSource, inputs: CaptureInputs) -> GivenMasks:
    """The masks of a file, or else the images' alpha channel."""
    refine = GivenMaskRefiner(enabled=inputs.refine_masks)
    if stored is None:
        return AlphaChannelMasks(source, refine)
    return StoredMasks(stored, source, refine)


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
    return RealtimePlayback(source, pace, skippable=True)
