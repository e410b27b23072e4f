"""The shoot: the actor in front of the camera, written as a native capture folder."""

import errno
import shutil
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from os import cpu_count, getpid
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from apps.studio import backdrop, motions
from apps.studio.actor import Actor
from apps.studio.framing import framed
from apps.studio.roughen import roughened
from apps.studio.shade import over
from apps.studio.tracker import tracked
from capture.camera import Camera
from capture.errors import BadInput
from capture.quiet import silence_opencv
from preprocess.pose import BodyPose, Motion
from preprocess.pose_file import write_motion

Progress = Callable[[int, int], None]
"""Called after each picture with how many are done and how many there will be."""


@dataclass(frozen=True, kw_only=True)
class ShootConfig:
    """What is filmed, and how well the poses and masks are known."""

    frames: int = 120
    """Frames of the video."""
    fps: float = 30.0
    """Frames per second of the video."""
    size: int = 270
    """Width and height of the pictures in pixels."""
    turns: float = 2.0
    """How often the actor turns round."""
    seed: int = 0
    """Of the swaying, the clutter and the noise; from 1 on it varies the actor's looks, too."""
    subject: Literal[1, 2] = 1
    """Which of the two actors."""
    motion: Literal["turn", "dance"] = "turn"
    """What the actor does: turns with arms held off the body, or dances."""
    background: Literal["plain", "clutter"] = "clutter"
    """What stands behind the actor: a bare wall, or a room full of things."""
    pose_noise_deg: float = 0.0
    """Noise of the poses: standard deviation of each rotation component, in degrees."""
    pose_noise_cm: float = 0.0
    """Noise of the poses: standard deviation of each component of the place, in centimetres."""
    mask_noise_px: float = 0.0
    """Noise of the masks: standard deviation of their border, in pixels."""

    def check(self) -> None:
        """Refuses what cannot be filmed.

        Raises:
            BadInput: If a number is out of its range.
        """
        ranges = {
            "frames": (1, 100_000), "fps": (0.1, 1000.0), "size": (16, 4096),
            "turns": (-100.0, 100.0), "seed": (0, 2**31 - 1), "pose_noise_deg": (0.0, 90.0),
            "pose_noise_cm": (0.0, 100.0), "mask_noise_px": (0.0, 50.0),
        }  # fmt: skip
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if not low <= value <= high:
                option = "--" + name.replace("_", "-")
                raise BadInput(f"{option} is {value}, but must lie between {low} and {high}.")


def shoot(
    out: Path, config: ShootConfig, progress: Progress | None = None, *, overwrite: bool = False
) -> None:
    """Films the actor into the folder `out`, which appears whole or not at all.

    Args:
        out: Folder that will hold video.mp4, masks/, cameras.npz, poses.npz, dance.npz and truth/.
        config: What is filmed.
        progress: Told after each picture; may raise to stop the shoot.
        overwrite: Whether an older capture in `out` gives way.

    Raises:
        BadInput: If `out` is in the way, or a number of `config` is out of its range.
        OSError: If the disk is full.
    """
    config.check()
    _check_place(out, overwrite=overwrite)
    out.parent.mkdir(parents=True, exist_ok=True)
    unfinished = out.parent / f".{out.name}.unfinished-{getpid()}"
    unfinished.mkdir()
    try:
        _film(unfinished, config, progress or (lambda done, total: None))
        if out.exists():
            old = out.parent / f".{out.name}.old-{getpid()}"
            out.rename(old)
            unfinished.rename(out)
            shutil.rmtree(old)
        else:
            unfinished.rename(out)
    except BaseException:
        shutil.rmtree(unfinished, ignore_errors=True)
        raise


