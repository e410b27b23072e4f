"""The player: poses and cameras in, pictures out, with numpy and onnxruntime alone.

player = Player.load("avatar.iavatar")
rgba = player.render(pose, camera)          # uint8, straight alpha
"""

from collections.abc import Generator, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

import numpy as np
import onnxruntime
from jaxtyping import Float, Float32, UInt8

from capture.camera import Camera
from capture.input_error import InputError
from capture.work_ahead import map_ahead
from export.package.manifest import Manifest
from export.package.package_file import AvatarPackage, read_package
from export.player_inputs import (
    ResolutionLimit,
    check_render_inputs,
    downscale_camera,
    graph_initializers,
    graph_inputs,
    resize_camera,
    upscale_picture,
)
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import body_from_rest, world_from_body

MIN_SAME_PSNR = 48.0
"""Least PSNR between pictures that count as the same, dB.

Rounding to 8 bits alone leaves 59 dB; one pixel in a thousand that is wrong altogether, 30 dB.
"""


@dataclass(frozen=True, kw_only=True)
class PictureDifference:
    """Difference of two premultiplied pictures.

    Attributes:
        largest_difference: Over all pixels and channels, in 1/255.
        close_fraction: Fraction of the pixels that differ by at most 2/255.
        psnr: Over all pixels and channels, dB; at most 90.
    """

    largest_difference: float
    close_fraction: float
    psnr: float

    @classmethod
    def of(
        cls, a: Float32[np.ndarray, "height width 4"], b: Float32[np.ndarray, "height width 4"]
    ) -> "PictureDifference":
        """Compare two premultiplied pictures in [0, 1]."""
        difference = np.abs(a - b).max(axis=-1) * 255.0
        return cls(
            largest_difference=float(difference.max()),
            close_fraction=float((difference <= 2).mean()),
            psnr=float(-10.0 * np.log10(max(np.mean((a - b) ** 2), 1e-9))),
        )

    @property
    def matches(self) -> bool:
        """Tell whether they count as the same picture."""
        return self.psnr >= MIN_SAME_PSNR


def premultiply(rgba: UInt8[np.ndarray, "height width 4"]) -> Float32[np.ndarray, "height width 4"]:
    """Convert a straight 8-bit picture to premultiplied floats in [0, 1]."""
    picture = rgba.astype(np.float32) / np.float32(255.0)
    picture[..., :3] *= picture[..., 3:]
    return picture


def straighten(
    premultiplied: Float32[np.ndarray, "height width 4"],
) -> UInt8[np.ndarray, "height width 4"]:
    """Convert premultiplied floats to a straight 8-bit picture."""
    alpha = premultiplied[..., 3:]
    color = premultiplied[..., :3] / np.maximum(alpha, 1e-6)
    picture = np.concatenate([color, alpha], axis=-1)
    return np.round(np.clip(picture, 0.0, 1.0) * 255.0).astype(np.uint8)


def picture_on_white(
    premultiplied: Float32[np.ndarray, "*pixels 4"],
) -> Float32[np.ndarray, "*pixels 3"]:
    """Composite premultiplied pixels over white, clipped to [0, 1]."""
    return np.clip(premultiplied[..., :3] + (1.0 - premultiplied[..., 3:]), 0.0, 1.0)


IN_MEMORY_TABLES = "add_external_initializers_from_files_in_memory"
"""Method of `SessionOptions` that older releases lack."""


