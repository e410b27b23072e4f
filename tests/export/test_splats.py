"""Gaussians of the surface and the surface itself, read back from their files and drawn here."""

import gzip
import struct
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from export.bake.voxel_grid import extract_isosurface
from export.player import Player, picture_on_white, premultiply
from export.skinned_mesh import LevelSet, extract_mesh
from export.splat_colors import cameras_around, fit_colors
from export.splats import (
    COARSE_PIXEL_M,
    DEPTH_PER_PIXEL,
    FIRM_DENSITY,
    SHELLS,
    GaussianSplats,
    build_splats,
    encode_ply,
    encode_spz,
)


@pytest.fixture(scope="module")
def splats(package):
    """In colors of few and coarse pictures: what is seen from afar is tested by itself."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("export.splats.VIEWS", 2)
        patch.setattr("export.splats.PIXEL_M", 0.02)
        return build_splats(package, None)


def covariances(scales, rotations):
    """Of Gaussians whose rotations are quaternions w, x, y, z."""
    axes = Rotation.from_quat(rotations, scalar_first=True).as_matrix() * scales[:, None]
    return axes @ axes.transpose(0, 2, 1)


def rasterize(splats, camera):
    """A picture on white as 3DGS defines it (EWA, front to back), with Mip-Splatting's filter."""
    points = splats.positions @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    order = np.argsort(points[:, 2])
    points, depth = points[order], points[order, 2:]
    center = points[:, :2] / depth * camera.focal_px + camera.center_px
    slopes = np.zeros((len(points), 2, 3))
    slopes[:, [0, 1], [0, 1]] = camera.focal_px / depth
    slopes[:, :, 2] = -points[:, :2] / depth**2 * camera.focal_px
    slopes = slopes @ camera.camera_from_world[:3, :3]
    shape = covariances(splats.scales[order], splats.rotations[order])
    shape = slopes @ shape @ slopes.transpose(0, 2, 1)
    wide = shape + 0.3 * np.eye(2)
    peak = splats.opacities[order] * np.sqrt(
        np.maximum(np.linalg.det(shape), 0.0) / np.linalg.det(wide)
    )
    reach = np.arange(-4, 5)
    pixels = np.floor(center).astype(int)[:, None] + np.stack(
        np.meshgrid(reach, reach), axis=-1
    ).reshape(-1, 2)
    away = pixels + 0.5 - center[:, None]
    power = np.einsum("spa,sab,spb->sp", away, np.linalg.inv(wide), away)
    alpha = np.where(power < 8.0, peak[:, None] * np.exp(-0.5 * power), 0.0)
    width, height = camera.size_px
    seen = (alpha > 1 / 512) & ((pixels >= 0) & (pixels < [width, height])).all(axis=2)
    splat, _ = np.nonzero(seen)
    place = (pixels[..., 1] * width + pixels[..., 0])[seen]
    sort = np.lexsort((splat, place))  # pixel after pixel, the nearest Gaussian first
    place, splat, passed = place[sort], splat[sort], np.log1p(-alpha[seen][sort])
    before = np.cumsum(passed) - passed
    first = np.searchsorted(place, place)
    weight = np.exp(before - before[first]) * -np.expm1(passed)
    picture = np.ones((height * width, 3))
    for channel in range(3):
        darker = weight * (splats.colors[order][splat, channel] - 1.0)
        picture[:, channel] += np.bincount(place, darker, height * width)
    return picture.reshape(height, width, 3)


def test_a_ply_holds_the_same_gaussians_with_y_down(splats):
    content = encode_ply(splats)
    head, rows = content.split(b"end_header\n", 1)
    names = [line.split()[-1] for line in head.decode().splitlines() if "float" in line]
    assert f"element vertex {len(splats.positions)}\n".encode() in head
    columns = dict(zip(names, np.frombuffer(rows, "<f4").reshape(-1, len(names)).T, strict=True))

    def read(*wanted):
        return np.stack([columns[name] for name in wanted], axis=1)

    flip = np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(read("x", "y", "z") @ flip, splats.positions, atol=1e-6)
    color = 0.5 + 0.28209479 * read("f_dc_0", "f_dc_1", "f_dc_2")
    np.testing.assert_allclose(color, splats.colors, atol=1e-5)
    opacity = 1.0 / (1.0 + np.exp(-read("opacity")[:, 0]))
    np.testing.assert_allclose(opacity, splats.opacities, atol=1e-5)
    scales = np.exp(read("scale_0", "scale_1", "scale_2"))
    found = covariances(scales, read("rot_0", "rot_1", "rot_2", "rot_3"))
    expected = flip @ covariances(splats.scales, splats.rotations) @ flip
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_an_spz_holds_the_same_gaussians_in_few_bytes(splats):
    content = encode_spz(splats)
    assert len(content) < 24 * len(splats.positions)
    plain = gzip.decompress(content)
    magic, version, count, degree, fraction, _, _ = struct.unpack_from("<IIIBBBB", plain)
    assert (magic, version, count, degree) == (0x5053474E, 2, len(splats.positions), 0)
    codes = np.frombuffer(plain, np.uint8, offset=16)
    place, opacity, color, scale, turn = np.split(codes, np.cumsum([9, 1, 3, 3]) * count)
    places = place.reshape(-1, 3, 3).astype(np.int32) @ [1, 1 << 8, 1 << 16]
    places = np.where(places >= 1 << 23, places - (1 << 24), places) / 2**fraction
    np.testing.assert_allclose(places, splats.positions, atol=2e-4)
    np.testing.assert_allclose(opacity / 255.0, splats.opacities, atol=2e-3)
    colors = (color.reshape(-1, 3) / 255.0 - 0.5) / 0.15 * 0.28209479 + 0.5
    np.testing.assert_allclose(colors, splats.colors, atol=4e-3)
    scales = np.exp(scale.reshape(-1, 3) / 16.0 - 10.0)
    np.testing.assert_allclose(scales / splats.scales, 1.0, atol=0.04)
    vector = turn.reshape(-1, 3) / 127.5 - 1.0
    real = np.sqrt(np.maximum(0.0, 1.0 - (vector**2).sum(axis=1)))
    given = Rotation.from_quat(splats.rotations, scalar_first=True)
    found = Rotation.from_quat(np.column_stack([real, vector]), scalar_first=True)
    assert np.median((found * given.inv()).magnitude()) < np.deg2rad(1.0)


