"""Grades tracked poses: do body and mask agree, are the poses smooth, and where are they doubtful?

No grade uses ground truth, so the same grades hold for any video.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from capture.camera import Camera
from capture.input_error import counted
from preprocess.alignment.capture_geometry import MIN_VIEW_COVERAGE, view_sector_share
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import rotation_matrices
from preprocess.body.parametric_body import ShapedBody
from preprocess.tracking.keypoints import HIPS, KeypointTrack
from preprocess.tracking.video_tracking import (
    MIN_FRAMES,
    PROBLEM_BITS,
    TrackingProblem,
    find_runs,
)

Rows = Bool[np.ndarray, "rows"]
"""Rows of a track that something holds for."""

MIN_IOU = 0.7
"""Least mean IoU of body and mask of poses that are good enough for an avatar."""
MIN_PERSON_PX = 96.0
"""Least median height of the person in the frames, px."""
MIN_STRETCH_FRAMES = 3
"""Fewest frames of a doubtful stretch that is reported."""
DISAGREE = "body and mask disagree (something may hide the person)"
"""Reason of frames whose IoU is low, or far below the film's usual."""
JUMPED = "the person jumps to another place; was the film cut here?"
"""Reason of the frames before and after a cut."""


@dataclass(frozen=True, kw_only=True)
class DoubtfulStretch:
    """Frames in a row, from `start_s` to `end_s`, whose poses are doubtful for one reason."""

    start_s: float
    end_s: float
    frames: int
    reason: str

    def describe(self) -> str:
        """Describe the stretch, for people."""
        return f"{self.start_s:.1f} to {self.end_s:.1f} s: {self.reason}"


