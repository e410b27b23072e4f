"""Tends the page between steps: draws the avatar for whoever looks, holds still, saves packages."""

import time
from typing import final

import cv2
import numpy as np
from jaxtyping import UInt8

from apps.learning.run_folder import RunFolder
from apps.learning.snapshot import snapshot, views_of
from apps.learning.watcher import Watched
from apps.recording.recording import Recording
from apps.reporting.body_map import BodyMap
from apps.reporting.report import percent, so_far
from apps.terminal.console import Console
from apps.terminal.interrupt import ended_by_ctrl_c
from apps.view.page import FRAME_PX, Page
from apps.view.poser import DANCE, FILMED, NEWEST, Poser
from apps.view.scene import Look, drawn
from avatar.advice import advice
from avatar.cells import WarpCells
from avatar.events import Evaluated, Finished, TrainEvent
from preprocess.observation import Observation
from preprocess.pose import BodyPose

SHARE, IDLE_SHARE = 0.1, 0.9
"""Of the time, how much the page may take: while the avatar learns, and while it does not."""
MOVING_PX, RESTING_PX, SHARP_PX = 160, 360, 720
"""Height of the picture: while something moves, at rest, and at rest while nothing is learnt."""
RESTS_AFTER_S = 0.4
PANEL_EVERY_S, MAP_EVERY_S = 0.25, 1.0


