"""The mesh, its texture and its .glb, read again by independent hands."""

import io
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy import ndimage
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from export import mesh_texture
from export.gltf import SkeletonAnimation, encode_glb, encode_vrm
from export.mesh_texture import TEXEL_M, _draw_faces, _project, draw_texture, unwrap
from export.player import Player
from export.skinned_mesh import SURFACE_DENSITY, _level_function, extract_mesh
from export.splat_colors import cameras_around
from preprocess.body.kinematics import body_from_rest, rotation_matrices, world_from_body
from preprocess.poses.pose_format_registry import read_poses
from tests.export.test_splats import is_closed, volume
from tests.motions import make_motion

TYPES = {5126: "<f4", 5125: "<u4", 5123: "<u2", 5121: "u1"}
SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


@pytest.fixture(scope="module")
def mesh(package):
    return extract_mesh(package.tables["hq"])


@pytest.fixture(scope="module")
def motion(bent):
    """Bent more and more, in a tracker's world that hangs upside down and turns."""
    share = np.array([0.3, 0.7, 1.0])
    flip = Rotation.from_euler("xyz", [np.pi - 0.2, 0.3, 0.1])
    yaw = Rotation.from_rotvec(share[:, None] * [0.0, 1.2, 0.0])
    places = share[:, None] * [0.5, -0.2, 3.0] + 1.0
    return make_motion(
        (flip * yaw).as_rotvec(), places, share[:, None, None] * bent.joint_rotations
    )


@pytest.fixture(scope="module")
def file(mesh, package, motion):
    rest = package.manifest.rest_joints
    return encode_glb(
        mesh, package.manifest, SkeletonAnimation.of(motion, (0, 1, 2), 25.0, rest[0]), name="x"
    )


class Read:
    """A .glb as its specification says it is read."""

    def __init__(self, content):
        magic, version, length = struct.unpack_from("<4sII", content)
        assert (magic, version, length) == (b"glTF", 2, len(content))
        size, kind = struct.unpack_from("<I4s", content, 12)
        assert kind == b"JSON"
        self.json = json.loads(content[20 : 20 + size])
        rest, kind = struct.unpack_from("<I4s", content, 20 + size)
        assert kind == b"BIN\0"
        self.binary = content[28 + size :]
        assert len(self.binary) == rest == self.json["buffers"][0]["byteLength"]

    def array(self, number):
        accessor = self.json["accessors"][number]
        view = self.json["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        width = SIZES[accessor["type"]]
        array = np.frombuffer(
            self.binary, TYPES[accessor["componentType"]], accessor["count"] * width,
            view["byteOffset"],
        ).reshape(-1, width)  # fmt: skip
        assert array.nbytes == view["byteLength"]
        if accessor.get("normalized"):
            return array / float(np.iinfo(array.dtype).max)
        return array

    def attribute(self, name):
        return self.array(self.json["meshes"][0]["primitives"][0]["attributes"][name])

    def skinned(self, key=None):
        """World positions at a key of the animation; without one, as the skeleton rests."""
        nodes = [dict(node) for node in self.json["nodes"]]
        clip = self.json["animations"][0] if key is not None else {"channels": []}
        for channel in clip["channels"]:
            values = self.array(clip["samplers"][channel["sampler"]]["output"])
            nodes[channel["target"]["node"]][channel["target"]["path"]] = values[key]
        world = {}

        def place(number, parent):
            node, local = nodes[number], np.eye(4)
            local[:3, :3] = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
            local[:3, 3] = node.get("translation", [0, 0, 0])
            world[number] = parent @ local
            for child in node.get("children", []):
                place(child, world[number])

        for root in self.json["scenes"][0]["nodes"]:
            place(root, np.eye(4))
        skin = self.json["skins"][0]
        inverse = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        joints = np.stack([world[joint] for joint in skin["joints"]]) @ inverse
        blended = np.einsum(
            "vi,viab->vab", self.attribute("WEIGHTS_0"), joints[self.attribute("JOINTS_0")]
        )
        points = self.attribute("POSITION")
        return np.einsum("vab,vb->va", blended[:, :3, :3], points) + blended[:, :3, 3]


def test_a_wrist_that_a_film_left_apart_is_kept_and_a_floater_is_not():
    codes = np.zeros((60, 60, 60, 4), dtype=np.uint8)
    codes[5:45, 5:45, 5:45, 3] = 255
    codes[50:54, 50:54, 50:54, 3] = 255  # a thousandth of the body
    codes[50:52, 5:7, 5:7, 3] = 255
    heights = _level_function(codes[..., 3], SURFACE_DENSITY)
    assert heights[51, 51, 51] > 0.0
    assert heights[50:52, 5:7, 5:7].max() < 0.0


def test_the_mesh_is_one_closed_body_at_the_surface(mesh, tables):
    assert is_closed(mesh.faces)
    assert volume(mesh.positions, mesh.faces) > 0.01
    surface = KDTree(tables.surfels.positions)
    assert surface.query(mesh.positions)[0].max() < 0.03  # nothing inside, though bricks are hollow
    assert KDTree(mesh.positions).query(tables.surfels.positions)[0].max() < 0.03
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)


