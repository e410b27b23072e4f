"""Page of the live viewer (viser): the rendered avatar in a pose of the user's choice, and a panel.

All poses are in the page's world: pelvis at the origin, y up, and the filming camera looks along
-z, so that the initial view shows the person as the video does.
"""

import io
import logging
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING, final

import numpy as np
from jaxtyping import Float, UInt8

from avatar.rig import canonical_rotations
from capture.camera import Camera
from capture.source import ASSUMED_FPS
from instant_avatar.animation.driving_motion import demo_motion
from instant_avatar.animation.web_server import HOST
from instant_avatar.report.report_schema import CurvePoint
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.kinematics import rotation_matrices
from preprocess.capture_session import Capture
from preprocess.observation import Observation

NEWEST, STANDING, FILMED, DANCE = "Newest", "Standing", "Filmed", "Dance"
"""Labels of the buttons."""
POSE_CHOICES = (NEWEST, STANDING, FILMED, DANCE)
"""Buttons in order."""


@final
class PreviewPoses:
    """Poses by the user's choice and by time."""

    def __init__(self, recording: Capture) -> None:
        """Take body and filmed motion from a capture."""
        self._pelvis = recording.shaped.joints[0]
        self._cameras = recording.cameras
        self._filmed, self._dance = recording.motion, demo_motion()
        self._valid = np.flatnonzero(recording.motion.valid)

    def pose_at(self, choice: str, seconds: float, newest: Observation | None) -> BodyPose:
        """Return the pose to show for one of `POSE_CHOICES`.

        Motions are looped; `seconds` count from their start. `newest` is None before the first
        frame.
        """
        if choice == FILMED:
            place = np.searchsorted(self._valid, _row_at(self._filmed, seconds))
            row = int(self._valid[min(place, len(self._valid) - 1)])
            return self._align_to_camera(self._filmed[row], self._camera_of_row(row))
        if choice == DANCE:
            pose = self._dance[_row_at(self._dance, seconds)]
            return self._center_on_pelvis(pose.root_rotation, pose)
        if choice == NEWEST and newest is not None:
            return self._align_to_camera(newest.pose, newest.camera)
        standing = replace(BodyPose.rest(), joint_rotations=canonical_rotations())
        return self._center_on_pelvis(standing.root_rotation, standing)

    def _camera_of_row(self, row: int) -> Camera:
        """Return the camera that filmed a row of the motion."""
        frames, track = self._filmed.frames, self._cameras
        frame = row if frames is None else int(frames[row])
        return track[min(frame, len(track.cameras) - 1)]

    def _align_to_camera(self, pose: BodyPose, camera: Camera) -> BodyPose:
        """Rotate a pose so that the page's camera sees what the filming camera saw."""
        page_from_camera = np.diag([1.0, -1.0, -1.0])
        turned = page_from_camera @ camera.camera_from_world[:3, :3]
        return self._center_on_pelvis(
            _axis_angle(turned @ rotation_matrices(pose.root_rotation)), pose
        )

    def _center_on_pelvis(self, root_rotation: np.ndarray, pose: BodyPose) -> BodyPose:
        """Move the pelvis to the origin: the root rotates about its rest position J0."""
        return BodyPose(
            root_rotation=root_rotation,
            root_translation=-self._pelvis,
            joint_rotations=pose.joint_rotations,
        )


def _row_at(motion: Motion, seconds: float) -> int:
    """Return the row of a motion that is shown after `seconds`."""
    times = motion.times_s
    if times is None or len(times) < 2 or not np.isfinite(times).all() or times[-1] <= times[0]:
        return int(seconds * ASSUMED_FPS) % len(motion)
    # n poses span n - 1 intervals; the loop lasts n, so that the last pose is shown, too
    length = (times[-1] - times[0]) * len(times) / (len(times) - 1)
    return int(np.searchsorted(times - times[0], seconds % length, side="right")) - 1


def _axis_angle(rotation: np.ndarray) -> np.ndarray:
    import cv2

    vector, _ = cv2.Rodrigues(rotation)
    return np.asarray(vector, dtype=np.float64).reshape(3)


if TYPE_CHECKING:  # an optional extra, loaded when the page is opened
    import viser  # pyright: ignore[reportMissingImports]

