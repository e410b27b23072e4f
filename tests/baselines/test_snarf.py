"""SNARF: roots of rigid bones, roots of the body's own weights, and implicit gradients."""

import pytest
import torch

from baselines.systems.method_settings import MethodSettings
from baselines.systems.posed_person import SkinnedPerson, apply_affine, invert_affine
from baselines.systems.snarf import START_BONES, Snarf

TINY = MethodSettings(frames=2, rays=64, samples=8, layers=2, width=64, octaves=2)


@pytest.fixture(scope="module")
def person(rig, shaped):
    return SkinnedPerson(rig, shaped)


@pytest.fixture
def method(person):
    torch.manual_seed(0)
    return Snarf(person, TINY)


def pose(method, person, joints):
    method.pose(person.pose(torch.from_numpy(joints).float()[None], torch.tensor([-1])))


def zeros(points):
    return torch.zeros(len(points), dtype=torch.int64)


def test_the_root_of_a_rigid_bone_is_its_inverse(method, person, bent_pose):
    pose(method, person, bent_pose)
    bone = 4
    with torch.no_grad():  # the whole space belongs to one bone
        method.skinning[-1].weight.zero_()
        method.skinning[-1].bias.zero_()
        method.skinning[-1].bias[bone] = 10.0
    canonical = person.vertices[person.weights.argmax(dim=1) == bone][::40]
    rigid = method._bones[0, bone].expand(len(canonical), 3, 4)
    posed = apply_affine(rigid, canonical)
    roots = method.find_roots(posed, zeros(posed))
    assert roots.valid.any(dim=1).all()
    assert int(roots.valid.sum(dim=1).max()) == 1  # all starts lead to one
    found = roots.points[roots.valid]
    torch.testing.assert_close(found, apply_affine(invert_affine(rigid), posed), atol=2e-4, rtol=0)


def test_every_vertex_is_found_again(method, person, bent_pose):
    pose(method, person, bent_pose)
    canonical = person.vertices[::60]
    posed = method.skin(canonical, zeros(canonical)).detach()
    roots = method.find_roots(posed, zeros(posed))
    away = (roots.points - canonical[:, None]).norm(dim=2).masked_fill(~roots.valid, 1.0)
    assert float((away.amin(dim=1) < 2e-3).float().mean()) > 0.9
    assert roots.points.shape == (len(canonical), len(START_BONES), 3)


def test_the_implicit_gradient_is_that_of_searching_again(method, person, bent_pose):
    pose(method, person, bent_pose)
    start = person.vertices[(person.weights.amax(dim=1) < 0.7).nonzero()[::40, 0]]
    posed = method.skin(start, zeros(start)).detach()
    bias = method.skinning[-1].bias

    def searched():
        roots = method.find_roots(posed, zeros(posed))
        away = (roots.points - start[:, None]).norm(dim=2).masked_fill(~roots.valid, 1.0)
        best = away.argmin(dim=1)
        rows = torch.arange(len(start))
        return roots.points[rows, best], roots.inverse[rows, best], away.amin(dim=1) < 0.01

    root, inverse, kept = searched()
    assert kept.sum() > 3
    carried = method.skin(root, zeros(root))
    moving = root - (inverse @ (carried - carried.detach())[..., None])[..., 0]
    joint = 16
    slope = torch.autograd.grad(moving[kept].sum(), bias)[0][joint]
    with torch.no_grad():
        bias[joint] += 2e-3
    difference = (searched()[0] - root)[kept].sum() / 2e-3
    torch.testing.assert_close(difference, slope, rtol=0.25, atol=0.05)
