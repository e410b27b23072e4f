"""Replay buffer: the keyframes that are kept, and the rays sampled from them.

Training on the newest frames alone loses 5-9 dB on the oldest. Half of the rays are drawn uniformly
from all kept frames, half in proportion to each frame's running error; a new frame starts with the
largest error.
"""

from typing import NamedTuple, final

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64, UInt8
from torch import Tensor

from avatar.deformation.correspondence_grid import CORRESPONDENCE_CELL_M, CorrespondenceGrid
from avatar.kernels.backend_protocol import CorrespondenceTables, RayBatch
from avatar.pose.pose_optimizer import RootCorrection
from avatar.training.keyframe_selection import view_descriptor
from avatar.training.training_frame import RayView, TrainingFrame
from preprocess.body.body_pose import BodyPose

NEAR_PERSON_RAY_SHARE = 0.9
"""Share of the rays that pass through pixels near the person."""
ERROR_EMA_DECAY = 0.9
"""Decay of each frame's running error."""


class ReplayFrame(NamedTuple):
    """The part of a frame that has to be saved to train on it again.

    Attributes:
        index: Index of the frame in its source.
        pose: The tracker's pose.
        view: Camera and pixels.
        colors: Premultiplied RGBA of these pixels.
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
    """

    rays: RayBatch
    target: Float32[Tensor, "rays 4"]


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
        self._poses_and_views: list[tuple[BodyPose, RayView | None]] = []
        self._descriptors = np.zeros((capacity, 3 + 69))
        self._descriptor_distances = np.full((capacity, capacity), np.inf)
        self._error = torch.zeros(capacity, device=device)
        self._near = torch.zeros(capacity, dtype=torch.int64, device=device)
        self._far = torch.zeros(capacity, dtype=torch.int64, device=device)
        self._given_origins = np.zeros((capacity, 3))
        self._origins = torch.zeros(capacity, 3, device=device)
        self._turns = torch.zeros(capacity, 3, 3, device=device)
        self._low = torch.zeros(capacity, 3, device=device)
        self._shape = torch.ones(capacity, 3, dtype=torch.int32, device=device)
        self._index = torch.zeros(capacity, 1, dtype=torch.int32, device=device)
        self._roots = torch.zeros(capacity, 1, 12, device=device)
        self._directions = torch.zeros(capacity, 1, 3, device=device)
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
        held = self._error[: len(self)]
        self._error[slot] = held.max() if float(held.max()) > 0 else 1.0
        return slot

    def replay_frames(self) -> list[ReplayFrame]:
        """The frames as they are saved, for training on them again."""
        kept = []
        for slot, (pose, sight) in enumerate(self._poses_and_views):
            if sight is not None:
                pixels = int(self._near[slot] + self._far[slot])
                colors = self._colors[slot, :pixels].cpu().numpy().copy()
                kept.append(ReplayFrame(self.frame_indices[slot], pose, sight, colors))
        return kept

    def set_correspondences(self, slot: int, correspondences: CorrespondenceGrid) -> None:
        """Gives a slot the warp of its frame's pose."""
        self._index = self._store_rows(self._index, slot, correspondences.packed_cells.reshape(-1))
        self._roots = self._store_rows(self._roots, slot, correspondences.roots)
        self._low[slot] = torch.from_numpy(correspondences.low).to(self.device)
        self._shape[slot] = torch.tensor(correspondences.packed_cells.shape, dtype=torch.int32)

    def correct_root(self, slot: int, correction: RootCorrection) -> None:
        """Lets a slot's rays follow its corrected root."""
        turn = correction.rotation.T
        origin = correction.pivot + turn @ (
            self._given_origins[slot] - correction.pivot - correction.shift
        )
        self._origins[slot] = torch.from_numpy(origin).to(self._origins)
        self._turns[slot] = torch.from_numpy(turn).to(self._turns)

    def sample_rays(self, count: int, generator: torch.Generator) -> TrainingBatch:
        """Draws rays from the kept frames.

        Args:
            count: How many.
            generator: On the store's device.
        """
        held = len(self)
        error = self._error[:held]
        chance = 0.5 / held + 0.5 * error / error.sum().clamp(min=1e-30)

        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator, device=self.device)

        slot = torch.multinomial(chance, count, replacement=True, generator=generator).sort()[0]
        near, far = self._near[slot], self._far[slot]
        wants_near = (uniform(count) < NEAR_PERSON_RAY_SHARE) | (far == 0)
        place = uniform(count)
        pixel = torch.where(wants_near, (place * near).long(), near + (place * far).long())
        pixel = torch.minimum(pixel, near + far - 1)
        rays = RayBatch(
            self._origins[slot],
            (self._turns[slot] @ self._directions[slot, pixel][..., None])[..., 0],
            slot.int(),
            uniform(count),
        )
        return TrainingBatch(rays, self._colors[slot, pixel].float() / 255.0)

    def update_errors(self, slots: Int64[Tensor, "rays"], loss: Float32[Tensor, "rays"]) -> None:
        """Updates the running error of the frames that the rays came from."""
        held = len(self)
        count = torch.bincount(slots, minlength=held)[:held]
        total = torch.bincount(slots, weights=loss.clamp(min=0.0), minlength=held)[:held]
        seen = count > 0
        mean = (total / count.clamp(min=1)).to(self._error)
        error = self._error[:held]
        error[seen] = ERROR_EMA_DECAY * error[seen] + (1.0 - ERROR_EMA_DECAY) * mean[seen]

    def _store_frame(self, slot: int, frame: TrainingFrame) -> None:
        self.set_correspondences(slot, frame.correspondences)
        self._directions = self._store_rows(self._directions, slot, frame.directions)
        self._colors = self._store_rows(self._colors, slot, frame.colors)
        self._given_origins[slot] = frame.origin
        self._origins[slot] = torch.from_numpy(frame.origin).to(self.device)
        self._turns[slot] = torch.eye(3, device=self.device)
        self._near[slot] = frame.near_count
        self._far[slot] = len(frame.colors) - frame.near_count

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
        """Of the two most similar frames, the one that is closer to a third."""
        first, second = np.unravel_index(
            self._descriptor_distances.argmin(), self._descriptor_distances.shape
        )
        pair = self._descriptor_distances[[first, second]]
        pair[:, [first, second]] = np.inf
        return int((first, second)[int(pair.min(axis=1).argmin())])
