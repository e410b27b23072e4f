"""One step and the encoding alone: ours, plain torch, and the paper's algorithm."""

from collections.abc import Callable

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.kernels import reference
from avatar.kernels.backend import Marching
from avatar.kernels.torch_backend import TorchBackend
from avatar.priors import pairs
from avatar.replay import Batch, Replay
from avatar.step import gradients
from benchmarks.marks import Mark
from benchmarks.paper_step import PaperScene, paper_step
from benchmarks.stage import Class
from benchmarks.stopwatch import interleaved
from benchmarks.torch_step import TorchField, torch_step

POINTS = 65_536


def step_marks(seen: Class, device: torch.device) -> list[Mark]:
    """The step on 1,024 rays of one frame, by all three."""
    trainer, config = seen.trainer, seen.trainer.config
    avatar, field = trainer.avatar, trainer.avatar.field
    frame = seen.frames[len(seen.frames) // 3]
    replay = Replay(1, device)
    replay.add(frame)
    batch = replay.draw(config.rays, _seeded(device))
    how = Marching(config.step_m, config.grace_m, config.most_samples)
    grid = avatar.occupancy.grid
    samples = field.backend.march(batch.rays, replay.cells, grid, how)
    chance = _seeded(device)
    empty = avatar.occupancy.empty_points(config.empty_points, chance)
    near = pairs(samples.points, config, chance)
    background = torch.rand(config.rays, 3, generator=chance, device=device)
    plain, scene = TorchField(field), PaperScene.of(avatar.rig, frame, seen.frames, grid)
    counts: list[tuple[int, int]] = []

    def ours() -> None:
        field.table_grad.zero_()
        gradients(
            field, seen.trainer.sampler, replay.cells, batch, config,
            hard_share=1.0, generator=_seeded(device),
        )  # fmt: skip

    alternatives: dict[str, Callable[[], object]] = {
        "ours": ours,
        "torch": lambda: torch_step(plain, samples, empty, near, batch, background, config),
        "march": lambda: TorchBackend().march(batch.rays, replay.cells, grid, how),
        "paper": lambda: counts.append(
            paper_step(scene, plain, batch, empty, background, config)
        ),
    }  # fmt: skip
    ours()
    strays = _strays(field.parameters(), alternatives["torch"]())
    times = interleaved(alternatives, device, seldom={"paper": 2})
    kept, roots = (count / config.rays for count in counts[-1])
    return _step_marks(times, len(samples.points) / config.rays, strays, kept, roots, batch)


def _step_marks(
    times: dict[str, float], mine: float, strays: float, kept: float, roots: float, batch: Batch
) -> list[Mark]:
    ms = {name: 1000.0 * time for name, time in times.items()}
    rays = f"{len(batch.target):,} rays of one frame"
    return [
        Mark(
            name="one step vs plain torch on the same samples, times",
            value=ms["torch"] / ms["ours"], least="4", moonshot="8",
            beside=f"{rays}, {mine:.1f} samples/ray: {ms['ours']:.1f} ms with marching, torch "
            f"{ms['torch']:.0f} ms without (its own marching: +{ms['march']:.0f} ms, not counted); "
            f"largest difference of a gradient {strays:.0e} of its largest",
        ),
        Mark(
            name="one step vs the paper's algorithm in plain torch, times",
            value=ms["paper"] / ms["ours"], least="100", moonshot="400",
            beside=f"same rays: {ms['paper']:,.0f} ms; {kept:.1f} of 128 samples/ray survive the "
            f"union grid, the field is asked at {roots:.1f} roots/ray",
        ),
    ]  # fmt: skip


def _strays(parameters: list[torch.nn.Parameter], plain: object) -> float:
    """Largest difference between gradients, each relative to its parameter's largest."""
    assert isinstance(plain, tuple)
    both = zip(parameters, plain, strict=True)
    return max(float((p.grad - g).abs().max() / g.abs().max()) for p, g in both)


def encode_marks(seen: Class, device: torch.device) -> list[Mark]:
    """The hash grid forward and backward at training samples."""
    field = seen.trainer.avatar.field
    points = training_points(seen, POINTS)
    grad = torch.randn(POINTS, field.levels.width, generator=_seeded(device), device=device)
    table = field.table.detach().clone().requires_grad_()

    def ours() -> None:
        field.table_grad.zero_()
        field.backend.encode(points, field.table, field.levels)
        field.backend.encode_backward(points, grad, field.levels, field.table_grad)

    def plain() -> None:
        torch.autograd.grad(reference.encode(points, table, field.levels), table, grad)

    times = interleaved({"ours": ours, "torch": plain}, device)
    mega = {name: POINTS / time / 1e6 for name, time in times.items()}
    levels = f"{len(field.levels.cells_per_m)} levels, {field.levels.entries:,} entries"
    return [
        Mark(
            name="encode forward + backward vs plain torch, times",
            value=times["torch"] / times["ours"], least="8", moonshot="15",
            beside=f"{POINTS:,} points of training rays, {levels}: {mega['ours']:.2f} and "
            f"{mega['torch']:.3f} million points/s",
        )
    ]  # fmt: skip


def training_points(seen: Class, count: int) -> Float32[Tensor, "count 3"]:
    """Canonical samples as training draws them, ray by ray."""
    trainer, config = seen.trainer, seen.trainer.config
    how = Marching(config.step_m, config.grace_m, config.most_samples)
    chance = _seeded(trainer.replay.device)
    found: list[Tensor] = []
    while sum(map(len, found)) < count:
        batch = trainer.replay.draw(config.rays, chance)
        grid = trainer.avatar.occupancy.grid
        found.append(trainer.backend.march(batch.rays, trainer.replay.cells, grid, how).points)
    return torch.cat(found)[:count].contiguous()


def _seeded(device: torch.device) -> torch.Generator:
    return torch.Generator(device=device).manual_seed(0)
