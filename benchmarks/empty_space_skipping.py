"""What skipping empty space is worth, for a training step and for a picture.

On: as the trainer and the renderer do it. Off, as the paper has it: a metre before to a metre
behind the body, on every ray, our step and our field, every sample warped and asked. Off, as a
harder measure: only what lies between the walls of the posed person's box. No ray ends early in
either (`benchmarks.dense_sampling`).
"""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float32

from avatar.evaluation.held_out import HeldOutFrame
from avatar.evaluation.image_metrics import composite_on_white, psnr
from avatar.kernels import operations
from avatar.kernels.operands import RayBatch
from avatar.render import correspondence_tables, render
from avatar.training.frame_stream import TrainingFrame, rebuild_frame
from avatar.training.replay_buffer import ReplayBuffer
from avatar.training.trainer import cosine_decay, step_optimizer
from avatar.training.training_pixels import RayView
from benchmarks.dense_sampling import DenseSampler, dense_as_in_paper, dense_in_box
from benchmarks.measurements import Measurement
from benchmarks.sample_training import LoadedTrainer
from benchmarks.stopwatch import time_interleaved

RAYS_AT_ONCE = 1 << 14
NEGLIGIBLE_RATE = 1e-6
"""Learning rates' factor: the avatar hardly changes while it is timed."""
PAPER_FRAMES = 12
"""Frames that the paper's scheme draws its rays from: their cells, continued, take much room."""
PAPER = "off as in the paper: ±1 m about the body on every ray"
BOX = "off: between the walls of the person's box only"


