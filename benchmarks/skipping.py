"""What skipping empty space is worth, for a training step and for a picture.

Off: the field is asked at every lattice sample between the walls of the posed person's box. Where
a sample has no warp (nothing of the body is near) it is asked at a stand-in point, and its density
counts as zero; no ray ends early. On: as the trainer and the renderer do it.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float32, Int32
from torch import Tensor

from avatar.field import Field
from avatar.hold import HeldOut, on_white
from avatar.kernels.backend import CellTables, Grid, Marching, Rays, Samples
from avatar.metrics import psnr
from avatar.prepare import BodyRays
from avatar.render import EMPTY_LOG_DENSITY, cell_tables, render
from avatar.step import cosine
from benchmarks.marks import Mark
from benchmarks.stage import Class
from benchmarks.stopwatch import interleaved

RAYS_AT_ONCE = 1 << 14
MOST_SAMPLES = 512
RATE = 1e-6
"""Learning rates' factor: the avatar hardly changes while it is timed."""


def filled(cells: CellTables, inside: Float32[Tensor, "3"]) -> tuple[CellTables, int]:
    """The cells, with a stand-in root wherever there is none; the stand-in's row."""
    slots, row, _ = cells.roots.shape
    stand_in = torch.zeros(slots, 1, 12, device=cells.roots.device)
    stand_in[:, 0, :3] = inside
    index = torch.where(cells.index == 0, row * 4 + 1, cells.index)
    return cells._replace(index=index, roots=torch.cat([cells.roots, stand_in], dim=1)), row


def everywhere(grid: Grid) -> Grid:
    """The grid, with every cell occupied."""
    return grid._replace(occupied=torch.ones_like(grid.occupied))


def emptied(
    raw: Float32[Tensor, "samples 4"], rows: Int32[Tensor, "samples"], stand_in: int
) -> Float32[Tensor, "samples 4"]:
    """Raw outputs without density where a sample has no warp."""
    raw[:, 3].masked_fill_(rows == stand_in, EMPTY_LOG_DENSITY)
    return raw


def skipping_marks(seen: Class, device: torch.device) -> list[Mark]:
    """Both ratios."""
    return [_training(seen, device), _rendering(seen, seen.held[len(seen.held) // 2], device)]


def _training(seen: Class, device: torch.device) -> Mark:
    trainer = seen.trainer
    step, counts = full_step(seen), []

    def without() -> None:
        counts.append(step())

    def skipping() -> None:
        for _ in range(trainer.config.occupancy_every):  # the occupancy's update is one of them
            trainer.step(rate=RATE * cosine(0.0), hard_share=1.0)

    before = trainer.samples
    times = interleaved({"on": skipping, "off": without}, device)
    per_step = times["on"] / trainer.config.occupancy_every
    rays = trainer.config.rays
    asked = (trainer.samples - before) / (6 * trainer.config.occupancy_every * rays)
    return Mark(
        name="empty-space skipping, whole training step, times",
        value=times["off"] / per_step, least="3", moonshot="10",
        beside=f"paper 1.77; on {1000 * per_step:.1f} ms ({asked:.1f} samples/ray), off "
        f"{1000 * times['off']:.0f} ms ({counts[-1] / rays:.0f} samples/ray: every one between "
        "the walls of the person's box); drawing, Adam and occupancy included",
    )  # fmt: skip


def full_step(seen: Class) -> Callable[[], int]:
    """A training step without skipping; it returns how many samples it had."""
    trainer, config, field = seen.trainer, seen.trainer.config, seen.trainer.avatar.field
    grid = everywhere(trainer.avatar.occupancy.grid)
    cells, stand_in = filled(trainer.replay.cells, grid.low + 0.5 / grid.cells_per_m)
    how = Marching(config.step_m, math.inf, MOST_SAMPLES)
    chance = torch.Generator(device=trainer.replay.device).manual_seed(0)

    def step() -> int:
        batch = trainer.replay.draw(config.rays, chance)
        samples = field.backend.march(batch.rays, cells, grid, how)
        activations = field.forward(samples.points)
        emptied(activations.raw, samples.rows, stand_in)
        background = torch.rand(config.rays, 3, generator=chance, device=chance.device)
        _, _, grad = field.backend.composite_loss(
            activations.raw, samples, config.step_m, batch.target, background,
            config.alpha_weight, config.hard_weight,
        )  # fmt: skip
        field.backward(activations, grad)
        trainer.optimizer.step()
        field.table_grad.zero_()
        return len(samples.points)

    return step


def _rendering(seen: Class, held: HeldOut, device: torch.device) -> Mark:
    avatar, observation = seen.trainer.avatar, held.observation
    pose, camera = observation.pose, observation.camera
    pictures: dict[str, np.ndarray] = {}

    def skipping() -> None:
        pictures["on"] = render(avatar, pose, camera, cells=held.cells)

    def without() -> None:
        pictures["off"] = full_picture(seen, held)

    times = interleaved({"on": skipping, "off": without}, device, rounds=3)
    alike = psnr(on_white(pictures["on"]), on_white(pictures["off"]))
    width, height = camera.size_px
    return Mark(
        name=f"empty-space skipping, whole {width}x{height} picture, times",
        value=times["off"] / times["on"], least="15", moonshot="40",
        beside=f"paper 15; on {1000 * times['on']:.0f} ms, off {1000 * times['off']:,.0f} ms "
        f"(every lattice sample between the walls of the person's box); both pictures agree to "
        f"{alike:.1f} dB PSNR",
    )  # fmt: skip


def full_picture(seen: Class, held: HeldOut) -> Float32[np.ndarray, "height width 4"]:
    """Premultiplied RGBA of a held-out frame without skipping."""
    avatar, camera = seen.trainer.avatar, held.observation.camera
    field, grid = avatar.field, everywhere(avatar.occupancy.grid)
    device = grid.low.device
    tables, stand_in = filled(cell_tables(held.cells, device), grid.low + 0.5 / grid.cells_per_m)
    rays = BodyRays.through(
        camera.pixel_centers().reshape(-1, 2), camera,
        avatar.rig.world_from_body(held.observation.pose),
    )  # fmt: skip
    origin = torch.from_numpy(rays.origin).to(device)
    parts = []
    for chunk in torch.from_numpy(rays.directions).to(device).split(RAYS_AT_ONCE):
        count = len(chunk)
        batch = Rays(
            origin.expand(count, 3).contiguous(),
            chunk,
            torch.zeros(count, dtype=torch.int32, device=device),
            torch.full((count,), 0.5, device=device),
        )
        how = Marching(avatar.step_m, math.inf, MOST_SAMPLES)
        samples = field.backend.march(batch, tables, grid, how)
        parts.append(_shown(field, samples, stand_in, avatar.step_m))
    width, height = camera.size_px
    return torch.cat(parts).reshape(height, width, 4).cpu().numpy()


def _shown(field: Field, samples: Samples, stand_in: int, step_m: float) -> Tensor:
    raw = emptied(field.raw_at(samples.points), samples.rows, stand_in)
    return field.backend.composite(raw, samples, step_m)
