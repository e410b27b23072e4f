"""A reader of a session that tells the page what the camera sees, and shows the avatar so far."""

import time
from dataclasses import replace
from typing import final

import numpy as np

from avatar.correspondence_grid import CorrespondenceGrid
from avatar.evaluation.coverage import coverage_advice
from avatar.events import FrameArrived, Stepped, WaitingForFrame
from avatar.rig import canonical_rotations
from capture.camera import Camera
from instant_avatar.phone.film_queue import Film
from instant_avatar.report.page_rendering import webp_data_uri
from instant_avatar.report.report_page import CoverageMap
from instant_avatar.run.live_viewer import (
    CENTER_ABOVE_PELVIS_M,
    INITIAL_DISTANCE_M,
    INITIAL_FOV_RAD,
    render_preview,
)
from instant_avatar.run.session_events import (
    Ended,
    PackageWritten,
    Playable,
    Progressed,
    SessionEvent,
    Started,
    Tracked,
)
from preprocess.body.body_pose import BodyPose
from preprocess.masks.color_models import DARK_LEVEL
from preprocess.tracking.blazepose import SEEN_AGO
from preprocess.tracking.video_tracking import TrackingProblem, touched_borders

CROWDED_LOOKS = SEEN_AGO + 1
"""The same for another person, whom the tracker must have seen twice; it looks every few frames."""
CROWDED = "Two people are in the picture: only one may be."
PREVIEW_PX = 180
"""Height of the drawing, pixels."""
CUT_SENTENCES = {
    TrackingProblem.BOTTOM: "Step back: your feet are cut off.",
    TrackingProblem.TOP: "Step back: your head is cut off.",
    TrackingProblem.LEFT: "Move to the middle of the picture.",
    TrackingProblem.RIGHT: "Move to the middle of the picture.",
}
"""What to do about a border that cuts the person."""


def framing_advice(seen: Tracked) -> str | None:
    """What is wrong with a frame, as one sentence; None if nothing is."""
    person = seen.person
    if float(np.percentile(seen.frame.rgb[::8, ::8], 98)) < DARK_LEVEL:
        return "It is too dark: switch on a light."
    if person is None:
        return "Step into the picture, from head to feet."
    if person.crowded:
        return CROWDED
    cut = touched_borders(person, seen.frame.size_px)
    return next((text for problem, text in CUT_SENTENCES.items() if problem in cut), None)


@final
class FilmFeedback:
    """Tells a film's page what its session does."""

    def __init__(self, film: Film) -> None:
        """Tell nothing yet."""
        self._film = film
        self._started: Started | None = None
        self._map: CoverageMap | None = None
        self._grid: tuple[BodyPose, CorrespondenceGrid] | None = None
        self._framing: str | None = None
        self._repeats, self._is_playable = 0, False
        self._advice, self._next_map, self._next_preview = "", 0.0, 0.0

    def __call__(self, event: SessionEvent) -> None:
        """Tell what an event means for the person who is filmed."""
        match event:
            case Tracked():
                self._look(event)
            case Started():
                self._started = event
                self._map = CoverageMap(event.shaped, event.coverage)
            case FrameArrived() | Stepped() | WaitingForFrame():
                self._show()
            case Progressed(stage=stage, share=share):
                self._film.tell("progress", text=stage, share=round(share, 2))
            case Playable() | PackageWritten(is_final=False) if not self._is_playable:
                self._is_playable = True
                self._film.tell("avatar", name=self._film.place.name, final=False)
            case PackageWritten(is_final=True):
                self._film.tell("avatar", name=self._film.place.name, final=True)
            case Ended():
                self._film.tell("state", state="done")

    def _look(self, seen: Tracked) -> None:
        """Speak of the framing once it is sure; on the tracker's thread."""
        text = framing_advice(seen)
        self._repeats = self._repeats + 1 if text == self._framing else 1
        self._framing = text
        time_s = round(seen.frame.time_s, 2)
        self._film.tell("seconds", seconds=time_s)
        if self._repeats >= (CROWDED_LOOKS if text == CROWDED else 2):
            coverage = self._started.coverage if self._started is not None else None
            advice = "Good. Now turn round slowly."
            if coverage is not None and coverage.stages.any():  # a frame was learnt from
                advice = coverage_advice(coverage)
            text = text or advice
            if text != self._advice:
                self._advice = text
                self._film.tell("advice", text=text, time=time_s)

    def _show(self) -> None:
        """Draw the body map and the avatar, where they are due; on the thread that trains."""
        now = time.perf_counter()
        if self._started is None or self._map is None:
            return
        if now >= self._next_map:
            self._next_map = now + 2.0
            share = self._started.coverage.seen_share
            self._film.tell("map", svg=str(self._map.svg()), seen=round(share, 3))
        if self._started.trainer.steps and now >= self._next_preview:
            self._film.tell("preview", image=self._draw(now))
            self._next_preview = now + (time.perf_counter() - now) / 0.08  # of the training time

    def _draw(self, now: float) -> str:
        """The avatar as it is, turning, as a data URI."""
        assert self._started is not None
        avatar = self._started.trainer.avatar
        if self._grid is None:
            pelvis = self._started.shaped.joints[0]
            pose = replace(
                BodyPose.rest(), joint_rotations=canonical_rotations(), root_translation=-pelvis
            )
            self._grid = (pose, CorrespondenceGrid.solve(avatar.rig, pose.joint_rotations))
        angle = 2.0 * np.pi * (now / 8.0 % 1.0)
        sine, cosine = np.sin(angle), np.cos(angle)
        axes = np.array([[cosine, 0.0, -sine], [0.0, -1.0, 0.0], [-sine, 0.0, -cosine]])
        position = np.array([sine, 0.0, cosine]) * INITIAL_DISTANCE_M
        position[1] = CENTER_ABOVE_PELVIS_M
        focal_px = 0.5 * PREVIEW_PX / float(np.tan(0.5 * INITIAL_FOV_RAD))
        camera = Camera.at(position, axes, focal_px, (round(0.8 * PREVIEW_PX), PREVIEW_PX))
        pose, grid = self._grid
        return webp_data_uri(render_preview(avatar, pose, camera, cells=grid))
