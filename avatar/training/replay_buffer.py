"""Replay buffer: the keyframes that are kept, and the rays sampled from them.

Training on the newest frames alone loses 5-9 dB on the oldest, so rays are drawn uniformly from all
kept frames. Drawing half of them in proportion to the frames' errors followed the frames whose
poses or masks were wrong, and lost 0.3 dB.

The draws are compiled: in torch and numpy they are fifty operations on small arrays, 1.5 core-ms a
step.
"""

from dataclasses import replace
from typing import NamedTuple, final

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from avatar.correspondence_grid import CORRESPONDENCE_CELL_M, CorrespondenceGrid
from avatar.kernels.kernel_compiler import FAST_MATH, INLINED, compile_kernel, prefetch
from avatar.kernels.operands import CorrespondenceTables, RayBatch
from avatar.kernels.threads import run_threads
from avatar.training.frame_stream import TrainingFrame, view_descriptor
from avatar.training.pose_optimizer import RootCorrection
from avatar.training.training_pixels import RayView, TrainingPixels
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose

NEAR_PERSON_RAY_SHARE = 0.9
"""Share of the rays that pass through pixels near the person."""
HEAD_SIDE_RAY_SHARE = 0.5
"""Share of the rays near the person that are drawn from the image of the head, where people look,
if it has as many pixels as the person in the whole frame; it falls with their square root, to 0.15
where the video is not reduced."""
MAX_HEAD_RAY_SHARE = 0.35
"""Largest share of these rays."""
PICTURES = 2
"""Images of a slot: the whole frame, and the head in the video's own resolution."""
F32, I32 = np.float32, np.int32
SIGHT_SPACING_PX = 8
"""Distance of the pixels whose directions are kept, px; others are interpolated: exact but for
rounding for a lens without distortion, to about 0.02 px for a strongly bent one."""


class ReplayFrame(NamedTuple):
    """The part of a frame that has to be saved to train on it again.

    `colors` are premultiplied RGBA of the pixels near the person; `head` has a view and colors of
    its own, if there is an image of it.
    """

    index: int
    pose: BodyPose
    view: RayView
    colors: UInt8[np.ndarray, "pixels 4"]
    head: tuple[RayView, UInt8[np.ndarray, "pixels 4"]] | None


class TrainingBatch(NamedTuple):
    """Rays and their ground truth, premultiplied color and alpha in [0, 1].

    `world_from_body` are rotations from the rays' body frames to the world.
    """

    rays: RayBatch
    target: Float32[Tensor, "rays 4"]
    world_from_body: Float32[Tensor, "rays 3 3"]


