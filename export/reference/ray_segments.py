"""Where the player's samples lie in the bricks, whatever these hold: pieces of rays."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32, Int32, Int64

from export.package.player_tables import BrickTable
from export.package.render_settings import RenderSettings
from export.reference.reference_march import (
    CanonicalRays,
    PosedNodes,
    max_sample_spacing,
    newton_correction,
)
from export.reference.reference_player import TracedPicture


@dataclass(frozen=True, eq=False, kw_only=True)
class RaySegments:
    """Blocks of samples along rays, as `twin_march.march` follows those that never end.

    Attributes:
        first: The first piece of each ray, in the order in which light passes them; and the end.
        start: Where pieces begin, in voxels of the lattice.
        slope: Voxels from one sample to the next.
        step_m: The same along the ray, metres.
        count: Samples.
        layer: Depth layer, from 0.
    """

    ray_offsets: Int64[np.ndarray, "rays_and_one"]
    start: Float32[np.ndarray, "pieces 3"]
    slope: Float32[np.ndarray, "pieces 3"]
    step_m: Float32[np.ndarray, "pieces"]
    count: Int32[np.ndarray, "pieces"]
    layer: Int32[np.ndarray, "pieces"]

    @property
    def num_rays(self) -> int:
        """How many there are."""
        return len(self.ray_offsets) - 1

    @classmethod
    def of_first_layer(
        cls, rays: CanonicalRays, posed: PosedNodes, bricks: BrickTable, rules: RenderSettings
    ) -> "RaySegments":
        """The first layer's, of these rays in their order."""
        blocks = list(_march_blocks(rays, posed, rules))
        number = np.concatenate([ray for ray, _, _ in blocks])
        step_m = np.concatenate([step for _, _, step in blocks])
        start = np.concatenate([rest.start_canonical for _, rest, _ in blocks])
        direction = np.concatenate([rest.direction_canonical for _, rest, _ in blocks])
        return cls._grouped_by_ray(
            number, len(rays.begin), bricks, start, direction, step_m, (rules.block_samples, 0)
        )

    @classmethod
    def of_further_layer(
        cls, look: TracedPicture, number: int, bricks: BrickTable, rules: RenderSettings
    ) -> "RaySegments":
        """Those of a look's further layer: 1 for the first one behind."""
        (again, rays), count = look.further_layers[number - 1], rules.further_layer_samples
        step_m = (rays.end - rays.begin) / np.float32(count)
        return cls._grouped_by_ray(
            again,
            len(look.pixel),
            bricks,
            rays.start_canonical,
            rays.direction_canonical,
            step_m,
            (count, number),
        )

    @classmethod
    def _grouped_by_ray(
        cls,
        number: Int64[np.ndarray, "pieces"],
        rays: int,
        bricks: BrickTable,
        start: Float32[np.ndarray, "pieces 3"],
        direction: Float32[np.ndarray, "pieces 3"],
        step_m: Float32[np.ndarray, "pieces"],
        count_and_layer: tuple[int, int],
    ) -> "RaySegments":
        """Ray by ray; the pieces of each stay in their order."""
        order, voxel_m = np.argsort(number, kind="stable"), np.float32(bricks.voxel_m)
        count, layer = count_and_layer
        return cls(
            ray_offsets=np.searchsorted(number[order], np.arange(rays + 1)).astype(np.int64),
            start=((start - bricks.low) / voxel_m)[order],
            slope=(direction * (step_m / voxel_m)[:, None])[order],
            step_m=step_m[order],
            count=np.full(len(number), count, dtype=np.int32),
            layer=np.full(len(number), layer, dtype=np.int32),
        )

    def append_layer(self, behind: "RaySegments") -> "RaySegments":
        """The same rays, with further pieces behind those that they have."""
        rays = np.arange(self.num_rays)
        owners = [np.repeat(rays, np.diff(pieces.ray_offsets)) for pieces in (self, behind)]
        order = np.argsort(np.concatenate(owners), kind="stable")
        columns = {
            name: np.concatenate([getattr(self, name), getattr(behind, name)])[order]
            for name in _SEGMENT_FIELDS
        }
        return RaySegments(ray_offsets=self.ray_offsets + behind.ray_offsets, **columns)

    @classmethod
    def concatenate(cls, many: "Sequence[RaySegments]") -> "RaySegments":
        """The rays of many looks, one after the other."""
        offsets = np.cumsum([0, *(len(pieces.step_m) for pieces in many)])
        starts = [pieces.ray_offsets[:-1] + o for pieces, o in zip(many, offsets[:-1], strict=True)]
        columns = {
            name: np.concatenate([getattr(pieces, name) for pieces in many])
            for name in _SEGMENT_FIELDS
        }
        return cls(ray_offsets=np.concatenate([*starts, offsets[-1:]]), **columns)


_SEGMENT_FIELDS = [field.name for field in fields(RaySegments) if field.name != "ray_offsets"]
"""What there is one of for each piece."""


def _march_blocks(
    rays: CanonicalRays, posed: PosedNodes, rules: RenderSettings
) -> Iterator[tuple[Int64[np.ndarray, "pieces"], CanonicalRays, Float32[np.ndarray, "pieces"]]]:
    """Numbers of rays, what is left of them, and the steps of their next block."""
    number, rest = np.arange(len(rays.begin)), rays
    for turn in range(rules.max_blocks):
        if turn > 0:
            rest = newton_correction(rules, posed, rest)
        step_m = np.minimum(
            (rest.end - rest.begin) / np.float32(rules.block_samples),
            max_sample_spacing(rules, rules.samples, turn, rest),
        )
        yield number, rest, step_m
        way = step_m * np.float32(rules.block_samples)
        rest = rest._replace(
            begin=rest.begin + way,
            start_canonical=rest.start_canonical + rest.direction_canonical * way[:, None],
        )
        going = rest.begin < rest.end - 1e-5
        number, rest = number[going], CanonicalRays(*(part[going] for part in rest))