def test_vertices_are_colored_and_moved_as_the_avatar_is(mesh, stand_in):
    inside = torch.from_numpy(mesh.positions - 0.004 * mesh.normals)
    expected = stand_in.field_at(inside)[0].numpy() * 255.0
    difference = np.abs(mesh.colors - expected).mean(axis=1)
    assert np.median(difference) < 6.0
    weights = np.zeros((len(mesh.positions), 24))
    np.add.at(weights, (np.arange(len(weights))[:, None], mesh.joints), mesh.weights / 255.0)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    from_rig = stand_in.rig.weights_at(mesh.positions)
    assert np.abs(weights - from_rig).mean() < 0.005


def test_the_skeleton_rests_in_the_canonical_pose_on_the_floor(file, mesh):
    resting = Read(file).skinned()
    floor = mesh.positions[:, 1].min()
    np.testing.assert_allclose(resting, mesh.positions - [0.0, floor, 0.0], atol=1e-5)


def test_every_key_of_the_animation_is_the_pose_turned_upright(file, mesh, package, motion):
    manifest, read = package.manifest, Read(file)
    rest, parents = manifest.rest_joints, manifest.parents
    canonical = body_from_rest(rest, parents, manifest.canonical_rotations)
    weights = mesh.weights / 255.0
    first = motion[0]
    upright = rotation_matrices(first.root_rotation).T
    middle = rest[0] + first.root_translation
    floor = mesh.positions[:, 1].min()
    for row in range(3):
        pose = motion[row]
        root = world_from_body(rest[0], pose.root_rotation, pose.root_translation)
        bones = body_from_rest(rest, parents, pose.joint_rotations) @ np.linalg.inv(canonical)
        blended = np.einsum("vi,viab->vab", weights, (root @ bones)[mesh.joints])
        world = np.einsum("vab,vb->va", blended[:, :3, :3], mesh.positions) + blended[:, :3, 3]
        expected = (world - middle) @ upright.T + rest[0] - [0.0, floor, 0.0]
        np.testing.assert_allclose(read.skinned(row), expected, atol=2e-5)
    times = read.array(read.json["animations"][0]["samplers"][0]["input"])
    np.testing.assert_allclose(times[:, 0], [0.0, 0.04, 0.08], atol=1e-6)


def test_quaternions_take_the_short_way(package):
    turns = np.linspace(0.0, 4.0 * np.pi, 60)
    spin = make_motion(np.stack([0 * turns, (turns + np.pi) % (2 * np.pi) - np.pi, 0 * turns], 1))
    animation = SkeletonAnimation.of(spin, tuple(range(60)), 30.0, package.manifest.rest_joints[0])
    steps = np.sum(animation.rotations[:, 1:] * animation.rotations[:, :-1], axis=-1)
    assert (steps > 0.9).all()


def test_another_reader_opens_it(file, mesh):
    scene = trimesh.load(io.BytesIO(file), file_type="glb")
    (found,) = scene.geometry.values()
    np.testing.assert_allclose(found.vertices, mesh.positions, atol=1e-6)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    assert {"pelvis", "left_hand", "floor"} <= set(scene.graph.nodes)


def test_colors_are_linear_light(file, mesh):
    light = Read(file).attribute("COLOR_0")
    back = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(back[:, :3] * 255.0, mesh.colors, atol=0.1)
    assert (light[:, 3] == 1.0).all()


@pytest.fixture(scope="module")
def simple(package):
    """The same of three thousand triangles, with a coarse texture."""
    pytest.importorskip("xatlas")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mesh_texture, "TEXEL_M", 2.0 * TEXEL_M)
        return extract_mesh(package.tables["hq"], triangles=3000, picture_by=show_nothing)


def texels(mesh, shares, smaller=1):
    """Bilinear samples at a place of every triangle, by its shares of the corners, of a mipmap."""
    side = len(mesh.texture.image) // smaller
    image = mesh.texture.image[: side * smaller, : side * smaller].astype(float)
    image = image.reshape(side, smaller, side, smaller, 3).mean(axis=(1, 3))
    x, y = (mesh.texture.coordinates[mesh.faces] * side - 0.5).transpose(2, 0, 1)
    place = [each @ shares for each in (y, x)]
    channels = [
        ndimage.map_coordinates(image[..., channel], place, order=1, mode="nearest")
        for channel in range(3)
    ]
    return np.stack(channels, axis=1)


