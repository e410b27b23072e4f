"""All that is known about a video before its first frame is read, checked together."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from apps.recording.notes import notes_of
from apps.recording.person import live_person, person_of
from capture.camera import Camera
from capture.camera_device import camera_address
from capture.errors import BadInput
from capture.frame import Frame
from capture.growing import IDLE_S
from capture.opening import open_live, open_source
from capture.pace import Pace
from capture.playback import Playback
from capture.source import Source
from preprocess.body import ShapedBody
from preprocess.body_file import load_body
from preprocess.camera_file import CameraTrack, default_cameras
from preprocess.capture_folder import CapturePaths, find_capture, find_live_capture
from preprocess.doctor.claim import Claim
from preprocess.fit.family import with_family
from preprocess.fit.growing import GrowingFit
from preprocess.fit.refit import Refit
from preprocess.focal import focal_from_masks
from preprocess.live import LiveParts
from preprocess.masks.files import Masks, masks_in_poses, open_masks
from preprocess.masks.segmenter import OURS, Segmenter, make_segmenter, segmenter_name
from preprocess.observation import Observation
from preprocess.observe import Dropped, observer
from preprocess.pose import Motion
from preprocess.poses import read_poses
from preprocess.poses.place import placed
from preprocess.shape import shaped_for
from preprocess.upright import upright_cameras


@dataclass(frozen=True, kw_only=True)
class RecordingPaths:
    """What the user named; the rest is looked for (see `find_capture`).

    Attributes:
        video: Video file, folder of pictures, or capture folder.
        poses, masks: Files or folders, or None.
        cameras: A file, "static", "solve" (poses are then in the camera of each frame, and so is
            all the rest until cameras were solved), or None.
        body: A body file; None for the embedded body.
        frames: Which frames are wanted.
        mask_invert: Whether the person is dark in the masks; None finds out.
        live: Whether `video` is a folder that grows; a camera is live without it.
        person: Whose poses, where the file holds several people's; None for the longest track.
        idle_s: Of a live source: how long nothing new may come.
        height_m: How tall the person is; None if only the poses tell.
    """

    video: Path
    poses: Path | None = None
    masks: Path | None = None
    cameras: str | None = None
    body: Path | None = None
    frames: slice | None = None
    mask_invert: bool | None = None
    live: bool = False
    person: str | None = None
    idle_s: float = IDLE_S
    height_m: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """A video of one person, with everything that belongs to it.

    Attributes:
        paths: Where its parts lie.
        source: The frames.
        motion: The poses.
        masks: The masks; None if the pictures have an alpha channel, or `segment` finds them.
        cameras: The cameras, of the frames' size.
        shaped: The person's body.
        size_px: Longer side that training sees; None for the frames' own.
        notes: What a user should know about how the parts were read.
        live: Poses and masks of a live source, which come while it runs; `motion` is what had come
            when it was opened.
        segment: What estimates the masks, if nothing holds them.
        solved: What the report says of cameras that were solved.
        refit: How the poses were fitted to the masks, if they were made for another body.
        growing_fit: The same of a live source, which goes on while its frames come.
    """

    paths: CapturePaths
    source: Source
    motion: Motion
    masks: Masks | None
    cameras: CameraTrack
    shaped: ShapedBody
    size_px: int | None
    notes: tuple[str, ...]
    live: LiveParts | None = None
    segment: Segmenter | None = None
    solved: dict[str, Any] | None = None
    refit: Refit | None = None
    growing_fit: GrowingFit | None = None

    @classmethod
    def open(
        cls,
        wanted: RecordingPaths,
        *,
        size_px: int | None = None,
        doubtful: bool = False,
        avatars: Path | None = None,
    ) -> "Recording":
        """Finds, opens and checks the parts.

        Args:
            wanted: What the user named.
            size_px: Longer side that training will see.
            doubtful: Leaves out whether they fit together, for somebody who wants to find out.
            avatars: The person of a finished avatar, as a file, to whom the poses are to belong.

        Raises:
            BadInput: If one is missing or unreadable, or they do not fit together.
        """
        camera = camera_address(wanted.video)
        if wanted.live or camera is not None:
            return cls._open_live(wanted, camera, size_px, avatars)
        named = segmenter_name(wanted.masks)
        given_masks = wanted.masks if named is None else None
        paths = find_capture(wanted.video, wanted.poses, given_masks, wanted.cameras)
        if named is not None:
            paths = replace(paths, masks=None)
        source = open_source(paths.video, frames=wanted.frames)
        body = load_body(wanted.body)
        motion = read_poses(paths.poses, default_model=body.family, person=wanted.person)
        masks = None
        if paths.masks is not None:
            masks = open_masks(paths.masks, invert=wanted.mask_invert, person=wanted.person)
        elif named is None and not source.has_alpha:
            masks = masks_in_poses(paths.poses, source, person=wanted.person)
        if paths.cameras is not None:
            cameras = upright_cameras(paths.cameras, source)
        else:
            cameras = default_cameras(motion, source.size_px)
        given = paths.cameras is not None
        motion = with_family(motion, body, cameras, source, masks, cameras_given=given)
        shaped = shaped_for(body, motion)
        motion = placed(motion, shaped, cameras, cameras_given=given)
        if paths.cameras is None and motion.intrinsic is None and motion.lens is None:
            cameras = focal_from_masks(cameras, motion, shaped, source, masks)
        fit = person_of(
            motion, shaped, cameras, source, masks, avatars=avatars, height_m=wanted.height_m
        )
        estimated = named or (OURS if masks is None and not source.has_alpha else None)
        recording = cls(
            paths=paths,
            source=source,
            motion=fit.motion,
            masks=masks,
            cameras=cameras,
            shaped=fit.shaped,
            size_px=size_px,
            notes=tuple(notes_of(fit, masks, cameras, segment=estimated)),
            segment=None if estimated is None else make_segmenter(estimated, fit.shaped),
            refit=fit.refit,
        )
        if not doubtful:
            recording.check()
        return recording

    @classmethod
    def _open_live(
        cls,
        wanted: RecordingPaths,
        camera: str | None,
        size_px: int | None,
        avatars: Path | None,
    ) -> "Recording":
        """The same of a live source, whose first picture and first pose are waited for."""
        if wanted.cameras == "solve" or wanted.height_m is not None:
            raise BadInput(
                "--cameras solve and --height-cm need a recording; of a live source the camera "
                "stands still (--cameras static), and nobody knows its poses yet."
            )
        named = segmenter_name(wanted.masks)
        given_masks = wanted.masks if named is None else None
        paths = find_live_capture(wanted.video, wanted.poses, given_masks, wanted.cameras)
        body, pace = load_body(wanted.body), Pace()
        source = open_live(paths.video, camera, wanted.frames, pace, idle_s=wanted.idle_s)
        live = LiveParts.open(
            paths, source, pace, family=body.family, invert=wanted.mask_invert,
            first_within_s=wanted.idle_s, estimated=named is not None,
        )  # fmt: skip
        motion = live.poses.motion
        if paths.cameras is not None:
            cameras = upright_cameras(paths.cameras, source)
        else:
            cameras = default_cameras(motion, source.size_px)
        shaped, given = shaped_for(body, motion), paths.cameras is not None
        live.poses.place(lambda read: placed(read, shaped, cameras, cameras_given=given))
        fit, growing_fit = live_person(
            live.poses.motion, shaped, avatars=avatars, masked=named is None
        )
        recording = cls(
            paths=paths,
            source=source,
            motion=fit.motion,
            masks=None,
            cameras=cameras,
            shaped=fit.shaped,
            size_px=size_px,
            notes=tuple(notes_of(fit, None, cameras, segment=named)),
            live=live,
            segment=None if named is None else make_segmenter(named, fit.shaped),
            growing_fit=growing_fit,
        )
        recording.observer()
        recording.footprint_m()
        return recording

    def check(self) -> None:
        """Whether the parts fit together; no frame is read.

        Raises:
            BadInput: If they do not.
        """
        self.observer()
        self.footprint_m()

    def observations(self) -> Iterator[Observation | Dropped]:
        """The frames with pose, mask and camera, in order, lazily; every call starts anew."""
        return map(self.observer(), self.source.frames())

    def observer(self) -> Callable[[Frame], Observation | Dropped]:
        """What joins a frame with its pose, mask and camera."""
        if self.live is not None:
            seen = self.live.observer(self.source, self.cameras, self.size_px, self.segment)
            return seen if self.growing_fit is None else self.growing_fit.observing(seen)
        return observer(
            self.source, self.motion, self.masks, self.cameras, size_px=self.size_px,
            segment=self.segment,
        )  # fmt: skip

    def told_of_masks(self) -> dict[str, str | float | None]:
        """Where the masks come from, and how well estimated ones agree with the posed body."""
        if self.segment is not None:
            agreement = getattr(self.segment, "agreement", None)
            name = getattr(self.segment, "name", type(self.segment).__name__)
            return {"masks": f"estimated by {name}", "mask_agreement": agreement}
        source = "alpha channel" if self.masks is None else self.masks.path.name
        return {"masks": source, "mask_agreement": None}

    def told_at_the_end(self) -> Iterator[str]:
        """What could not be said before the frames came."""
        growing = self.growing_fit
        if growing is not None and growing.refit is not None:
            yield f"{growing.refit.in_words()} (By the first {growing.frames} frames.)"

    def told_of_body(self) -> dict[str, float | bool] | None:
        """How the poses were fitted to the body that is used; None if that was not needed."""
        growing = self.growing_fit
        refit = self.refit if growing is None else growing.refit
        if refit is None:
            return None
        told = refit.as_json()
        return told if growing is None else {**told, "frames": growing.frames}

    def camera_of_row(self, row: int) -> Camera:
        """The camera that sees one of the poses."""
        claim = Claim.of(self.motion, self.cameras, self.source)
        return self.cameras[int(claim.camera_rows()[row])]

    def played(self) -> "Recording":
        """The same, its frames coming at their own times."""
        return replace(self, source=Playback(self.source, Pace()))

    def footprint_m(self) -> float:
        """What one pixel covers on the body: the dial of the field's resolution.

        Raises:
            BadInput: If the person is behind the camera.
        """
        claim = Claim.of(self.motion, self.cameras, self.source)
        valid = self.motion.valid
        pelves = self.shaped.joints[0] + self.motion.root_translations[valid]
        forward = claim.extrinsics[claim.camera_rows()[valid], 2]  # of the camera that sees each
        depth = float(np.median((pelves * forward[:, :3]).sum(axis=1) + forward[:, 3]))
        camera = self.cameras[0]
        if depth <= 0.0:
            raise BadInput(
                f"The person is at the camera or behind it (depth {depth:.2f} m); poses were "
                "expected in the camera's world, in metres, with OpenCV axes (x right, y down, "
                "z forward). Do poses and cameras come from the same run? Poses in a world need "
                "the cameras of that world; without them, and with --cameras solve, poses must be "
                "in each frame's own camera."
            )
        longer = max(camera.size_px)
        shrinking = min(1.0, (self.size_px or longer) / longer)
        return depth / (max(camera.focal_px) * shrinking)
