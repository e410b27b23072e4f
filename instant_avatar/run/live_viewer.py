"""Live viewer: a page that renders the avatar between training steps, pauses and saves.

Poses are in the page's world: pelvis at the origin, y up, and the filming camera looks along -z, so
that the first view shows the person as the video does.
"""

import io
import logging
import time
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from typing import Any, final

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from avatar.avatar_model import Avatar
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.evaluation.coverage import coverage_advice
from avatar.events import Finished
from avatar.render import render
from avatar.rig import canonical_rotations
from capture.camera import Camera
from capture.input_error import counted
from capture.source import RgbImage
from export.bake.bake_tables import ExportRefused
from instant_avatar.animation.driving_motion import demo_motion, pose_rate
from instant_avatar.cli.command_line import stop_on_interrupt
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import HOST
from instant_avatar.report.report_schema import format_percent, format_psnr
from instant_avatar.run.run_folder import RunFolder
from instant_avatar.run.session_events import EventReader, SessionEvent
from instant_avatar.run.training_session import TrainingSession
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import rotation_matrices
from preprocess.capture_session import Capture
from preprocess.observation import Observation

NEWEST, DANCE = "Newest frame", "Dance"
"""Labels of the buttons that choose the pose."""
PANEL_INTERVAL_S = 0.5
"""Interval of updates of the panel, seconds."""
PANEL_PX = 340
"""Width of the panel beside the avatar."""
BACKGROUND_RGB = (251, 250, 247)
"""Background color of the page, as in report.html."""
INITIAL_FOV_RAD, INITIAL_DISTANCE_M = 0.6, 3.7
"""Initial field of view and distance: a standing person fills 80 % of the image height."""
CENTER_ABOVE_PELVIS_M = -0.08
"""Height of a person's center above the pelvis."""


@final
class PreviewPoses:
    """Poses by the user's choice and by time."""

    def __init__(self, recording: Capture) -> None:
        """Take the body from a capture."""
        self._pelvis, self._dance = recording.shaped.joints[0], demo_motion()

    def pose_at(self, choice: str, seconds: float, newest: Observation | None) -> BodyPose:
        """Return the pose to show, `seconds` after it was chosen.

        The newest frame's is seen as its camera saw it; before the first frame the person stands.
        """
        if choice == DANCE:
            row = int(seconds * pose_rate(self._dance)) % len(self._dance)
            return self._at_origin(self._dance[row])
        if newest is None:
            return self._at_origin(replace(BodyPose.rest(), joint_rotations=canonical_rotations()))
        page_from_world = np.diag([1.0, -1.0, -1.0]) @ newest.camera.camera_from_world[:3, :3]
        turned, _ = cv2.Rodrigues(page_from_world @ rotation_matrices(newest.pose.root_rotation))
        root = np.asarray(turned, dtype=np.float64).reshape(3)
        return self._at_origin(replace(newest.pose, root_rotation=root))

    def _at_origin(self, pose: BodyPose) -> BodyPose:
        """Move the pelvis to the origin: the root rotates about its rest position."""
        return replace(pose, root_translation=-self._pelvis)


@dataclass(frozen=True, eq=False, kw_only=True)
class BrowserCamera:
    """Camera of a browser, as viser reports it (OpenCV axes).

    Attributes:
        position: Position in the world, meters.
        fov: Vertical field of view, radians.
        aspect: Width over height.
        moved_at: Time of its last motion, on `time.time`'s clock.
    """

    world_from_camera: Float[np.ndarray, "3 3"]
    position: Float[np.ndarray, "3"]
    fov: float
    aspect: float
    moved_at: float

    def to_camera(self, height_px: int) -> Camera:
        """Convert to a camera with this image height."""
        size_px = max(1, round(height_px * self.aspect)), height_px
        focal_px = 0.5 * height_px / float(np.tan(0.5 * self.fov))
        return Camera.at(self.position, self.world_from_camera.T, focal_px, size_px)


