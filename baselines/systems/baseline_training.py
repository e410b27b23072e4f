"""The one trainer of all baselines: frames, rays, compositor, losses, poses and decay."""

from itertools import product
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor, nn

from avatar.render import body_frame_rays, pixel_chunks
from avatar.training.frame_stream import TrainingFrame
from avatar.training.replay_buffer import NEAR_PERSON_RAY_SHARE
from avatar.training.trainer import UncompiledAdam, cosine_decay
from baselines.systems.method_settings import MethodSettings
from baselines.systems.posed_person import OccupiedCells, PoseTable, SkinnedPerson
from baselines.systems.ray_rendering import BodyRays, PosedRadiance, render_rays
from capture.camera import Camera
from preprocess.observation import Observation

RENDERED_RAYS = 4096
"""Rays that are rendered together."""


@final
class BaselineSystem:
    """A method in training.

    Attributes:
        field: The method.
        poses: Poses of the training frames.
        steps: Steps done.
    """

    def __init__(
        self,
        field: PosedRadiance,
        person: SkinnedPerson,
        frames: list[TrainingFrame],
        settings: MethodSettings,
    ) -> None:
        """Takes in all frames; nothing is trained yet."""
        self.field, self.steps = field, 0
        self.poses = PoseTable(person, frames)
        self._person, self._settings = person, settings
        self._origins = torch.stack([torch.from_numpy(frame.origin) for frame in frames])
        self._directions = [torch.from_numpy(frame.directions()) for frame in frames]
        self._colors = [torch.from_numpy(frame.colors) for frame in frames]
        groups: list[dict[str, Any]] = list(field.parameter_groups())
        if settings.pose_rate:
            groups.append({"params": list(self.poses.parameters()), "lr": settings.pose_rate})
        self._rates = [float(group["lr"]) for group in groups]
        self._optimizer = UncompiledAdam(groups, betas=(0.9, 0.99))

    def step(self, progress: float) -> float:
        """Makes one step; returns its loss.

        Args:
            progress: Share of the budget that is used up; the learning rates fall with it.
        """
        wanted, settings = min(self._settings.frames, len(self._colors)), self._settings
        frames = torch.randperm(len(self._colors))[:wanted]
        rays, target = self._draw_rays(frames, settings.rays // wanted)
        with torch.set_grad_enabled(settings.pose_rate > 0.0):
            bodies = self.poses.bodies(frames)
            origins, directions = self.poses.move_rays(
                rays.origins, rays.directions, frames[rays.bodies]
            )
        rays = rays._replace(origins=origins, directions=directions)
        cells = self.field.pose(bodies)
        rendered = render_rays(
            self.field, cells, rays, samples=settings.samples, fine_samples=settings.fine_samples,
            jitters=True,
        )  # fmt: skip
        background = torch.rand(len(target), 3)
        loss = self.field.prior_loss()
        for colors in rendered:
            missing = (target - colors)[:, 3:] * background
            loss = loss + ((colors - target)[:, :3] + missing).square().mean()
            loss = loss + settings.alpha_weight * (colors - target)[:, 3].abs().mean()
        self._optimizer.zero_grad(set_to_none=False)
        loss.backward()
        for group, rate in zip(self._optimizer.param_groups, self._rates, strict=True):
            group["lr"] = rate * cosine_decay(progress)
        self._optimizer.step()
        self.steps += 1
        return float(loss.detach())

    def _draw_rays(
        self, frames: Int64[Tensor, "frames"], count: int
    ) -> tuple[BodyRays, Float32[Tensor, "rays 4"]]:
        """As many rays of each frame, mostly near the person, and their premultiplied RGBA."""
        origins, directions, targets = [], [], []
        for frame in frames.tolist():
            near, total = len(self._colors[frame]), len(self._directions[frame])
            wants_near = (torch.rand(count) < NEAR_PERSON_RAY_SHARE) | (total == near)
            place = torch.rand(count)
            pixel = torch.where(wants_near, place * near, near + place * (total - near)).long()
            pixel = pixel.clamp(max=total - 1)
            color = self._colors[frame][pixel.clamp(max=near - 1)].float() / 255.0
            targets.append(color * (pixel < near)[:, None])
            directions.append(self._directions[frame][pixel])
            origins.append(self._origins[frame].expand(count, 3))
        bodies = torch.arange(len(frames)).repeat_interleave(count)
        return BodyRays(torch.cat(origins), torch.cat(directions), bodies), torch.cat(targets)

    @torch.no_grad()
    def render(self, observation: Observation) -> Float32[np.ndarray, "height width 4"]:
        """Renders a pose as a premultiplied RGBA image in [0, 1]."""
        pose, camera = observation.pose, observation.camera
        joints = torch.from_numpy(pose.joint_rotations).float()[None]
        self._set_training(False)
        cells = self.field.pose(self._person.pose(joints, torch.tensor([-1])))
        world_from_body = self._person.rig.world_from_body(pose)
        width, height = camera.size_px
        picture = np.zeros((height, width, 4), dtype=np.float32)
        rows, columns = _seen_part(cells, camera, world_from_body)
        for part, pixels in pixel_chunks(picture[rows, columns], rows.start, columns.start):
            rays = body_frame_rays(pixels, camera, world_from_body)
            parts = zip(
                rays.origins.split(RENDERED_RAYS), rays.directions.split(RENDERED_RAYS), strict=True
            )
            colors = [self._render_part(cells, *some).numpy() for some in parts]
            part[:] = np.concatenate(colors).reshape(part.shape)
        self._set_training(True)
        return picture

    def _render_part(
        self,
        cells: OccupiedCells,
        origins: Float32[Tensor, "rays 3"],
        directions: Float32[Tensor, "rays 3"],
    ) -> Float32[Tensor, "rays 4"]:
        count, settings = len(directions), self._settings
        bodies = torch.zeros(count, dtype=torch.int64)
        rays = BodyRays(origins, directions, bodies)
        return render_rays(
            self.field, cells, rays, samples=settings.samples, fine_samples=settings.fine_samples,
            jitters=False,
        )[-1]  # fmt: skip

    def _set_training(self, trains: bool) -> None:
        if isinstance(self.field, nn.Module):
            self.field.train(trains)


def _seen_part(
    cells: OccupiedCells, camera: Camera, world_from_body: Float[np.ndarray, "4 4"]
) -> tuple[slice, slice]:
    """Rows and columns of the picture where a body's cells can be seen; all if it is too near."""
    low, size = cells.low[0].numpy(), cells.shape[0].numpy() * cells.cell_m
    corners = low + np.array(list(product((0.0, 1.0), repeat=3))) * size
    corners = corners @ world_from_body[:3, :3].T + world_from_body[:3, 3]
    view, (width, height) = camera.camera_from_world[2], camera.size_px
    if (corners @ view[:3] + view[3]).min() <= 0.0 or camera.distortion:
        return slice(0, height), slice(0, width)
    pixels = camera.project(corners)
    first = np.clip(np.floor(pixels.min(axis=0)), 0, (width, height)).astype(int)
    last = np.clip(np.ceil(pixels.max(axis=0)), first, (width, height)).astype(int)
    return slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0]))