@final
class Player:
    """Draws an avatar in any pose, from any camera, in any size.

    One player may be used by several threads at once.

    Attributes:
        manifest: The package's joints, tiers, golden frames and licence.
        provider: onnxruntime's execution provider that draws.
    """

    def __init__(
        self,
        package: AvatarPackage,
        *,
        tier: str = "hq",
        threads: int = 1,
        provider: str = "cpu",
        optimize: bool = True,
    ) -> None:
        """Prepare the graph of a package that was read or is about to be written.

        Args:
            package: Tables and graphs.
            tier: Quality tier.
            threads: Threads for one picture.
            provider: onnxruntime's execution provider, "cpu", "cuda", …
            optimize: Whether onnxruntime may change the graph: 0.15 s, which fifty pictures gain.
        """
        self.manifest: Manifest = package.manifest
        self._settings = package.manifest.tiers[tier].settings
        self._close_ups = ResolutionLimit(package.tables[tier], self._settings)
        # onnxruntime only borrows the tables: they must live as long as the session
        self._tables = {
            name: array.tobytes()
            for name, array in graph_initializers(package.tables[tier], self._settings).items()
        }
        self.provider = find_provider(provider)
        self._session = create_session(
            package.graphs[tier], self._tables, threads, self.provider, optimize=optimize
        )
        canonical = self._body_from_rest(self.manifest.canonical_rotations)
        self._rest_from_canonical = np.linalg.inv(canonical)

    @classmethod
    def load(
        cls, path: Path | str, *, tier: str = "hq", threads: int = 1, provider: str = "cpu"
    ) -> "Player":
        """Read a package and prepare its player.

        More than one of `threads` rarely pays (see `render_all`); arguments as of `Player`.

        Raises:
            InputError: If the file is not a sound package, or lacks the tier, or the provider is
                unknown.
        """
        try:
            package = read_package(Path(path), tier=tier)
            return cls(package, tier=tier, threads=threads, provider=provider)
        except InputError as cause:
            raise cause if str(path) in str(cause) else InputError(f"{path}: {cause}") from cause

    def render_canonical(self, camera: Camera) -> UInt8[np.ndarray, "height width 4"]:
        """Draw the avatar in its canonical pose, where it was learnt; straight alpha."""
        learnt = self.manifest.canonical_rotations
        return self.render(replace(BodyPose.rest(), joint_rotations=learnt), camera)

    def render(
        self,
        pose: BodyPose,
        camera: Camera,
        size: int | np.integer | tuple[int, int] | None = None,
        samples: int | None = None,
    ) -> UInt8[np.ndarray, "height width 4"]:
        """Draw the avatar with straight alpha.

        Args:
            pose: In the camera's world.
            camera: Without lens distortion.
            size: Longer side, or width and height, of the picture in pixels, with the camera's
                field of view; the camera's own size if None.
            samples: Density samples along 5 cm of a ray; the tier's own number if None.

        Raises:
            InputError: If the camera has lens distortion, there are no samples or no pixels, or
                pose or camera have another shape or are not finite.
        """
        samples = self._settings.samples if samples is None else samples
        camera = resize_camera(camera, size)
        check_render_inputs(pose, camera, samples)
        bones = self.bones(pose, camera)
        factor = self._close_ups.downscale_factor(bones, camera)
        if factor == 1.0:
            return self._run_graph(bones, camera, samples)
        return upscale_picture(
            self._run_graph(bones, downscale_camera(camera, factor), samples),
            camera.size_px,
            factor,
        )

    def _run_graph(
        self, bones: Float32[np.ndarray, "24 3 4"], camera: Camera, samples: int
    ) -> UInt8[np.ndarray, "height width 4"]:
        """Run the graph once."""
        width, height = camera.size_px
        try:
            inputs = graph_inputs(bones, camera, samples)
            packed = np.asarray(self._session.run(["rgba"], inputs)[0])
        except Exception as error:  # onnxruntime has no common class for what a graph can do
            raise InputError(
                f"The package's graph cannot draw this: {shorten_error(error)}"
            ) from error
        if packed.size != height * width or packed.dtype != np.int32:
            raise InputError(
                f"The package's graph draws {packed.dtype} {packed.shape} instead of one 32-bit "
                f"number for each of {width}x{height} px. It is damaged, or another program "
                "wrote it."
            )
        return packed.astype("<i4", copy=False).view(np.uint8).reshape(height, width, 4)

    def render_all(
        self,
        shots: Iterable[tuple[BodyPose, Camera]],
        *,
        workers: int = 1,
        samples: int | None = None,
    ) -> Generator[UInt8[np.ndarray, "_ _ 4"], None, None]:
        """Yield the pictures of many poses and cameras in order, drawing several at a time.

        The pictures do not depend on the number of workers, which are threads; at most two a worker
        are held back. Other arguments are as of `render`.
        """
        if workers == 1:
            for pose, camera in shots:
                yield self.render(pose, camera, samples=samples)
            return
        yield from map_ahead(
            lambda shot: self.render(*shot, samples=samples), shots, workers=workers
        )

    def bones(self, pose: BodyPose, camera: Camera) -> Float32[np.ndarray, "24 3 4"]:
        """Return camera-from-canonical matrices of the joints."""
        camera_from_canonical = camera.camera_from_world @ self.world_from_canonical(pose)
        return camera_from_canonical[:, :3].astype(np.float32)

    def world_from_canonical(self, pose: BodyPose) -> Float[np.ndarray, "24 4 4"]:
        """Return the joints' matrices that move canonical points into the pose's world."""
        root = world_from_body(
            self.manifest.rest_joints[0], pose.root_rotation, pose.root_translation
        )
        return root @ self._body_from_rest(pose.joint_rotations) @ self._rest_from_canonical

    def _body_from_rest(self, rotations: Float[np.ndarray, "23 3"]) -> Float[np.ndarray, "24 4 4"]:
        return body_from_rest(self.manifest.rest_joints, self.manifest.parents, rotations)


