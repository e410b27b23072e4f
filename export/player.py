"""The player: poses and cameras in, pictures out, with numpy and onnxruntime alone."""

from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
import onnxruntime
from jaxtyping import Float, Float32, UInt8

from capture.camera import Camera
from capture.errors import BadInput
from export.initialisers import initialisers
from export.manifest import Manifest
from export.package import AvatarPackage, read_package
from preprocess.kinematics import body_from_rest, world_from_body
from preprocess.pose import BodyPose

CLOSE = 2
"""Two pictures are alike where no channel (premultiplied) differs by more, in 1/255 …"""
ALIKE = 0.999
"""… on at least this share of the pixels."""
MOST_SAMPLES = 256


@final
class Player:
    """Draws an avatar in any pose, from any camera, in any size."""

    def __init__(self, package: AvatarPackage, *, tier: str = "hq", threads: int = 1) -> None:
        """A player of a package that has been read (or is about to be written)."""
        self.manifest: Manifest = package.manifest
        self._rules = package.manifest.tiers[tier].rules
        # onnxruntime only borrows the tables: they must live as long as the session
        self._tables = {
            name: array.tobytes() for name, array in initialisers(package.tables[tier]).items()
        }
        self._session = _session(package.graphs[tier], self._tables, threads)
        canonical = self._body_from_rest(self.manifest.canonical_rotations)
        self._rest_from_canonical = np.linalg.inv(canonical)

    @classmethod
    def load(cls, path: Path | str, *, tier: str = "hq", threads: int = 1) -> "Player":
        """Reads a package.

        Args:
            path: The `.iavatar` file.
            tier: Which quality.
            threads: More than one seldom pays: frames are better spread over processes.

        Raises:
            BadInput: If the file is no sound package, or has no such tier.
        """
        return cls(read_package(Path(path), tier=tier), tier=tier, threads=threads)

    def render(
        self, pose: BodyPose, camera: Camera, samples: int | None = None
    ) -> UInt8[np.ndarray, "height width 4"]:
        """The avatar's picture with straight alpha.

        Args:
            pose: In the camera's world.
            camera: Without lens distortion; its size is the picture's.
            samples: Along each ray and layer; the package's own choice if None.

        Raises:
            BadInput: If the camera's lens bends, or there are no samples.
        """
        samples = self._rules.samples if samples is None else samples
        if camera.distortion:
            raise BadInput(
                "The camera has lens distortion, but the player draws pinhole pictures. "
                "Leave the distortion out of the camera."
            )
        if not 1 <= samples <= MOST_SAMPLES:
            raise BadInput(f"{samples} samples were asked for; 1 to {MOST_SAMPLES} can be drawn.")
        width, height = camera.size_px
        lens = [*camera.focal_px, *camera.center_px]
        inputs = {
            "bones": self.bones(pose, camera).reshape(24, 12),
            "camera": np.array(lens, dtype=np.float32),
            "height": np.array(height, dtype=np.int64),
            "width": np.array(width, dtype=np.int64),
            "samples": np.array(samples, dtype=np.int64),
        }
        return np.asarray(self._session.run(["rgba"], inputs)[0])

    def bones(self, pose: BodyPose, camera: Camera) -> Float32[np.ndarray, "24 3 4"]:
        """Camera-from-canonical matrices of the joints."""
        root = world_from_body(
            self.manifest.rest_joints[0], pose.root_rotation, pose.root_translation
        )
        body_from_canonical = self._body_from_rest(pose.joint_rotations) @ self._rest_from_canonical
        camera_from_canonical = camera.camera_from_world @ root @ body_from_canonical
        return camera_from_canonical[:, :3].astype(np.float32)

    def _body_from_rest(self, rotations: Float[np.ndarray, "23 3"]) -> Float[np.ndarray, "24 4 4"]:
        return body_from_rest(self.manifest.rest_joints, self.manifest.parents, rotations)


def _session(graph: bytes, tables: dict[str, bytes], threads: int) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    names, buffers = list(tables), list(tables.values())
    options.add_external_initializers_from_files_in_memory(
        names, buffers, [len(buffer) for buffer in buffers]
    )
    try:
        return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise BadInput(
            f"The package's graph does not run on onnxruntime {onnxruntime.__version__}: {error}"
        ) from error


@dataclass(frozen=True, kw_only=True)
class Likeness:
    """How far two pictures are apart.

    Attributes:
        largest: Largest difference of any premultiplied channel, in 1/255.
        close: Share of the pixels that differ by no more than `CLOSE`.
    """

    largest: float
    close: float

    @classmethod
    def of(
        cls, a: Float32[np.ndarray, "height width 4"], b: Float32[np.ndarray, "height width 4"]
    ) -> "Likeness":
        """Of two premultiplied pictures in [0, 1]."""
        difference = np.abs(a - b).max(axis=-1) * 255.0
        return cls(largest=float(difference.max()), close=float((difference <= CLOSE).mean()))

    @property
    def alike(self) -> bool:
        """Whether they count as the same picture."""
        return self.close >= ALIKE


def premultiplied(
    rgba: UInt8[np.ndarray, "height width 4"],
) -> Float32[np.ndarray, "height width 4"]:
    """A straight 8-bit picture as premultiplied floats in [0, 1]."""
    picture = rgba.astype(np.float32) / np.float32(255.0)
    picture[..., :3] *= picture[..., 3:]
    return picture


def verify(path: Path | str) -> list[Likeness]:
    """Draws a package's golden frames again, on this machine.

    Returns:
        For each golden frame, how far the new picture is from the stored one.

    Raises:
        BadInput: If the file is no sound package.
    """
    package = read_package(Path(path))
    player = Player(package)
    return [
        Likeness.of(premultiplied(player.render(frame.pose, frame.camera)), premultiplied(stored))
        for frame, stored in zip(package.manifest.golden, package.golden, strict=True)
    ]
