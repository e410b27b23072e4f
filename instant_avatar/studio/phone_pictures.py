"""Images as a phone takes them: portrait, with motion blur, drifting exposure, noise, loss.

Garments move a little, and light stays in the room while the actor turns.
"""

from dataclasses import dataclass, replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Float32

from capture.camera import Camera
from capture.source import AlphaMask, RgbImage
from instant_avatar.studio import painted_surfaces
from instant_avatar.studio.actor import Actor
from instant_avatar.studio.input_errors import smooth_noise
from instant_avatar.studio.lighting import LAMP_RGB, RenderedFrame, composite_over, lamp_visibility
from instant_avatar.studio.outfit import SHIRT, TROUSERS, PerVertex, Vertices
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.body_surface import vertex_normals

WAVES = 4
SHIRT_M, TROUSERS_M = 0.010, 0.006
"""Largest displacement of each garment, metres, at its loose end."""


@final
class MovingCloth:
    """The displacement of one actor's garments over time."""

    def __init__(self, actor: Actor, seed: int) -> None:
        """Choose the waves."""
        generator = np.random.default_rng([seed, 21])
        self._normals = vertex_normals(actor.rest_vertices, actor.faces)
        self._reach = _looseness_m(actor)
        place = actor.template_points.astype(np.float64)
        wave_vectors = generator.normal(0.0, 2.0 * np.pi / 0.45, (3, WAVES)) / np.sqrt(3.0)
        self._phases = place @ wave_vectors + generator.uniform(0.0, 2.0 * np.pi, WAVES)
        self._turns_per_s = generator.uniform(0.3, 0.9, WAVES)

    def displacement_m(self, time_s: float) -> Vertices:
        """Displacement of each rest vertex along its normal; zero for skin, hair and shoes."""
        waves = np.sin(self._phases + 2.0 * np.pi * self._turns_per_s * time_s).mean(axis=1)
        return (self._reach * np.clip(1.6 * waves, -1.0, 1.0))[:, None] * self._normals


def _looseness_m(actor: Actor) -> PerVertex:
    """Return vertices' largest displacement: none where a garment is held, most at loose ends."""
    x, y, _ = actor.template_points.T.astype(np.float64)
    down = np.clip((0.25 - y) / 0.45, 0.0, 1.0)
    sleeve = np.clip((np.abs(x) - 0.18) / 0.20, 0.0, 1.0)
    leg = np.clip((-0.15 - y) / 0.9, 0.0, 1.0)
    reach = np.zeros(len(x))
    for material, loose in (
        (SHIRT, SHIRT_M * np.maximum(down, 0.8 * sleeve)),
        (TROUSERS, TROUSERS_M * leg),
    ):
        worn = np.unique(actor.faces[actor.materials == material])
        reach[worn] = loose[worn]
    return min(1.0, 1.5 * actor.outfit.looseness) * reach


WINDOW_FROM = np.array([-0.75, 0.50, 0.45]) / np.linalg.norm([-0.75, 0.50, 0.45])
"""Direction of the window, from the actor, in the world (the camera is on +z)."""


@final
class RoomLight:
    """The light of a window and of the room's walls on one actor."""

    def __init__(self, actor: Actor) -> None:
        """Bake the walls' light in the A-pose: it is the only part that turns with the actor."""
        self._ambient = 0.92 * actor.with_baked_light(lamp_strength=0.0).baked_light

    def on(self, actor: Actor, pose: BodyPose) -> Float32[np.ndarray, "vertices 3"]:
        """Light on each vertex of an actor in a pose, as a factor of its color."""
        points = actor.vertices(pose)
        cosine = vertex_normals(points, actor.faces) @ WINDOW_FROM
        # a window is wide: it still lights surfaces beyond the right angle, to a cosine of -0.4
        facing = np.maximum((cosine + 0.4) / 1.4, 0.0)
        free = lamp_visibility(points, actor.faces, WINDOW_FROM, actor.cut)
        # an avatar whose light turns with it comes to 31 dB of the film at best
        window = 0.40 * (facing * (0.25 + 0.75 * free))[:, None] * LAMP_RGB
        return (self._ambient + window).astype(np.float32)