@final
class ViserPage:
    """Content of the page, and requests of its users.

    Buttons are handled on viser's threads, where they only set fields that `LiveViewer` reads.

    Attributes:
        pose_choice: Pose to show, `NEWEST` or `DANCE`.
        chosen_at: Time of that choice, on `time.time`'s clock.
    """

    def __init__(self, name: str, port: int) -> None:
        """Serve the page on the loopback address, at a free port from `port` on; 0 for any."""
        from viser import ViserServer  # pyright: ignore[reportMissingImports]

        self.paused = self.save_requested = False
        self.pose_choice, self.chosen_at = NEWEST, time.time()
        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # connections may close
        with redirect_stdout(io.StringIO()):  # viser prints a banner
            self._server = ViserServer(host=HOST, port=port, label=name, verbose=False)
        # never open a public tunnel: any page in the browser could request it
        self._server.request_share_url = lambda verbose=True: None
        gui, scene, camera = self._server.gui, self._server.scene, self._server.initial_camera
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(31, 111, 139))
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_PX)
        gui.set_panel_label(name)
        scene.set_up_direction("+y")
        scene.set_background_image(np.full((4, 4, 3), BACKGROUND_RGB, dtype=np.uint8), format="png")
        camera.position = (0.0, CENTER_ABOVE_PELVIS_M, INITIAL_DISTANCE_M)
        camera.look_at = (0.0, CENTER_ABOVE_PELVIS_M, 0.0)
        camera.up, camera.fov = (0.0, 1.0, 0.0), INITIAL_FOV_RAD
        self._status = gui.add_markdown("Starting")
        self._pause = gui.add_button("Pause")
        self._pause.on_click(lambda event: self._toggle_pause())
        self._save = gui.add_button("Save package now", color="gray")
        self._save.on_click(lambda event: self._request_save())
        poses = gui.add_button_group("Pose", (NEWEST, DANCE))
        poses.on_click(lambda event: self._choose_pose(event.target.value))
        with gui.add_folder("What it learns from", expand_by_default=False):
            self._advice = gui.add_markdown("")
            self._frame = gui.add_image(np.full((4, 4, 3), 255, dtype=np.uint8), format="jpeg")

    @property
    def address(self) -> str:
        """Address for a browser."""
        return f"http://{HOST}:{self._server.get_port()}"

    def browser_cameras(self) -> dict[int, BrowserCamera]:
        """Return the camera of each browser, by client number."""
        from viser import transforms  # pyright: ignore[reportMissingImports]

        cameras = {number: each.camera for number, each in self._server.get_clients().items()}
        return {
            number: BrowserCamera(
                world_from_camera=transforms.SO3(camera.wxyz).as_matrix(),
                position=np.array(camera.position),
                fov=float(camera.fov),
                aspect=float(camera.aspect),
                moved_at=float(camera.update_timestamp),
            )
            for number, camera in cameras.items()
        }

    def show_render(self, browser: int, image: RgbImage) -> None:
        """Show a rendering in one browser."""
        client = self._server.get_clients().get(browser)
        if client is not None:
            client.scene.set_background_image(image, format="jpeg", jpeg_quality=88)

    def show_status(self, status: str, advice: str) -> None:
        """Show the state of training, and what to film next."""
        self._status.content, self._advice.content = status, advice

    def show_frame(self, image: RgbImage) -> None:
        """Show the newest frame."""
        self._frame.image = image

    def notify(self, title: str, message: str) -> None:
        """Show a notification for a few seconds."""
        for client in self._server.get_clients().values():
            client.add_notification(title, message, auto_close_seconds=6.0)

    def disable_controls(self) -> None:
        """Hide the controls of training after its end."""
        self.paused = self.save_requested = False
        self._pause.visible = self._save.visible = False

    def close(self) -> None:
        """Close the page."""
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def _toggle_pause(self) -> None:
        self.paused = not self.paused
        self._pause.label = "Resume" if self.paused else "Pause"

    def _request_save(self) -> None:
        self.save_requested = True

    def _choose_pose(self, choice: str) -> None:
        self.pose_choice, self.chosen_at = choice, time.time()


