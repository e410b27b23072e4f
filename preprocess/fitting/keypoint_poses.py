"""Poses that the built-in tracker's key points tell, as evidence beside given poses.

Outlines do not show how far limbs turn about themselves; key points tell it in part, by depth. Both
estimates of a pose err independently, so each counts by the inverse of its error's variance. The
given poses' error is estimated by how far outlines turned them, the key points' by the rest of the
disagreement between the two.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from capture.input_error import InputError
from capture.source import Frame
from capture.source_opening import reopen
from preprocess.alignment.silhouette_objective import spaced_indices
from preprocess.capture_session import Capture
from preprocess.fitting.clip_fitting import TRACKED_WEIGHTS, ClipFitter, ClipFrame, FitParameters
from preprocess.fitting.clip_poses import ClipPoses
from preprocess.observation import associate_cameras
from preprocess.tracking.keypoints import MIN_PRESENCE, KeypointTrack, PersonKeypoints

MOST_FRAMES = 80
"""Frames in which key points would be found if they alone counted, 30 core-ms each. The number is
this times the weight that they are expected to get."""
MIN_TRACKED_FRAMES = 4
"""Fewest frames with key points that tell poses."""
ITERATIONS = (4, 3)
"""Iterations with key points alone, and then with outlines."""
ERROR_PER_TURN = 1.2
"""Error that outlines leave in given poses, per rotation by which they turned them: 0.9 to 1.3 in
films of studio motions, 1.7 to 2.3 in real ones."""
LEAST_ERROR_RAD = math.radians(5.0)
"""Least error of poses by key points that is assumed: it is 3.5 degrees in films of studio motions,
10 to 14 in real ones."""


class KeypointEvidence(NamedTuple):
    """Poses by key points, and how far they are believed.

    Attributes:
        poses: Pose of each frame of the fit.
        weight: Weight against the fitted given poses, in [0, 1].
    """

    poses: ClipPoses
    weight: float


def weigh_keypoint_poses(
    capture: Capture, fitter: ClipFitter, share: float
) -> KeypointEvidence | None:
    """Estimate poses by key points, and their weight beside given poses that were fitted.

    Args:
        fitter: A fit of the capture's given poses to outlines; it is not changed.
        share: Share of its changes that is no noise, in [0, 1].

    Returns None if the person is not found, or key points would count by less than a twentieth.
    """
    error2 = share * (ERROR_PER_TURN * _mean_turn(fitter.corrections)) ** 2
    expected = error2 / (error2 + LEAST_ERROR_RAD**2)
    count = round(expected * MOST_FRAMES)
    if count < MIN_TRACKED_FRAMES:
        return None
    track = _find_keypoints(capture, fitter, _spread_frames(fitter.frames, count))
    if len(track) < MIN_TRACKED_FRAMES:
        return None
    beside = _fit_keypoints(capture, fitter, track)
    rows = np.searchsorted(_numbers(fitter.frames), _numbers(beside.frames)).tolist()
    steps = beside.poses.steps_from(fitter.poses.rows(rows), beside.camera_rotations)
    weight = error2 / max(_mean_turn(steps) ** 2, error2 + LEAST_ERROR_RAD**2)
    everywhere = [
        np.interp(_numbers(fitter.frames), _numbers(beside.frames), each) for each in steps.T
    ]
    poses = fitter.poses.moved(np.column_stack(everywhere), fitter.camera_rotations)
    return KeypointEvidence(poses, weight)


def blend_poses(
    one: ClipPoses,
    other: ClipPoses,
    share: float,
    camera_rotations: Float[np.ndarray, "frames 3 3"],
) -> ClipPoses:
    """Poses a share of the way from one to the other."""
    return one.moved(share * other.steps_from(one, camera_rotations), camera_rotations)


def _spread_frames(frames: Sequence[ClipFrame], count: int) -> list[ClipFrame]:
    """Choose `count` frames, evenly spread, those with outlines first."""
    outlined = [frame for frame in frames if frame.mask is not None]
    others = [frame for frame in frames if frame.mask is None]
    chosen = [outlined[n] for n in spaced_indices(len(outlined), count)] if outlined else []
    left = count - len(chosen)
    if left > 0 and others:
        chosen += [others[n] for n in spaced_indices(len(others), left)]
    return sorted(chosen, key=lambda frame: frame.number)


def _find_keypoints(
    capture: Capture, fitter: ClipFitter, frames: Sequence[ClipFrame]
) -> KeypointTrack:
    """Key points of the person in some of a fit's frames, where the fitted poses put the body."""
    from preprocess.tracking.blazepose import PosedPersonFinder  # loads onnxruntime

    places = {int(frame.number): place for place, frame in enumerate(fitter.frames)}
    wanted = sorted(int(frame.number) for frame in frames)
    find = PosedPersonFinder(fitter.model.space.shape(fitter.coefficients))
    source, camera_row = capture.source, associate_cameras(capture.cameras, capture.source)
    zoom = float(np.exp(fitter.log_focal))
    persons = dict[int, PersonKeypoints]()
    times_s = dict[int, float]()
    size_px, step = source.size_px, int(np.gcd.reduce(np.diff(wanted)))
    pictures: Iterable[Frame] = [each.picture for each in frames if each.picture is not None]
    if len(pictures) < len(frames):
        pictures = reopen(source, slice(wanted[0], wanted[-1] + 1, step)).frames()
    for frame in pictures:
        if frame.index not in wanted or "corrupt" in frame.flags:
            continue
        size_px = frame.size_px
        camera = capture.cameras[camera_row(frame.index)].scale_focal(zoom).resize(size_px)
        try:
            person, _ = find(frame.rgb, fitter.pose(places[frame.index]), camera)
        except InputError:  # the body is outside the image
            continue
        if person.presence >= MIN_PRESENCE:
            persons[frame.index], times_s[frame.index] = person, frame.time_s
    return KeypointTrack.of(list(persons), list(persons.values()), size_px, list(times_s.values()))


def _fit_keypoints(capture: Capture, fitter: ClipFitter, track: KeypointTrack) -> ClipFitter:
    """Fit human poses of the fitted person to key points, then to outlines, too."""
    numbers = set(track.frames.tolist())
    rows = [row for row, frame in enumerate(fitter.frames) if int(frame.number) in numbers]
    beside = ClipFitter(
        capture.motion,
        fitter.model.space,
        [fitter.frames[row] for row in rows],
        track=track,
        weights=TRACKED_WEIGHTS,
    )
    beside.take_person(fitter)
    beside.poses = fitter.poses.rows(rows)
    poses_only = FitParameters(proportions=False, focal=False)
    for _ in range(ITERATIONS[0]):
        beside.iterate(poses_only._replace(outlines=False))
    for _ in range(ITERATIONS[1]):
        beside.iterate(poses_only)
    return beside


def _mean_turn(steps: Float[np.ndarray, "frames 75"]) -> float:
    """Mean rotation of the joints but hands' inner ones and root, radians."""
    return float(np.linalg.norm(steps[:, 3:66].reshape(-1, 21, 3), axis=2).mean())


def _numbers(frames: Sequence[ClipFrame]) -> Float[np.ndarray, "frames"]:
    return np.array([frame.number for frame in frames])
