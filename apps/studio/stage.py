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
from apps.studio.room import Room
from apps.studio.shade import over
from capture.camera import Camera
from preprocess.pose import BodyPose, Motion

Picture = tuple[UInt8[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]
"""The actor on the stage, and the exact soft mask."""


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Stage:
    """What a motion is filmed on.

    Attributes:
        actor: Who is filmed.
        cameras: One for all pictures, or one for each.
        behind: A painted backdrop (for one camera), or a room.
        first: Number of the first picture, of which a room's noise depends.
    """

    actor: Actor
    cameras: tuple[Camera, ...]
    behind: UInt8[np.ndarray, "height width 3"] | Room
    first: int = 0

    def picture(self, pose: BodyPose, number: int) -> Picture:
        """One picture."""
        camera = self.cameras[min(number, len(self.cameras) - 1)]
        rgb, alpha = self.actor.layers_of(pose, camera)
        feet = self.actor.shaped.with_pose(pose).joints()[[10, 11]]
        return over(rgb, alpha, self._background(camera, feet, number)), alpha

    def pictures(self, motion: Motion) -> Iterator[Picture]:
        """All pictures of a motion in order, a few drawn ahead on other threads."""
        workers = max(1, min(4, cpu_count() or 1))
        with ThreadPoolExecutor(workers) as pool:
            ahead = deque()
            try:
                for row in range(len(motion)):
                    ahead.append(pool.submit(self.picture, motion[row], row))
                    if len(ahead) > workers:
                        yield ahead.popleft().result()
                while ahead:
                    yield ahead.popleft().result()
            finally:
                for waiting in ahead:
                    waiting.cancel()

    def _background(
        self, camera: Camera, feet: Float[np.ndarray, "feet 3"], number: int
    ) -> UInt8[np.ndarray, "height width 3"]:
        if isinstance(self.behind, Room):
            return self.behind.picture(camera, feet, self.first + number)
        return backdrop.shadowed(self.behind, feet, camera)
