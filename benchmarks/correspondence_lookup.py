"""The warp: cells looked up as marching does it, beside Broyden's method for every sample.

Fast-SNARF's own way, compiled for the CPU: Broyden's method for every sample.

Nine starts per sample, one for each of InstantAvatar's bones; each ends as soon as it is within
1e-4 m, after twelve iterations, or when it has left the body (the solver that builds warp cells).
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32

from avatar.correspondence_grid import CorrespondenceGrid
from avatar.kernels import operations
from avatar.kernels.kernel_compiler import FAST_MATH, compile_kernel
from avatar.kernels.numba_skinning import MATRIX_LANES, solve_root, transform_point
from avatar.kernels.operands import (
    CorrespondenceTables,
    DensityGrid,
    MarchSettings,
    RayBatch,
    RaySamples,
)
from avatar.render import correspondence_tables
from avatar.rig import Rig
from baselines.instant_avatar.broyden_kernels import START_BONES
from benchmarks.measurements import Measurement
from benchmarks.sample_training import LoadedTrainer
from benchmarks.stopwatch import time_interleaved

POINTS = 65_536
ONE_SAMPLE_STEP_M = 1e3
"""Step that leaves the body's box at once, metres: each ray is sampled at its origin only."""
WRONG_ROOT_M = 0.01
"""A point warped farther off than this was warped with another root."""


class PosedPoints(NamedTuple):
    """Points of the avatar in one pose.

    Attributes:
        canonical: Where they were drawn: in cells that hold something.
        posed: Where skinning carries them, body frame, metres.
    """

    canonical: Float32[np.ndarray, "points 3"]
    posed: Float32[np.ndarray, "points 3"]


