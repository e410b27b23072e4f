"""Pictures as a phone takes them: portrait, with motion blur, drifting exposure, noise, loss."""

from dataclasses import dataclass, replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from capture.camera import Camera
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.rotations import slerp
from studio.actor import Actor
from studio.draw_ahead import RenderedFrame
from studio.input_noise import smooth_noise
from studio.lighting import composite_over
from studio.phone.moving_cloth import MovingCloth
from studio.phone.room_light import RoomLight
from studio.room import painted_backdrop

SHUTTER_FRAMES = 0.5
"""How long a picture is exposed, in frames."""
SUBFRAMES = 3
"""Moments that are averaged into one picture."""
SUPERSAMPLING = 2
"""Subsamples along each side of a pixel, at each of these moments."""
GAIN_DRIFT, WARMTH_DRIFT = 0.15, 0.05
"""Largest drift of the exposure, and of red against blue."""
DRIFT_S = 0.9
"""They drift this slowly: correlated over about two seconds."""
SENSOR_NOISE = 2.0
"""Standard deviation of the noise of each pixel and channel, of 255."""
JPEG_QUALITY = 82
"""The loss of video compression: blocks of 8 x 8 quantized, colors at half the resolution. The
same on every machine, unlike an H.264 encoder."""


def drifting_exposure(frames: int, fps: float, seed: int) -> Float[np.ndarray, "frames 3"]:
    """Gain of red, green and blue in each frame, about 1."""
    generator = np.random.default_rng([seed, 25])
    slow = np.tanh(smooth_noise(generator, (frames, 2), over=max(DRIFT_S * fps, 0.5)))
    gain, warmth = 1.0 + GAIN_DRIFT * slow[:, 0], WARMTH_DRIFT * slow[:, 1]
    return np.stack([gain * (1.0 + warmth), gain, gain * (1.0 - warmth)], axis=1)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class PhoneScene:
    """The actor before a phone on a tripod.

    Attributes:
        actor: Who is filmed.
        camera: The true camera.
        background: A painted backdrop.
        light: Of the room.
        cloth: Displacement of the garments; None if they are still.
        fps: Frames per second.
    """

    actor: Actor
    camera: Camera
    background: UInt8[np.ndarray, "height width 3"]
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
            at = float(np.clip(row + SHUTTER_FRAMES * share, 0.0, len(motion) - 1.0))
            rgb, alpha = self._draw_moment(_pose_between(motion, at), at / self.fps, SUPERSAMPLING)
            total, alphas = total + rgb * alpha[..., None], alphas + alpha
        mean = (alphas / SUBFRAMES).astype(np.float32)
        rgb = (total / np.maximum(alphas, 1e-6)[..., None]).astype(np.float32)
        return composite_over(rgb, mean, self._behind(motion[row])), mean

    def _draw_moment(
        self, pose: BodyPose, time_s: float, supersampling: int
    ) -> tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]:
        actor = self.actor
        if self.cloth is not None:
            moved = actor.rest_vertices + self.cloth.displacement_m(time_s)
            actor = replace(actor, rest_vertices=moved)
        actor = replace(actor, baked_light=self.light.on(actor, pose))
        return actor.render_rgb_alpha(pose, self.camera, supersampling)

    def _behind(self, pose: BodyPose) -> UInt8[np.ndarray, "height width 3"]:
        feet = self.actor.shaped.with_pose(pose).joints()[[10, 11]]
        return painted_backdrop.add_foot_shadows(self.background, feet, self.camera)


def expose(
    rgb: UInt8[np.ndarray, "height width 3"],
    gains: Float[np.ndarray, "3"],
    generator: np.random.Generator,
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture as the phone stores it: exposed, noisy and compressed.

    Args:
        rgb: Neutrally exposed.
        gains: Of red, green and blue.
        generator: Of the sensor's noise.
    """
    noise = SENSOR_NOISE * generator.standard_normal(rgb.shape, dtype=np.float32)
    exposed = np.clip(rgb * gains + noise + 0.5, 0.0, 255.0).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    _, code = cv2.imencode(".jpg", np.ascontiguousarray(exposed[..., ::-1]), options)
    return np.ascontiguousarray(np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR))[..., ::-1])


def _pose_between(motion: Motion, at: float) -> BodyPose:
    """The pose at a moment between two rows."""
    row = min(int(at), max(len(motion) - 2, 0))
    share = at - row
    first, second = motion[row], motion[min(row + 1, len(motion) - 1)]
    turned = slerp(
        np.concatenate([first.root_rotation[None], first.joint_rotations]),
        np.concatenate([second.root_rotation[None], second.joint_rotations]),
        np.array([share]),
    )[0]
    place = (1.0 - share) * first.root_translation + share * second.root_translation
    return BodyPose(root_rotation=turned[0], root_translation=place, joint_rotations=turned[1:])