@final
class ReplayBuffer:
    """Bounded buffer of prepared frames with distinct views and poses, one slot each."""

    def __init__(self, capacity: int) -> None:
        """Starts empty, for at most `capacity` frames."""
        self.capacity = capacity
        self.frame_indices: list[int] = []
        self._poses_and_views: list[tuple[BodyPose, RayView, RayView | None]] = []
        self._descriptors = np.zeros((capacity, 3 + 69))
        self._descriptor_distances = np.full((capacity, capacity), np.inf)
        pictures = PICTURES * capacity
        self._pixels = np.zeros((pictures, 4), dtype=np.int64)
        self._runs = torch.zeros(pictures, 1, 2, dtype=torch.int32)
        self._sights = torch.zeros(pictures, 1, 2)
        self._colors = torch.zeros(pictures, 1, 4, dtype=torch.uint8)
        self._given_origins = np.zeros((capacity, 3))
        self._origins = np.zeros((capacity, 3), dtype=np.float32)
        self._body_from_camera = np.zeros((capacity, 3, 3))
        self._turns = np.zeros((capacity, 3, 3), dtype=np.float32)
        self._world_from_camera = np.zeros((capacity, 3, 3), dtype=np.float32)
        self.clear_correspondences()

    def __len__(self) -> int:
        """Number of frames that are held."""
        return len(self.frame_indices)

    @property
    def correspondences(self) -> CorrespondenceTables:
        """Correspondence grids of all slots."""
        return CorrespondenceTables(
            self._index, self._roots, self._low, self._shape, CORRESPONDENCE_CELL_M
        )

    def add(self, frame: TrainingFrame) -> int:
        """Adds a frame, and returns its slot.

        A full buffer drops the more redundant of its two most similar frames.
        """
        if len(self) < self.capacity:
            slot = len(self)
            self.frame_indices.append(frame.index)
            self._poses_and_views.append((frame.pose, frame.view, None))
        else:
            slot = self._most_redundant_slot()
            self.frame_indices[slot] = frame.index
        head_view = frame.head and frame.head.view
        self._poses_and_views[slot] = frame.pose, frame.view, head_view
        held, descriptor = len(self), view_descriptor(frame.origin, frame.pose)
        self._descriptors[slot] = descriptor
        gap = np.linalg.norm(self._descriptors[:held] - descriptor, axis=1)
        gap[slot] = np.inf
        self._descriptor_distances[slot, :held] = self._descriptor_distances[:held, slot] = gap
        self._store_frame(slot, frame)
        return slot

    def replay_frames(self) -> list[ReplayFrame]:
        """The frames as they are saved, for training on them again."""
        kept = []
        for slot, (pose, view, head_view) in enumerate(self._poses_and_views):
            colors, head_colors = (
                self._colors[picture, : self._pixels[picture, 0]].numpy().copy()
                for picture in range(PICTURES * slot, PICTURES * (slot + 1))
            )
            head = None if head_view is None else (head_view, head_colors)
            kept.append(ReplayFrame(self.frame_indices[slot], pose, view, colors, head))
        return kept

    def clear_correspondences(self) -> None:
        """Empties the correspondence grids of all slots, which take most of the buffer's memory.

        Rays of the frames then miss the person: to be called after the last step.
        """
        self._low = torch.zeros(self.capacity, 3)
        self._shape = torch.ones(self.capacity, 3, dtype=torch.int32)
        self._index = torch.zeros(self.capacity, 1, dtype=torch.int32)
        self._roots = torch.zeros(self.capacity, 1, 12)

    def set_correspondences(self, slot: int, correspondences: CorrespondenceGrid) -> None:
        """Gives a slot the warp of its frame's pose."""
        self._index = self._store_rows(self._index, slot, correspondences.packed_cells.reshape(-1))
        self._roots = self._store_rows(self._roots, slot, correspondences.roots)
        self._low[slot] = torch.from_numpy(correspondences.low)
        self._shape[slot] = torch.tensor(correspondences.packed_cells.shape, dtype=torch.int32)

    def correct_root(self, slot: int, correction: RootCorrection) -> None:
        """Lets a slot's rays follow its corrected root."""
        _follow_root(
            *correction, self._given_origins[slot], self._body_from_camera[slot],
            self._origins[slot], self._turns[slot],
        )  # fmt: skip

    def sample_rays(self, count: int, generator: torch.Generator) -> TrainingBatch:
        """Draws rays from the kept frames."""
        # its frame, near the person or not, its pixel, the head or not, where its samples begin
        chances = torch.rand(5, count, generator=generator)
        slots = np.empty(count, dtype=np.int32)
        origins, directions = np.empty((2, count, 3), dtype=np.float32)
        targets = np.empty((count, 4), dtype=np.float32)
        world_from_body = np.empty((count, 3, 3), dtype=np.float32)
        run_threads(
            draw_rays, chances.numpy(), len(self),
            (NEAR_PERSON_RAY_SHARE, HEAD_SIDE_RAY_SHARE, MAX_HEAD_RAY_SHARE),
            self._pixels, self._runs.numpy(), self._sights.numpy(), self._colors.numpy(),
            self._origins, self._turns, self._world_from_camera,
            slots, origins, directions, targets, world_from_body,
        )  # fmt: skip
        rays = RayBatch(
            origins=torch.from_numpy(origins),
            directions=torch.from_numpy(directions),
            slots=torch.from_numpy(slots),
            jitter=chances[-1],
        )
        return TrainingBatch(rays, torch.from_numpy(targets), torch.from_numpy(world_from_body))

    def _store_frame(self, slot: int, frame: TrainingFrame) -> None:
        self.set_correspondences(slot, frame.correspondences)
        body = TrainingPixels(frame.view, frame.pixels, frame.colors)
        for picture, part in enumerate((body, frame.head), start=PICTURES * slot):
            self._pixels[picture] = 0
            if part is None:
                continue
            camera, runs = part.view.camera, part.runs
            rows = np.stack([runs.ends, runs.shifts], axis=1)
            self._runs = self._store_rows(self._runs, picture, rows)
            self._sights = self._store_rows(self._sights, picture, _sights_on_a_grid(camera))
            self._colors = self._store_rows(self._colors, picture, part.colors)
            self._pixels[picture] = runs.near_count, runs.count, camera.size_px[0], len(rows)
        self._given_origins[slot] = self._origins[slot] = frame.origin
        self._body_from_camera[slot] = self._turns[slot] = frame.body_from_camera
        self._world_from_camera[slot] = frame.view.camera.camera_from_world[:3, :3].T

    def _store_rows(self, store: Tensor, row: int, values: np.ndarray) -> Tensor:
        """Writes a row; a store that is too narrow becomes a quarter wider than needed."""
        needed = len(values)
        if needed > store.shape[1]:
            width = needed + needed // 4
            # untouched pages cost nothing; numpy, not torch, asks for those of 2 MiB
            room = np.empty((len(store), width, *store.shape[2:]), dtype=values.dtype)
            wider, held = torch.from_numpy(room), len(store) // self.capacity * len(self)
            wider[:held, : store.shape[1]] = store[:held]
            store = wider
        store[row, :needed] = torch.from_numpy(values)
        return store

    def _most_redundant_slot(self) -> int:
        """The slot, of the two most similar frames', that is closer to a third."""
        first, second = np.unravel_index(
            self._descriptor_distances.argmin(), self._descriptor_distances.shape
        )
        pair = self._descriptor_distances[[first, second]]
        pair[:, [first, second]] = np.inf
        return int((first, second)[int(pair.min(axis=1).argmin())])


