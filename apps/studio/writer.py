"""The shoot: the actor in front of the camera, written as a native capture folder."""

import errno
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from apps.playing.encoders import video_encoder
from apps.studio import backdrop, motions, walk
from apps.studio.actor import Actor
from apps.studio.framing import framed
from apps.studio.room import Room
from apps.studio.roughen import roughened
from apps.studio.shoot_config import ShootConfig as ShootConfig
from apps.studio.stage import Stage
from apps.studio.tracker import in_cameras, tracked
from apps.terminal.places import check_folder_place
from capture.atomic_files import whole_folder
from capture.camera import Camera
from capture.errors import BadInput
from capture.quiet import silence_opencv
from preprocess.pose import Motion
from preprocess.pose_file import write_motion

Progress = Callable[[int, int], None]
"""Called after each picture with how many are done and how many there will be."""


def shoot(
    out: Path, config: ShootConfig, progress: Progress | None = None, *, overwrite: bool = False
) -> None:
    """Films the actor into the folder `out`, which appears whole or not at all.

    Args:
        out: Folder that will hold video.mp4, preview.webm, masks/, cameras.npz (a walkaround's lie
            in truth/), poses.npz, dance.npz and truth/.
        config: What is filmed.
        progress: Told after each picture; may raise to stop the shoot.
        overwrite: Whether an older capture in `out` gives way, if all of it was written by `shoot`.

    Raises:
        BadInput: If `out` is in the way, or a number of `config` is out of its range.
        OSError: If the disk is full.
    """
    config.check()
    _check_free(out, overwrite=overwrite)
    with whole_folder(out) as unfinished:
        _film(unfinished, config, progress or (lambda done, total: None))


def _check_free(out: Path, *, overwrite: bool) -> None:
    check_folder_place(out, "OUT")
    if not overwrite and out.exists() and any(out.iterdir()):
        raise BadInput(f"{out} already exists. Choose another OUT, or give --overwrite.")


def _film(folder: Path, config: ShootConfig, progress: Progress) -> None:
    actor = Actor.of(config.subject, config.seed)
    truth = _acted(actor, config)
    stages = _stages(actor, truth, config)
    novel = motions.novel(actor)
    total = len(truth) + len(novel)
    _write_video(folder, stages[0], truth, config, lambda done: progress(done, total))
    _write_preview(folder, config.fps)
    _write_novel(
        folder / "truth" / "novel", stages[1], novel,
        lambda done: progress(len(truth) + done, total),
    )  # fmt: skip
    cameras = stages[0].cameras
    given = truth if not config.walks else in_cameras(truth, cameras, actor.shaped.joints[0])
    given = tracked(
        given, degrees=config.pose_noise_deg, centimetres=config.pose_noise_cm, seed=config.seed
    )
    write_motion(folder / "poses.npz", given)
    write_motion(folder / "truth" / "poses.npz", truth)
    write_motion(folder / "dance.npz", motions.clip(actor))
    if config.walks:
        # Nobody tells a phone where it is: the cameras are truth, and lie where no command looks.
        _write_cameras(folder / "truth" / "cameras.npz", cameras)
        _write_cameras(folder / "truth" / "novel" / "cameras.npz", stages[1].cameras)
    else:
        _write_cameras(folder / "cameras.npz", cameras)


def _acted(actor: Actor, config: ShootConfig) -> Motion:
    acts = {"turn": motions.turn, "dance": motions.dance, "walkaround": motions.in_place}
    turns = config.turns
    if turns is None:
        turns = -0.75 if config.walks else 2.0
    return acts[config.motion](
        actor, frames=config.frames, fps=config.fps, turns=turns, seed=config.seed
    )


def _stages(actor: Actor, truth: Motion, config: ShootConfig) -> tuple[Stage, Stage]:
    """Where the film is made, and where the poses that no film holds are pictured."""
    kind = config.behind
    if config.walks:
        tall = walk.height_of(actor)
        at = (truth.root_translations + actor.shaped.joints[0])[:, [0, 2]]
        cameras = walk.carried(at, tall, config.size, config.seed)
        apart = walk.standing(tall, config.size)
    else:
        apart = framed(actor, config.size)
        cameras = (apart,)
    if kind == "room" or kind == "tiles":
        behind = Room.furnished(kind, config.size, config.seed)
    else:
        behind = backdrop.paint(kind, apart, np.random.default_rng([config.seed, 4]))
    filmed = Stage(actor=actor, cameras=cameras, behind=behind)
    return filmed, replace(filmed, cameras=(apart,), first=len(truth))


def _write_cameras(path: Path, cameras: tuple[Camera, ...]) -> None:
    """One camera, or one a frame, with their common K."""
    extrinsics = np.stack([camera.camera_from_world for camera in cameras])
    width, height = cameras[0].size_px
    np.savez(
        path,
        intrinsic=cameras[0].intrinsic,
        extrinsic=extrinsics[0] if len(cameras) == 1 else extrinsics,
        height=height,
        width=width,
    )


def _write_video(
    folder: Path, stage: Stage, motion: Motion, config: ShootConfig, done: Callable[[int], None]
) -> None:
    """video.mp4, lossless (FFV1), and masks/."""
    (folder / "masks").mkdir()
    path = folder / "video.mp4"
    # The default mp4v costs 30 dB on stripes; FFV1 is exact, fast, and OpenCV reads it.
    silence_opencv()
    code = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, config.fps, stage.cameras[0].size_px)
    if not writer.isOpened():
        path.write_bytes(bytes(1 << 16))  # says so if there is no room
        raise BadInput(
            f"OpenCV {cv2.__version__} cannot write a lossless video (FFV1 in .mp4); 4.13 or newer "
            "can: pip install --upgrade opencv-contrib-python-headless."
        )
    generator = np.random.default_rng([config.seed, 5])
    try:
        for index, (rgb, alpha) in enumerate(stage.pictures(motion)):
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


def _write_preview(folder: Path, fps: float) -> None:
    """Write preview.webm: the film for browsers and phones, which play no lossless video."""

    def frames() -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        video = cv2.VideoCapture(str(folder / "video.mp4"), cv2.CAP_FFMPEG)
        while (read := video.read())[0]:
            yield np.ascontiguousarray(read[1][..., ::-1])
        video.release()

    video_encoder(".webm", transparent=False).write(folder / "preview.webm", frames(), fps)


def _write_novel(folder: Path, stage: Stage, motion: Motion, done: Callable[[int], None]) -> None:
    """Never-seen poses with their true images and masks."""
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    for index, (rgb, alpha) in enumerate(stage.pictures(motion)):
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