def skipping_marks(seen: LoadedTrainer) -> list[Measurement]:
    """All ratios."""
    held = seen.held_out[len(seen.held_out) // 2].with_correspondences(seen.trainer.avatar.rig)
    return [*_training(seen), *_rendering(seen, held)]


def _training(seen: LoadedTrainer) -> list[Measurement]:
    trainer, every = seen.trainer, seen.trainer.config.occupancy_interval
    rays, counts = trainer.config.rays, {"paper": [], "box": []}
    grid = trainer.avatar.occupancy.density_grid
    box = dense_in_box(trainer.replay.correspondences, grid.low + 0.5 / grid.cells_per_m)
    some = seen.frames[:: max(1, len(seen.frames) // PAPER_FRAMES)]
    paper, store = dense_as_in_paper(some, trainer.avatar.rig.rest_joints[0])
    boxed, papers = dense_step(seen, box, trainer.replay), dense_step(seen, paper, store)

    def skipping() -> None:
        for _ in range(every):  # the occupancy's update is one of them
            trainer.step(rate=NEGLIGIBLE_RATE * cosine_decay(0.0), hard_surface_share=1.0)

    before = trainer.samples
    times = time_interleaved(
        {
            "on": skipping,
            "box": lambda: counts["box"].append(boxed()),
            "paper": lambda: counts["paper"].append(papers()),
        }
    )
    on = times["on"] / every
    asked = (trainer.samples - before) / (6 * every * rays)

    def beside(off: str) -> str:
        return (
            f"on {1000 * on:.1f} ms ({asked:.1f} samples/ray), off {1000 * times[off]:.0f} ms "
            f"({counts[off][-1] / rays:.0f} samples/ray); drawing, Adam and occupancy included"
        )

    return [
        Measurement(
            name=f"empty-space skipping, whole training step, times; {PAPER}",
            value=times["paper"] / on, required="3", stretch_goal="10",
            context=f"paper 1.77; {beside('paper')}; warp by look-up, without Broyden's search",
        ),
        Measurement(
            name=f"the same; {BOX}", value=times["box"] / on, required="printed",
            context=beside("box"),
        ),
    ]  # fmt: skip


def dense_step(
    seen: LoadedTrainer, unskipped: DenseSampler, replay: ReplayBuffer
) -> Callable[[], int]:
    """A training step without skipping; it returns how many samples it had."""
    trainer, config, field = seen.trainer, seen.trainer.config, seen.trainer.avatar.field
    grid = trainer.avatar.occupancy.density_grid
    chance = torch.Generator().manual_seed(0)

    def step() -> int:
        batch = replay.sample_rays(config.rays, chance)
        samples = unskipped.samples(batch.rays, grid, config.sample_step_m)
        activations = field.forward(samples.points)
        unskipped.clear_substitutes(activations.raw, samples.root_rows)
        _, _, grad = operations.composite_loss(
            activations.raw, samples, config.sample_step_m, batch.target,
            config.alpha_weight, config.hard_surface_weight,
        )  # fmt: skip
        field.backward(activations, grad)
        step_optimizer(trainer.optimizer)
        return len(samples.points)

    return step


def _rendering(seen: LoadedTrainer, held: HeldOutFrame) -> list[Measurement]:
    avatar, observation = seen.trainer.avatar, held.observation
    pose, camera = observation.pose, observation.camera
    grid, pictures = avatar.occupancy.density_grid, dict[str, np.ndarray]()
    box = dense_in_box(
        correspondence_tables(held.correspondences), grid.low + 0.5 / grid.cells_per_m
    )
    paper, _ = dense_as_in_paper([whole_frame(seen, held)], avatar.rig.rest_joints[0])

    def skipping() -> None:
        pictures["on"] = render(avatar, pose, camera, cells=held.correspondences)

    def without(unskipped: DenseSampler, name: str) -> None:
        pictures[name] = dense_picture(seen, held, unskipped)

    times = time_interleaved(
        {
            "on": skipping,
            "box": lambda: without(box, "box"),
            "paper": lambda: without(paper, "paper"),
        },
        rounds=5, fewer_rounds={"box": 3, "paper": 2},
    )  # fmt: skip
    width, height = camera.size_px

    def beside(off: str) -> str:
        alike = psnr(composite_on_white(pictures["on"]), composite_on_white(pictures[off]))
        return (
            f"on {1000 * times['on']:.0f} ms, off {1000 * times[off]:,.0f} ms; both pictures agree "
            f"to {alike:.1f} dB PSNR"
        )

    return [
        Measurement(
            name=f"empty-space skipping, whole {width}x{height} picture, times; {PAPER}",
            value=times["paper"] / times["on"], required="15", stretch_goal="40",
            context=f"paper 15; {beside('paper')}; warp by look-up, without Broyden's search",
        ),
        Measurement(
            name=f"the same; {BOX}", value=times["box"] / times["on"], required="printed",
            context=beside("box"),
        ),
    ]  # fmt: skip


def whole_frame(seen: LoadedTrainer, held: HeldOutFrame) -> TrainingFrame:
    """A held-out frame with every pixel of its picture."""
    observation = held.observation
    near = np.ones_like(observation.alpha, dtype=bool)
    view = RayView.of(observation.camera, near)
    colors = np.zeros((near.size, 4), dtype=np.uint8)
    rig = seen.trainer.avatar.rig
    return rebuild_frame(observation.frame.index, observation.pose, view, colors, rig)


def dense_picture(
    seen: LoadedTrainer, held: HeldOutFrame, unskipped: DenseSampler
) -> Float32[np.ndarray, "height width 4"]:
    """Premultiplied RGBA of a held-out frame without skipping."""
    avatar, frame = seen.trainer.avatar, whole_frame(seen, held)
    field, grid = avatar.field, avatar.occupancy.density_grid
    origin = torch.from_numpy(frame.origin).to(grid.low)
    parts = []
    for chunk in torch.from_numpy(frame.directions()).to(grid.low).split(RAYS_AT_ONCE):
        count = len(chunk)
        rays = RayBatch(
            origin.expand(count, 3).contiguous(),
            chunk,
            torch.zeros(count, dtype=torch.int32),
            torch.full((count,), 0.5),
        )
        samples = unskipped.samples(rays, grid, avatar.sample_step_m)
        raw = unskipped.clear_substitutes(field.raw_outputs_at(samples.points), samples.root_rows)
        parts.append(operations.composite(raw, samples, avatar.sample_step_m))
    width, height = held.observation.camera.size_px
    return torch.cat(parts).reshape(height, width, 4).numpy()
