"""Actors in front of a phone's camera, cut out, and their true poses."""

from dataclasses import dataclass

import numpy as np
import pytest

from capture.camera import Camera
from instant_avatar.studio import staging
from instant_avatar.studio.actor import Actor
from instant_avatar.studio.staging import portrait_camera
from preprocess.body.body_pose import BodyPose


@dataclass(frozen=True, eq=False)
class Shot:
    """An actor, cut out: colors times alpha, 0 to 255, and alpha; the actor's pose, the camera."""

    actor: Actor
    rgb: np.ndarray
    alpha: np.ndarray
    pose: BodyPose
    camera: Camera

    def paste(self, picture: np.ndarray, left: int) -> None:
        """Put the actor into a picture whose height is the same, before what is there."""
        width = self.alpha.shape[1]
        here = slice(max(0, left), min(left + width, picture.shape[1]))
        there = slice(here.start - left, here.stop - left)
        if here.start < here.stop:
            alpha = self.alpha[:, there, None]
            picture[:, here] = picture[:, here] * (1 - alpha) + self.rgb[:, there] * alpha


@pytest.fixture(scope="session")
def shots() -> list[Shot]:
    """One in stripes and one in a plain shirt, of 270x480 px."""
    found = []
    for subject in (1, 2):
        actor = Actor.of(subject)
        pose = staging.turning_motion(actor, frames=8, fps=30.0, turns=1.0, seed=0)[0]
        camera = portrait_camera(actor, 270)
        rgb, alpha = actor.render_rgb_alpha(pose, camera, supersampling=2)
        rgb = (255 * np.clip(rgb, 0, 1)).astype(np.float32)
        found.append(Shot(actor=actor, rgb=rgb, alpha=alpha, pose=pose, camera=camera))
    return found


def room(width: int = 270) -> np.ndarray:
    """A wall that is darker on the right."""
    wall = np.linspace(170, 110, width)[None, :, None]
    return np.broadcast_to(wall, (480, width, 3)).astype(np.uint8).copy()
