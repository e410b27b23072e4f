"""Sparse 3-D convolutions in plain torch: active voxels gather their 27 neighbors.

Submanifold convolutions keep the active voxels, strided ones activate every voxel that sees an
active one (Graham et al. 2018): the layers that sparse-convolution libraries have, by one gather
and one matrix product each.
"""

from itertools import pairwise
from typing import NamedTuple, final

import torch
from jaxtyping import Float32, Int64
from torch import Tensor, nn

TAPS = 27
"""Neighbors of a voxel, itself included."""


class ActiveVoxels(NamedTuple):
    """Voxels of a grid that hold features, in the order of their flat indices.

    Attributes:
        places: Their indices along each axis.
        shape: Size of the grid.
    """

    places: Int64[Tensor, "voxels 3"]
    shape: tuple[int, int, int]

    def index(self) -> Int64[Tensor, "cells"]:
        """Row of each cell of the grid with a border of one; the number of rows where inactive."""
        x, y, z = (size + 2 for size in self.shape)
        rows = torch.full((x * y * z,), len(self.places))
        place = self.places + 1
        rows[(place[:, 0] * y + place[:, 1]) * z + place[:, 2]] = torch.arange(len(place))
        return rows

    def neighbors(self, of: "ActiveVoxels", stride: int) -> Int64[Tensor, "voxels 27"]:
        """Rows of the voxels around `stride` times the places of others."""
        _, y, z = (size + 2 for size in self.shape)
        around = torch.cartesian_prod(*[torch.arange(-1, 2)] * 3)
        place = stride * of.places[:, None] + around + 1
        return self.index()[(place[..., 0] * y + place[..., 1]) * z + place[..., 2]]

    def halved(self) -> "ActiveVoxels":
        """The voxels of a grid of half the resolution whose 27 taps see an active one."""
        sides = torch.cartesian_prod(*[torch.arange(2)] * 3)
        shape = tuple((size + 1) // 2 for size in self.shape)
        places = ((self.places[:, None] + sides) // 2).flatten(0, 1)
        x, y, z = (size + 1 for size in shape)  # what lies beyond the last voxel is left out
        seen = torch.zeros(x, y, z, dtype=torch.bool)
        seen[places[:, 0], places[:, 1], places[:, 2]] = True
        return ActiveVoxels(seen[:-1, :-1, :-1].nonzero(), (x - 1, y - 1, z - 1))


@final
class VoxelConvolution(nn.Module):
    """A 3³ convolution without bias, normalization over the active voxels, and a ReLU.

    Each body is normalized by its own voxels, also when it is rendered: means over bodies need
    hundreds of steps before they are of use.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        """Draws the kernel."""
        super().__init__()
        self.kernel = nn.Linear(TAPS * inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs, eps=1e-3, track_running_stats=False)

    def forward(
        self, features: Float32[Tensor, "inputs width"], neighbors: Int64[Tensor, "outputs 27"]
    ) -> Float32[Tensor, "outputs channels"]:
        """Features of the output voxels."""
        padded = torch.cat([features, features.new_zeros(1, features.shape[1])])
        gathered = nn.functional.embedding(neighbors, padded).flatten(1)
        return torch.relu(self.norm(self.kernel(gathered)))


@final
class CodeDiffusion(nn.Module):
    """Neural Body's network: four halvings, whose volumes are read trilinearly and joined.

    Attributes:
        widths: Channels of the volumes that are read.
    """

    def __init__(self, channels: int) -> None:
        """Levels of 1, 2, 4, 8 and 8 times the codes' channels, with 2, 2, 3, 3 and 3 layers."""
        super().__init__()
        sizes = [channels * factor for factor in (1, 2, 4, 8, 8)]
        self.widths = sizes[1:]
        self._first = nn.ModuleList(VoxelConvolution(channels, channels) for _ in range(2))
        self._down = nn.ModuleList(VoxelConvolution(a, b) for a, b in pairwise(sizes))
        self._level = nn.ModuleList(
            nn.ModuleList(VoxelConvolution(size, size) for _ in range(count))
            for size, count in zip(sizes[1:], (2, 3, 3, 3), strict=True)
        )

    def forward(
        self, features: Float32[Tensor, "voxels channels"], voxels: ActiveVoxels
    ) -> list[Float32[Tensor, "1 width x y z"]]:
        """The dense volumes at strides 2, 4, 8 and 16."""
        within = voxels.neighbors(voxels, 1)
        for layer in self._first:
            features = layer(features, within)
        volumes = []
        for down, layers in zip(self._down, self._level, strict=True):
            assert isinstance(layers, nn.ModuleList)
            half = voxels.halved()
            features = down(features, voxels.neighbors(half, 2))
            voxels, within = half, half.neighbors(half, 1)
            for layer in layers:
                features = layer(features, within)
            dense = features.new_zeros(*voxels.shape, features.shape[1])
            dense = dense.index_put(tuple(voxels.places.T), features)
            volumes.append(dense.permute(3, 0, 1, 2)[None])
        return volumes


def read_volumes(
    volumes: list[Float32[Tensor, "1 _ _ _ _"]], places: Float32[Tensor, "points 3"]
) -> Float32[Tensor, "points width"]:
    """Trilinear features at places, in voxels of the finest grid; zero outside.

    Args:
        volumes: Volumes at strides 2, 4, 8, …; voxel i of stride s lies at place i · s.
        places: Where to read.
    """
    read = []
    for level, volume in enumerate(volumes):
        last = torch.tensor(volume.shape[2:]) - 1
        at = places / 2.0 ** (level + 1) / last.clamp(min=1) * 2.0 - 1.0
        grid = at.flip(-1)[None, :, None, None]
        seen = nn.functional.grid_sample(volume, grid, align_corners=True)
        read.append(seen[0, :, :, 0, 0].T)
    return torch.cat(read, dim=1)
