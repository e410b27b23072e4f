"""A skinned mesh with its skeleton and a motion, as glTF 2.0 in one binary file (.glb, .vrm)."""

import base64
import json
import struct
from dataclasses import dataclass
from typing import Any, final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Shaped, UInt16
from scipy.spatial.transform import Rotation

from export.package.manifest import Manifest
from export.skinned_mesh import SkinnedMesh
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import JOINT_NAMES, body_from_rest

COMPONENT_TYPES = {"float32": 5126, "uint32": 5125, "uint16": 5123, "uint8": 5121}
"""glTF's codes of the element types."""
ACCESSOR_TYPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
"""glTF's names of the shapes of elements."""
LINEAR_FILTER, MIPMAP_FILTER, CLAMP_TO_EDGE = 9729, 9987, 33071
"""OpenGL's codes of how a texture is read: magnified, minified, and beyond its edge."""
FIRST_JOINT = 2
"""Node of the first joint; 0 is the mesh and 1 the floor."""
_VRM_AXIS = {"pelvis": "hips", "spine1": "spine", "spine2": "chest", "spine3": "upperChest",
             "neck": "neck", "head": "head"}  # fmt: skip
_VRM_LIMBS = {"hip": "UpperLeg", "knee": "LowerLeg", "ankle": "Foot", "foot": "Toes",
              "collar": "Shoulder", "shoulder": "UpperArm", "elbow": "LowerArm",
              "wrist": "Hand"}  # fmt: skip
