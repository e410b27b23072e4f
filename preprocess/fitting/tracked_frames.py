"""Fits the poses of a stream's frames one by one, to the key points and the mask of each.

The first frames settle proportions and focal length, which stay; each later pose is fitted together
with those of the last few frames, so that it moves as people do. Earlier poses are fitted once more
with the frames that came after them.
"""

from collections import deque
from collections.abc import Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float, Float32

from capture.camera import Camera
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
from preprocess.observation import shrink_to_longer_side
from preprocess.tracking.keypoints import KeypointTrack, PersonKeypoints
from preprocess.tracking.pose_lift import lift_keypoints

WINDOW_FRAMES = 10
"""Frames whose poses are fitted together while a stream runs."""
LAG_FRAMES = 4
"""Later frames that a frame's pose waits for: without any, poses jitter three times as much."""
FIRST_ITERATIONS = (5, 5)
"""Iterations over the first frames, with key points alone and then with outlines."""
FRAME_ITERATIONS = (1, 1)
"""Iterations for each later frame, with key points alone and then with outlines."""
REVISED_FRAMES = 32
"""New frames after which the poses of all of them are fitted again."""
OVERLAP_FRAMES = 16
"""Frames before those whose poses are fitted with them: a second time, with later neighbors."""
REVISION_ITERATIONS = 2
"""Iterations over these frames, with outlines; a third wins 0.5 mm."""


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
    """Fit proportions, focal length and poses to the first frames of a stream.

    Args:
        shaped: The body's mean shape, or (`fixed`) the person, whose proportions stay.
        camera: Camera of the frames, whose focal length is not exact.
        sigma_log_focal: Prior standard deviation of the focal length's logarithm.
    """
    model, lifted = OutlineModel(ProportionSpace.around(shaped)), _lift(seen, shaped, camera)
    fitter = _fitter(
        seen, ClipPoses.of(lifted, range(len(seen))), model, camera, range(len(seen)),
        settled=False, sigma_log_focal=sigma_log_focal, weights=USUAL_WEIGHTS,
    )  # fmt: skip
    fitter.iterate_stages(FitParameters(proportions=not fixed), *FIRST_ITERATIONS)
    fitted = camera.scale_focal(float(np.exp(fitter.log_focal)))
    return fitter.poses.replace_in(lifted), model.space.shape(fitter.coefficients), fitted


@final
class FramePoseFitter:
    """Fits the poses of a stream's last frames, for a known person and camera."""

    def __init__(self, shaped: ShapedBody, camera: Camera) -> None:
        """Start without frames."""
        self._model, self._camera = OutlineModel(ProportionSpace.around(shaped)), camera
        self._seen: deque[SeenPerson] = deque(maxlen=WINDOW_FRAMES)
        self._poses: list[BodyPose] = []
        self._last: BodyPose | None = None

    def add(self, seen: SeenPerson, start: BodyPose | None = None) -> None:
        """Fit the poses of the window that ends with the next frame.

        `start` is its pose, if it is known nearly; None lifts it from the key points.
        """
        self._seen.append(seen)
        shaped = self._model.space.shaped
        if start is None:
            start = _lift([seen], shaped, self._camera)[0]
            if self._last is not None:
                start = _at_distance_of(start, self._last, shaped.joints[0])
        count = len(self._seen)
        poses = ClipPoses.stack([*self._poses, start][-count:])
        outlined = {count - 1, count - 1 - LAG_FRAMES}
        fitter = _fitter(self._seen, poses, self._model, self._camera, outlined)
        fitter.iterate_stages(POSES_ALONE, *FRAME_ITERATIONS)
        self._poses = [fitter.poses[place] for place in range(count)]
        self._last = self._poses[-1]

    def forget(self) -> None:
        """Start again without frames, but at the last one's distance."""
        self._seen.clear()
        self._poses.clear()

    def pose(self, number: int) -> BodyPose:
        """Present pose of one of the last frames, by its number."""
        numbers = [each.number for each in self._seen]
        return self._poses[numbers.index(number)]


@final
class EarlierPoses:
    """Fits the poses of a stream's earlier frames again, with their later neighbors.

    Fits run on a thread of their own: no method waits for them. What comes while a fit is still
    going on is left as it is, so that a slow machine does not fall behind.
    """

    def __init__(self, shaped: ShapedBody, camera: Camera) -> None:
        """Start without frames."""
        self._model, self._camera = OutlineModel(ProportionSpace.around(shaped)), camera
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="earlier poses")
        self._fit: Future[None] | None = None
        self._new: dict[SeenPerson, BodyPose] = {}
        self._recent: dict[SeenPerson, BodyPose] = {}
        self._revised: deque[dict[int, BodyPose]] = deque()

    def add(self, seen: SeenPerson, pose: BodyPose) -> None:
        """Add the next frame and its pose, and fit once there are enough of them."""
        self._new[seen] = pose
        if len(self._new) < REVISED_FRAMES:
            return
        if self._fit is None or self._fit.done():
            self._fit_new()
        else:
            self._new = {}

    def fit_rest(self) -> None:
        """Fit the frames that were added since the last fit, which have no later neighbors."""
        self._fit_new()
        self._pool.submit(self._recent.clear)

    def _fit_new(self) -> None:
        if self._fit is not None and self._fit.done():
            self._fit.result()  # raises what it raised
        if self._new:
            self._fit = self._pool.submit(self._fit_again, self._new)
            self._new = {}

    def take(self) -> dict[int, BodyPose]:
        """Poses that were fitted since the last call, by the numbers of their frames."""
        found: dict[int, BodyPose] = {}
        while self._revised:
            found |= self._revised.popleft()
        return found

    def _fit_again(self, new: dict[SeenPerson, BodyPose]) -> None:
        frames = {**self._recent, **new}
        seen, count = list(frames), len(frames)
        start = ClipPoses.stack(list(frames.values()))
        fitter = _fitter(seen, start, self._model, self._camera, range(count))
        fitter.iterate_stages(POSES_ALONE, 0, REVISION_ITERATIONS)
        poses = [fitter.poses[place] for place in range(count)]
        self._recent.clear()
        self._recent.update(zip(seen[-OVERLAP_FRAMES:], poses[-OVERLAP_FRAMES:], strict=True))
        self._revised.append({each.number: p for each, p in zip(seen, poses, strict=True)})


def _at_distance_of(pose: BodyPose, other: BodyPose, pelvis: Float[np.ndarray, "3"]) -> BodyPose:
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
    outlined: Collection[int],
    *,
    settled: bool = True,
    sigma_log_focal: float = SIGMA_LOG_FOCAL,
    weights: EvidenceWeights = TRACKED_WEIGHTS,
) -> ClipFitter:
    """The fit of some frames, of which those at some places are compared with their masks."""
    small = camera.resize(seen[0].mask.shape[::-1])
    frames = [
        ClipFrame(
            number=float(each.number),
            camera=small,
            mask=OutlineDistances.of(each.mask, small) if place in outlined else None,
        )
        for place, each in enumerate(seen)
    ]
    return ClipFitter(
        poses, model.space, frames, model=model, track=_track(seen, camera),
        settled=settled, sigma_log_focal=sigma_log_focal, weights=weights,
    )  # fmt: skip
