"""Light that stays in the room: what falls on the actor's vertices depends on where they face."""

from typing import final

import numpy as np
from jaxtyping import Float32

from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import vertex_normals
from studio.actor import Actor
from studio.lighting import LAMP_RGB, lamp_visibility

WINDOW_FROM = np.array([-0.75, 0.50, 0.45]) / np.linalg.norm([-0.75, 0.50, 0.45])
"""Direction of the window, from the actor, in the world (the camera is on +z)."""
WINDOW_STRENGTH = 0.40
"""As a factor of color. An avatar whose light turns with it comes to 31 dB of the film at best."""
AMBIENT_STRENGTH = 0.92
WRAP = 0.4
"""A window is wide: it still lights surfaces this far (cosine) beyond the right angle."""


@final
class RoomLight:
    """The light of a window and of the room's walls on one actor."""

    def __init__(self, actor: Actor) -> None:
        """Bakes what the walls give in the A-pose: it is the only part that turns with the actor.

        Args:
            actor: As its pictures will be drawn, but for the light.
        """
        self._ambient = AMBIENT_STRENGTH * actor.with_baked_light(lamp_strength=0.0).baked_light

    def on(self, actor: Actor, pose: BodyPose) -> Float32[np.ndarray, "vertices 3"]:
        """Light on each vertex of an actor in a pose, as a factor of its color."""
        points = actor.vertices(pose)
        cosine = vertex_normals(points, actor.faces) @ WINDOW_FROM
        facing = np.maximum((cosine + WRAP) / (1.0 + WRAP), 0.0)
        free = lamp_visibility(
            points,
            actor.faces,
            WINDOW_FROM,
            template_points=actor.template_points,
            materials=actor.materials,
            measures=actor.outfit.measures,
        )
        window = WINDOW_STRENGTH * (facing * (0.25 + 0.75 * free))[:, None] * LAMP_RGB
        return (self._ambient + window).astype(np.float32)