VRM_BONES = {JOINT_NAMES.index(joint): bone for joint, bone in _VRM_AXIS.items()} | {
    JOINT_NAMES.index(f"{side}_{joint}"): side + bone
    for side in ("left", "right")
    for joint, bone in _VRM_LIMBS.items()
}
"""VRM's humanoid bones by joint; the two hands of SMPL beyond the wrists have none."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkeletonAnimation:
    """Translations and rotations of the skeleton's nodes over time.

    Attributes:
        translations: Positions of the pelvis, metres.
        rotations: Quaternions x, y, z, w of every joint, whose signs do not jump.
    """

    times_s: Float32[np.ndarray, "poses"]
    translations: Float32[np.ndarray, "poses 3"]
    rotations: Float32[np.ndarray, "24 poses 4"]

    @classmethod
    def of(
        cls, motion: Motion, rows: tuple[int, ...], fps: float, pelvis: Float[np.ndarray, "3"]
    ) -> "SkeletonAnimation":
        """Convert poses of a motion, rotated and translated so that the first one is upright.

        glTF's axes are the body's own (y up, the front towards z); a tracker's world may have any
        orientation, so the first pose's root defines up, forward and the origin.
        """
        chosen = list(rows)
        roots = Rotation.from_rotvec(motion.root_rotations[chosen])
        upright = roots[0].inv()
        shifts = motion.root_translations[chosen]
        bends = motion.joint_rotations[chosen].reshape(-1, 3)
        joints = Rotation.from_rotvec(bends).as_quat().reshape(-1, 23, 4)
        turned = (upright * roots).as_quat()[:, None]
        rotations = np.concatenate([turned, joints], axis=1).transpose(1, 0, 2)
        return cls(
            times_s=(np.arange(len(chosen)) / fps).astype(np.float32),
            translations=(pelvis + upright.apply(shifts - shifts[0])).astype(np.float32),
            rotations=_continuous_quaternions(rotations).astype(np.float32),
        )


def _continuous_quaternions(
    quaternions: Float[np.ndarray, "24 poses 4"],
) -> Float[np.ndarray, "24 poses 4"]:
    """Choose between q and -q, the same rotation, the one nearer to its predecessor."""
    steps = np.sum(quaternions[:, 1:] * quaternions[:, :-1], axis=-1)
    signs = np.cumprod(np.where(steps < 0.0, -1.0, 1.0), axis=1)
    return np.concatenate([quaternions[:, :1], quaternions[:, 1:] * signs[..., None]], axis=1)


def encode_glb(
    mesh: SkinnedMesh, manifest: Manifest, animation: SkeletonAnimation, *, name: str
) -> bytes:
    """Encode a skinned mesh, its skeleton and a motion as a .glb file.

    Colors include the recording's light, so the material is unlit (KHR_materials_unlit), and matt
    for importers without that extension. The canonical pose is the bind pose and the rest pose.
    """
    bends = np.concatenate([np.zeros((1, 3)), manifest.canonical_rotations])
    return _encode_scene(mesh, manifest, name, bends, animation=animation)


def encode_vrm(mesh: SkinnedMesh, manifest: Manifest, *, name: str, author: str) -> bytes:
    """Encode a skinned mesh and its skeleton as a VRM 1.0 file, which rests in a T.

    Expressions are left empty, as no face was told apart. The author alone may play the avatar,
    unmodified, and commercially if all that it was made with allows that.
    (vrm.dev, VRMC_vrm-1.0.)
    """
    is_free = manifest.metrics.get("made_with", {}).get("commercial_use") == "yes"
    humanoid = {bone: {"node": FIRST_JOINT + joint} for joint, bone in VRM_BONES.items()}
    meta = {
        "name": name,
        "authors": [author],
        "copyrightInformation": manifest.licence,
        "licenseUrl": "https://vrm.dev/licenses/1.0/",
        "avatarPermission": "onlyAuthor",
        "commercialUsage": "personalProfit" if is_free else "personalNonProfit",
        "creditNotation": "required",
        "modification": "prohibited",
    }
    vrm = {"specVersion": "1.0", "meta": meta, "humanoid": {"humanBones": humanoid}}
    return _encode_scene(mesh, manifest, name, np.zeros((24, 3)), extensions={"VRMC_vrm": vrm})


def _encode_scene(
    mesh: SkinnedMesh,
    manifest: Manifest,
    name: str,
    bent: Float[np.ndarray, "24 3"],
    *,
    animation: SkeletonAnimation | None = None,
    extensions: dict[str, Any] | None = None,
) -> bytes:
    """Encode the mesh below its skeleton, which rests in `bent`, with a motion or extensions."""
    draft = _GltfBuffer()
    skin, nodes = _skeleton(draft, mesh, manifest, bent)
    more: dict[str, Any] = {}
    if animation is not None:
        more["animations"] = [_animation(draft, animation)]
    if extensions is not None:
        more["extensions"] = extensions
    content = {
        "asset": {
            "version": "2.0",
            "generator": "instant-avatar-stream",
            "copyright": manifest.licence,
        },
        "extensionsUsed": ["KHR_materials_unlit", *more.get("extensions", {})],
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"name": name, "mesh": 0, "skin": 0}, *nodes],
        "meshes": [{"name": name, "primitives": [_primitive(draft, mesh)]}],
        **_material(draft, mesh),
        "skins": [skin],
        **more,
        **draft.describe(),
    }
    return _pack_glb(content, bytes(draft.binary))


def _skeleton(
    draft: "_GltfBuffer", mesh: SkinnedMesh, manifest: Manifest, bent: Float[np.ndarray, "24 3"]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the skin, and the joints' nodes below one that puts the feet on the floor.

    `bent` are the axis-angles in which the joints rest; the mesh is bound in the canonical pose.
    """
    rest, parents = manifest.rest_joints, manifest.parents
    canonical = body_from_rest(rest, parents, manifest.canonical_rotations)
    canonical_from_joint = canonical.copy()
    canonical_from_joint[:, :3, 3] += np.einsum("jab,jb->ja", canonical[:, :3, :3], rest)
    inverse = np.linalg.inv(canonical_from_joint)
    inverse[:, 3] = [0.0, 0.0, 0.0, 1.0]
    bends = Rotation.from_rotvec(bent).as_quat()
    nodes: list[dict[str, Any]] = []
    for joint, parent in enumerate(parents):
        offset = rest[joint] - (rest[parent] if parent >= 0 else 0.0)
        children = [FIRST_JOINT + int(child) for child in np.flatnonzero(parents == joint)]
        node = {"name": JOINT_NAMES[joint], "translation": offset.tolist()}
        nodes.append({**node, "rotation": bends[joint].tolist(), "children": children})
        if not children:
            del nodes[-1]["children"]
    at_rest = body_from_rest(rest, parents, bent[1:]) @ np.linalg.inv(canonical)
    heights = np.einsum("jb,vb->vj", at_rest[:, 1, :3], mesh.positions) + at_rest[:, 1, 3]
    heights = (np.take_along_axis(heights, mesh.joints.astype(int), 1) * mesh.weights).sum(axis=1)
    floor = {"translation": [0.0, -float(heights.min()) / 255.0, 0.0]}
    skin = {
        # column-major, as glTF has it
        "inverseBindMatrices": draft.add(inverse.transpose(0, 2, 1).astype(np.float32)),
        "joints": [FIRST_JOINT + joint for joint in range(len(parents))],
        "skeleton": FIRST_JOINT,
    }
    return skin, [{"name": "floor", **floor, "children": [FIRST_JOINT]}, *nodes]


