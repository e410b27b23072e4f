"""What a picture skips: nothing that counts, and its sum is that of all lattice samples."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from avatar.avatar_model import Avatar
from avatar.correspondence_grid import (
    CorrespondenceCheck,
    CorrespondenceGrid,
    cull_cells,
    screen_bounds,
)
from avatar.kernels import operations
from avatar.kernels.operands import MAX_LOG_DENSITY, MarchSettings, RayBatch
from avatar.render import EMPTY_LOG_DENSITY, body_frame_rays, correspondence_tables, render
from baselines import torch_reference
from capture.camera import Camera
from tests.avatar_fixtures import pixel_centers


def rays_of(camera: Camera, world_from_body: np.ndarray) -> RayBatch:
    return body_frame_rays(pixel_centers(camera), camera, world_from_body)


def lattice_samples(avatar: Avatar, pose, camera, cells: CorrespondenceGrid):
    """Every sample of each ray through the cells, and which skinning carries elsewhere."""
    rays = rays_of(camera, avatar.rig.world_from_body(pose))
    how = MarchSettings(avatar.sample_step_m, math.inf, 1024)
    grid = avatar.rendering_grid()
    samples = operations.march(rays, correspondence_tables(cells), grid, how)
    assert int(samples.counts.max()) < how.max_samples
    return samples, CorrespondenceCheck.for_pose(
        avatar.rig, pose.joint_rotations, cells
    ).find_spurious(samples, rays)


def brute_force(avatar: Avatar, pose, camera, cells: CorrespondenceGrid) -> np.ndarray:
    """All of them but those, summed in double precision."""
    samples, strays = lattice_samples(avatar, pose, camera, cells)
    raw = avatar.field.raw_outputs_at(samples.points).double()
    raw[strays, 3] = EMPTY_LOG_DENSITY
    colors = torch_reference.composite(raw, samples.offsets, samples.counts, avatar.sample_step_m)
    return colors.reshape(*camera.size_px[::-1], 4).numpy()


def turned(camera: Camera, axis_angle, shift) -> Camera:
    """The camera after a motion of its own: axes and metres of the camera."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(axis_angle).as_matrix()
    motion[:3, 3] = shift
    return dataclasses.replace(camera, camera_from_world=motion @ camera.camera_from_world)


def depth_of(avatar: Avatar, pose, camera: Camera) -> float:
    chest = avatar.rig.world_from_body(pose) @ np.append(avatar.rig.rest_joints[9], 1.0)
    return float((camera.camera_from_world @ chest)[2])


@pytest.fixture(scope="module")
def avatar(learnt) -> Avatar:
    return learnt.trainer.avatar


@pytest.fixture(scope="module")
def shot(learnt):
    seen = learnt.novel.observation
    return seen.pose, seen.camera, learnt.novel.correspondences


def views(avatar, pose, camera) -> dict[str, Camera]:
    inside = [0.0, 0.0, 0.1 - depth_of(avatar, pose, camera)]
    return {
        "as filmed": camera,
        "half out of the picture": turned(camera, [0.0, 0.25, 0.0], np.zeros(3)),
        "upside down": turned(camera, [0.0, 0.0, 3.0], np.zeros(3)),
        "from within the box": turned(camera, np.zeros(3), inside),
        "through a lens that bends": dataclasses.replace(camera, distortion=(0.3, 0.1, 0.0, 0.0)),
    }


def test_a_picture_is_the_sum_over_all_lattice_samples(avatar, shot):
    pose, camera, cells = shot
    for name, seen in views(avatar, pose, camera).items():
        expected = brute_force(avatar, pose, seen, cells)
        picture = render(avatar, pose, seen, cells=cells)
        assert (expected[..., 3] > 0.5).mean() > 0.05, name
        assert np.abs(picture - expected).max() <= 1e-5, name