def compare_golden_frames(
    package: AvatarPackage, *, provider: str = "cpu"
) -> list[PictureDifference]:
    """Draw a package's golden frames again and compare them with the stored ones."""
    player = Player(package, provider=provider)
    return [
        PictureDifference.of(
            premultiply(player.render(frame.pose, frame.camera)), premultiply(stored)
        )
        for frame, stored in zip(package.manifest.golden, package.golden, strict=True)
    ]


def find_provider(name: str) -> str:
    """Return onnxruntime's full name of a provider: "cpu" is "CPUExecutionProvider"."""
    known = onnxruntime.get_available_providers()
    for provider in known:
        if name.lower() in (provider.lower(), provider.lower().removesuffix("executionprovider")):
            return provider
    short = ", ".join(provider.removesuffix("ExecutionProvider").lower() for provider in known)
    raise InputError(
        f"onnxruntime {onnxruntime.__version__} has no provider {name!r} here; it has: {short}. "
        "Others come with other builds of it, such as onnxruntime-gpu or onnxruntime-openvino."
    )


def shorten_error(error: Exception) -> str:
    """Return onnxruntime's message on one line, its middle cut out beyond 400 characters."""
    message = " ".join(str(error).split())
    return message if len(message) <= 400 else f"{message[:200]} … {message[-200:]}"


def create_session(
    graph: bytes, tables: dict[str, bytes], threads: int, provider: str, *, optimize: bool = True
) -> onnxruntime.InferenceSession:
    """Create a session for a graph, with threads that do not spin.

    `tables` are its external tables by name, which must outlive the session; `provider` is a name
    from `find_provider`.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 4  # failures are reported below
    options.enable_mem_reuse = False  # its planning dominates loading time
    levels = onnxruntime.GraphOptimizationLevel
    options.graph_optimization_level = (
        levels.ORT_ENABLE_BASIC if optimize else levels.ORT_DISABLE_ALL
    )
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    names, buffers = list(tables), list(tables.values())
    if not hasattr(options, IN_MEMORY_TABLES):
        raise InputError(
            f"onnxruntime {onnxruntime.__version__} is too old for the player; 1.24 "
            "or newer is needed: pip install --upgrade onnxruntime (or the build that you use)."
        )
    getattr(options, IN_MEMORY_TABLES)(names, buffers, [len(buffer) for buffer in buffers])
    wanted = list(dict.fromkeys([provider, "CPUExecutionProvider"]))  # the CPU runs what it lacks
    try:
        session = onnxruntime.InferenceSession(graph, options, providers=wanted)
    except Exception as error:
        raise InputError(
            f"The package's graph does not run on onnxruntime {onnxruntime.__version__} "
            f"({provider}): {shorten_error(error)}"
        ) from error
    if session.get_providers()[0] != provider:
        raise InputError(
            f"onnxruntime {onnxruntime.__version__} knows {provider} but could not start it here; "
            "it would draw on the CPU instead. Are the drivers and libraries installed?"
        )
    return session