def _material(draft: "_GltfBuffer", mesh: SkinnedMesh) -> dict[str, Any]:
    """Return the unlit material, with the texture if the mesh has one."""
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    unlit = {"KHR_materials_unlit": {}}
    material = {"name": "as recorded", "pbrMetallicRoughness": surface, "extensions": unlit}
    if mesh.texture is None:
        return {"materials": [material]}
    surface["baseColorTexture"] = {"index": 0}
    options = [cv2.IMWRITE_JPEG_QUALITY, 95]
    options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    image = np.ascontiguousarray(mesh.texture.image[..., ::-1])
    code = cv2.imencode(".jpg", image, options)[1].tobytes()
    wraps = dict.fromkeys(("wrapS", "wrapT"), CLAMP_TO_EDGE)
    sampler = {"magFilter": LINEAR_FILTER, "minFilter": MIPMAP_FILTER, **wraps}
    return {
        "materials": [material],
        "textures": [{"source": 0, "sampler": 0}],
        "images": [{"bufferView": draft.add_bytes(code), "mimeType": "image/jpeg"}],
        "samplers": [sampler],
    }


def _primitive(draft: "_GltfBuffer", mesh: SkinnedMesh) -> dict[str, Any]:
    def vertices(array: Shaped[np.ndarray, "vertices _"], **more: Any) -> int:
        return draft.add(array, target=34962, **more)  # glTF's code of a buffer of vertices

    colors = (
        {"COLOR_0": vertices(_srgb_to_linear(mesh.colors), normalized=True)}
        if mesh.texture is None
        else {"TEXCOORD_0": vertices(mesh.texture.coordinates)}
    )
    return {
        "attributes": {
            "POSITION": vertices(mesh.positions, bounds=True),
            "NORMAL": vertices(mesh.normals),
            **colors,
            "JOINTS_0": vertices(mesh.joints),
            "WEIGHTS_0": vertices(mesh.weights, normalized=True),
        },
        "indices": draft.add(mesh.faces.astype(np.uint32).ravel(), target=34963),  # indices
        "material": 0,
    }


def _srgb_to_linear(colors: Shaped[np.ndarray, "vertices 3"]) -> UInt16[np.ndarray, "vertices 4"]:
    """Convert sRGB to linear light with alpha, as glTF wants it; 16 bits keep the darks."""
    srgb = colors.astype(np.float64) / 255.0
    light = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    opaque = np.concatenate([light, np.ones((len(light), 1))], axis=1)
    return np.round(opaque * 65535.0).astype(np.uint16)


def _animation(draft: "_GltfBuffer", animation: SkeletonAnimation) -> dict[str, Any]:
    times = draft.add(animation.times_s, bounds=True)
    moves = [("translation", 0, animation.translations)]
    moves += [("rotation", joint, turns) for joint, turns in enumerate(animation.rotations)]
    return {
        "name": "motion",
        "samplers": [
            {"input": times, "output": draft.add(values), "interpolation": "LINEAR"}
            for _, _, values in moves
        ],
        "channels": [
            {"sampler": number, "target": {"node": FIRST_JOINT + joint, "path": path}}
            for number, (path, joint, _) in enumerate(moves)
        ],
    }


@final
class _GltfBuffer:
    """The binary part of a file being built, and its description."""

    def __init__(self) -> None:
        self.binary = bytearray()
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []

    def add(
        self,
        array: Shaped[np.ndarray, "..."],
        *,
        target: int | None = None,
        normalized: bool = False,
        bounds: bool = False,
    ) -> int:
        """Add an array of scalars, vectors or matrices; return its accessor's number."""
        content = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes()
        accessor: dict[str, Any] = {
            "bufferView": self.add_bytes(content, target=target),
            "componentType": COMPONENT_TYPES[array.dtype.name],
            "count": len(array),
            "type": ACCESSOR_TYPES[array.shape[1:]],
        }
        if normalized:
            accessor["normalized"] = True
        if bounds:
            rows = array.reshape(len(array), -1)
            accessor["min"] = rows.min(axis=0).tolist()
            accessor["max"] = rows.max(axis=0).tolist()
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def add_bytes(self, content: bytes, *, target: int | None = None) -> int:
        """Add bytes, such as a PNG; return the number of their view."""
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content)}
        self._views.append(view if target is None else {**view, "target": target})
        self.binary += content + bytes(-len(content) % 4)
        return len(self._views) - 1

    def describe(self) -> dict[str, Any]:
        """Describe the binary part for the JSON part."""
        return {
            "buffers": [{"byteLength": len(self.binary)}],
            "bufferViews": self._views,
            "accessors": self._accessors,
        }


def text_of_glb(content: bytes) -> bytes:
    """Convert a .glb file to a .gltf with the data inside, for programs that read text."""
    (size,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + size])
    data = base64.b64encode(content[28 + size :]).decode()  # after two headers
    document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{data}"
    return json.dumps(document, indent=1, allow_nan=False).encode()


def _pack_glb(content: dict[str, Any], binary: bytes) -> bytes:
    """Pack glTF's container: a header and two chunks, each padded to four bytes."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