def _check_place(out: Path, *, overwrite: bool) -> None:
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if not out.is_dir():
        raise BadInput(f"{out} is a file, but a folder is to be written. Choose another OUT.")
    if not overwrite:
        raise BadInput(f"{out} already exists. Choose another OUT, or give --overwrite.")
    if not (out / "poses.npz").exists():
        raise BadInput(
            f"{out} is no capture folder (it holds no poses.npz), so --overwrite leaves it alone. "
            "Choose another OUT, or delete it yourself."
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Studio:
    """All that stays the same from picture to picture."""

    actor: Actor
    camera: Camera
    background: UInt8[np.ndarray, "height width 3"]

    def picture(
        self, pose: BodyPose
    ) -> tuple[UInt8[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]:
        """The actor in the room, and the exact soft mask."""
        rgb, alpha = self.actor.layers_of(pose, self.camera)
        feet = self.actor.shaped.with_pose(pose).joints()[[10, 11]]
        return over(rgb, alpha, backdrop.shadowed(self.background, feet, self.camera)), alpha

    def pictures(
        self, motion: Motion
    ) -> Iterator[tuple[UInt8[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]]:
        """All pictures of a motion in order, a few drawn ahead on other threads."""
        workers = max(1, min(4, cpu_count() or 1))
        with ThreadPoolExecutor(workers) as pool:
            ahead = deque()
            try:
                for row in range(len(motion)):
                    ahead.append(pool.submit(self.picture, motion[row]))
                    if len(ahead) > workers:
                        yield ahead.popleft().result()
                while ahead:
                    yield ahead.popleft().result()
            finally:
                for waiting in ahead:
                    waiting.cancel()


def _film(folder: Path, config: ShootConfig, progress: Progress) -> None:
    actor = Actor.of(config.subject, config.seed)
    camera = framed(actor, config.size)
    background = backdrop.paint(config.background, camera, np.random.default_rng([config.seed, 4]))
    studio = _Studio(actor=actor, camera=camera, background=background)
    act = motions.turn if config.motion == "turn" else motions.dance
    truth = act(actor, frames=config.frames, fps=config.fps, turns=config.turns, seed=config.seed)
    novel = motions.novel(actor)
    total = len(truth) + len(novel)
    _write_video(folder, studio, truth, config, lambda done: progress(done, total))
    _write_novel(
        folder / "truth" / "novel", studio, novel, lambda done: progress(len(truth) + done, total)
    )
    given = tracked(
        truth, degrees=config.pose_noise_deg, centimetres=config.pose_noise_cm, seed=config.seed
    )
    write_motion(folder / "poses.npz", given)
    write_motion(folder / "truth" / "poses.npz", truth)
    write_motion(folder / "dance.npz", motions.clip(actor))
    np.savez(
        folder / "cameras.npz",
        intrinsic=camera.intrinsic,
        extrinsic=camera.camera_from_world,
        height=config.size,
        width=config.size,
    )


def _write_video(
    folder: Path, studio: _Studio, motion: Motion, config: ShootConfig, done: Callable[[int], None]
) -> None:
    """video.mp4, lossless (FFV1), and masks/."""
    (folder / "masks").mkdir()
    path = folder / "video.mp4"
    # The default mp4v costs 30 dB on stripes; FFV1 is exact, fast, and OpenCV reads it.
    silence_opencv()
    code = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, config.fps, studio.camera.size_px)
    generator = np.random.default_rng([config.seed, 5])
    try:
        for index, (rgb, alpha) in enumerate(studio.pictures(motion)):
            writer.write(np.ascontiguousarray(rgb[..., ::-1]))
            mask = roughened(alpha, config.mask_noise_px, generator)
            _write_png(folder / "masks" / f"{index:04d}.png", _eight_bit(mask))
            done(index + 1)
    finally:
        writer.release()
    _check_video(path, len(motion))


def _check_video(path: Path, frames: int) -> None:
    """OpenCV does not say when it could not write; so the file is asked."""
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    written = int(video.get(cv2.CAP_PROP_FRAME_COUNT)) if video.isOpened() else 0
    video.release()
    if written != frames:
        raise OSError(errno.ENOSPC, f"only {written} of {frames} video frames could be written")


def _write_novel(
    folder: Path, studio: _Studio, motion: Motion, done: Callable[[int], None]
) -> None:
    """Never-seen poses with their true images and masks."""
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    for index, (rgb, alpha) in enumerate(studio.pictures(motion)):
        _write_png(folder / "images" / f"{index:04d}.png", np.ascontiguousarray(rgb[..., ::-1]))
        _write_png(folder / "masks" / f"{index:04d}.png", _eight_bit(alpha))
        done(index + 1)
    write_motion(folder / "poses.npz", motion)


def _eight_bit(alpha: Float32[np.ndarray, "height width"]) -> UInt8[np.ndarray, "height width"]:
    return (alpha * 255.0 + 0.5).astype(np.uint8)


def _write_png(path: Path, image: UInt8[np.ndarray, "..."]) -> None:
    """A PNG in OpenCV's channel order; unlike OpenCV's own writer it says when the disk is full."""
    _, code = cv2.imencode(".png", image)
    path.write_bytes(code.tobytes())