@dataclass(frozen=True, kw_only=True)
class TrackingGrade:
    """Grades of tracked poses.

    Attributes:
        missed_share: Share of frames that seem to show the person, but in which they were not
            found; the longer a gap, the less so.
        doubtful_share: Share of frames that seem to show the person, and are doubtful; missed ones
            are.
        iou_mean, iou_worst: IoU of posed body and mask; NaN where no mask could be compared.
        jitter_mm: Median second difference of joints relative to the root, mm per frame squared.
        person_px: Median height of the person in the frames, px.
        directions_seen: Share of the horizontal directions from which the person was seen.
        breadth: Breadth of shoulders and hips to the height, relative to the mean body's.
        breadth_seen: Degree to which the directions seen show that breadth, in [0, 1]: 0 from the
            side.
        main_doubt: Reason of most of the doubtful frames; empty without any.
        main_doubt_frames: Number of those.
        left_out: Numbers of the frames that had better not be learnt from.
        doubts: Reasons why frames are doubtful, by their numbers.
    """

    frames: int
    found_share: float
    missed_share: float
    doubtful_share: float
    iou_mean: float
    iou_worst: float
    jitter_mm: float
    person_px: float
    directions_seen: float
    breadth: float
    breadth_seen: float
    main_doubt: str
    main_doubt_frames: int
    left_out: tuple[int, ...]
    stretches: tuple[DoubtfulStretch, ...]
    doubts: Mapping[int, str]

    @property
    def objections(self) -> tuple[str, ...]:
        """Reasons why the poses are not good enough for an avatar; empty if they are."""
        objections = []
        if self.doubtful_share > 0.5:
            most = f"{self.main_doubt} in {self.main_doubt_frames} of {self.frames} frames"
            others = len(self.doubts) - self.main_doubt_frames
            objections.append(f"{most}, and {others} more are doubtful" if others else most)
        if self.missed_share > 0.3:
            objections.append(
                f"the person was missed in {self.missed_share:.0%} of the frames that seem to "
                "show them"
            )
        count = round(self.found_share * self.frames)
        if count < MIN_FRAMES:
            objections.append(f"too few frames show the person: {count} (expected {MIN_FRAMES})")
        if self.iou_mean < MIN_IOU:
            objections.append(
                f"body and masks agree by an IoU of only {self.iou_mean:.2f} (expected {MIN_IOU})"
            )
        if self.person_px < MIN_PERSON_PX:
            objections.append(
                f"the person is only {self.person_px:.0f} px tall (expected {MIN_PERSON_PX:.0f})"
            )
        # in 40 videos 0.82 to 1.10, in videos stretched by a third 1.3
        if not 0.78 <= self.breadth**self.breadth_seen <= 1.17:
            which = "broad" if self.breadth > 1.0 else "narrow"
            objections.append(
                f"the body is too {which}, {self.breadth:.2f} times the usual (the pictures may be "
                "stretched: convert the video to its right width and height)"
            )
        return tuple(objections)

    @property
    def is_good_enough(self) -> bool:
        """True if the poses are good enough for an avatar."""
        return not self.objections

    def describe(self) -> str:
        """The verdict, for people."""
        shakes = f"jitter {self.jitter_mm:.1f} mm per frame squared; "
        jitter = "" if np.isnan(self.jitter_mm) else shakes
        scores = (
            f"found in {self.found_share:.0%} of {self.frames} frames; IoU of body and masks "
            f"{self.iou_mean:.2f} (worst frame {self.iou_worst:.2f}); {jitter}seen from "
            f"{self.directions_seen:.0%} of the directions around"
        )
        if not self.is_good_enough:
            why = "; and ".join(self.objections)
            return f"Good enough for an avatar: no, because {why}. The person was {scores}."
        verdict = f"Good enough for an avatar: yes, because the person was {scores}."
        if self.directions_seen < MIN_VIEW_COVERAGE:
            verdict += " The sides that the camera never saw will be guesses: let the person turn."
        if self.left_out:
            verdict += (
                f" Left out: {counted(len(self.left_out), 'frame')} in which another person is "
                "near, or body and mask disagree."
            )
        return verdict

    def as_json(self) -> dict[str, Any]:
        """Figures for a report; NaN becomes null."""
        figures = {
            name: None if np.isnan(value) else round(float(value), 4)
            for name, value in vars(self).items()
            if isinstance(value, float)
        }
        return {
            "summary": self.describe(),
            "good_enough": self.is_good_enough,
            "objections": list(self.objections),
            "frames": self.frames,
            **figures,
            "doubtful": [vars(each) for each in self.stretches],
        }


def grade_tracking(
    motion: Motion,
    keypoints: KeypointTrack,
    shaped: ShapedBody,
    camera: Camera,
    frame_times_s: Mapping[int, float],
    iou_of_frame: Mapping[int, float],
) -> TrackingGrade:
    """Grade poses that were made of key points.

    Times are those of all frames that were looked at, with a person or without; IoUs of posed body
    and mask those of some. Both are by the frames' numbers.
    """
    numbers = np.array(sorted(frame_times_s))
    disagreeing = _disagreeing(keypoints, iou_of_frame)
    reasons = _reasons_by_frame(keypoints, frame_times_s, disagreeing)
    missed = _missed(numbers, np.array([frame_times_s[each] for each in numbers]), keypoints.frames)
    shown = len(keypoints) + sum(missed.values())
    doubts = {each: missed.get(each, 1.0) for each in reasons}
    weights = dict.fromkeys((each for some in reasons.values() for each in some), 0.0)
    for number, weight in doubts.items():
        for reason in set(reasons[number]):
            weights[reason] += weight
    main_doubt = max(weights, key=weights.__getitem__, default="")
    ious = np.array([value for value in iou_of_frame.values() if np.isfinite(value)])
    heights, views = np.ptp(keypoints.image_px[:, :, 1], axis=1), _views(motion, camera)
    return TrackingGrade(
        frames=len(numbers),
        found_share=len(keypoints) / max(1, len(numbers)),
        missed_share=sum(missed.values()) / max(1.0, shown),
        doubtful_share=sum(doubts.values()) / max(1.0, shown),
        iou_mean=float(ious.mean()) if len(ious) else float("nan"),
        iou_worst=float(ious.min()) if len(ious) else float("nan"),
        jitter_mm=_jitter_mm(motion, keypoints.frames, shaped),
        person_px=float(np.median(heights)) if len(heights) else 0.0,
        directions_seen=view_sector_share(views),
        breadth=_breadth(shaped) / _breadth(shaped.body.with_shape()),
        breadth_seen=_breadth_seen(views),
        main_doubt=main_doubt,
        main_doubt_frames=sum(main_doubt in some for some in reasons.values()),
        left_out=_frames_to_leave_out(keypoints, disagreeing),
        stretches=tuple(_stretches(numbers.tolist(), frame_times_s, reasons)),
        doubts={number: "; ".join(words) for number, words in reasons.items()},
    )


