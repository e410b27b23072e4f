"""Sizes and rates of a method, and its network."""

from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float32
from torch import Tensor, nn

SKIP_LAYER = 4
"""Layer of a deep network that sees the encoded point again (Mildenhall et al. 2020)."""


@dataclass(frozen=True, kw_only=True)
class MethodSettings:
    """What a preset fixes; a method reads what it has.

    Attributes:
        frames: Training frames of a step.
        rays: Rays of a step, shared among them.
        samples: Stratified samples of a ray.
        fine_samples: Samples of the second network; 0 for none.
        layers, width: Hidden layers of the field and their width.
        octaves: Octaves of the positional encoding.
        learning_rate: Of Adam, before its decay.
        pose_rate: Learning rate of the poses, radians and metres; 0 keeps them as given.
        alpha_weight: Weight of the L1 loss on alpha.
        reach_m: Distance from the skin within which there may be density, metres.
    """

    frames: int
    rays: int
    samples: int
    fine_samples: int = 0
    layers: int = 8
    width: int = 256
    octaves: int = 10
    learning_rate: float = 5e-4
    pose_rate: float = 0.0
    alpha_weight: float = 0.1
    reach_m: float = 0.08


def encode_positions(
    points: Float32[Tensor, "points 3"], octaves: int
) -> Float32[Tensor, "points width"]:
    """Positional encoding: the points, then sines and cosines of each octave."""
    angles = (points[:, None] * 2.0 ** torch.arange(octaves)[:, None]).flatten(1)
    return torch.cat([points, torch.sin(angles), torch.cos(angles)], dim=1)


@final
class NerfNetwork(nn.Module):
    """A network of positional encodings without view direction: color logits and log density."""

    def __init__(self, settings: MethodSettings) -> None:
        """Draws the parameters; density begins as a thin fog."""
        super().__init__()
        self._octaves, width = settings.octaves, settings.width
        seen = 3 + 6 * settings.octaves
        sizes = [seen, *[width] * (settings.layers - 1)]
        if settings.layers > SKIP_LAYER:
            sizes[SKIP_LAYER] += seen
        self._hidden = nn.ModuleList(nn.Linear(size, width) for size in sizes)
        self._density = nn.Linear(width, 1)
        self._color = nn.Sequential(
            nn.Linear(width, width // 2), nn.ReLU(), nn.Linear(width // 2, 3)
        )

    def forward(self, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, "points 4"]:
        """Color logits and log density (log 1/m) at canonical points."""
        seen = encode_positions(points, self._octaves)
        hidden = seen
        for index, layer in enumerate(self._hidden):
            if index == SKIP_LAYER:
                hidden = torch.cat([hidden, seen], dim=1)
            hidden = torch.relu(layer(hidden))
        return torch.cat([self._color(hidden), self._density(hidden)], dim=1)
