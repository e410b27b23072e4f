"""Replay buffer: the keyframes that are kept, and the rays sampled from them.

Training on the newest frames alone loses 5-9 dB on the oldest, so rays are drawn uniformly from all
kept frames. Drawing half of them in proportion to the frames' errors followed the frames whose
poses or masks were wrong, and lost 0.3 dB.
"""

from dataclasses import replace
from typing import Any, NamedTuple, final

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32, Int64, UInt8
from torch import Tensor

from avatar.correspondence_grid import CORRESPONDENCE_CELL_M, CorrespondenceGrid
from avatar.kernels.backend_protocol import CorrespondenceTables, RayBatch
from avatar.rig import Rig
from avatar.training.frame_stream import (
    PixelRuns,
    RayView,
    TrainingFrame,
    camera_in_body,
    view_descriptor,
)
from avatar.training.pose_optimizer import RootCorrection
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose

NEAR_PERSON_RAY_SHARE = 0.9
"""Share of the rays that pass through pixels near the person."""
HEAD_RAY_SHARE = 0.15
"""Share of the rays near the person that are drawn from the rows of the head alone, where people
look; the others are drawn from all rows."""
PIXEL_KEYS_PER_SLOT = 1 << 32
"""Distance of the slots' keys in the search for a pixel's run; no image has as many pixels."""


class ReplayFrame(NamedTuple):
    """The part of a frame that has to be saved to train on it again.

    Attributes:
        index: Index of the frame in its source.
        pose: The tracker's pose.
        view: Camera and pixels.
        colors: Premultiplied RGBA of the pixels near the person.
    """

    index: int
    pose: BodyPose
    view: RayView
    colors: UInt8[np.ndarray, "pixels 4"]


class TrainingBatch(NamedTuple):
    """Rays and their ground truth.

    Attributes:
        rays: Rays in the body frames of their slots.
        target: Premultiplied color and alpha, in [0, 1].
        world_from_body: Rotations from the rays' body frames to the world.
    """

    rays: RayBatch
    target: Float32[Tensor, "rays 4"]
    world_from_body: Float32[Tensor, "rays 3 3"]


class _RunTable(NamedTuple):
    """Runs of pixels of all slots, one after the other.

    Attributes:
        ends: `PixelRuns.ends` plus the slot's multiple of `PIXEL_KEYS_PER_SLOT`: rising.
        shifts: `PixelRuns.shifts`.
    """

    ends: Int64[np.ndarray, "runs"]
    shifts: Int32[np.ndarray, "runs"]


