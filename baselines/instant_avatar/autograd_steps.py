"""A training step in plain torch with autograd, on samples that are given.

InstantAvatar's training step in plain torch: the algorithm of the paper, not its CUDA code.

What follows the paper (Jiang et al. 2023) and its released configuration:
128 stratified samples a ray between the walls of the posed person's box; of them those survive
that lie in occupied cells of a 64³ grid in root-normalised space, the union over the sequence
(§3.3, training); each survivor is carried to canonical space by Broyden's method from nine bones,
ten iterations each (Fast-SNARF, §3.2); of its roots the one of highest density counts; the losses
of §3.4. One picture a step.

What does not: field, losses and pixels are ours, so that the algorithms alone differ; the union
grid is made by posing our canonical occupancy, dilated once, not by probing the field; Broyden
starts from the bone's own inverse rotation, which costs nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from avatar.config import TrainConfig
from avatar.kernels.numba_priors import OPACITY_LENGTH_M
from avatar.kernels.operands import DensityGrid, HashLevels, RaySamples
from avatar.radiance_field import RadianceField
from avatar.rig import Rig
from avatar.training.frame_stream import TrainingFrame
from avatar.training.replay_buffer import TrainingBatch
from baselines import torch_reference
from baselines.instant_avatar.broyden_kernels import START_BONES


class AutogradField:
    """A field's parameters, and its forward pass as autograd sees it."""

    def __init__(self, field: RadianceField) -> None:
        """Copies the parameters of `field`."""
        self.levels: HashLevels = field.levels
        self.parameters = [p.detach().clone().requires_grad_() for p in field.parameters()]

    def raw_outputs_at(self, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, "points 4"]:
        """Raw outputs at canonical points."""
        table, first, first_bias, second, second_bias = self.parameters
        features = torch_reference.encode(points, table, self.levels)
        return torch.relu(features @ first + first_bias) @ second + second_bias


def centimeter_opacity(raw: Float32[Tensor, "points 4"]) -> Float32[Tensor, "points"]:
    """Opacity of one centimetre."""
    density = torch.exp(raw[:, 3].clamp(max=torch_reference.MAX_LOG_DENSITY))
    return 1.0 - torch.exp(-density * OPACITY_LENGTH_M)


def autograd_step(
    field: AutogradField,
    samples: RaySamples,
    empty: Float32[Tensor, "empty 3"],
    pairs: Float32[Tensor, "pairs 3"],
    batch: TrainingBatch,
    config: TrainConfig,
) -> tuple[Tensor, ...]:
    """Gradients of the loss with respect to the field's parameters, by what the recipe asks."""
    asked = [samples.points, empty, pairs]
    raw, raw_empty, raw_pairs = field.raw_outputs_at(torch.cat(asked)).split(
        [len(some) for some in asked]
    )
    rendered = torch_reference.composite(raw, samples.offsets, samples.counts, config.sample_step_m)
    loss = torch_reference.loss_per_ray(
        rendered, batch.target, config.alpha_weight, config.hard_surface_weight
    ).mean()
    one, other = centimeter_opacity(raw_pairs).chunk(2)
    total = loss + config.empty_space_weight * centimeter_opacity(raw_empty).mean()
    total = total + config.density_tv_weight * (one - other).abs().mean()
    return torch.autograd.grad(total, field.parameters)