def warp_marks(seen: LoadedTrainer, novel: Float[np.ndarray, "23 3"]) -> list[Measurement]:
    """Speed and error of the look-up in a training pose and in one that was never filmed."""
    rig = seen.trainer.avatar.rig
    poses = {"training": seen.frames[len(seen.frames) // 3].pose.joint_rotations, "novel": novel}
    marks: list[Measurement] = []
    for name, pose in poses.items():
        points = draw_points(seen, pose)
        rays = one_sample_rays(points)
        solved = CorrespondenceGrid.solve(rig, pose)
        cells = correspondence_tables(solved)
        broyden = BroydenLookup(rig, pose, _grid(seen))
        times = time_interleaved(
            {
                "look-up": lambda rays=rays, cells=cells: march_once(seen, rays, cells),
                "BroydenLookup": lambda points=points, broyden=broyden: broyden(points.posed),
            },
            cpu,
        )
        marks += _lookup_marks(
            name, times, _errors(canonical_points(march_once(seen, rays, cells)), points),
            _errors(broyden(points.posed), points), lookups_per_second(seen, cells),
            _second_order_share(solved, points),
        )  # fmt: skip
    return marks


def draw_points(seen: LoadedTrainer, pose: Float[np.ndarray, "23 3"]) -> PosedPoints:
    """Random points of cells that hold something dense, carried to a pose."""
    rig, grid, chance = seen.trainer.avatar.rig, _grid(seen), np.random.default_rng(0)
    cells = (grid.occupied != 0).nonzero().numpy()
    cells = cells[chance.integers(len(cells), size=POINTS)]
    inside = cells + chance.random((POINTS, 3))
    canonical = (inside / grid.cells_per_m.numpy() + grid.low.numpy()).astype(np.float32)
    bones = rig.body_from_canonical(pose)[:, :3].reshape(24, 12)
    blended = (rig.weights_at(canonical) @ bones).reshape(-1, 3, 4)
    posed = (blended[:, :, :3] @ canonical[:, :, None])[..., 0] + blended[:, :, 3]
    return PosedPoints(canonical, posed.astype(np.float32))


def one_sample_rays(points: PosedPoints) -> RayBatch:
    """One ray a point, to be asked at its origin alone."""
    count = len(points.posed)
    return RayBatch(
        torch.from_numpy(points.posed),
        torch.tensor([[0.6, 0.64, 0.48]]).expand(count, 3).contiguous(),
        torch.zeros(count, dtype=torch.int32),
        torch.zeros(count),
    )


def march_once(seen: LoadedTrainer, rays: RayBatch, cells: CorrespondenceTables) -> RaySamples:
    """The trainer's own march, asked for one sample a ray."""
    return operations.march(rays, cells, _grid(seen), MarchSettings(ONE_SAMPLE_STEP_M, math.inf, 1))


def canonical_points(samples: RaySamples) -> Float32[np.ndarray, "points 3"]:
    """The canonical point of each one-sample ray; far off where there is none."""
    out = np.full((len(samples.counts), 3), ONE_SAMPLE_STEP_M, dtype=np.float32)
    out[samples.counts.numpy() > 0] = samples.points.numpy()
    return out


def lookups_per_second(seen: LoadedTrainer, cells: CorrespondenceTables) -> float:
    """Look-ups a second of core time along whole rays, when every sample that has a root stays."""
    trainer, grid = seen.trainer, _grid(seen)
    generator = torch.Generator().manual_seed(0)
    batches = [trainer.replay.sample_rays(trainer.config.rays, generator).rays for _ in range(8)]
    batches = [rays._replace(slots=torch.zeros_like(rays.slots)) for rays in batches]
    everywhere = grid._replace(occupied=torch.ones_like(grid.occupied))
    how = MarchSettings(trainer.config.sample_step_m, math.inf, 256)

    def march() -> int:
        return sum(len(operations.march(rays, cells, everywhere, how).points) for rays in batches)

    return march() / time_interleaved({"march": march})["march"]


def _grid(seen: LoadedTrainer) -> DensityGrid:
    return seen.trainer.avatar.occupancy.density_grid


def _second_order_share(cells: CorrespondenceGrid, points: PosedPoints) -> float:
    """How many of the points lie in cells whose warp has a second-order term."""
    place = ((points.posed - cells.low) / cells.cell_m).astype(int)
    place = np.clip(place, 0, np.array(cells.packed_cells.shape) - 1)
    return float((cells.packed_cells[tuple(place.T)] & 4 > 0).mean())


def _errors(
    where: Float32[np.ndarray, "points 3"], points: PosedPoints
) -> Float[np.ndarray, "points"]:
    return np.linalg.norm(where - points.canonical, axis=1)


def _lookup_marks(
    pose: str,
    times: dict[str, float],
    errors: Float[np.ndarray, "points"],
    broyden: Float[np.ndarray, "points"],
    along: float,
    bent: float,
) -> list[Measurement]:
    mega = {name: POINTS / time / 1e6 for name, time in times.items()}

    def told(error: Float[np.ndarray, "points"]) -> str:
        p50, p99 = 1000.0 * np.quantile(error, (0.5, 0.99))
        lost = 100.0 * float((error > WRONG_ROOT_M).mean())
        return f"p50 {p50:.3f} mm, p99 {p99:.2f} mm, {lost:.2f} % off by more than 1 cm"

    true = errors[errors <= WRONG_ROOT_M]
    return [
        Measurement(
            name=f"warp-cell look-up vs numba Broyden, {pose} pose, one-sample rays, times",
            value=times["BroydenLookup"] / times["look-up"], required="30", stretch_goal="80",
            context=f"{mega['look-up']:.1f} million points/s in random order, each a ray of its "
            f"own; Broyden (9 starts) {mega['BroydenLookup']:.2f}",
        ),
        Measurement(
            name=f"warp-cell look-up vs numba Broyden, {pose} pose, whole rays, times",
            value=along / 1e6 / mega["BroydenLookup"], required="30", stretch_goal="80",
            context=f"{along / 1e6:.1f} million points/s along the trainer's rays, when every "
            "sample that has a root stays; empty cells on the way included",
        ),
        Measurement(
            name=f"error of that look-up, {pose} pose, p99 mm",
            value=1000.0 * float(np.quantile(errors, 0.99)), required="< 2", stretch_goal="< 1",
            context=f"{told(errors)}; p99 of the others {1000 * np.quantile(true, 0.99):.2f} mm; "
            f"Broyden: {told(broyden)}; points of occupied cells, {100 * bent:.0f} % of them in "
            "bent cells, where a second-order term corrects",
        ),
    ]  # fmt: skip


F32, I32 = np.float32, np.int32


@compile_kernel(cache=False, **FAST_MATH)  # what it calls lies in another folder
def _nearest_density_roots(
    points, transforms, low, nodes_per_m, inverse_bones, occupied, density, cells_per_m, out
):
    blend, inverse = np.empty(MATRIX_LANES, np.float32), np.empty(9, np.float32)
    x = np.empty(3, np.float32)
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        best = F32(-1)
        out[i, 0] = out[i, 1] = out[i, 2] = F32(1e3)
        for bone in range(inverse_bones.shape[0]):
            x[0], x[1], x[2] = transform_point(inverse_bones[bone], px, py, pz)
            if not solve_root(transforms, low, nodes_per_m, points[i], x, blend, inverse, True):
                continue
            a = I32(np.floor((x[0] - low[0]) * cells_per_m[0]))
            b = I32(np.floor((x[1] - low[1]) * cells_per_m[1]))
            c = I32(np.floor((x[2] - low[2]) * cells_per_m[2]))
            if a < 0 or b < 0 or c < 0:
                continue
            if a >= occupied.shape[0] or b >= occupied.shape[1] or c >= occupied.shape[2]:
                continue
            if occupied[a, b, c] != 0 and density[a, b, c] > best:
                best = density[a, b, c]
                out[i, 0], out[i, 1], out[i, 2] = x[0], x[1], x[2]


class BroydenLookup:
    """Root finding in one pose; of several roots the one of highest cached density counts."""

    def __init__(
        self, rig: Rig, joint_rotations: Float[np.ndarray, "23 3"], grid: DensityGrid
    ) -> None:
        bones = rig.body_from_canonical(joint_rotations)
        flat = np.zeros((24, MATRIX_LANES), dtype=np.float32)
        flat[:, :12] = bones[:, :3].reshape(24, 12)
        inverses = np.linalg.inv(bones[list(START_BONES)])[:, :3].reshape(-1, 12)
        nodes = np.array(rig.weights.shape[:3], dtype=np.float32) - 1
        self._given = (
            np.ascontiguousarray(rig.weights @ flat),
            rig.box_low,
            nodes / (rig.box_high - rig.box_low),
            np.ascontiguousarray(inverses, dtype=np.float32),
            grid.occupied.cpu().numpy(),
            grid.density.cpu().numpy(),
            grid.cells_per_m.cpu().numpy(),
        )

    def __call__(self, points: Float32[np.ndarray, "points 3"]) -> Float32[np.ndarray, "points 3"]:
        """Canonical points; far outside the box where nothing was found."""
        out = np.empty_like(points)
        _nearest_density_roots(points, *self._given, out)
        return out