@final
class LiveViewer:
    """A reader of a session's events that shows training in browsers."""

    def __init__(self, recording: Capture, run: RunFolder, console: Console, port: int) -> None:
        """Open the page, at `port` or a free one after it, and print its address."""
        self._run, self._console, self._poser = run, console, PreviewPoses(recording)
        self.page = ViserPage(recording.paths.video.name, port)
        self._cells: tuple[BodyPose, CorrespondenceGrid] | None = None
        self._shown: dict[int, tuple[Any, ...]] = {}
        self._shown_frame: Observation | None = None
        self._next_image = self._next_panel = self._posed_at = 0.0
        self._finished = False
        console.info(f"Live viewer: {self.page.address}")

    def watch(self, session: TrainingSession) -> EventReader:
        """Return a reader of the session's events, which updates the page between them."""

        def read(event: SessionEvent) -> None:
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
        self._next_panel = 0.0
        status = f"Done after {session.trainer.wall_seconds:.0f} s: `{self._run.package}`"
        with stop_on_interrupt(self._console, "closing the page") as ended:
            while not ended.wait(0.02):
                self._update_page(session, status, idle=True)

    def close(self) -> None:
        """Close the page."""
        self.page.close()

    def _wait_while_paused(self, session: TrainingSession) -> None:
        self._next_panel = 0.0
        status = f"Paused after {_progress_text(session)}"
        while self.page.paused and not session.stop.is_set():
            self._update_page(session, status, idle=True)
            if self.page.save_requested:
                self._save_package(session)
            time.sleep(0.02)
        self._next_panel = 0.0

    def _save_package(self, session: TrainingSession) -> None:
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
        now = time.perf_counter()
        if now >= self._next_panel:
            self._next_panel = now + PANEL_INTERVAL_S
            advice = coverage_advice(session.coverage)
            self.page.show_status(f"{status}  \n{_quality_text(session)}", advice)
            newest = session.newest_observation
            if newest is not None and newest is not self._shown_frame:
                self._shown_frame = newest
                self.page.show_frame(_thumbnail(newest.frame.rgb))
        if session.trainer.steps and now >= self._next_image:
            began = time.perf_counter()
            if self._render_next_view(session, idle=idle):
                took = time.perf_counter() - began
                self._next_image = began + took / (1.0 if idle else 0.1)

    def _render_next_view(self, session: TrainingSession, *, idle: bool) -> bool:
        """Render for the browser that has waited longest; return whether any needed it."""
        now, looks = time.time(), self.page.browser_cameras()
        self._shown = {browser: shown for browser, shown in self._shown.items() if browser in looks}
        choice = self.page.pose_choice
        pose = self._poser.pose_at(choice, now - self.page.chosen_at, session.newest_observation)
        cells = self._correspondence_grid(session, pose, now)
        for browser in [*(looks.keys() - self._shown.keys()), *self._shown]:
            look = looks[browser]
            moves = choice == DANCE or now - max(look.moved_at, self._posed_at) < 0.4
            height = 160 if moves else 720 if idle else 360
            wanted = (look.moved_at, id(cells), session.trainer.steps, height)
            if self._shown.get(browser) == wanted:
                continue
            self._shown.pop(browser, None)  # to the end of the queue
            self._shown[browser] = wanted
            camera = look.to_camera(height)
            image = render_preview(session.trainer.avatar, pose, camera, cells=cells)
            self.page.show_render(browser, image)
            return True
        return False

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


def _quality_text(session: TrainingSession) -> str:
    trainer, seen = session.trainer, format_percent(session.coverage.seen_share)
    parts = [counted(trainer.frames_seen, "frame"), f"{trainer.steps:,} steps", f"{seen} seen"]
    if session.curve:
        last = session.curve[-1]
        score = format_psnr(last.psnr, last.verdict, digits=1, provisional=True)
        parts.append(f"held-out PSNR {score}")
    return " · ".join(parts)


def render_preview(
    avatar: Avatar, pose: BodyPose, camera: Camera, *, cells: CorrespondenceGrid
) -> RgbImage:
    """Render the avatar as it is over the page's background; `cells` are those of the pose."""
    rgba = render(avatar, pose, camera, cells=cells)
    behind = np.array(BACKGROUND_RGB, dtype=np.float32)
    mixed = rgba[..., :3] * 255.0 + (1.0 - rgba[..., 3:]) * behind
    return np.clip(mixed + 0.5, 0.0, 255.0).astype(np.uint8)


def _thumbnail(rgb: RgbImage) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return a frame as high as the panel shows it, in a strip as wide as the panel."""
    scale = 300 / rgb.shape[0]
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    small = np.asarray(cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=how))
    beside = max(0, PANEL_PX - small.shape[1]) // 2
    return np.pad(small, ((0, 0), (beside, beside), (0, 0)), constant_values=255)
