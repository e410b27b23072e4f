"""The stage: the actor before a backdrop or in a room, seen by cameras that stand or walk."""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from os import cpu_count
from typing import final

import numpy as np
from jaxtyping import Float, Float32, UInt8

from apps.studio import backdrop
from apps.studio.actor import Actor
from apps.studio.room import FurnishedRoom
from apps.studio.shade import composite_over
from capture.camera import Camera
from preprocess.pose import BodyPose, Motion

RenderedFrame = tuple[UInt8[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]
"""The actor on the stage, and the exact soft mask."""


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class StudioScene:
    """What a motion is filmed on.

    Attributes:
        actor: Who is filmed.
        cameras: One for all pictures, or one for each.
        behind: A painted backdrop (for one camera), or a room.
        first: Number of the first picture, of which a room's noise depends.
    """

    actor: Actor
    cameras: tuple[Camera, ...]
    background: UInt8[np.ndarray, "height width 3"] | FurnishedRoom
    first_frame_number: int = 0

    def render(self, pose: BodyPose, number: int) -> RenderedFrame:
        """One picture."""
        camera = self.cameras[min(number, len(self.cameras) - 1)]
        rgb, alpha = self.actor.render_rgb_alpha(pose, camera)
        feet = self.actor.shaped.with_pose(pose).joints()[[10, 11]]
        return composite_over(rgb, alpha, self._render_background(camera, feet, number)), alpha

    def render_all(self, motion: Motion) -> Iterator[RenderedFrame]:
        """All pictures of a motion in order, a few drawn ahead on other threads."""
        workers = max(1, min(4, cpu_count() or 1))
        with ThreadPoolExecutor(workers) as pool:
            ahead = deque()
            try:
                for row in range(len(motion)):
                    ahead.append(pool.submit(self.render, motion[row], row))
                    if len(ahead) > workers:
                        yield ahead.popleft().result()
                while ahead:
                    yield ahead.popleft().result()
            finally:
                for waiting in ahead:
                    waiting.cancel()

    def _render_background(
        self, camera: Camera, feet: Float[np.ndarray, "feet 3"], number: int
    ) -> UInt8[np.ndarray, "height width 3"]:
        if isinstance(self.background, FurnishedRoom):
            return self.background.render(camera, feet, self.first_frame_number + number)
        return backdrop.add_foot_shadows(self.background, feet, camera)
