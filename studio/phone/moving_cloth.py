"""Cloth that moves a little: a smooth displacement of the garments that changes with time."""

from typing import final

import numpy as np
from jaxtyping import Float

from preprocess.body.body_surface import vertex_normals
from studio.actor import Actor
from studio.outfit import SHIRT, TROUSERS

WAVES = 4
SHIRT_M, TROUSERS_M = 0.010, 0.006
"""Largest displacement of each garment, metres, at its loose end."""


@final
class MovingCloth:
    """The displacement of one actor's garments over time."""

    def __init__(self, actor: Actor, seed: int) -> None:
        """Chooses the waves.

        Args:
            actor: Who wears the garments.
            seed: Of the waves.
        """
        generator = np.random.default_rng([seed, 21])
        self._normals = vertex_normals(actor.rest_vertices, actor.faces)
        self._reach = _looseness_m(actor)
        place = actor.template_points.astype(np.float64)
        wave_vectors = generator.normal(0.0, 2.0 * np.pi / 0.45, (3, WAVES)) / np.sqrt(3.0)
        self._phases = place @ wave_vectors + generator.uniform(0.0, 2.0 * np.pi, WAVES)
        self._turns_per_s = generator.uniform(0.3, 0.9, WAVES)

    def displacement_m(self, time_s: float) -> Float[np.ndarray, "vertices 3"]:
        """Of each rest vertex, metres: along its normal; zero for skin, hair and shoes."""
        waves = np.sin(self._phases + 2.0 * np.pi * self._turns_per_s * time_s).mean(axis=1)
        return (self._reach * np.clip(1.6 * waves, -1.0, 1.0))[:, None] * self._normals


def _looseness_m(actor: Actor) -> Float[np.ndarray, "vertices"]:
    """How far each vertex may move: nothing where a garment is held, most at its loose end."""
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
