"""manifest.json: the content of a package, its units, and how to check it."""

import json
from dataclasses import asdict, dataclass, fields
from math import isfinite
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int

from capture.camera import Camera
from capture.input_error import InputError
from export.package.player_tables import RenderSettings
from export.package.table_codec import TableLayout
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import JOINT_NAMES

FORMAT_VERSION = 6
"""Version of the package format that is written."""
READABLE_FORMATS = (5, 6)
"""Versions that are read; all others are refused. Graphs of 5 use fewer tables."""
MAX_GOLDEN_PX = 128
"""Longest side of a golden frame, pixels."""
LICENCE_NOTE = (
    "A likeness of a person: use it only as that person allows. It is neither the body model's "
    "data nor code; the rights in it are those of the recording it was learnt from."
)
"""Default of `Manifest.licence`."""
Record = TypeVar("Record")


@dataclass(frozen=True, eq=False, kw_only=True)
class TierInfo:
    """One quality tier of the player.

    Attributes:
        layout: Sizes and scales of the tables; the streams are read by the one of "hq".
        settings: How the tables are drawn.
        psnr_to_renderer: Mean PSNR to the volume renderer, dB.
        largest_difference: Between the graph and its rays composited by the compiled kernel, in
            1/255, over the checked frames.
    """

    layout: TableLayout
    settings: RenderSettings
    psnr_to_renderer: float
    largest_difference: float


@dataclass(frozen=True, eq=False, kw_only=True)
class GoldenFrame:
    """Pose and camera of a picture that the player must reproduce."""

    pose: BodyPose
    camera: Camera


@dataclass(frozen=True, eq=False, kw_only=True)
class Manifest:
    """Skeleton, tiers, golden frames and checksums of a package.

    Attributes:
        rest_joints: Rest positions of the joints, metres.
        parents: Parent of each joint, -1 for the root.
        canonical_rotations: Axis-angles of joints 1 … 23 in the canonical pose, radians.
        tiers: Quality tiers by name; "hq" comes first and always exists.
        golden: Golden frames, drawn by "hq" with its own number of samples.
        sha256: Checksums of every entry but the manifest, hexadecimal, by name.
    """

    rest_joints: Float[np.ndarray, "24 3"]
    parents: Int[np.ndarray, "24"]
    canonical_rotations: Float[np.ndarray, "23 3"]
    tiers: dict[str, TierInfo]
    golden: tuple[GoldenFrame, ...]
    metrics: dict[str, Any]
    licence: str = LICENCE_NOTE
    sha256: dict[str, str]

    def to_json(self) -> str:
        """Serialize to the text of manifest.json."""
        content = {
            "format": FORMAT_VERSION,
            "units": "metres, radians, density in 1/m",
            "body_axes": "x to the body's left, y up, z out of the chest (SMPL)",
            "camera_axes": "x right, y down, z forward (OpenCV); pixel centers at +0.5",
            "pose": "world = R(root_rotation) (x - J0) + J0 + root_translation; "
            "axis-angle joint rotations",
            "picture": "RGBA, 8 bits, straight alpha",
            "joints": JOINT_NAMES,
            "parents": self.parents.tolist(),
            "rest_joints": self.rest_joints.tolist(),
            "canonical_rotations": self.canonical_rotations.tolist(),
            "tiers": {name: asdict(tier) for name, tier in self.tiers.items()},
            "golden": [_golden_frame_to_json(frame) for frame in self.golden],
            "metrics": _without_nan(self.metrics),
            "licence": self.licence,
            "sha256": self.sha256,
        }
        return json.dumps(content, indent=1, allow_nan=False)

    @classmethod
    def from_json(cls, text: bytes) -> "Manifest":
        """Parse manifest.json; `InputError` if its format, a key or a value is not as expected."""
        content = _parse_json(text)
        try:
            return cls(
                rest_joints=_parse_array(content["rest_joints"], (24, 3)),
                parents=_parse_parents(content["parents"]),
                canonical_rotations=_parse_array(content["canonical_rotations"], (23, 3)),
                tiers=_parse_tiers(content["tiers"]),
                golden=tuple(_parse_golden_frame(frame) for frame in content["golden"]),
                metrics=dict(content["metrics"]),
                licence=str(content["licence"]),
                sha256={str(name): str(sum_) for name, sum_ in content["sha256"].items()},
            )
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            what = f"it has no {error}" if isinstance(error, KeyError) else str(error)
            raise InputError(
                f"The package's manifest is damaged: {what}. Copy or export it again."
            ) from error