@final
class ReplayBuffer:
    """Bounded buffer of prepared frames with distinct views and poses, one slot each.

    Attributes:
        frame_indices: Index in its source of the frame that each slot holds.
    """

    def __init__(self, capacity: int, device: torch.device) -> None:
        """Starts empty, for at most `capacity` frames."""
        self.capacity = capacity
        self.device = device
        self.frame_indices: list[int] = []
        self._poses_and_views: list[tuple[BodyPose, RayView]] = []
        self._descriptors = np.zeros((capacity, 3 + 69))
        self._descriptor_distances = np.full((capacity, capacity), np.inf)
        self._near = torch.zeros(capacity, dtype=torch.int64, device=device)
        self._far = torch.zeros(capacity, dtype=torch.int64, device=device)
        self._head = torch.zeros(capacity, 2, dtype=torch.int64, device=device)
        self._given_origins = np.zeros((capacity, 3))
        self._origins = torch.zeros(capacity, 3, device=device)
        self._body_from_camera = np.zeros((capacity, 3, 3))
        self._turns = torch.zeros(capacity, 3, 3, device=device)
        self._world_from_camera = torch.zeros(capacity, 3, 3, device=device)
        self.clear_correspondences()
        self._lenses: list[Camera] = []
        self._lens_numbers: dict[tuple[Any, ...], int] = {}
        self._lens = np.zeros(capacity, dtype=np.int64)
        self._runs: list[PixelRuns] = []
        self._run_table: _RunTable | None = None
        self._colors = torch.zeros(capacity, 1, 4, dtype=torch.uint8, device=device)

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
        """Adds a frame; a full buffer drops the more redundant of its two most similar frames.

        Returns:
            The slot of the frame.
        """
        if len(self) < self.capacity:
            slot = len(self)
            self.frame_indices.append(frame.index)
            self._poses_and_views.append((frame.pose, frame.view))
        else:
            slot = self._most_redundant_slot()
            self.frame_indices[slot] = frame.index
            self._poses_and_views[slot] = frame.pose, frame.view
        self._update_distances(slot, view_descriptor(frame.origin, frame.pose))
        self._store_frame(slot, frame)
        return slot

    def replay_frames(self) -> list[ReplayFrame]:
        """The frames as they are saved, for training on them again."""
        kept = []
        for slot, (pose, view) in enumerate(self._poses_and_views):
            colors = self._colors[slot, : int(self._near[slot])].cpu().numpy().copy()
            kept.append(ReplayFrame(self.frame_indices[slot], pose, view, colors))
        return kept

    def clear_correspondences(self) -> None:
        """Empties the correspondence grids of all slots, which take most of the buffer's memory.

        Rays of the frames then miss the person: to be called after the last step.
        """
        self._low = torch.zeros(self.capacity, 3, device=self.device)
        self._shape = torch.ones(self.capacity, 3, dtype=torch.int32, device=self.device)
        self._index = torch.zeros(self.capacity, 1, dtype=torch.int32, device=self.device)
        self._roots = torch.zeros(self.capacity, 1, 12, device=self.device)

    def set_correspondences(self, slot: int, correspondences: CorrespondenceGrid) -> None:
        """Gives a slot the warp of its frame's pose."""
        self._index = self._store_rows(self._index, slot, correspondences.packed_cells.reshape(-1))
        self._roots = self._store_rows(self._roots, slot, correspondences.roots)
        self._low[slot] = torch.from_numpy(correspondences.low).to(self.device)
        self._shape[slot] = torch.tensor(correspondences.packed_cells.shape, dtype=torch.int32)

    def set_pose(self, slot: int, pose: BodyPose, rig: Rig) -> None:
        """Gives a slot's frame another pose; `set_correspondences` and `correct_root` follow."""
        view = self._poses_and_views[slot][1]
        self._poses_and_views[slot] = pose, view
        origin, self._body_from_camera[slot] = camera_in_body(view.camera, pose, rig)
        self._given_origins[slot] = origin
        self._update_distances(slot, view_descriptor(origin, pose))

    def correct_root(self, slot: int, correction: RootCorrection) -> None:
        """Lets a slot's rays follow its corrected root."""
        turn = correction.rotation.T
        origin = correction.pivot + turn @ (
            self._given_origins[slot] - correction.pivot - correction.shift
        )
        self._origins[slot] = torch.from_numpy(origin).to(self._origins)
        self._turns[slot] = torch.from_numpy(turn @ self._body_from_camera[slot]).to(self._turns)

    def sample_rays(self, count: int, generator: torch.Generator) -> TrainingBatch:
        """Draws rays from the kept frames.

        Args:
            count: How many.
            generator: On the store's device.
        """

        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, device=self.device)

        slot = torch.randint(len(self), (count,), generator=generator, device=self.device).sort()[0]
        near, far = self._near[slot], self._far[slot]
        wants_near = (uniform(count) < NEAR_PERSON_RAY_SHARE) | (far == 0)
        place = uniform(count)
        first, last = self._head[slot].unbind(dim=1)
        wants_head = wants_near & (last > first) & (uniform(count) < HEAD_RAY_SHARE)
        pixel = torch.where(wants_near, (place * near).long(), near + (place * far).long())
        pixel = torch.where(wants_head, first + (place * (last - first)).long(), pixel)
        pixel = torch.minimum(pixel, near + far - 1)
        rays = RayBatch(
            self._origins[slot],
            (self._turns[slot] @ self._camera_directions(slot, pixel)[..., None])[..., 0],
            slot.int(),
            uniform(count),
        )
        color = self._colors[slot, torch.minimum(pixel, near - 1)].float() / 255.0
        world_from_body = self._world_from_camera[slot] @ self._turns[slot].transpose(1, 2)
        return TrainingBatch(rays, color * (pixel < near)[:, None], world_from_body)

    def _camera_directions(
        self, slot: Int64[Tensor, "rays"], pixel: Int64[Tensor, "rays"]
    ) -> Float32[Tensor, "rays 3"]:
        """Unit directions of numbered pixels in the axes of their slots' cameras."""
        if self._run_table is None:
            keys = PIXEL_KEYS_PER_SLOT * np.arange(len(self))
            ends = [runs.ends + key for runs, key in zip(self._runs, keys, strict=True)]
            shifts = [runs.shifts for runs in self._runs]
            self._run_table = _RunTable(np.concatenate(ends), np.concatenate(shifts))
        slots, pixels = slot.cpu().numpy(), pixel.cpu().numpy()
        run = self._run_table.ends.searchsorted(pixels + slots * PIXEL_KEYS_PER_SLOT, side="right")
        flat, lens = pixels + self._run_table.shifts[run], self._lens[slots]
        directions = np.empty((len(flat), 3), dtype=np.float32)
        for number in np.unique(lens):
            mine, camera = lens == number, self._lenses[number]
            row, column = np.divmod(flat[mine], camera.size_px[0])
            directions[mine] = camera.ray_directions(np.stack([column, row], axis=-1) + 0.5)
        return torch.from_numpy(directions).to(self.device)

    def _lens_number(self, camera: Camera) -> int:
        """The number of a camera's lens; cameras that only move share one."""
        lens = camera.focal_px, camera.center_px, camera.size_px, camera.distortion
        number = self._lens_numbers.setdefault(lens, len(self._lenses))
        if number == len(self._lenses):
            self._lenses.append(replace(camera, camera_from_world=np.eye(4)))
        return number

    def _store_frame(self, slot: int, frame: TrainingFrame) -> None:
        self.set_correspondences(slot, frame.correspondences)
        self._lens[slot] = self._lens_number(frame.view.camera)
        self._runs[slot:] = [frame.pixels, *self._runs[slot + 1 :]]
        self._run_table = None
        self._colors = self._store_rows(self._colors, slot, frame.colors)
        self._given_origins[slot] = frame.origin
        self._origins[slot] = torch.from_numpy(frame.origin).to(self.device)
        self._body_from_camera[slot] = frame.body_from_camera
        self._turns[slot] = torch.from_numpy(frame.body_from_camera).to(self.device)
        camera_from_world = frame.view.camera.camera_from_world[:3, :3]
        self._world_from_camera[slot] = torch.from_numpy(camera_from_world.T.copy()).to(
            self._world_from_camera
        )
        self._near[slot] = frame.pixels.near_count
        self._far[slot] = frame.pixels.count - frame.pixels.near_count
        self._head[slot] = torch.tensor(frame.head_pixels)

    def _store_rows(self, store: Tensor, slot: int, values: np.ndarray) -> Tensor:
        """Writes one slot; a store that is too narrow becomes a quarter wider than needed."""
        needed = len(values)
        if needed > store.shape[1]:
            width = needed + needed // 4
            # untouched memory costs nothing: pages are committed when they are written
            wider = torch.empty(
                self.capacity, width, *store.shape[2:], dtype=store.dtype, device=self.device
            )
            held = len(self)
            wider[:held, : store.shape[1]] = store[:held]
            store = wider
        store[slot, :needed] = torch.from_numpy(values).to(self.device)
        return store

    def _update_distances(self, slot: int, descriptor: Float[np.ndarray, " 72"]) -> None:
        """Notes how far a slot's frame is from every other."""
        held = len(self)
        self._descriptors[slot] = descriptor
        gap = np.linalg.norm(self._descriptors[:held] - descriptor, axis=1)
        gap[slot] = np.inf
        self._descriptor_distances[slot, :held] = self._descriptor_distances[:held, slot] = gap

    def _most_redundant_slot(self) -> int:
        """The slot, of the two most similar frames', that is closer to a third."""
        first, second = np.unravel_index(
            self._descriptor_distances.argmin(), self._descriptor_distances.shape
        )
        pair = self._descriptor_distances[[first, second]]
        pair[:, [first, second]] = np.inf
        return int((first, second)[int(pair.min(axis=1).argmin())])