@final
class Viewer:
    """Looks on for a browser; a `Watcher`.

    Attributes:
        page: What it looks after.
    """

    def __init__(self, recording: Recording, run: RunFolder, console: Console, port: int) -> None:
        """Opens the page and says where.

        Args:
            recording: What is learnt from.
            run: Where packages go.
            console: Where it says what it does.
            port: Tried first.
        """
        self._recording, self._run, self._console = recording, run, console
        self._poser = Poser(recording)
        self.page = Page(recording.paths.video.name, port)
        self._newest: Observation | None = None
        self._cells: tuple[BodyPose, WarpCells] | None = None
        self._shown: dict[int, tuple[object, ...]] = {}
        self._body_map: BodyMap | None = None
        self._seen = -1.0
        self._next_picture = self._next_panel = self._next_map = 0.0
        self._posed_at = 0.0
        self._framed: Observation | None = None
        self._finished, self._note = False, ""
        console.say(f"Watch it learn: {self.page.address}")

    def frame(self, observation: Observation, *, held_out: bool) -> None:
        """Shows it, soon."""
        self._newest = observation

    def heard(self, event: TrainEvent) -> None:
        """Scores are shown at once, and the end; all else can wait for its turn."""
        if isinstance(event, Evaluated | Finished):
            self._next_panel = 0.0
        self._finished = isinstance(event, Finished)

    def tend(self, lesson: Watched) -> None:
        """Takes a tenth of the time at most, except while somebody has paused or saves."""
        what = "Writing the package, after" if self._finished else "Learning,"
        self._look_after(lesson, f"{what} {self._progress(lesson)}", idle=False)
        if self.page.saving:
            with lesson.trainer.held_up():
                self._save(lesson)
        if self.page.paused:
            with lesson.trainer.held_up():
                self._hold(lesson)

    def stay(self, lesson: Watched) -> None:
        """Keeps the page after the end, until Ctrl-C."""
        self.page.end()
        status = f"Done after {lesson.trainer.wall_seconds:.0f} s"
        self._note = f"The avatar: {self._run.package}"
        self._next_panel = 0.0
        with ended_by_ctrl_c() as ended:
            while not ended.wait(0.02):
                self._look_after(lesson, status, idle=True)

    def close(self) -> None:
        """Takes the page down."""
        self.page.close()

    def _progress(self, lesson: Watched) -> str:
        trainer = lesson.trainer
        return f"{trainer.wall_seconds:.0f} of {trainer.config.seconds:.0f} s"

    def _hold(self, lesson: Watched) -> None:
        """Nothing is learnt until somebody resumes, or Ctrl-C ends everything."""
        self._next_panel = 0.0
        status = f"Paused after {self._progress(lesson)}"
        while self.page.paused and not lesson.stopping:
            self._look_after(lesson, status, idle=True)
            if self.page.saving:
                self._save(lesson)
            time.sleep(0.02)
        self._next_panel = 0.0

    def _save(self, lesson: Watched) -> None:
        """Writes the package as the avatar stands."""
        self.page.saving = False
        trainer, mark = lesson.trainer, lesson.curve[-1] if lesson.curve else None
        if not trainer.steps:
            self.page.tell("Not yet", "Nothing has been learnt so far.")
            return
        try:
            views = views_of(lesson.held, self._recording)
            taken = snapshot(trainer, self._run.package, views, mark=mark, fine_tuned=False)
        except OSError as error:
            self.page.tell("The package could not be written", str(error))
            return
        if taken.exported is None:
            self.page.tell("No package yet", taken.refused or "")
            return
        size = f"{taken.exported.bytes / 1e6:.1f} MB after {trainer.wall_seconds:.0f} s of training"
        notes = " ".join([f"{self._run.package}: {size}.", *taken.exported.warnings])
        self.page.tell("Package saved", notes)
        self._console.say(f"Saved from the page: {self._run.package}, {size}.")

    def _look_after(self, lesson: Watched, status: str, *, idle: bool) -> None:
        """Brings the page up to date, as far as it is time to."""
        now = time.perf_counter()
        if now >= self._next_panel:
            self._next_panel = now + PANEL_EVERY_S
            self._fill_panel(lesson, status)
        if now >= self._next_map:
            self._next_map = now + MAP_EVERY_S
            self._fill_map(lesson)
        if lesson.trainer.steps and now >= self._next_picture:
            began = time.perf_counter()
            if self._draw(lesson, idle=idle):
                took = time.perf_counter() - began
                share = IDLE_SHARE if idle else SHARE
                self._next_picture = began + took / share

    def _fill_panel(self, lesson: Watched, status: str) -> None:
        trainer = lesson.trainer
        last = lesson.curve[-1] if lesson.curve else None
        psnr = None if last is None else last.psnr
        word = so_far(None if last is None else last.verdict)
        held_out = f"held out: {word}" if word else "held out"
        self.page.say(
            status,
            [
                (f"{trainer.frames_seen}", "frames"),
                (f"{trainer.steps:,}", "steps"),
                (percent(lesson.coverage.seen), "seen"),
                ("none yet" if psnr is None else f"{psnr:.1f} dB", held_out),
            ],
            note=self._note,
        )
        self.page.show_curve(lesson.curve)
        if self.page.choice != NEWEST or not trainer.steps:
            self._show_frame(self._newest)  # else it comes with its picture

    def _show_frame(self, newest: Observation | None) -> None:
        if newest is not None and newest is not self._framed:
            self._framed = newest
            self.page.show_frame(_fitted(newest.frame.rgb))

    def _fill_map(self, lesson: Watched) -> None:
        coverage = lesson.coverage
        if coverage.seen == self._seen:
            return
        if self._body_map is None:
            self._body_map = BodyMap(self._recording.shaped, coverage)
        self._seen = coverage.seen
        self.page.show_coverage(advice(coverage), self._body_map.svg())

    def _draw(self, lesson: Watched, *, idle: bool) -> bool:
        """Draws for the browser that has waited longest; whether any needed it."""
        now = time.perf_counter()
        looks = self.page.looks()
        for gone in self._shown.keys() - looks.keys():
            del self._shown[gone]
        newest = self._newest
        pose = self._poser.pose(self.page.choice, now - self.page.chosen_at, newest)
        cells = self._warped(lesson, pose, now)
        plays = self.page.choice in (FILMED, DANCE) or now - self._posed_at < RESTS_AFTER_S
        waiting = [browser for browser in looks if browser not in self._shown]
        for browser in [*waiting, *self._shown]:
            look = looks[browser]
            height = self._height(look, now, plays=plays, idle=idle)
            wanted = (look.moved_at, id(cells), lesson.trainer.steps, height)
            if self._shown.get(browser) == wanted:
                continue
            self._shown.pop(browser, None)  # to the end of the queue
            self._shown[browser] = wanted
            picture = drawn(lesson.trainer.avatar, pose, look.camera(height), cells=cells)
            self.page.show(browser, picture)
            self._show_frame(newest)
            return True
        return False

    def _height(self, look: Look, now: float, *, plays: bool, idle: bool) -> int:
        if plays or now - look.moved_at < RESTS_AFTER_S:
            return MOVING_PX
        return SHARP_PX if idle else RESTING_PX

    def _warped(self, lesson: Watched, pose: BodyPose, now: float) -> WarpCells:
        """The pose's warp; solved anew only if the pose has changed."""
        if self._cells is None or not np.array_equal(
            self._cells[0].joint_rotations, pose.joint_rotations
        ):
            cells = WarpCells.of(lesson.trainer.avatar.rig, pose.joint_rotations)
            self._cells, self._posed_at = (pose, cells), now
        return self._cells[1]


def _fitted(rgb: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "_ _ 3"]:
    """A frame in the middle of a strip that is as wide as the panel."""
    width, height = FRAME_PX
    scale = min(height / rgb.shape[0], width / rgb.shape[1])
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    small = np.asarray(cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=how))
    strip = np.full((small.shape[0], width, 3), 255, dtype=np.uint8)
    left = (width - small.shape[1]) // 2
    strip[:, left : left + small.shape[1]] = small
    return strip