def _reasons_by_frame(
    keypoints: KeypointTrack, frame_times_s: Mapping[int, float], disagreeing: Rows
) -> dict[int, list[str]]:
    """Reasons why frames are doubtful, by their numbers."""
    reasons: dict[int, list[str]] = {}

    def note(rows: Rows, reason: str) -> None:
        for number in keypoints.frames[rows].tolist():
            reasons.setdefault(int(number), []).append(reason)

    tracked = set(keypoints.frames.tolist())
    for number in frame_times_s:
        if number not in tracked:
            reasons[number] = ["the person was not found"]
    note(disagreeing, DISAGREE)
    for problem, bit in PROBLEM_BITS.items():
        if keypoints.problems is not None:
            note((keypoints.problems & bit) > 0, problem.value)
    note(_jumps(keypoints) & ~_crowded(keypoints), JUMPED)
    return reasons


def _missed(
    numbers: Int[np.ndarray, "frames"],
    times_s: Float[np.ndarray, "frames"],
    tracked: Int[np.ndarray, "rows"],
) -> dict[int, float]:
    """Degree to which each frame without a pose may show the person, in [0, 1], by its number."""
    weights: dict[int, float] = {}
    for first, end in find_runs(~np.isin(numbers, tracked)):
        length_s = times_s[end - 1] - times_s[first]
        degree = 1.0 / (1.0 + length_s**2)  # half in a gap of 1 s; in longer ones they are away
        weights.update(dict.fromkeys(numbers[first:end].tolist(), float(degree)))
    return weights


def _disagreeing(keypoints: KeypointTrack, iou_of_frame: Mapping[int, float]) -> Rows:
    """Rows whose IoU, interpolated between graded frames, is low or far below the film's usual."""
    numbers = [number for number in sorted(iou_of_frame) if np.isfinite(iou_of_frame[number])]
    if not numbers:
        return np.zeros(len(keypoints), dtype=bool)
    ious = np.array([iou_of_frame[number] for number in numbers])
    usual = float(np.median(ious))
    spread = max(0.01, 1.4826 * float(np.median(np.abs(ious - usual))))  # of a normal's
    least = max(0.65, usual - 5.0 * spread)  # below, as where another person walks by in front
    return np.interp(keypoints.frames, numbers, ious) < least


def _frames_to_leave_out(keypoints: KeypointTrack, disagreeing: Rows) -> tuple[int, ...]:
    """Frames in which another person is near, or body and mask disagree; none if most are such."""
    numbers, doubtful = keypoints.frames, disagreeing | _crowded(keypoints)
    return tuple(numbers[doubtful].tolist()) if doubtful.sum() <= 0.5 * len(doubtful) else ()


def _crowded(keypoints: KeypointTrack) -> Rows:
    """Rows in which another person is near."""
    if keypoints.problems is None:
        return np.zeros(len(keypoints), dtype=bool)
    return (keypoints.problems & PROBLEM_BITS[TrackingProblem.CROWDED]) > 0


