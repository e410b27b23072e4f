"""The player: poses and cameras in, pictures out, with numpy and onnxruntime alone."""

from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
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
LARGEST_PX = 8192


@final
class Player:
    """Draws an avatar in any pose, from any camera, in any size.

    One player may be used by several threads at once.

    Attributes:
        manifest: What the package says about itself: joints, tiers, golden frames, licence.
        provider: onnxruntime's execution provider that really draws.
    """

    def __init__(
        self,
        package: AvatarPackage,
        *,
        tier: str = "hq",
        threads: int = 1,
        provider: str = "cpu",
    ) -> None:
        """A player of a package that has been read (or is about to be written)."""
        self.manifest: Manifest = package.manifest
        self._rules = package.manifest.tiers[tier].rules
        # onnxruntime only borrows the tables: they must live as long as the session
        self._tables = {
            name: array.tobytes()
            for name, array in initialisers(package.tables[tier], self._rules).items()
        }
        self.provider = provider_named(provider)
        self._session = _session(package.graphs[tier], self._tables, threads, self.provider)
        canonical = self._body_from_rest(self.manifest.canonical_rotations)
        self._rest_from_canonical = np.linalg.inv(canonical)

    @classmethod
    def load(
        cls,
        path: Path | str,
        *,
        tier: str = "hq",
        threads: int = 1,
        provider: str = "cpu",
    ) -> "Player":
        """Reads a package.

        Args:
            path: The `.iavatar` file.
            tier: Which quality: "hq", or "lite" where the package has it.
            threads: Of one picture; more than one seldom pays: see `render_all`.
            provider: onnxruntime's execution provider, "cpu", "cuda", …

        Raises:
            BadInput: If the file is no sound package, or has no such tier, or there is no such
                provider here.
        """
        try:
            package = read_package(Path(path), tier=tier)
            return cls(package, tier=tier, threads=threads, provider=provider)
        except BadInput as cause:
            raise cause if str(path) in str(cause) else BadInput(f"{path}: {cause}") from cause

    def render(
        self,
        pose: BodyPose,
        camera: Camera,
        size: int | tuple[int, int] | None = None,
        samples: int | None = None,
    ) -> UInt8[np.ndarray, "height width 4"]:
        """The avatar's picture with straight alpha.

        Args:
            pose: In the camera's world.
            camera: Without lens distortion.
            size: Longer side, or width and height, of the picture in pixels: the camera's own field
                of view, scaled; the camera's own size if None.
            samples: Along 5 cm of a ray; the tier's own choice if None.

        Raises:
            BadInput: If the camera's lens bends, or there are no samples or no pixels.
        """
        samples = self._rules.samples if samples is None else samples
        if size is not None:
            camera = camera.fitted(size) if isinstance(size, int) else camera.resized(size)
        if camera.distortion:
            raise BadInput(
                "The camera has lens distortion, but the player draws pinhole pictures. "
                "Leave the distortion out of the camera."
            )
        if not 1 <= samples <= MOST_SAMPLES:
            raise BadInput(f"{samples} samples were asked for; 1 to {MOST_SAMPLES} can be drawn.")
        width, height = camera.size_px
        if not (0 < width <= LARGEST_PX and 0 < height <= LARGEST_PX):
            raise BadInput(
                f"Pictures of {width}x{height} px cannot be drawn; 1 to {LARGEST_PX} a side can."
            )
        lens = [*camera.focal_px, *camera.center_px]
        inputs = {
            "bones": self.bones(pose, camera).reshape(24, 12),
            "camera": np.array(lens, dtype=np.float32),
            "height": np.array(height, dtype=np.int64),
            "width": np.array(width, dtype=np.int64),
            "samples": np.array(samples, dtype=np.int64),
        }
        try:
            packed = np.asarray(self._session.run(["rgba"], inputs)[0])
        except Exception as error:  # onnxruntime has no common class for what a graph can do
            raise BadInput(f"The package's graph cannot draw this: {_shortened(error)}") from error
        if packed.size != height * width or packed.dtype != np.int32:
            raise BadInput(
                f"The package's graph draws {packed.dtype} {packed.shape} instead of one 32-bit "
                f"number for each of {width}x{height} px. It is damaged, or none of ours."
            )
        return packed.astype("<i4", copy=False).view(np.uint8).reshape(height, width, 4)

    def render_all(
        self,
        shots: Iterable[tuple[BodyPose, Camera]],
        *,
        workers: int = 1,
        samples: int | None = None,
    ) -> Generator[UInt8[np.ndarray, "_ _ 4"], None, None]:
        """Pictures of many shots, in their order, several at the same time.

        The pictures do not depend on how many workers draw them. No more than a few are held back
        until they are taken.

        Args:
            shots: Poses and cameras, as `render` takes them.
            workers: Threads; onnxruntime leaves Python free while it draws.
            samples: As in `render`.

        Raises:
            BadInput: As `render` does.
        """
        if workers == 1:
            for pose, camera in shots:
                yield self.render(pose, camera, samples=samples)
            return
        with ThreadPoolExecutor(workers) as beside:
            drawn = deque[Future[UInt8[np.ndarray, "_ _ 4"]]]()
            try:
                for pose, camera in shots:
                    drawn.append(beside.submit(self.render, pose, camera, samples=samples))
                    if len(drawn) >= 2 * workers:
                        yield drawn.popleft().result()
                while drawn:
                    yield drawn.popleft().result()
            finally:
                for picture in drawn:
                    picture.cancel()

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


