"""Fits the poses of a stream's frames to the key points and the mask of each.

The first frames settle proportions and focal length, which stay; later poses are fitted a few at a
time, together with those of the frames before and after them, so that they move as people do.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float32

from capture.camera import Camera, Vector3
from capture.source import shrink_to_longer_side
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.parametric_body import ShapedBody
from preprocess.body.proportion_space import ProportionSpace
from preprocess.fitting.clip_fitting import (
    POSES_ALONE,
    SIGMA_LOG_FOCAL,
    TRACKED_WEIGHTS,
    USUAL_WEIGHTS,
    ClipFitter,
    ClipFrame,
    EvidenceWeights,
    FitParameters,
)
from preprocess.fitting.clip_poses import ClipPoses
from preprocess.fitting.outlines import OUTLINE_PERSON_PX, OutlineDistances, OutlineModel
from preprocess.tracking.keypoints import KeypointTrack, PersonKeypoints
from preprocess.tracking.pose_lift import lift_keypoints

CHUNK_FRAMES = 8
"""Frames whose poses are fitted at once, together with as many before and after them: without later
ones, poses jitter three times as much."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SeenPerson:
    """The person as found in one frame of a stream.

    Key points are in pixels of the frame; `mask` is that of the reduced frame, in [0, 1].
    """

    number: int
    time_s: float
    keypoints: PersonKeypoints
    mask: Float32[np.ndarray, "rows columns"]


def reduced_size_px(person: PersonKeypoints, frame_px: tuple[int, int]) -> tuple[int, int]:
    """Width and height of the frame at which a person is as tall as outlines need it to be."""
    tall = max(1.0, float(np.ptp(person.image_px[:, 1])))
    return shrink_to_longer_side(frame_px, max(32, round(max(frame_px) * OUTLINE_PERSON_PX / tall)))


def fit_first_frames(
    seen: Sequence[SeenPerson],
    shaped: ShapedBody,
    camera: Camera,
    *,
    fixed: bool = False,
    sigma_log_focal: float = SIGMA_LOG_FOCAL,
) -> tuple[Motion, ShapedBody, Camera]:
    """Fit proportions (unless `fixed`), focal length and poses to the first frames of a stream."""
    model, lifted = OutlineModel(ProportionSpace.around(shaped)), _lift(seen, shaped, camera)
    fitter = _fitter(
        seen, ClipPoses.of(lifted, range(len(seen))), model, camera,
        settled=False, sigma_log_focal=sigma_log_focal, weights=USUAL_WEIGHTS,
    )  # fmt: skip
    fitter.iterate_stages(FitParameters(proportions=not fixed), keypoint_count=5, outline_count=5)
    fitted = camera.scale_focal(float(np.exp(fitter.log_focal)))
    return fitter.poses.replace_in(lifted), model.space.shape(fitter.coefficients), fitted


@final
class StreamPoseFitter:
    """Fits the poses of a stream's frames, a few at a time, for a known person and camera."""

    def __init__(self, shaped: ShapedBody, camera: Camera) -> None:
        """Start without frames."""
        self._model, self._camera = OutlineModel(ProportionSpace.around(shaped)), camera
        self._seen: list[SeenPerson] = []
        self._poses: list[BodyPose] = []
        self._done = 0  # frames at the front whose poses were returned

    def add(self, seen: SeenPerson, start: BodyPose | None = None) -> dict[int, BodyPose]:
        """Add the next frame; return the poses that are fitted now, by the frames' numbers.

        `start` is its pose, if it is known nearly; None lifts it from the key points.
        """
        if start is None:
            shaped = self._model.space.shaped
            start = _lift([seen], shaped, self._camera)[0]
            if self._poses:
                start = _at_distance_of(start, self._poses[-1], shaped.joints[0])
        if not self._seen:
            self._poses = []
        self._seen.append(seen)
        self._poses.append(start)
        end = self._done + CHUNK_FRAMES
        return self._fit(end) if len(self._seen) >= end + CHUNK_FRAMES else {}

    def finish(self) -> dict[int, BodyPose]:
        """Fit what is left; the next frame is no neighbor of the last one, but at its distance."""
        found = self._fit(len(self._seen))
        self._seen, self._poses, self._done = [], self._poses[-1:], 0
        return found

    def _fit(self, end: int) -> dict[int, BodyPose]:
        """Fit all frames that are kept, and return the poses up to one of them."""
        if self._done == end:
            return {}
        fitter = _fitter(self._seen, ClipPoses.stack(self._poses), self._model, self._camera)
        fitter.iterate_stages(POSES_ALONE, keypoint_count=1, outline_count=3)
        self._poses = [fitter.poses[place] for place in range(len(self._seen))]
        new = range(self._done, end)
        found = {self._seen[place].number: self._poses[place] for place in new}
        first = max(0, end - CHUNK_FRAMES)
        self._seen, self._poses = self._seen[first:], self._poses[first:]
        self._done = end - first
        return found


def _at_distance_of(pose: BodyPose, other: BodyPose, pelvis: Vector3) -> BodyPose:
    """A pose moved along its view, from a camera at the origin, to the distance of another."""
    place, away = pelvis + pose.root_translation, (pelvis + other.root_translation)[2]
    return replace(pose, root_translation=place * (away / max(float(place[2]), 1e-3)) - pelvis)


def _lift(seen: Sequence[SeenPerson], shaped: ShapedBody, camera: Camera) -> Motion:
    """First guess of the poses of frames, which need not follow one another."""
    track, numbers = _track(seen, camera), np.array([each.number for each in seen])
    motion = lift_keypoints(track, shaped, camera)
    assert motion.frames is not None
    rows = np.searchsorted(motion.frames, numbers)  # others bridge the gaps between them
    return replace(motion.select_rows(rows, numbers), times_s=track.times_s)


def _track(seen: Sequence[SeenPerson], camera: Camera) -> KeypointTrack:
    return KeypointTrack.of(
        [each.number for each in seen],
        [each.keypoints for each in seen],
        camera.size_px,
        [each.time_s for each in seen],
    )


def _fitter(
    seen: Sequence[SeenPerson],
    poses: ClipPoses,
    model: OutlineModel,
    camera: Camera,
    *,
    settled: bool = True,
    sigma_log_focal: float = SIGMA_LOG_FOCAL,
    weights: EvidenceWeights = TRACKED_WEIGHTS,
) -> ClipFitter:
    """The fit of some frames to their key points and masks."""
    small = camera.resize(seen[0].mask.shape[::-1])
    frames = [
        ClipFrame(
            number=float(each.number), camera=small, mask=OutlineDistances.of(each.mask, small)
        )
        for each in seen
    ]
    return ClipFitter(
        poses, model.space, frames, model=model, track=_track(seen, camera),
        settled=settled, sigma_log_focal=sigma_log_focal, weights=weights,
    )  # fmt: skip
