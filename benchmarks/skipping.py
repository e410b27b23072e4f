"""What skipping empty space is worth, for a training step and for a picture.

On: as the trainer and the renderer do it. Off, as the paper has it: a metre before to a metre
behind the body, on every ray, our step and our field, every sample warped and asked. Off, as a
harder measure: only what lies between the walls of the posed person's box. No ray ends early in
either (`benchmarks.unskipped`).
"""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float32

from avatar.hold import HeldOut, on_white
from avatar.kernels.backend import Rays
from avatar.metrics import psnr
from avatar.prepare import BodyRays, PreparedFrame
from avatar.render import cell_tables, render
from avatar.replay import Replay
from avatar.step import cosine
from benchmarks.marks import Mark
from benchmarks.stage import Class
from benchmarks.stopwatch import interleaved
from benchmarks.unskipped import Unskipped, as_the_paper, in_the_box

RAYS_AT_ONCE = 1 << 14
RATE = 1e-6
"""Learning rates' factor: the avatar hardly changes while it is timed."""
PAPER_FRAMES = 12
"""Frames that the paper's scheme draws its rays from: their cells, continued, take much room."""
PAPER = "off as in the paper: ±1 m about the body on every ray"
BOX = "off: between the walls of the person's box only"


def skipping_marks(seen: Class, device: torch.device) -> list[Mark]:
    """All ratios."""
    held = seen.held[len(seen.held) // 2].solved(seen.trainer.avatar.rig)
    return [*_training(seen, device), *_rendering(seen, held, device)]


def _training(seen: Class, device: torch.device) -> list[Mark]:
    trainer, every = seen.trainer, seen.trainer.config.occupancy_every
    rays, counts = trainer.config.rays, {"paper": [], "box": []}
    grid = trainer.avatar.occupancy.grid
    box = in_the_box(trainer.replay.cells, grid.low + 0.5 / grid.cells_per_m)
    some = seen.frames[:: max(1, len(seen.frames) // PAPER_FRAMES)]
    paper, store = as_the_paper(some, trainer.avatar.rig.rest_joints[0], device)
    boxed, papers = full_step(seen, box, trainer.replay), full_step(seen, paper, store)

    def skipping() -> None:
        for _ in range(every):  # the occupancy's update is one of them
            trainer.step(rate=RATE * cosine(0.0), hard_share=1.0)

    before = trainer.samples
    times = interleaved(
        {
            "on": skipping,
            "box": lambda: counts["box"].append(boxed()),
            "paper": lambda: counts["paper"].append(papers()),
        },
        device,
    )
    on = times["on"] / every
    asked = (trainer.samples - before) / (6 * every * rays)

    def beside(off: str) -> str:
        return (
            f"on {1000 * on:.1f} ms ({asked:.1f} samples/ray), off {1000 * times[off]:.0f} ms "
            f"({counts[off][-1] / rays:.0f} samples/ray); drawing, Adam and occupancy included"
        )

    return [
        Mark(
            name=f"empty-space skipping, whole training step, times; {PAPER}",
            value=times["paper"] / on, least="3", moonshot="10",
            beside=f"paper 1.77; {beside('paper')}; warp by look-up, without Broyden's search",
        ),
        Mark(
            name=f"the same; {BOX}", value=times["box"] / on, least="printed",
            beside=beside("box"),
        ),
    ]  # fmt: skip


def full_step(seen: Class, unskipped: Unskipped, replay: Replay) -> Callable[[], int]:
    """A training step without skipping; it returns how many samples it had."""
    trainer, config, field = seen.trainer, seen.trainer.config, seen.trainer.avatar.field
    grid = trainer.avatar.occupancy.grid
    chance = torch.Generator(device=replay.device).manual_seed(0)

    def step() -> int:
        batch = replay.draw(config.rays, chance)
        samples = unskipped.samples(field.backend, batch.rays, grid, config.step_m)
        activations = field.forward(samples.points)
        unskipped.emptied(activations.raw, samples.rows)
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


def _rendering(seen: Class, held: HeldOut, device: torch.device) -> list[Mark]:
    avatar, observation = seen.trainer.avatar, held.observation
    pose, camera = observation.pose, observation.camera
    grid, pictures = avatar.occupancy.grid, dict[str, np.ndarray]()
    box = in_the_box(cell_tables(held.cells, device), grid.low + 0.5 / grid.cells_per_m)
    paper, _ = as_the_paper([whole(seen, held)], avatar.rig.rest_joints[0], device)

    def skipping() -> None:
        pictures["on"] = render(avatar, pose, camera, cells=held.cells)

    def without(unskipped: Unskipped, name: str) -> None:
        pictures[name] = full_picture(seen, held, unskipped)

    times = interleaved(
        {
            "on": skipping,
            "box": lambda: without(box, "box"),
            "paper": lambda: without(paper, "paper"),
        },
        device, rounds=5, seldom={"box": 3, "paper": 2},
    )  # fmt: skip
    width, height = camera.size_px

    def beside(off: str) -> str:
        alike = psnr(on_white(pictures["on"]), on_white(pictures[off]))
        return (
            f"on {1000 * times['on']:.0f} ms, off {1000 * times[off]:,.0f} ms; both pictures agree "
            f"to {alike:.1f} dB PSNR"
        )

    return [
        Mark(
            name=f"empty-space skipping, whole {width}x{height} picture, times; {PAPER}",
            value=times["paper"] / times["on"], least="15", moonshot="40",
            beside=f"paper 15; {beside('paper')}; warp by look-up, without Broyden's search",
        ),
        Mark(
            name=f"the same; {BOX}", value=times["box"] / times["on"], least="printed",
            beside=beside("box"),
        ),
    ]  # fmt: skip


def whole(seen: Class, held: HeldOut) -> PreparedFrame:
    """A held-out frame with every pixel of its picture."""
    observation, rig = held.observation, seen.trainer.avatar.rig
    pixels = observation.camera.pixel_centers().reshape(-1, 2)
    rays = BodyRays.through(pixels, observation.camera, rig.world_from_body(observation.pose))
    return PreparedFrame(
        index=observation.frame.index, pose=observation.pose, cells=held.cells,
        origin=rays.origin, directions=rays.directions,
        colors=np.zeros((len(pixels), 4), dtype=np.uint8), near=len(pixels),
    )  # fmt: skip


def full_picture(
    seen: Class, held: HeldOut, unskipped: Unskipped
) -> Float32[np.ndarray, "height width 4"]:
    """Premultiplied RGBA of a held-out frame without skipping."""
    avatar, frame = seen.trainer.avatar, whole(seen, held)
    field, grid = avatar.field, avatar.occupancy.grid
    origin = torch.from_numpy(frame.origin).to(grid.low)
    parts = []
    for chunk in torch.from_numpy(frame.directions).to(grid.low).split(RAYS_AT_ONCE):
        count = len(chunk)
        rays = Rays(
            origin.expand(count, 3).contiguous(),
            chunk,
            torch.zeros(count, dtype=torch.int32, device=grid.low.device),
            torch.full((count,), 0.5, device=grid.low.device),
        )
        samples = unskipped.samples(field.backend, rays, grid, avatar.step_m)
        raw = unskipped.emptied(field.raw_at(samples.points), samples.rows)
        parts.append(field.backend.composite(raw, samples, avatar.step_m))
    width, height = held.observation.camera.size_px
    return torch.cat(parts).reshape(height, width, 4).cpu().numpy()