PANEL_PX = 380
"""Width of the panel."""
FRAME_PX = (720, 440)
"""Largest width and height of a frame in the panel, which shows it at half the size."""
BACKGROUND_RGB = (251, 250, 247)
"""Background color of the page, as in report.html."""
TEAL, ORANGE = "#1f6f8b", "#c8742b"
"""Colors of the curves: whole image, and inside the mask."""
CURVE_TITLE = (
    "<h2>Held-out PSNR (dB) over training time (s)</h2>"
    f'<p class="legend"><i style="background:{TEAL}"></i>whole image'
    f'<i style="background:{ORANGE}"></i>inside the mask</p>'
)
"""Title and legend of the learning curve."""
INITIAL_FOV_RAD, INITIAL_DISTANCE_M = 0.6, 3.7
"""Initial field of view and distance: a standing person fills 80 % of the image height."""
CENTER_ABOVE_PELVIS_M = -0.08
"""Height of a person's center above the pelvis."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BrowserCamera:
    """Camera of a browser, as viser reports it (OpenCV axes).

    Attributes:
        position: Position in the world, meters.
        fov: Vertical field of view, radians.
        aspect: Width over height.
        moved_at: Time of its last motion, on `time.perf_counter`'s clock.
    """

    world_from_camera: Float[np.ndarray, "3 3"]
    position: Float[np.ndarray, "3"]
    fov: float
    aspect: float
    moved_at: float

    def to_camera(self, height_px: int) -> Camera:
        """Convert to a camera with this image height."""
        width_px = max(1, round(height_px * self.aspect))
        focal = 0.5 * height_px / np.tan(0.5 * self.fov)
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = self.world_from_camera.T
        camera_from_world[:3, 3] = -self.world_from_camera.T @ self.position
        return Camera(
            focal_px=(float(focal), float(focal)),
            center_px=(width_px / 2.0, height_px / 2.0),
            size_px=(width_px, height_px),
            camera_from_world=camera_from_world,
        )


@final
class ViserPage:
    """Content of the page, and requests of its users.

    Buttons are handled on viser's threads, where they only set fields that `LiveViewer` reads.

    Attributes:
        pose_choice: Poses to show, one of `POSE_CHOICES`.
        chosen_at: Time of that choice, on `time.perf_counter`'s clock.
    """

    def __init__(self, name: str, port: int) -> None:
        """Serve the page on the loopback address, at a free port from `port` on; 0 for any."""
        from viser import ViserServer  # pyright: ignore[reportMissingImports]

        self.paused = self.save_requested = False
        self.pose_choice, self.chosen_at = NEWEST, time.perf_counter()
        self._browser_cameras: dict[int, BrowserCamera] = {}
        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # connections may close
        with redirect_stdout(io.StringIO()):  # viser prints a banner
            self._server = ViserServer(host=HOST, port=port, label=name, verbose=False)
        # never open a public tunnel: any page in the browser could request it
        self._server.request_share_url = lambda verbose=True: None
        self._configure_theme()
        self._build_panel(name)
        self._server.on_client_connect(self._on_connect)
        self._server.on_client_disconnect(self._on_disconnect)

    @property
    def address(self) -> str:
        """Address for a browser."""
        return f"http://{HOST}:{self._server.get_port()}"

    def browser_cameras(self) -> dict[int, BrowserCamera]:
        """Return the camera of each browser, by client number."""
        return dict(self._browser_cameras)

    def show_render(self, browser: int, image: UInt8[np.ndarray, "height width 3"]) -> None:
        """Show a rendering in one browser."""
        client = self._server.get_clients().get(browser)
        if client is not None:
            client.scene.set_background_image(image, format="jpeg", jpeg_quality=88)

    def show_status(
        self, status: str, figures: Sequence[tuple[str, str]], *, note: str = ""
    ) -> None:
        """Show the state of training, values with their names, and a note."""
        cells = "".join(
            f"<div><b>{escape(v)}</b><span>{escape(n)}</span></div>" for v, n in figures
        )
        self._status.content = _html(
            f'<p class="status">{escape(status)}</p><div class="figures">{cells}</div>'
            + (f'<p class="note">{escape(note)}</p>' if note else "")
        )

    def show_frame(self, picture: UInt8[np.ndarray, "height width 3"]) -> None:
        """Show the newest frame."""
        self._frame.image = picture
        self._frame.visible = True

    def show_curve(self, curve: Sequence[CurvePoint]) -> None:
        """Show the learning curve."""
        points = [(p.wall_seconds, p.psnr, p.psnr_mask) for p in curve if p.psnr is not None]
        if points:
            table = np.array([[np.nan if v is None else v for v in row] for row in points])
            self._curve.data = tuple(table.T)
            self._curve.visible = self._curve_title.visible = True

    def show_coverage(self, sentence: str, body_map: str) -> None:
        """Show the coverage map with its advice."""
        self._coverage.content = _html(f'<p class="advice">{escape(sentence)}</p>{body_map}')

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

    def _configure_theme(self) -> None:
        gui, scene = self._server.gui, self._server.scene
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(31, 111, 139))
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_PX)
        scene.set_up_direction("+y")
        scene.set_background_image(np.full((4, 4, 3), BACKGROUND_RGB, dtype=np.uint8), format="png")
        camera = self._server.initial_camera
        camera.position, camera.look_at = (
            (0.0, CENTER_ABOVE_PELVIS_M, INITIAL_DISTANCE_M),
            (0.0, CENTER_ABOVE_PELVIS_M, 0.0),
        )
        camera.up, camera.fov = (0.0, 1.0, 0.0), INITIAL_FOV_RAD

    def _build_panel(self, name: str) -> None:
        gui = self._server.gui
        gui.set_panel_label(name)
        self._status = gui.add_html(_html('<p class="status">Starting</p>'))
        self._pause = gui.add_button("Pause")
        self._pause.on_click(lambda event: self._toggle_pause())
        self._save = gui.add_button("Save package now", color="gray")
        self._save.on_click(lambda event: self._request_save(saving=True))
        poses = gui.add_button_group("Pose", POSE_CHOICES)
        poses.on_click(lambda event: self._choose_pose(event.target.value))
        blank = np.full((4, 4, 3), 255, dtype=np.uint8)
        self._frame = gui.add_image(blank, format="jpeg", visible=False)
        self._coverage = gui.add_html(_html(""))
        self._curve_title = gui.add_html(_html(CURVE_TITLE), visible=False)
        self._curve = self._add_curve()

    def _add_curve(self) -> "viser.GuiUplotHandle":
        from viser import uplot  # pyright: ignore[reportMissingImports]

        grid = uplot.Axis_Grid(stroke="#e4dfd4", width=1)
        return self._server.gui.add_uplot(
            data=(np.zeros(1), np.zeros(1), np.zeros(1)),
            series=(
                {"label": "s"},
                {"label": "whole image", "stroke": TEAL, "width": 2},
                {"label": "inside the mask", "stroke": ORANGE, "width": 2},
            ),
            scales={"x": {"time": False}},
            axes=tuple(uplot.Axis(stroke="#6d675d", grid=grid, size=size) for size in (30, 44)),
            legend={"show": False},
            height=190,
            visible=False,
        )

    def _on_connect(self, client: "viser.ClientHandle") -> None:
        begins_at = np.array(client.camera.position)
        goes_to = np.array(self._server.initial_camera.position)
        if np.allclose(begins_at, goes_to):
            self._update_browser_camera(client)

        def moved(event: object) -> None:
            """Ignore updates until the camera has left viser's default position."""
            if client.client_id in self._browser_cameras or not np.allclose(
                client.camera.position, begins_at
            ):
                self._update_browser_camera(client)

        client.camera.on_update(moved)

    def _on_disconnect(self, client: "viser.ClientHandle") -> None:
        self._browser_cameras.pop(client.client_id, None)

    def _update_browser_camera(self, client: "viser.ClientHandle") -> None:
        from viser import transforms  # pyright: ignore[reportMissingImports]

        camera = client.camera
        self._browser_cameras[client.client_id] = BrowserCamera(
            world_from_camera=transforms.SO3(camera.wxyz).as_matrix(),
            position=np.array(camera.position),
            fov=float(camera.fov),
            aspect=float(camera.aspect),
            moved_at=time.perf_counter(),
        )

    def _toggle_pause(self) -> None:
        self.paused = not self.paused
        self._pause.label = "Resume" if self.paused else "Pause"

    def _request_save(self, *, saving: bool) -> None:
        self.save_requested = saving

    def _choose_pose(self, choice: str) -> None:
        self.pose_choice, self.chosen_at = choice, time.perf_counter()


def _html(content: str) -> str:
    """Wrap content with the style of the page."""
    style = (files("instant_avatar") / "run" / "viewer.css").read_text(encoding="utf-8")
    return f'<style>{style}</style><div class="ia">{content}</div>'
