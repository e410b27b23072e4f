"""The avatar: rig, radiance field and occupancy of one person, and the light they were filmed in.

The light stays in the room while the person turns. The field's colors move with the skin. What the
room's light adds depends on where the skin faces in the world: one factor per direction, in
spherical harmonics of the first order (a second order won nothing). Its four numbers are shared by
all frames and found by linear least squares from running sums. The field and the package hold
neutral colors.
"""

from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from jaxtyping import Float32, Float64
from scipy.ndimage import gaussian_filter
from torch import Tensor

from avatar.kernels.backend_protocol import (
    Backend,
    CorrespondenceTables,
    DensityGrid,
    NormalVolume,
    PremultipliedPixels,
    RawOutputs,
    RayBatch,
    RaySamples,
)
from avatar.kernels.torch_reference import activate
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
MIN_RAYS = 10_000.0
"""Rays before the first estimate; the field is fog until about then."""
RIDGE = 0.02
"""Weight of the constant factor 1, as a share of the rays."""
UNEXPLAINED_SHARE, EXPLAINED_SHARE = 0.02, 0.06
"""Share of the squared error that shading has to explain: below the first it is not believed, from
the second on it is believed in full."""
MIN_FACTOR, MAX_FACTOR = 0.3, 3.0
"""Bounds of the factor."""
OBSERVATION_INTERVAL = 4
"""Steps between observations of the light."""


@final
class OrientationShading:
    """The room's light on the person.

    Attributes:
        coefficients: Coefficients of the factor of the neutral color, for `_harmonics`.
        is_neutral: Whether no shading has been found; the factor is then 1 everywhere.
    """

    def __init__(self, rig: Rig, device: torch.device) -> None:
        """Starts from light that is the same from everywhere."""
        distance = np.where(rig.inside_skin, -rig.skin_distance, rig.skin_distance)
        distance = gaussian_filter(distance.astype(np.float32), 1.0)
        slope = np.stack([np.gradient(distance, axis=axis) for axis in range(3)], axis=-1)
        slope /= np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-6)
        self._normals = NormalVolume(
            torch.from_numpy(slope.astype(np.float32)).to(device),
            torch.from_numpy(rig.box_low).to(device),
            torch.from_numpy(rig.cells_per_m).to(device),
        )
        self._gram: Float64[Tensor, "harmonics harmonics"] = torch.zeros(
            HARMONICS, HARMONICS, dtype=torch.float64, device=device
        )
        self._moments = torch.zeros_like(self._gram[0])
        self._power, self._rays = self._moments[0].clone(), self._moments[0].clone()
        self.coefficients = self._gram[0].float()
        self.coefficients[0] = 1.0
        self.is_neutral = True
        self._steps = 1  # not an observation's turn, where none is ever asked for

    def body_normals(
        self,
        backend: Backend,
        rays: RayBatch,
        samples: RaySamples,
        raw: RawOutputs,
        cells: CorrespondenceTables,
        step_m: float,
    ) -> Float32[Tensor, "rays 3"]:
        """Mean normal of what each ray sees, in the body frame; shorter than 1 where it is thin.

        Normals of the skin's distance volume, through the warp, composited like colors. All are
        zero in steps that need none.
        """
        if self.is_neutral and self._steps % OBSERVATION_INTERVAL:
            return torch.zeros(len(rays.slots), 3, device=raw.device)
        return backend.mean_normals(raw, samples, step_m, rays.slots, cells, self._normals)

    def factor(self, normals: Float32[Tensor, "rays 3"]) -> Float32[Tensor, "rays 1"]:
        """Factor of the neutral color of surfaces with these world normals; 1 without one."""
        length = normals.norm(dim=1, keepdim=True)
        shade = _harmonics(normals / length.clamp(min=1e-6)) @ self.coefficients[:, None]
        return torch.where(
            length > MIN_NORMAL_LENGTH, shade.clamp(MIN_FACTOR, MAX_FACTOR), torch.ones_like(shade)
        )

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
        """Updates the coefficients.

        Args:
            normals: World normals.
            target: Pixels, at neutral exposure.
            rendered: Shaded rendering of the same rays.
        """
        self._steps += 1
        if (self._steps - 1) % OBSERVATION_INTERVAL:
            return
        length = normals.norm(dim=1, keepdim=True)
        alpha = torch.minimum(target[:, 3:], rendered[:, 3:])
        counts = (alpha > MIN_ALPHA) & (length > MIN_NORMAL_LENGTH)
        basis = (_harmonics(normals / length.clamp(min=1e-6)) * counts).double()
        before = (rendered[:, :3].mean(dim=1, keepdim=True) / self.factor(normals)).double()
        after = (target[:, :3].mean(dim=1, keepdim=True) * counts).double()
        basis, rays = basis * before, counts.sum()
        kept = torch.exp(-rays / MEMORY_RAYS)
        self._gram = kept * self._gram + basis.T @ basis
        self._moments = kept * self._moments + (basis.T @ after)[:, 0]
        self._power = kept * self._power + after.square().sum()
        self._rays = kept * self._rays + rays
        if float(self._rays) > MIN_RAYS:
            self.restore(self._solve().float())

    def _solve(self) -> Float64[Tensor, "harmonics"]:
        """Coefficients of least squares, drawn to 1; their mean over the rays is 1."""
        unit = torch.zeros_like(self._moments)
        unit[0] = 1.0
        ridge = RIDGE * self._gram[0, 0] * torch.eye(HARMONICS, device=unit.device)
        ridge[0, 0] = 0.0
        found = torch.linalg.solve(self._gram + ridge, self._moments)
        level = self._moments[0] / self._gram[0, 0]
        constant = self._power - level * self._moments[0]
        rest = self._power - 2.0 * found @ self._moments + found @ self._gram @ found
        explained = 1.0 - rest / constant.clamp(min=1e-12)
        belief = (explained - UNEXPLAINED_SHARE) / (EXPLAINED_SHARE - UNEXPLAINED_SHARE)
        found = found / ((self._gram[0] @ found) / self._gram[0, 0])
        return unit + belief.clamp(0.0, 1.0) * (found - unit)


def _harmonics(normals: Float32[Tensor, "rays 3"]) -> Float32[Tensor, "rays 4"]:
    """Spherical harmonics up to the first order, not normalized."""
    return torch.cat([torch.ones_like(normals[:, :1]), normals], dim=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Avatar:
    """A person who can be rendered in any pose.

    Attributes:
        rig: Articulation.
        field: Canonical color and density.
        occupancy: Occupied canonical cells.
        sample_step_m: Distance between samples along a ray in training, metres.
        shading: Light of the room in which the person was filmed.
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
        color, density = activate(self.field.raw_outputs_at(points[held].contiguous()))
        all_colors, all_densities = torch.zeros_like(points), torch.zeros_like(points[:, 0])
        all_colors[held], all_densities[held] = color, density
        return all_colors, all_densities