def test_they_lie_in_shells_under_the_surface_and_clear_of_it(package, splats):
    tables = package.tables["hq"]
    level = LevelSet.of(tables.bricks, FIRM_DENSITY)
    mesh = extract_mesh(tables, level, spacing_m=SHELLS[0].spacing_m)
    surface = KDTree(mesh.positions)
    far, nearest = surface.query(splats.positions)
    inward = np.sum((mesh.positions[nearest] - splats.positions) * mesh.normals[nearest], axis=1)
    for shell in SHELLS:
        chosen = splats.opacities == np.float32(shell.opacity)
        assert chosen.sum() > 0.1 * (splats.opacities == np.float32(SHELLS[0].opacity)).sum()
        assert np.median(inward[chosen]) == pytest.approx(shell.depth_m, rel=0.1)
        assert far[chosen].min() >= 0.999 * shell.clear_share * shell.depth_m
        thinnest = splats.scales[chosen].min(axis=1)
        assert np.median(thinnest) == pytest.approx(shell.thickness_m, rel=0.15)
    assert len(mesh.positions) == (splats.opacities == np.float32(SHELLS[0].opacity)).sum()


def test_wide_clothes_have_gaussians_farther_apart(package, splats, monkeypatch):
    monkeypatch.setattr("export.splats.MAX_CROSSED_M2", 0.2)
    monkeypatch.setattr("export.splats.VIEWS", 2)
    monkeypatch.setattr("export.splats.PIXEL_M", 0.02)
    fewer = build_splats(package, None)
    assert len(fewer.positions) < 0.6 * len(splats.positions)
    area = [np.sort(each.scales, axis=1)[:, 1:].prod(axis=1).sum() for each in (fewer, splats)]
    assert area[0] == pytest.approx(area[1], rel=0.1)  # each is wider


@pytest.mark.slow
def test_shells_of_a_finer_film_lie_nearer_to_the_surface(package, splats):
    metrics = {**package.manifest.metrics, "recipe": {"finest_m": COARSE_PIXEL_M - 0.005}}
    finer = replace(package, manifest=replace(package.manifest, metrics=metrics))
    fine = build_splats(finer, None)
    surface = KDTree(extract_mesh(package.tables["hq"]).positions)
    for shell in SHELLS[:2]:
        depths = [
            np.median(surface.query(each.positions[each.opacities == np.float32(shell.opacity)])[0])
            for each in (splats, fine)
        ]
        assert depths[0] - depths[1] == pytest.approx(0.005 * DEPTH_PER_PIXEL, rel=0.3)


def test_colors_are_fitted_so_that_blurred_and_overlapping_gaussians_show_the_pictures():
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(2000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turned = Rotation.concatenate(
        [Rotation.align_vectors([normal], [[0.0, 0.0, 1.0]])[0] for normal in normals]
    )
    scales = np.tile([0.015, 0.015, 0.001], (len(normals), 1))
    stripes = np.where(np.sin(20.0 * normals[:, 1:2]) > 0.0, [0.9, 0.2, 0.1], [0.1, 0.3, 0.8])
    true = GaussianSplats(
        positions=np.float32(0.25 * normals),
        colors=np.float32(stripes),
        opacities=np.full(len(normals), 0.7, np.float32),
        scales=np.float32(scales),
        rotations=np.float32(turned.as_quat(scalar_first=True)),
    )
    cameras = cameras_around(true.positions, views=8, pixel_m=0.005)
    pictures = [np.float32(rasterize(true, each)) for each in cameras]
    assert all((picture[0] == 1.0).all() for picture in pictures)  # the whole ball is seen
    gray = np.full((len(normals), 3), 0.5)
    error = {}
    axes = turned.as_matrix() * scales[:, None]
    found = fit_colors(true.positions, axes, true.opacities, gray, cameras, pictures)
    for name, colors in (("gray", gray), ("found", found)):
        drawn = [rasterize(replace(true, colors=np.float32(colors)), each) for each in cameras]
        error[name] = np.mean([((a - b) ** 2).mean() for a, b in zip(drawn, pictures, strict=True)])
    assert error["found"] < 0.05 * error["gray"]


@pytest.mark.slow
@pytest.mark.parametrize("pose", ["canonical", "bent"])
def test_they_look_like_the_avatar(package, stand_in, camera, bent, pose):
    player, view = Player(package), camera(320, 400)
    pose = stand_in.canonical if pose == "canonical" else bent
    drawn = rasterize(build_splats(package, pose), view)
    expected = picture_on_white(premultiply(player.render(pose, view)))
    error = ((drawn - expected) ** 2).mean()
    assert -10.0 * np.log10(error) > 33.5  # 34.7 and 35.7 were measured


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


def test_noise_gives_a_closed_surface_too():
    values = np.random.default_rng(3).standard_normal((14, 15, 16)).astype(np.float32)
    inside = np.full((16, 17, 18), -1.0, dtype=np.float32)
    inside[1:-1, 1:-1, 1:-1] = values
    vertices, faces = extract_isosurface(inside)
    assert is_closed(faces)
    assert ((faces >= 0) & (faces < len(vertices))).all()