def _sights_on_a_grid(camera: Camera) -> Float32[np.ndarray, "nodes 2"]:
    """Points of the plane at depth 1 that every `SIGHT_SPACING_PX`-th pixel sees, row by row."""
    width, height = camera.size_px
    nodes = (SIGHT_SPACING_PX * np.arange(side // SIGHT_SPACING_PX + 2) for side in (width, height))
    pixels = np.stack(np.meshgrid(*nodes), axis=-1).reshape(-1, 2) + 0.5
    sights = replace(camera, camera_from_world=np.eye(4)).ray_directions(pixels)
    return (sights[:, :2] / sights[:, 2:]).astype(np.float32)


@compile_kernel(**FAST_MATH)
def _follow_root(rotation, shift, pivot, given_origin, body_from_camera, origin, turns):
    """Writes a frame's origin of rays and its rotation by `RootCorrection`'s numbers."""
    for i in range(3):
        place = pivot[i]
        for k in range(3):
            place += rotation[k, i] * (given_origin[k] - pivot[k] - shift[k])
        origin[i] = place
        for j in range(3):
            turned = 0.0
            for k in range(3):
                turned += rotation[k, i] * body_from_camera[k, j]
            turns[i, j] = turned


@compile_kernel(**INLINED)
def _sight(sights, picture, width, flat):
    """Unit direction of a pixel in its camera's axes, between the four kept ones about it."""
    row, column = flat // width, flat % width
    columns = width // SIGHT_SPACING_PX + 2
    i, j = row // SIGHT_SPACING_PX, column // SIGHT_SPACING_PX
    b = F32(row - i * SIGHT_SPACING_PX) * F32(1.0 / SIGHT_SPACING_PX)
    a = F32(column - j * SIGHT_SPACING_PX) * F32(1.0 / SIGHT_SPACING_PX)
    n = i * columns + j
    m = n + columns
    p, q, r, s = (F32(1) - a) * (F32(1) - b), a * (F32(1) - b), (F32(1) - a) * b, a * b
    x = (
        p * sights[picture, n, 0] + q * sights[picture, n + 1, 0]
        + r * sights[picture, m, 0] + s * sights[picture, m + 1, 0]
    )  # fmt: skip
    y = (
        p * sights[picture, n, 1] + q * sights[picture, n + 1, 1]
        + r * sights[picture, m, 1] + s * sights[picture, m + 1, 1]
    )  # fmt: skip
    z = F32(1) / np.sqrt(x * x + y * y + F32(1))
    return x * z, y * z, z


@compile_kernel(**INLINED)
def _find_runs(runs, pixels, pictures, numbers, found):
    """The run that holds each ray's pixel: binary searches, a step of all rays at a time.

    Each step waits for memory; steps of different rays wait together.
    """
    step, most = 1, 1
    for picture in range(pixels.shape[0]):
        most = max(most, pixels[picture, 3])
    while 2 * step < most:
        step *= 2
    for ray in range(pictures.shape[0]):
        found[ray] = 0
    while step > 0:
        for ray in range(pictures.shape[0]):
            picture, run = pictures[ray], found[ray] + step
            if run < pixels[picture, 3] and runs[picture, run - 1, 0] <= numbers[ray]:
                found[ray] = run
        step //= 2


@compile_kernel(nogil=True, error_model="numpy")
def draw_rays(
    thread, threads, chances, frames, shares, pixels, runs, sights, colors, all_origins, turns,
    world_from_camera, slots, origins, directions, targets, world_from_body,
):  # fmt: skip
    """Draws rays uniformly from the frames, in their order; the last five arguments are written.

    A slot has two pictures, 2 * slot: the whole frame, and 2 * slot + 1: the head.

    Args:
        chances: Random numbers in [0, 1) (5, rays): frame, near the person or not, pixel, head or
            not; the last row is not read.
        frames: Number of frames, whose slots are the first.
        shares: Share of the rays near the person, and of these, of those in the head's picture: if
            it has as many pixels as the whole frame's person, and at most.
        pixels: Of each picture: numbers of pixels near the person and of all (0: there is none),
            width, number of runs (pictures, 4).
        runs: `PixelRuns.ends` and `shifts` (pictures, runs, 2).
        sights: Points of the plane at depth 1 seen by every `SIGHT_SPACING_PX`-th pixel (pictures,
            nodes, 2).
        colors: Premultiplied RGBA of the pixels near the person (pictures, pixels, 4).
        all_origins, turns: Origin of the rays and body-from-camera rotation of each slot.
        world_from_camera: Rotation of each slot's camera.
    """
    rays, stop = slots.shape[0], 0
    first, last = rays * thread // threads, rays * (thread + 1) // threads
    drawn, numbers, found = np.zeros(frames, I32), np.empty(rays, np.int64), np.empty(rays, I32)
    pictures = np.empty(rays, I32)
    for n in range(rays):
        drawn[min(I32(chances[0, n] * F32(frames)), frames - 1)] += 1
    for slot in range(frames):
        near, count, head = pixels[2 * slot, 0], pixels[2 * slot, 1], pixels[2 * slot + 1, 0]
        start, stop = stop, stop + drawn[slot]
        in_head = min(F32(shares[1]) * np.sqrt(F32(head) / F32(near)), F32(shares[2]))
        for ray in range(max(start, first), min(stop, last)):
            place, far = chances[2, ray], count - near
            picture, number = 2 * slot, near + np.int64(place * F32(far))
            if chances[1, ray] < F32(shares[0]) or far == 0:
                number = np.int64(place * F32(near))
                if chances[3, ray] < in_head:
                    picture, number = picture + 1, np.int64(place * F32(head))
            slots[ray], pictures[ray] = slot, picture
            numbers[ray] = min(number, pixels[picture, 1] - 1)
            prefetch(colors[picture], numbers[ray], 0)
    part = slice(first, last)
    _find_runs(runs, pixels[: 2 * frames], pictures[part], numbers[part], found[part])
    for ray in range(first, last):
        slot, picture, number = slots[ray], pictures[ray], numbers[ray]
        turn, camera = turns[slot], world_from_camera[slot]
        flat = number + runs[picture, found[ray], 1]
        x, y, z = _sight(sights, picture, pixels[picture, 2], flat)
        for q in range(4):
            color = colors[picture, number, q] if number < pixels[picture, 0] else 0
            targets[ray, q] = F32(color) / F32(255)
        for i in range(3):
            origins[ray, i] = all_origins[slot, i]
            directions[ray, i] = turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z
            for k in range(3):
                world_from_body[ray, i, k] = (
                    camera[i, 0] * turn[k, 0] + camera[i, 1] * turn[k, 1]
                    + camera[i, 2] * turn[k, 2]
                )  # fmt: skip
