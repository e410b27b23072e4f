"""The zero set of a grid: closed forms that it must come close to."""

import numpy as np
import pytest

from export.bake.voxel_grid import extract_isosurface


def grid(of, size=33):
    """A function of points in [-1, 1]³ on a cubic grid, and the distance between its nodes."""
    axis = np.linspace(-1.0, 1.0, size)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    return of(points).astype(np.float32), axis[1] - axis[0]


def sphere(points, radius=0.7):
    return radius - np.linalg.norm(points, axis=-1)


def torus(points):
    x, y, z = np.moveaxis(points, -1, 0)
    return 0.25 - np.hypot(np.hypot(x, y) - 0.6, z)


def volume(vertices, faces):
    a, b, c = (vertices[corner].astype(float) for corner in faces.T)
    return np.einsum("na,na->", a, np.cross(b, c)) / 6.0


def is_closed(faces):
    """Every edge is walked as often in one direction as in the other."""
    faces, most = faces.astype(np.int64), int(faces.max()) + 1
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    there, back = np.sort(start * most + end), np.sort(end * most + start)
    return np.array_equal(there, back)


def euler(vertices, faces):
    edges = {frozenset(map(int, e)) for f in faces for e in zip(f, np.roll(f, -1), strict=True)}
    return len(vertices) - len(edges) + len(faces)


def test_a_sphere_has_its_radius_its_volume_and_faces_that_look_out():
    values, step = grid(sphere)
    nodes, faces = extract_isosurface(values)
    vertices = nodes * step - 1.0
    assert np.abs(np.linalg.norm(vertices, axis=1) - 0.7).max() < 0.1 * step
    assert volume(vertices, faces) == pytest.approx(4.0 / 3.0 * np.pi * 0.7**3, rel=0.01)
    assert faces.max() == len(vertices) - 1


@pytest.mark.parametrize(("shape", "characteristic"), [(sphere, 2), (torus, 0)])
def test_surfaces_are_closed_and_have_as_many_handles_as_they_should(shape, characteristic):
    vertices, faces = extract_isosurface(grid(shape)[0])
    assert is_closed(faces)
    assert euler(vertices, faces) == characteristic


def test_a_plane_between_nodes_is_found_where_it_is():
    values = np.broadcast_to(2.3 - np.arange(6, dtype=np.float32)[:, None, None], (6, 5, 5))
    vertices, faces = extract_isosurface(np.ascontiguousarray(values))
    np.testing.assert_allclose(vertices[:, 0], 2.3, atol=1e-6)
    a, b, c = (vertices[corner] for corner in faces.T)
    normals = np.cross(b - a, c - a)
    assert (normals[:, 0] > 0.0).all()  # towards the negative


def test_a_surface_with_a_hole_is_not_closed():
    _, faces = extract_isosurface(grid(sphere)[0])
    assert not is_closed(faces[1:])


def test_noise_gives_a_closed_surface_too():
    values = np.random.default_rng(3).standard_normal((14, 15, 16)).astype(np.float32)
    inside = np.full((16, 17, 18), -1.0, dtype=np.float32)
    inside[1:-1, 1:-1, 1:-1] = values
    vertices, faces = extract_isosurface(inside)
    assert is_closed(faces)
    assert ((faces >= 0) & (faces < len(vertices))).all()