@pytest.fixture
def altered(avatar):
    """The same person with a density of one's own choice, and everything near the skin occupied."""

    def with_density(log_density: float) -> Avatar:
        field = avatar.field
        *rest, bias = [layer.detach().clone() for layer in field.layers]
        rest[2][:, 3], bias[3] = 0.0, log_density
        copy = object.__new__(type(field))
        copy.__dict__.update(field.__dict__, layers=[*rest, bias])
        return dataclasses.replace(avatar, field=copy)

    return with_density


@pytest.mark.parametrize("log_density", [-40.0, 0.0, 3.0, 50.0])
def test_clear_foggy_and_opaque_people_are_summed_as_exactly(altered, shot, log_density):
    pose, camera, cells = shot
    person = altered(log_density)
    expected = brute_force(person, pose, camera, cells)
    picture = render(person, pose, camera, cells=cells)
    assert np.abs(picture - expected).max() <= 1e-5
    samples, strays = lattice_samples(person, pose, camera, cells)
    there = torch.ones(len(samples.points))
    there[strays] = 0.0
    ray = torch.repeat_interleave(torch.arange(len(samples.counts)), samples.counts)
    count = torch.bincount(ray, there, minlength=len(samples.counts))
    through = math.exp(-math.exp(min(log_density, MAX_LOG_DENSITY)) * person.sample_step_m)
    alpha = 1.0 - through ** count.numpy().reshape(picture.shape[:2])
    np.testing.assert_allclose(picture[..., 3], alpha, atol=1e-5)


# --- what is skipped --------------------------------------------------------------------------


def scattered(avatar, share: float):
    """The avatar's grid with `count` random cells occupied."""
    grid = avatar.occupancy.density_grid
    chance = torch.rand(grid.occupied.shape, generator=torch.Generator().manual_seed(2))
    return grid._replace(occupied=(chance < share).to(torch.uint8))


@pytest.mark.parametrize("share", [0.0, 1e-4, 1e-2, 1.0])
def test_pruning_loses_no_sample(avatar, shot, share):
    pose, camera, cells = shot
    grid, how = scattered(avatar, share), MarchSettings(0.007, math.inf, 1024)
    rays = rays_of(camera, avatar.rig.world_from_body(pose))
    full = operations.march(rays, correspondence_tables(cells), grid, how)
    held = cull_cells(cells, grid)
    some = operations.march(rays, correspondence_tables(held), grid, how)
    assert torch.equal(some.points, full.points)
    assert torch.equal(some.counts, full.counts)
    assert ((held.packed_cells > 0) <= (cells.packed_cells > 0)).all()
    assert (len(full.points) > 0) == (share > 0.0)


def test_pruning_leaves_few_cells_that_lead_to_nothing(avatar, shot):
    grid, cells = avatar.rendering_grid(), shot[2]
    kept, whole = (cull_cells(cells, grid).packed_cells > 0).sum(), (cells.packed_cells > 0).sum()
    assert 0.2 * whole < kept < 0.85 * whole


def test_an_empty_cell_knows_how_far_off_the_next_full_one_is(avatar, shot):
    index = cull_cells(shot[2], scattered(avatar, 1e-4)).packed_cells
    full = np.argwhere(index > 0)
    for cell in np.argwhere(index <= 0)[::997]:
        assert np.abs(full - cell).max(axis=1).min() == -index[tuple(cell)]


def test_the_window_of_a_person_seen_from_afar_is_narrow(avatar, shot):
    pose, camera, cells = shot
    held = cull_cells(cells, avatar.rendering_grid())
    found = screen_bounds(held, camera, avatar.rig.world_from_body(pose))
    opaque = render(avatar, pose, camera, cells=cells)[..., 3] > 0.5
    for axis, part in enumerate(found):
        seen = np.flatnonzero(opaque.any(axis=1 - axis))
        assert [part.start, part.stop] == pytest.approx(seen[[0, -1]], abs=0.12 * camera.size_px[0])
