"""Files of animated skeletons: BVH (a text) and glTF's animations (.glb, .vrm, .vrma).

One `parse_…` a layout, as for files of trackers: the motion on SMPL's joints by the name of its
animation, or None if the content is another's.
"""

import json
import re
import struct
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from capture.source import ASSUMED_FPS
from preprocess.poses.body_joints import fit_mhr
from preprocess.poses.motion_builder import MotionByPerson
from preprocess.poses.skeleton_motion import SkeletonMotion

MAX_POSES = 100_000
"""Most poses of a file that are read."""
MIN_FRAME_TIME_S = 1e-4
"""Shortest time of a frame that is believed, seconds."""
GLTF_TYPES = {5126: ("<f4", 1.0), 5120: ("<i1", 127.0), 5121: ("<u1", 255.0),
              5122: ("<i2", 32767.0), 5123: ("<u2", 65535.0)}  # fmt: skip
"""numpy's types of glTF's codes, and what stands for 1 in them."""


def parse_bvh(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """Biovision's hierarchy: names, offsets and channels of joints, then a line of numbers a frame.

    Rotations are in degrees, about the axes in the order of the channels, each about the axes that
    the ones before it have turned. (Meredith and Maddock 2001, motion capture file formats
    explained.)
    """
    if not isinstance(content, bytes) or not content.lstrip().startswith(b"HIERARCHY"):
        return None
    head, found, tail = content.decode("utf-8", "replace").partition("MOTION")
    if not found:
        raise ValueError("the part MOTION is missing")
    names, parents, offsets, channels = _bvh_hierarchy(head.split()[1:])
    count, frame_time, numbers = _bvh_frames(tail)
    width = sum(len(each) for each in channels)
    values = np.array(numbers[: count * width], dtype=np.float64)
    count = min(count, len(values) // max(1, width))
    if not width or not count:
        raise ValueError("no frames")
    values = values[: count * width].reshape(count, width)
    rotations = np.tile(np.eye(3), (count, len(names), 1, 1))
    translations = np.tile(np.array(offsets), (count, 1, 1))
    column = 0
    for joint, kinds in enumerate(channels):
        part = values[:, column : column + len(kinds)]
        column += len(kinds)
        turns = [number for number, kind in enumerate(kinds) if kind.endswith("rotation")]
        if turns:
            axes = "".join(kinds[number][0].upper() for number in turns)
            turned = Rotation.from_euler(axes, part[:, turns], degrees=True)
            rotations[:, joint] = turned.as_matrix()
        for number, kind in enumerate(kinds):
            if kind.endswith("position"):  # other joints than the root's repeat their offset
                translations[:, joint, "xyz".index(kind[0])] = part[:, number]
    skeleton = SkeletonMotion(
        names=names,
        parents=np.array(parents),
        offsets=np.array(offsets),
        rest_rotations=np.tile(np.eye(3), (len(names), 1, 1)),
        rotations=rotations,
        translations=translations,
        times_s=np.arange(count) * frame_time,
    )
    return _motions("0", skeleton)


def _bvh_hierarchy(
    words: list[str],
) -> tuple[list[str], list[int], list[list[float]], list[list[str]]]:
    """Names, parents, offsets and kinds of channels (small letters) of all joints."""
    names, parents, offsets, channels = [], [], [], []
    open_joints: list[int] = []  # -1 for an end site, which is no joint
    following, place = -1, 0
    while place < len(words):
        word = words[place].upper()
        if word in ("ROOT", "JOINT"):
            end = words.index("{", place)
            names.append(" ".join(words[place + 1 : end]))
            parents.append(open_joints[-1] if open_joints else -1)
            offsets.append([0.0, 0.0, 0.0])
            channels.append([])
            following, place = len(names) - 1, end
        elif word == "END":
            following, place = -1, words.index("{", place)
        elif word == "{":
            open_joints.append(following)
            place += 1
        elif word == "}":
            open_joints.pop()
            place += 1
        elif word == "OFFSET":
            if open_joints[-1] >= 0:
                offsets[open_joints[-1]] = [float(value) for value in words[place + 1 : place + 4]]
            place += 4
        elif word == "CHANNELS":
            count = int(words[place + 1])
            kinds = [kind.lower() for kind in words[place + 2 : place + 2 + count]]
            channels[open_joints[-1]] = kinds
            place += 2 + count
        else:
            raise ValueError(f"{words[place][:40]!r} stands where a joint was expected")
    return names, parents, offsets, channels


def _bvh_frames(tail: str) -> tuple[int, float, list[str]]:
    """Number of frames, seconds a frame, and all numbers."""
    words = tail.replace(":", " : ").split()
    if [word.lower() for word in (words[0], words[3], words[4])] != ["frames", "frame", "time"]:
        raise ValueError("`Frames:` and `Frame Time:` are missing after MOTION")
    count, frame_time = int(words[2]), float(words[6])
    if not 0 < count <= MAX_POSES or not frame_time > MIN_FRAME_TIME_S:
        raise ValueError(f"{count} frames of {frame_time} s")
    return count, frame_time, words[7:]


def parse_gltf(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """glTF 2.0's animations in a binary file, VRM's included; the longest is `--person`'s default.

    Keys are read at their own rate: rotations by slerp, places along straight lines. Scales are
    ignored, as the length of the legs gives the unit. (Khronos' glTF 2.0 specification, appendix
    C; VRMC_vrm_animation-1.0 for the names of its bones.)
    """
    if not isinstance(content, bytes) or not content.startswith(b"glTF"):
        return None
    text, binary = _glb_chunks(content)
    names = [str(node.get("name", number)) for number, node in enumerate(text.get("nodes", []))]
    extensions = text.get("extensions", {})
    for extension in ("VRMC_vrm_animation", "VRMC_vrm"):
        bones = extensions.get(extension, {}).get("humanoid", {}).get("humanBones", {})
        for bone, which in bones.items():
            names[which["node"]] = bone
    animations = text.get("animations", [])
    if not animations:
        raise ValueError("it has no animation")
    motions: MotionByPerson = {}
    for number, animation in enumerate(animations):
        skeleton = _gltf_motion(text, binary, names, animation)
        motions |= _motions(str(animation.get("name", number)), skeleton)
    return motions


def _motions(name: str, skeleton: SkeletonMotion) -> MotionByPerson:
    """The motion of a skeleton, or those of several whose joints bear MHR's numbers (ComfyUI's)."""
    people: dict[str, dict[int, int]] = {}
    for joint, called in enumerate(skeleton.names):
        numbered = re.fullmatch(r"(?:bone|[Jj]oint)_(\d{3})", called)
        if numbered:
            root = joint
            while skeleton.parents[root] >= 0:
                root = int(skeleton.parents[root])
            joints = people.setdefault(skeleton.names[root], {1: root})  # BVH's root is `Hips`
            joints[int(numbered[1])] = joint
    if not people:
        return {name: skeleton.retarget()}
    places, step = skeleton.places(), float(np.median(np.diff(skeleton.times_s, prepend=-1.0)))
    return {
        name if len(people) == 1 else person: fit_mhr(places, joints, 1.0 / step)
        for person, joints in people.items()
    }


def _glb_chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    size, kind = struct.unpack_from("<I4s", content, 12)
    if kind != b"JSON":
        raise ValueError("its first part is not JSON")
    start = 20 + size
    (length,) = struct.unpack_from("<I", content, start) if start + 8 <= len(content) else (0,)
    return json.loads(content[20:start]), content[start + 8 : start + 8 + length]


def _accessor(text: dict[str, Any], binary: bytes, number: int) -> Float[np.ndarray, "keys _"]:
    """The rows of an accessor, normalized where it says so."""
    accessor = text["accessors"][number]
    view = text["bufferViews"][accessor["bufferView"]]
    if view.get("buffer", 0) != 0 or "uri" in text["buffers"][0] or "sparse" in accessor:
        raise ValueError("its keys are in another file, or sparse: export one whole .glb")
    kind, one = GLTF_TYPES[accessor["componentType"]]
    width, count = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]], accessor["count"]
    size = width * np.dtype(kind).itemsize
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    stride = view.get("byteStride", size)
    rows = [np.frombuffer(binary, kind, width, start + row * stride) for row in range(count)]
    return np.array(rows, dtype=np.float64).reshape(count, width) / one


def _gltf_motion(
    text: dict[str, Any], binary: bytes, names: list[str], animation: dict[str, Any]
) -> SkeletonMotion:
    """All nodes as joints, ordered so that parents come first."""
    nodes = text["nodes"]
    parents = np.full(len(nodes), -1)
    for number, node in enumerate(nodes):
        parents[node.get("children", [])] = number
    order = _parents_first(parents)
    offsets = np.array([node.get("translation", [0.0] * 3) for node in nodes], dtype=np.float64)
    quaternions = [node.get("rotation", [0.0, 0.0, 0.0, 1.0]) for node in nodes]
    rest = Rotation.from_quat(quaternions).as_matrix()
    keyed = []
    for channel in animation["channels"]:
        node, path = channel["target"].get("node"), channel["target"]["path"]
        if node is not None and path in ("rotation", "translation"):
            sampler = animation["samplers"][channel["sampler"]]
            times = _accessor(text, binary, sampler["input"])[:, 0]
            values = _accessor(text, binary, sampler["output"])
            if sampler.get("interpolation") == "CUBICSPLINE":
                values = values[1::3]  # the points between their tangents
            keyed.append((node, path, times, values))
    if not keyed:
        raise ValueError("its animation moves no joint")
    begin, end = min(each[2][0] for each in keyed), max(each[2][-1] for each in keyed)
    densest = max((each[2] for each in keyed), key=len)
    step = float(np.median(np.diff(densest))) if len(densest) > 1 else 0.0
    step = step if MIN_FRAME_TIME_S < step <= 0.1 else 1.0 / ASSUMED_FPS  # keys may be sparse
    count = min(round((end - begin) / step) + 1, MAX_POSES)
    times_s = begin + np.arange(count) * step
    rotations = np.tile(rest, (count, 1, 1, 1))
    translations = np.tile(offsets, (count, 1, 1))
    for node, path, times, values in keyed:
        at = np.clip(times_s, times[0], times[-1])
        if path == "rotation":
            turns = Rotation.from_quat(values)
            turned = Slerp(times, turns)(at) if len(times) > 1 else turns
            rotations[:, node] = turned.as_matrix()
        else:
            translations[:, node] = np.column_stack(
                [np.interp(at, times, values[:, axis]) for axis in range(3)]
            )
    place = np.empty(len(nodes) + 1, dtype=int)  # a parent of -1 stays -1
    place[order], place[-1] = np.arange(len(nodes)), -1
    return SkeletonMotion(
        names=[names[node] for node in order],
        parents=place[parents[order]],
        offsets=offsets[order],
        rest_rotations=rest[order],
        rotations=rotations[:, order],
        translations=translations[:, order],
        times_s=times_s - begin,
    )


def _parents_first(parents: np.ndarray) -> list[int]:
    """The nodes' numbers, each after its parent's."""
    order: list[int] = []
    waiting = [int(node) for node in np.flatnonzero(parents < 0)]
    while waiting:
        node = waiting.pop()
        order.append(node)
        waiting += np.flatnonzero(parents == node).tolist()
    if len(order) < len(parents):
        raise ValueError("its nodes are their own ancestors")
    return order