SAMPLES_PER_RAY = 128
UNION_CELLS = 64
ITERATIONS = 10
CONVERGED_M = 1e-3
SAME_ROOT_M = 1e-3
"""Roots closer than this are one, as in Fast-SNARF's filter."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PaperStepInputs:
    """One frame, as the paper's step needs it.

    Attributes:
        volume: Blended transforms of the frame, as grid_sample wants them.
        low, high: Corners of the canonical box, metres.
        bones: From body to canonical frame, of the nine bones.
        person_box: Corners of the box about the posed person, metres.
        union: Cells that are occupied in any frame.
        union_box: Corners of the union grid, body frame, metres.
    """

    volume: Float32[Tensor, "1 12 z y x"]
    low: Float32[Tensor, "3"]
    high: Float32[Tensor, "3"]
    bones: Float32[Tensor, "bones 3 4"]
    person_box: Float32[Tensor, "2 3"]
    union: Bool[Tensor, "64 64 64"]
    union_box: Float32[Tensor, "2 3"]

    @classmethod
    def of(
        cls, rig: Rig, frame: TrainingFrame, frames: Sequence[TrainingFrame], grid: DensityGrid
    ) -> "PaperStepInputs":
        """The scene of one frame out of a sequence."""
        transforms = rig.body_from_canonical(frame.pose.joint_rotations)
        weights = torch.from_numpy(rig.weights)
        blended = weights @ torch.from_numpy(transforms[:, :3].reshape(24, 12)).to(weights)
        inverses = np.linalg.inv(transforms[list(START_BONES)])[:, :3]
        union, union_box = union_occupancy(rig, frames, grid)
        return cls(
            volume=blended.permute(3, 2, 1, 0)[None].contiguous(),
            low=torch.from_numpy(rig.box_low),
            high=torch.from_numpy(rig.box_high),
            bones=torch.from_numpy(inverses).to(weights),
            person_box=torch.from_numpy(person_box(frame)),
            union=union,
            union_box=union_box,
        )


def person_box(frame: TrainingFrame) -> Float32[np.ndarray, "2 3"]:
    """Corners of the box about a posed person, body frame, metres."""
    cells = frame.correspondences
    high = cells.low + np.array(cells.packed_cells.shape, np.float32) * np.float32(cells.cell_m)
    return np.stack([cells.low, high]).astype(np.float32)


def union_occupancy(
    rig: Rig, frames: Sequence[TrainingFrame], grid: DensityGrid
) -> tuple[Bool[Tensor, "64 64 64"], Float32[Tensor, "2 3"]]:
    """The cells of root-normalised space that hold something in any frame, and their box."""
    boxes = np.stack([person_box(frame) for frame in frames])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    cells = grid.occupied.nonzero().numpy()
    points = (cells + 0.5) / grid.cells_per_m.numpy() + grid.low.numpy()
    weights = rig.weights_at(points)
    union = torch.zeros((UNION_CELLS,) * 3)
    for frame in frames:
        bones = rig.body_from_canonical(frame.pose.joint_rotations)[:, :3]
        blended = (weights @ bones.reshape(24, 12)).reshape(-1, 3, 4)
        posed = (blended[:, :, :3] @ points[:, :, None])[..., 0] + blended[:, :, 3]
        place = ((posed - low) / (high - low) * UNION_CELLS).astype(int)
        union[tuple(place.clip(0, UNION_CELLS - 1).T)] = 1.0
    dilated = torch.nn.functional.max_pool3d(union[None, None], 3, stride=1, padding=1)[0, 0]
    return (dilated > 0), torch.from_numpy(np.stack([low, high]))


def stratified_samples(
    scene: PaperStepInputs, batch: TrainingBatch
) -> tuple[Float32[Tensor, "survivors 3"], Tensor, Float32[Tensor, "rays"]]:
    """Samples that survive the union grid, how many each ray keeps, and each ray's step."""
    origins, directions = batch.rays.origins, batch.rays.directions
    towards = torch.where(directions.abs() > 1e-7, directions, 1e-7)
    walls = (scene.person_box[:, None] - origins) / towards
    enter = walls.amin(dim=0).amax(dim=1).clamp(min=0.0)
    step = (walls.amax(dim=0).amin(dim=1) - enter).clamp(min=0.0) / SAMPLES_PER_RAY
    place = torch.arange(SAMPLES_PER_RAY) + torch.rand(len(step), SAMPLES_PER_RAY)
    points = (
        origins[:, None] + (enter[:, None] + place * step[:, None])[..., None] * directions[:, None]
    )
    low, high = scene.union_box
    cell = ((points - low) / (high - low) * UNION_CELLS).long()
    inside = ((cell >= 0) & (cell < UNION_CELLS)).all(dim=-1) & (step > 0)[:, None]
    x, y, z = cell.clamp(0, UNION_CELLS - 1).unbind(dim=-1)
    kept = inside & scene.union[x, y, z]
    return points[kept], kept.sum(dim=1), step