def provider_named(name: str) -> str:
    """onnxruntime's own name of a provider: "cpu" is "CPUExecutionProvider".

    Raises:
        BadInput: If this onnxruntime has none of that name.
    """
    known = onnxruntime.get_available_providers()
    for provider in known:
        if name.lower() in (provider.lower(), provider.lower().removesuffix("executionprovider")):
            return provider
    short = ", ".join(provider.removesuffix("ExecutionProvider").lower() for provider in known)
    raise BadInput(
        f"onnxruntime {onnxruntime.__version__} has no provider {name!r} here; it has: {short}. "
        "Others come with other builds of it, such as onnxruntime-gpu or onnxruntime-openvino."
    )


def _shortened(error: Exception, most: int = 400) -> str:
    """What onnxruntime says, without the pages that some providers add."""
    said = " ".join(str(error).split())
    return said if len(said) <= most else f"{said[: most // 2]} … {said[-most // 2 :]}"


def _session(
    graph: bytes, tables: dict[str, bytes], threads: int, provider: str
) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 4  # what fails is said below
    options.enable_mem_reuse = False  # planning it takes longer than anything else at load
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    names, buffers = list(tables), list(tables.values())
    options.add_external_initializers_from_files_in_memory(
        names, buffers, [len(buffer) for buffer in buffers]
    )
    wanted = list(dict.fromkeys([provider, "CPUExecutionProvider"]))  # what it lacks, the CPU does
    try:
        session = onnxruntime.InferenceSession(graph, options, providers=wanted)
    except Exception as error:
        raise BadInput(
            f"The package's graph does not run on onnxruntime {onnxruntime.__version__} "
            f"({provider}): {_shortened(error)}"
        ) from error
    if session.get_providers()[0] != provider:
        raise BadInput(
            f"onnxruntime {onnxruntime.__version__} knows {provider} but could not start it here; "
            "it would draw on the CPU instead. Are the drivers and libraries installed?"
        )
    return session


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


def verify(path: Path | str, *, provider: str = "cpu") -> list[Likeness]:
    """Draws a package's golden frames again, on this machine.

    Args:
        path: The `.iavatar` file.
        provider: onnxruntime's execution provider.

    Returns:
        For each golden frame, how far the new picture is from the stored one.

    Raises:
        BadInput: If the file is no sound package, or there is no such provider.
    """
    package = read_package(Path(path))
    player = Player(package, provider=provider)
    return [
        Likeness.of(premultiplied(player.render(frame.pose, frame.camera)), premultiplied(stored))
        for frame, stored in zip(package.manifest.golden, package.golden, strict=True)
    ]