def _without_nan(value: Any) -> Any:
    """Replace NaN and infinity by null, as JSON has neither."""
    if isinstance(value, dict):
        return {str(key): _without_nan(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(part) for part in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def _parse_json(text: bytes) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError("The package's manifest is not JSON; the file is damaged.") from error
    if not isinstance(content, dict) or content.get("format") not in READABLE_FORMATS:
        found = content.get("format") if isinstance(content, dict) else None
        newer = isinstance(found, int) and found > FORMAT_VERSION
        raise InputError(
            f"The package has format {found!r}; this version reads formats "
            f"{' and '.join(map(str, READABLE_FORMATS))}. "
            + ("Update instant-avatar-stream, " if newer else "Export the avatar again, ")
            + "or use the version that wrote it."
        )
    return content


def _parse_array(values: Any, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"expected finite numbers of shape {shape}, found {array.shape}")
    return array


def _parse_parents(values: Any) -> Int[np.ndarray, "24"]:
    parents = np.asarray(values)
    known = parents.shape == (24,) and parents.dtype.kind == "i" and parents[0] == -1
    if not (known and all(0 <= parents[j] < j for j in range(1, 24))):
        raise ValueError("parents must be a tree of 24 joints, each after its parent")
    return parents


def _parse_tiers(content: dict[str, Any]) -> dict[str, TierInfo]:
    tiers = {str(name): _parse_tier(note) for name, note in content.items()}
    if "hq" not in tiers:
        raise ValueError(f'there is no tier "hq", only {", ".join(tiers)}')
    return tiers


def _parse_tier(note: dict[str, Any]) -> TierInfo:
    return TierInfo(
        layout=_parse_record(TableLayout, note["layout"]),
        settings=_parse_record(RenderSettings, note["settings"]),
        psnr_to_renderer=float(note["psnr_to_renderer"]),
        largest_difference=float(note["largest_difference"]),
    )


def _parse_record(kind: type[Record], values: dict[str, Any]) -> Record:
    """Parse a record of numbers and of tuples of three numbers."""
    content: dict[str, Any] = {}
    for field in fields(kind):  # type: ignore[arg-type]
        value, whole = values[field.name], "int" in str(field.type)
        if "tuple" in str(field.type):
            content[field.name] = tuple(_parse_number(v, whole) for v in value)
            if len(value) != 3:
                raise ValueError(f"{field.name} must be three numbers")
        else:
            content[field.name] = _parse_number(value, whole)
    return kind(**content)


def _parse_number(value: Any, whole: bool) -> float | int:
    number = int(value) if whole else float(value)
    if number != value or not np.isfinite(number):
        raise ValueError(f"{value!r} is not a usable number")
    return number


def _golden_frame_to_json(frame: GoldenFrame) -> dict[str, Any]:
    pose, camera = frame.pose, frame.camera
    return {
        "root_rotation": pose.root_rotation.tolist(),
        "root_translation": pose.root_translation.tolist(),
        "joint_rotations": pose.joint_rotations.tolist(),
        "focal_px": camera.focal_px,
        "center_px": camera.center_px,
        "size_px": camera.size_px,
        "camera_from_world": camera.camera_from_world.tolist(),
    }


def _parse_golden_frame(content: dict[str, Any]) -> GoldenFrame:
    width, height = (int(size) for size in content["size_px"])
    if not (0 < width <= MAX_GOLDEN_PX and 0 < height <= MAX_GOLDEN_PX):
        raise ValueError(f"golden frames are at most {MAX_GOLDEN_PX} px, not {width}x{height}")
    focal, center = (
        _parse_array(content["focal_px"], (2,)),
        _parse_array(content["center_px"], (2,)),
    )
    return GoldenFrame(
        pose=BodyPose(
            root_rotation=_parse_array(content["root_rotation"], (3,)),
            root_translation=_parse_array(content["root_translation"], (3,)),
            joint_rotations=_parse_array(content["joint_rotations"], (23, 3)),
        ),
        camera=Camera(
            focal_px=(float(focal[0]), float(focal[1])),
            center_px=(float(center[0]), float(center[1])),
            size_px=(width, height),
            camera_from_world=_parse_array(content["camera_from_world"], (4, 4)),
        ),
    )