SUBFRAMES = 3
"""Moments that are averaged into one picture."""
GAIN_DRIFT, WARMTH_DRIFT = 0.15, 0.05
"""Largest drift of the exposure, and of red against blue."""


def drifting_exposure(frames: int, fps: float, seed: int) -> Float[np.ndarray, "frames 3"]:
    """Gain of red, green and blue in each frame, about 1."""
    generator = np.random.default_rng([seed, 25])
    slow = np.tanh(smooth_noise(generator, (frames, 2), over=max(0.9 * fps, 0.5)))  # about 2 s
    gain, warmth = 1.0 + GAIN_DRIFT * slow[:, 0], WARMTH_DRIFT * slow[:, 1]
    return np.stack([gain * (1.0 + warmth), gain, gain * (1.0 - warmth)], axis=1)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class PhoneScene:
    """The actor before a phone on a tripod.

    Attributes:
        camera: The true camera.
        background: A painted backdrop.
        cloth: Displacement of the garments; None if they are still.
    """

    actor: Actor
    camera: Camera
    background: RgbImage
    light: RoomLight
    cloth: MovingCloth | None
    fps: float

    def still(self, pose: BodyPose) -> RenderedFrame:
        """The sharp picture of a pose, neutrally exposed, garments still; and its mask."""
        still = replace(self, cloth=None)
        rgb, alpha = still._draw_moment(pose, 0.0, supersampling=4)
        return composite_over(rgb, alpha, self._behind(pose)), alpha

    def frame(self, motion: Motion, row: int) -> RenderedFrame:
        """One frame of a film with motion blur, neutrally exposed; and its mask."""
        width, height = self.camera.size_px
        total = np.zeros((height, width, 3), dtype=np.float32)
        alphas = np.zeros((height, width), dtype=np.float32)
        for share in (np.arange(SUBFRAMES) + 0.5) / SUBFRAMES - 0.5:
            at = float(np.clip(row + 0.5 * share, 0.0, len(motion) - 1.0))  # shutter: half a frame
            rgb, alpha = self._draw_moment(
                _pose_between(motion, at), at / self.fps, supersampling=2
            )
            total, alphas = total + rgb * alpha[..., None], alphas + alpha
        mean = (alphas / SUBFRAMES).astype(np.float32)
        rgb = (total / np.maximum(alphas, 1e-6)[..., None]).astype(np.float32)
        return composite_over(rgb, mean, self._behind(motion[row])), mean

    def _draw_moment(
        self, pose: BodyPose, time_s: float, supersampling: int
    ) -> tuple[Float32[np.ndarray, "height width 3"], AlphaMask]:
        actor = self.actor
        if self.cloth is not None:
            moved = actor.rest_vertices + self.cloth.displacement_m(time_s)
            actor = replace(actor, rest_vertices=moved)
        actor = replace(actor, baked_light=self.light.on(actor, pose))
        return actor.render_rgb_alpha(pose, self.camera, supersampling)

    def _behind(self, pose: BodyPose) -> RgbImage:
        feet = self.actor.shaped.with_pose(pose).joints()[[10, 11]]
        return painted_surfaces.add_foot_shadows(self.background, feet, self.camera)


def expose(
    rgb: RgbImage, gains: Float[np.ndarray, "3"], generator: np.random.Generator
) -> RgbImage:
    """Return a neutrally exposed image as the phone stores it: exposed, noisy and compressed."""
    noise = 2.0 * generator.standard_normal(rgb.shape, dtype=np.float32)
    exposed = np.clip(rgb * gains + noise + 0.5, 0.0, 255.0).astype(np.uint8)
    # JPEG loses what video does, and is the same on every machine, unlike an H.264 encoder
    options = [cv2.IMWRITE_JPEG_QUALITY, 82]
    _, code = cv2.imencode(".jpg", np.ascontiguousarray(exposed[..., ::-1]), options)
    return np.ascontiguousarray(np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR))[..., ::-1])


def _pose_between(motion: Motion, at: float) -> BodyPose:
    """The pose at a moment between two rows."""
    row = min(int(at), max(len(motion) - 2, 0))
    return motion[row].towards(motion[min(row + 1, len(motion) - 1)], at - row)
