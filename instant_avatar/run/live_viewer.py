"""Live viewer: renders the avatar between training steps, pauses training, saves packages."""

import time
from typing import final

import cv2
import numpy as np
from jaxtyping import UInt8

from avatar.avatar_model import Avatar
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.evaluation.coverage import coverage_advice
from avatar.events import Evaluated, Finished
from avatar.render import render
from capture.camera import Camera
from export.bake.bake_tables import ExportRefused
from instant_avatar.cli.command_line import stop_on_interrupt
from instant_avatar.cli.console import Console
from instant_avatar.report.report_figures import CoverageMap
from instant_avatar.report.report_schema import format_percent, provisional_verdict
from instant_avatar.run.run_folder import RunFolder
from instant_avatar.run.session_events import EventReader, SessionEvent
from instant_avatar.run.training_session import TrainingSession
from instant_avatar.run.viser_page import (
    BACKGROUND_RGB,
    DANCE,
    FILMED,
    FRAME_PX,
    NEWEST,
    BrowserCamera,
    PreviewPoses,
    ViserPage,
)
from preprocess.body.body_pose import BodyPose
from preprocess.capture_session import Capture
from preprocess.observation import Observation

RENDER_TIME_SHARE = 0.1
"""Fraction of the time that the page may take during training."""
IDLE_RENDER_TIME_SHARE = 0.9
"""Fraction of the time that the page may take while training is paused or done."""
MOVING_HEIGHT_PX = 160
"""Height of the image while camera or pose move."""
RESTING_HEIGHT_PX = 360
"""Height of the image at rest, during training."""
IDLE_HEIGHT_PX = 720
"""Height of the image at rest while training is paused or done."""
REST_DELAY_S = 0.4
"""Time without motion after which the image counts as at rest, seconds."""
PANEL_INTERVAL_S = 0.25
"""Interval of updates of the panel, seconds."""
MAP_INTERVAL_S = 1.0
"""Interval of updates of the coverage map, seconds."""