def test_few_triangles_keep_the_shape_and_its_colors(simple, mesh):
    assert 2900 <= len(simple.faces) <= 3000
    assert len(simple.positions) < 1.3 * len(simple.faces)
    assert volume(simple.positions, simple.faces) == pytest.approx(
        volume(mesh.positions, mesh.faces), rel=0.04
    )
    near = KDTree(mesh.positions)
    assert near.query(simple.positions)[0].max() < 0.02
    corners = simple.positions[simple.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middle, lost = corners.mean(axis=1), KDTree(corners.mean(axis=1)).query(mesh.positions)[1]
    apart = ((mesh.positions - middle[lost]) * normals[lost]).sum(axis=1)
    apart /= np.linalg.norm(normals[lost], axis=1)
    assert np.sqrt((apart**2).mean()) < 0.0014  # 0.0020 where the error may grow fast
    for smaller, shares in [
        (1, [1 / 3, 1 / 3, 1 / 3]), (1, [0.9, 0.05, 0.05]), (1, [1.1, -0.05, -0.05]),
        (2, [0.05, 0.05, 0.9]), (2, [1.1, -0.05, -0.05]),
    ]:  # fmt: skip
        points = np.einsum("c,fcx->fx", shares, simple.positions[simple.faces])
        away, nearest = near.query(points)
        expected = mesh.colors[nearest].astype(float)
        off = np.abs(texels(simple, np.array(shares), smaller) - expected).mean(axis=1)
        assert np.median(off[away < 0.004]) < 6.0


def test_its_outline_is_as_wide_as_the_avatars(mesh, package):
    player, wider = Player(package), []
    for camera in cameras_around(mesh.positions, views=2, pixel_m=0.002):
        pixels = _project(camera, mesh.positions)[0]
        drawn = _draw_faces(pixels[mesh.faces], camera.size_px[0]) >= 0
        seen = player.render_canonical(camera)[..., 3] > 127
        rim = seen & ~ndimage.binary_erosion(seen)
        # OpenCV draws borders, so faces are half a pixel wider
        wider.append(2.0 * ((drawn.sum() - float(seen.sum())) / rim.sum() - 0.5))
    assert abs(np.mean(wider)) < 0.8  # mm; 1.2 at a density of 25


def test_a_texture_is_read_by_another_reader(simple, package, motion):
    clip = SkeletonAnimation.of(motion, (0, 1), 25.0, package.manifest.rest_joints[0])
    content = encode_glb(simple, package.manifest, clip, name="x")
    read = Read(content)
    assert "COLOR_0" not in read.json["meshes"][0]["primitives"][0]["attributes"]
    np.testing.assert_array_equal(read.attribute("TEXCOORD_0"), simple.texture.coordinates)
    assert ((read.attribute("TEXCOORD_0") > 0.0) & (read.attribute("TEXCOORD_0") < 1.0)).all()
    (found,) = trimesh.load(io.BytesIO(content), file_type="glb").geometry.values()
    image = np.asarray(found.visual.material.baseColorTexture.convert("RGB"))
    assert image.shape == simple.texture.image.shape
    assert np.abs(image.astype(float) - simple.texture.image).mean() < 3.0  # a JPEG
    (sampler,) = read.json["samplers"]
    assert sampler["minFilter"] == 9987  # mipmaps


def test_the_animation_is_read_back_as_the_motion(file, motion, tmp_path):
    path = tmp_path / "dance.glb"
    path.write_bytes(file)
    again = read_poses(path)
    for ours, given in zip(again.joint_rotations, motion.joint_rotations, strict=True):
        np.testing.assert_allclose(rotation_matrices(ours), rotation_matrices(given), atol=1e-4)
    roots = Rotation.from_rotvec(motion.root_rotations)
    turned = (roots[0].inv() * roots).as_matrix()
    np.testing.assert_allclose(rotation_matrices(again.root_rotations), turned, atol=1e-4)
    way = roots[0].inv().apply(motion.root_translations - motion.root_translations[0])
    moved = again.root_translations - again.root_translations[0]
    np.testing.assert_allclose(moved, way, atol=1e-4)


VRM_NEEDS = {
    "hips", "spine", "head",
    *(side + bone for side in ("left", "right")
      for bone in ("UpperLeg", "LowerLeg", "Foot", "UpperArm", "LowerArm", "Hand")),
}  # fmt: skip
"""Bones that VRM 1.0 requires."""


@pytest.mark.parametrize(
    ("use", "stated"), [("yes", "personalProfit"), ("no", "personalNonProfit"), (None,) * 2]
)
def test_a_vrms_licence_follows_what_the_avatar_was_made_with(mesh, package, use, stated):
    metrics = {} if use is None else {"made_with": {"commercial_use": use}}
    manifest = replace(package.manifest, metrics=metrics)
    vrm = Read(encode_vrm(mesh, manifest, name="x", author="Anna"))
    meta = vrm.json["extensions"]["VRMC_vrm"]["meta"]
    assert meta["commercialUsage"] == (stated or "personalNonProfit")


def test_a_vrm_names_its_bones_and_rests_in_a_t_on_the_floor(mesh, package):
    manifest = package.manifest
    vrm = Read(encode_vrm(mesh, manifest, name="x", author="Anna"))
    extension = vrm.json["extensions"]["VRMC_vrm"]
    assert "VRMC_vrm" in vrm.json["extensionsUsed"]
    assert extension["meta"]["authors"] == ["Anna"]
    assert extension["meta"]["avatarPermission"] == "onlyAuthor"
    bones = {name: bone["node"] for name, bone in extension["humanoid"]["humanBones"].items()}
    assert bones.keys() >= VRM_NEEDS
    assert vrm.json["nodes"][bones["leftLowerArm"]]["name"] == "left_elbow"
    assert "animations" not in vrm.json
    points = vrm.skinned()
    assert points[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    # in a T the wrists are as far apart as the arms are long
    left, right = (
        np.take_along_axis(mesh.weights, (mesh.joints == joint).argmax(axis=1)[:, None], 1)[:, 0]
        * (mesh.joints == joint).any(axis=1)
        for joint in (20, 21)
    )
    hands = [points[weight > 200].mean(axis=0) for weight in (left, right)]
    rest = manifest.rest_joints
    assert hands[0][0] - hands[1][0] > rest[20, 0] - rest[21, 0]
    assert abs(hands[0][1] - hands[1][1]) < 0.05


SIDE_M = 0.2


def show_nothing(camera):
    return np.zeros((*camera.size_px[::-1], 4), dtype=np.uint8)


def test_a_single_texel_that_sees_another_color_is_not_shown():
    pytest.importorskip("xatlas")
    ends = [0.0, SIDE_M]
    positions = np.array([[x, y, 0.0] for x in ends for y in ends], dtype=np.float32)
    mesh = unwrap(positions, np.array([[0, 2, 1], [1, 2, 3]], dtype=np.int32))

    def color_at(points, _):
        there = np.linalg.norm(points[:, :2] - SIDE_M / 2.0, axis=1) < 0.6 * TEXEL_M
        seen.append(there.sum())
        left = points[:, :1] < SIDE_M / 4.0
        return np.where(there[:, None], 255, np.where(left, 40, 120)).repeat(3, 1).astype(np.uint8)

    seen = []
    upwards = np.tile(np.float32([0.0, 0.0, 1.0]), (len(mesh.sources), 1))
    texture = draw_texture(mesh, positions[mesh.sources], upwards, color_at, show_nothing)
    assert 1 <= sum(seen) <= 4
    assert np.unique(texture.image).tolist() == [40, 120]
    assert (texture.image == 40).mean() == pytest.approx(0.25, abs=0.05)


def test_a_texture_shows_what_pictures_show_where_they_see_it():
    pytest.importorskip("xatlas")
    balls = [trimesh.creation.icosphere(3, radius) for radius in (0.1, 0.05)]
    outside = len(balls[0].faces)
    positions = np.concatenate([ball.vertices for ball in balls]).astype(np.float32)
    faces = np.concatenate([balls[0].faces, balls[1].faces + len(balls[0].vertices)])
    mesh = unwrap(positions, faces.astype(np.int32))
    places = positions[mesh.sources]
    normals = places / np.linalg.norm(places, axis=1, keepdims=True)

    def show_blue(camera):
        return np.broadcast_to(np.uint8([0, 0, 200, 255]), (*camera.size_px[::-1], 4))

    def gray(points, _):
        return np.full((len(points), 3), 90, dtype=np.uint8)

    image = draw_texture(mesh, places, normals, gray, show_blue).image
    column, row = (mesh.coordinates[mesh.faces].mean(axis=1) * mesh.side_px).astype(int).T
    shown = image[row, column].astype(float)
    assert np.abs(shown[:outside] - [0.0, 0.0, 200.0]).max() < 40.0  # 200 - 90 without pictures
    assert np.abs(shown[outside:] - 90.0).max() <= 1.0  # from nowhere seen