def _jumps(keypoints: KeypointTrack) -> Rows:
    """Rows on both sides of a cut in which the person goes on in another place."""
    jumps = np.zeros(len(keypoints), dtype=bool)
    if len(keypoints) < 16:  # a few photographs have no times
        return jumps
    hips = keypoints.image_px[:, HIPS].mean(axis=1)
    tall = max(1.0, float(np.median(np.ptp(keypoints.image_px[:, :, 1], axis=1))))
    way = np.linalg.norm(np.diff(hips, axis=0), axis=1) / tall / np.diff(keypoints.frames)
    cut = way > max(0.1, 8.0 * float(np.median(way)))  # body heights
    jumps[1:] |= cut
    jumps[:-1] |= cut
    return jumps


def _breadth(shaped: ShapedBody) -> float:
    """Geometric mean of the breadths of shoulders and hips, by the height of the joints."""
    joints = shaped.joints
    shoulders, hips = (np.linalg.norm(joints[a] - joints[b]) for a, b in ((16, 17), (1, 2)))
    return float(np.sqrt(shoulders * hips) / np.ptp(joints[:, 1]))


def _jitter_mm(motion: Motion, tracked: Int[np.ndarray, "tracked"], shaped: ShapedBody) -> float:
    """Median second difference of joints relative to the root, mm per frame squared.

    Of three tracked frames at equal distances; poses between them are interpolated.
    """
    rows = np.arange(len(motion)) if motion.frames is None else motion.frames
    own = np.flatnonzero(motion.valid & np.isin(rows, tracked))
    steps = np.diff(rows[own])
    even = np.flatnonzero(steps[:-1] == steps[1:])
    if not len(even):
        return float("nan")
    joints = np.stack([shaped.with_pose(motion[int(row)]).joints() for row in own])
    relative = joints - joints[:, :1]
    bend = (relative[2:] - 2.0 * relative[1:-1] + relative[:-2])[even, 1:]
    per_frame = np.linalg.norm(bend, axis=2) / steps[even, None] ** 2
    return 1000.0 * float(np.median(per_frame))


def _views(motion: Motion, camera: Camera) -> Float[np.ndarray, "views 3"]:
    """Directions to the camera in the body's axes, of the frames with a pose."""
    turned = camera.camera_from_world[:3, :3] @ rotation_matrices(motion.root_rotations)
    return -turned[motion.valid, 2]


def _breadth_seen(views: Float[np.ndarray, "views 3"]) -> float:
    """Degree to which views show a body's breadth: 1 if half of them are from front or back."""
    across, ahead = views[:, 0], views[:, 2]
    frontal = ahead**2 / np.maximum(across**2 + ahead**2, 1e-9)
    return min(1.0, 2.0 * float(frontal.mean())) if len(views) else 0.0


def _stretches(
    numbers: list[int], frame_times_s: Mapping[int, float], reasons: Mapping[int, list[str]]
) -> Iterator[DoubtfulStretch]:
    """Doubtful frames joined to stretches with one reason each, by their start."""
    stretches: list[DoubtfulStretch] = []
    for reason in dict.fromkeys(each for number in numbers for each in reasons.get(number, [])):
        rows = [number for number in numbers if reason in reasons.get(number, [])]
        groups: list[list[int]] = []
        for number in rows:
            near = groups and frame_times_s[number] - frame_times_s[groups[-1][-1]] <= 0.35  # s
            groups[-1].append(number) if near else groups.append([number])
        stretches += [
            DoubtfulStretch(
                start_s=round(frame_times_s[group[0]], 2),
                end_s=round(frame_times_s[group[-1]], 2),
                frames=len(group),
                reason=reason,
            )
            for group in groups
            if len(group) >= MIN_STRETCH_FRAMES
            or len(numbers) < 4 * MIN_STRETCH_FRAMES
            or reason == JUMPED
        ]
    return iter(sorted(stretches, key=lambda each: (each.start_s, each.reason)))
