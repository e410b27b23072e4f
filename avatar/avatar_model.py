"""The avatar: rig, radiance field and occupancy of one person, and the light they were filmed in.

The light stays in the room while the person turns. The field's colors move with the skin. What the
room's light adds depends on where the skin faces in the world: one factor per direction, in
spherical harmonics of the first order (a second order won nothing). Its four numbers are shared by
all frames and found by linear least squares from running sums. The field and the package hold
neutral colors.
"""

import math
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from jaxtyping import Float32, Float64
from scipy.ndimage import gaussian_filter
from torch import Tensor

from avatar.kernels.numba_shading import add_light, light_factors
from avatar.kernels.operands import (
    MAX_LOG_DENSITY,
    DensityGrid,
    LitSkin,
    NormalVolume,
    PremultipliedPixels,
)
from avatar.occupancy_grid import OccupancyGrid, in_occupied_cells
from avatar.radiance_field import RadianceField
from avatar.rig import Rig

HARMONICS = 4
"""Spherical harmonics up to the first order."""
MIN_ALPHA = 0.9
"""Alpha, of the frame and of the rendering, from which a ray counts."""
MIN_NORMAL_LENGTH = 0.5
"""Length of a ray's mean normal below which it has no direction."""
MEMORY_RAYS = 60_000.0
"""Rays after which an earlier one weighs 1/e."""
MIN_FACTOR, MAX_FACTOR = 0.3, 3.0
"""Bounds of the factor."""
OBSERVATION_INTERVAL = 4
"""Steps between observations of the light."""


@final
class OrientationShading:
    """The room's light on the person: `coefficients` of a factor of the neutral color.

    While it `is_neutral`, no shading has been found, and the factor is 1 everywhere. `normals` are
    those of the skin's distance volume.
    """

    def __init__(self, rig: Rig) -> None:
        """Starts from light that is the same from everywhere."""
        distance = np.where(rig.inside_skin, -rig.skin_distance, rig.skin_distance)
        distance = gaussian_filter(distance.astype(np.float32), 1.0)
        slope = np.stack([np.gradient(distance, axis=axis) for axis in range(3)], axis=-1)
        slope /= np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-6)
        self.normals = NormalVolume(
            torch.from_numpy(slope.astype(np.float32)),
            torch.from_numpy(rig.box_low),
            torch.from_numpy(rig.cells_per_m),
        )
        self._sums: Float64[np.ndarray, "5 5"] = np.zeros((HARMONICS + 1, HARMONICS + 1))
        self._rays = 0.0
        self.coefficients = torch.tensor([1.0, 0.0, 0.0, 0.0])
        self.is_neutral = True
        self._steps = 1  # not an observation's turn, where none is ever asked for

    def lit_skin(self) -> LitSkin:
        """Normals and light of a step; in steps that need no normals all of them are zero."""
        needed = not self.is_neutral or self._steps % OBSERVATION_INTERVAL == 0
        return LitSkin(
            self.normals, self.coefficients, MIN_NORMAL_LENGTH, (MIN_FACTOR, MAX_FACTOR), needed
        )

    def factors(self, normals: Float32[Tensor, "rays 3"]) -> PremultipliedPixels:
        """Factors of color, and of alpha (1), at world normals; 1 where there is no surface."""
        factors = np.empty((len(normals), 4), dtype=np.float32)
        light_factors(
            normals.numpy(), self.coefficients.numpy(), MIN_NORMAL_LENGTH,
            (MIN_FACTOR, MAX_FACTOR), factors,
        )  # fmt: skip
        return torch.from_numpy(factors)

    def restore(self, coefficients: Float32[Tensor, "harmonics"]) -> None:
        """Continues from coefficients that were found earlier."""
        self.coefficients = coefficients.to(self.coefficients)
        self.is_neutral = not bool(self.coefficients[1:].any())

    def observe(
        self,
        normals: Float32[Tensor, "rays 3"],
        target: PremultipliedPixels,
        rendered: PremultipliedPixels,
    ) -> None:
        """Updates the coefficients by world normals, neutral pixels and their shaded rendering."""
        self._steps += 1
        if (self._steps - 1) % OBSERVATION_INTERVAL:
            return
        rays = add_light(
            normals.numpy(), target.numpy(), rendered.numpy(), self.coefficients.numpy(),
            MIN_ALPHA, MIN_NORMAL_LENGTH, (MIN_FACTOR, MAX_FACTOR), MEMORY_RAYS, self._sums,
        )  # fmt: skip
        self._rays = math.exp(-rays / MEMORY_RAYS) * self._rays + rays
        # fog until about then; 16 is a multiple of the steps between observations
        if self._rays > 10_000.0 and self._steps % 16 == 1:
            self.restore(torch.from_numpy(self._solve()))

    def _solve(self) -> Float32[np.ndarray, "harmonics"]:
        """Coefficients of least squares, drawn to 1; their mean over the rays is 1."""
        gram, moments, power = self._sums[:-1, :-1], self._sums[:-1, -1], self._sums[-1, -1]
        unit = np.eye(HARMONICS)[0]
        ridge = 0.02 * gram[0, 0] * (np.eye(HARMONICS) - np.outer(unit, unit))
        found = np.linalg.solve(gram + ridge, moments)
        constant = power - moments[0] ** 2 / gram[0, 0]
        rest = power - 2.0 * found @ moments + found @ gram @ found
        explained = 1.0 - rest / max(constant, 1e-12)
        # shading that explains 2 % of the squared error is not believed, 6 % in full
        belief = (explained - 0.02) / (0.06 - 0.02)
        found /= (gram[0] @ found) / gram[0, 0]
        return (unit + min(max(belief, 0.0), 1.0) * (found - unit)).astype(np.float32)


@dataclass(frozen=True, eq=False, kw_only=True)
class Avatar:
    """A person who can be rendered in any pose.

    `sample_step_m` is the distance between samples along a ray in training; `shading` is the light
    of the room in which the person was filmed.
    """

    rig: Rig
    field: RadianceField
    occupancy: OccupancyGrid
    sample_step_m: float
    shading: OrientationShading

    def rendering_grid(self) -> DensityGrid:
        """Occupancy for rendering, grown so that images have no holes."""
        return self.occupancy.for_rendering(self.sample_step_m)

    def color_and_density_at(
        self, points: Float32[Tensor, "points 3"]
    ) -> tuple[Float32[Tensor, "points 3"], Float32[Tensor, "points"]]:
        """Color in [0, 1] and density, 1/m, at canonical points; zero in empty cells."""
        held = in_occupied_cells(self.rendering_grid(), points).nonzero()[:, 0]
        raw = self.field.raw_outputs_at(points[held].contiguous())
        all_colors, all_densities = torch.zeros_like(points), torch.zeros_like(points[:, 0])
        all_colors[held] = torch.sigmoid(raw[:, :3])
        all_densities[held] = torch.exp(raw[:, 3].clamp(max=MAX_LOG_DENSITY))
        return all_colors, all_densities