def _skin_points(
    scene: PaperStepInputs, points: Float32[Tensor, "points 3"]
) -> Float32[Tensor, "points 3"]:
    place = (points - scene.low) / (scene.high - scene.low) * 2.0 - 1.0
    read = torch.nn.functional.grid_sample(
        scene.volume, place[None, :, None, None], padding_mode="border", align_corners=True
    )
    blended = read[0, :, :, 0, 0].T.unflatten(1, (3, 4))
    return (blended[..., :3] @ points[..., None])[..., 0] + blended[..., 3]


@torch.no_grad()
def find_start_roots(
    scene: PaperStepInputs, targets: Float32[Tensor, "points 3"]
) -> tuple[Float32[Tensor, "bones points 3"], Bool[Tensor, "bones points"]]:
    """A root from each bone for every sample, and which came to rest at a place of their own."""
    count, bones = len(targets), len(scene.bones)
    inverse = scene.bones[:, None, :, :3].expand(bones, count, 3, 3).flatten(0, 1)
    goal = targets.repeat(bones, 1)
    x = (inverse @ goal[..., None])[..., 0] + scene.bones[:, :, 3].repeat_interleave(count, 0)
    error = _skin_points(scene, x) - goal
    for _ in range(ITERATIONS):
        step = -(inverse @ error[..., None])[..., 0]
        x = x + step
        new = _skin_points(scene, x) - goal
        change = (inverse @ (new - error)[..., None])[..., 0]
        scale = (step * change).sum(dim=-1, keepdim=True)
        scale = torch.where(scale.abs() < 1e-12, 1e-12, scale)
        row = step[:, None] @ inverse
        inverse = inverse + ((step - change) / scale)[..., None] * row
        error = new
    roots = x.unflatten(0, (bones, count))
    valid = (error.norm(dim=-1) < CONVERGED_M).unflatten(0, (bones, count))
    for bone in range(1, bones):
        near = (roots[:bone] - roots[bone]).norm(dim=-1) < SAME_ROOT_M
        valid[bone] &= ~(near & valid[:bone]).any(dim=0)
    return roots, valid


def paper_step(
    scene: PaperStepInputs,
    field: AutogradField,
    batch: TrainingBatch,
    empty: Float32[Tensor, "empty 3"],
    config: TrainConfig,
) -> tuple[int, int]:
    """Gradients of the loss; how many samples survived, and how many roots were asked."""
    points, count, step = stratified_samples(scene, batch)
    roots, valid = find_start_roots(scene, points)
    raw = field.raw_outputs_at(torch.cat([roots[valid], empty]))
    asked = int(valid.sum())
    candidates = raw.new_full((*valid.shape, 4), -30.0)
    candidates[valid] = raw[:asked]
    best = candidates[..., 3].argmax(dim=0)
    chosen = candidates[best, torch.arange(len(points))]
    mean_step = float(step[step > 0].mean())
    scale = torch.log(step / mean_step).repeat_interleave(count)
    chosen = torch.cat([chosen[:, :3], chosen[:, 3:] + scale[:, None]], dim=1)
    first = torch.cumsum(count, 0) - count
    rendered = torch_reference.composite(chosen, first, count.int(), mean_step)
    loss = torch_reference.loss_per_ray(
        rendered, batch.target, config.alpha_weight, config.hard_surface_weight
    ).mean()
    total = loss + config.empty_space_weight * centimeter_opacity(raw[asked:]).mean()
    torch.autograd.grad(total, field.parameters)
    return len(points), asked