@final
class LiveViewer:
    """A reader of a session's events that shows training in browsers."""

    def __init__(self, recording: Capture, run: RunFolder, console: Console, port: int) -> None:
        """Open the page, at `port` or a free one after it, and print its address."""
        self._recording, self._run, self._console = recording, run, console
        self._poser = PreviewPoses(recording)
        self.page = ViserPage(recording.paths.video.name, port)
        self._cells: tuple[BodyPose, CorrespondenceGrid] | None = None
        self._shown: dict[int, tuple[object, ...]] = {}
        self._body_map: CoverageMap | None = None
        self._mapped_coverage = -1.0
        self._next_picture = self._next_panel = self._next_map = 0.0
        self._posed_at = 0.0
        self._shown_observation: Observation | None = None
        self._finished, self._note = False, ""
        console.info(f"Live viewer: {self.page.address}")

    def watch(self, session: TrainingSession) -> EventReader:
        """Return a reader of the session's events, which updates the page between them."""

        def read(event: SessionEvent) -> None:
            if isinstance(event, Evaluated | Finished):
                self._next_panel = 0.0
            self._finished = self._finished or isinstance(event, Finished)
            what = "Writing the package, after" if self._finished else "Training,"
            self._update_page(session, f"{what} {_progress_text(session)}", idle=False)
            if self._finished:
                return
            if self.page.save_requested:
                with session.trainer.paused():
                    self._save_package(session)
            if self.page.paused:
                with session.trainer.paused():
                    self._wait_while_paused(session)

        return read

    def serve_until_interrupt(self, session: TrainingSession) -> None:
        """Keep the page open after training, until Ctrl-C."""
        self.page.disable_controls()
        status = f"Done after {session.trainer.wall_seconds:.0f} s"
        self._note = f"The avatar: {self._run.package}"
        self._next_panel = 0.0
        with stop_on_interrupt(self._console, "closing the page") as ended:
            while not ended.wait(0.02):
                self._update_page(session, status, idle=True)

    def close(self) -> None:
        """Close the page."""
        self.page.close()

    def _wait_while_paused(self, session: TrainingSession) -> None:
        """Wait until the user resumes training, or presses Ctrl-C."""
        self._next_panel = 0.0
        status = f"Paused after {_progress_text(session)}"
        while self.page.paused and not session.stop.is_set():
            self._update_page(session, status, idle=True)
            if self.page.save_requested:
                self._save_package(session)
            time.sleep(0.02)
        self._next_panel = 0.0

    def _save_package(self, session: TrainingSession) -> None:
        """Write the avatar in its current state as a package."""
        self.page.save_requested = False
        if not session.trainer.steps:
            self.page.notify("Not yet", "Training has not started.")
            return
        try:
            exported = session.save_package()
        except OSError as error:
            self.page.notify("The package could not be written", str(error))
            return
        except ExportRefused as error:
            self.page.notify("No package yet", str(error))
            return
        seconds = session.trainer.wall_seconds
        size = f"{exported.bytes / 1e6:.1f} MB after {seconds:.0f} s of training"
        notes = " ".join([f"{self._run.package}: {size}.", *exported.warnings])
        self.page.notify("Package saved", notes)
        self._console.info(f"Saved from the live viewer: {self._run.package}, {size}.")

    def _update_page(self, session: TrainingSession, status: str, *, idle: bool) -> None:
        """Update the parts of the page that are due."""
        now = time.perf_counter()
        if now >= self._next_panel:
            self._next_panel = now + PANEL_INTERVAL_S
            self._fill_panel(session, status)
        if now >= self._next_map:
            self._next_map = now + MAP_INTERVAL_S
            self._fill_map(session)
        if session.trainer.steps and now >= self._next_picture:
            began = time.perf_counter()
            if self._render_next_view(session, idle=idle):
                took = time.perf_counter() - began
                share = IDLE_RENDER_TIME_SHARE if idle else RENDER_TIME_SHARE
                self._next_picture = began + took / share

    def _fill_panel(self, session: TrainingSession, status: str) -> None:
        trainer = session.trainer
        last = session.curve[-1] if session.curve else None
        psnr = None if last is None else last.psnr
        word = provisional_verdict(None if last is None else last.verdict)
        held_out = f"held-out PSNR: {word}" if word else "held-out PSNR"
        self.page.show_status(
            status,
            [
                (f"{trainer.frames_seen}", "frames"),
                (f"{trainer.steps:,}", "steps"),
                (format_percent(session.coverage.seen_share), "coverage"),
                ("none yet" if psnr is None else f"{psnr:.1f} dB", held_out),
            ],
            note=self._note,
        )
        self.page.show_curve(session.curve)
        if self.page.pose_choice != NEWEST or not trainer.steps:
            self._show_frame(session.newest_observation)  # otherwise shown with its rendering

    def _show_frame(self, newest: Observation | None) -> None:
        if newest is not None and newest is not self._shown_observation:
            self._shown_observation = newest
            self.page.show_frame(_letterbox(newest.frame.rgb))

    def _fill_map(self, session: TrainingSession) -> None:
        coverage = session.coverage
        if coverage.seen_share == self._mapped_coverage:
            return
        if self._body_map is None:
            self._body_map = CoverageMap(self._recording.shaped, coverage)
        self._mapped_coverage = coverage.seen_share
        self.page.show_coverage(coverage_advice(coverage), self._body_map.svg())

    def _render_next_view(self, session: TrainingSession, *, idle: bool) -> bool:
        """Render for the browser that has waited longest; return whether any needed it."""
        now = time.perf_counter()
        looks = self.page.browser_cameras()
        for gone in self._shown.keys() - looks.keys():
            del self._shown[gone]
        newest = session.newest_observation
        pose = self._poser.pose_at(self.page.pose_choice, now - self.page.chosen_at, newest)
        cells = self._correspondence_grid(session, pose, now)
        plays = self.page.pose_choice in (FILMED, DANCE) or now - self._posed_at < REST_DELAY_S
        waiting = [browser for browser in looks if browser not in self._shown]
        for browser in [*waiting, *self._shown]:
            look = looks[browser]
            height = self._render_height_px(look, now, plays=plays, idle=idle)
            wanted = (look.moved_at, id(cells), session.trainer.steps, height)
            if self._shown.get(browser) == wanted:
                continue
            self._shown.pop(browser, None)  # to the end of the queue
            self._shown[browser] = wanted
            picture = render_preview(
                session.trainer.avatar, pose, look.to_camera(height), cells=cells
            )
            self.page.show_render(browser, picture)
            self._show_frame(newest)
            return True
        return False

    def _render_height_px(self, look: BrowserCamera, now: float, *, plays: bool, idle: bool) -> int:
        if plays or now - look.moved_at < REST_DELAY_S:
            return MOVING_HEIGHT_PX
        return IDLE_HEIGHT_PX if idle else RESTING_HEIGHT_PX

    def _correspondence_grid(
        self, session: TrainingSession, pose: BodyPose, now: float
    ) -> CorrespondenceGrid:
        """Return the pose's correspondence grid; solved again only if the pose has changed."""
        if self._cells is None or not np.array_equal(
            self._cells[0].joint_rotations, pose.joint_rotations
        ):
            cells = CorrespondenceGrid.solve(session.trainer.avatar.rig, pose.joint_rotations)
            self._cells, self._posed_at = (pose, cells), now
        return self._cells[1]


def _progress_text(session: TrainingSession) -> str:
    trainer = session.trainer
    return f"{trainer.wall_seconds:.0f} of {trainer.config.seconds:.0f} s"


def render_preview(
    avatar: Avatar, pose: BodyPose, camera: Camera, *, cells: CorrespondenceGrid
) -> UInt8[np.ndarray, "height width 3"]:
    """Render the avatar in its current state over the page's background.

    The camera also defines the image size; `cells` is the correspondence grid of the pose.
    """
    rgba = render(avatar, pose, camera, cells=cells)
    mixed = rgba[..., :3] * 255.0 + (1.0 - rgba[..., 3:]) * np.array(
        BACKGROUND_RGB, dtype=np.float32
    )
    return np.clip(mixed + 0.5, 0.0, 255.0).astype(np.uint8)


def _letterbox(rgb: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "_ _ 3"]:
    """Center a frame in a strip as wide as the panel."""
    width, height = FRAME_PX
    scale = min(height / rgb.shape[0], width / rgb.shape[1])
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    small = np.asarray(cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=how))
    strip = np.full((small.shape[0], width, 3), 255, dtype=np.uint8)
    left = (width - small.shape[1]) // 2
    strip[:, left : left + small.shape[1]] = small
    return strip
