"""Film the actor before a backdrop or in a room, and write a native capture folder."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from capture.atomic_files import atomic_folder, check_replaceable_folder
from capture.camera import Camera
from capture.input_error import InputError
from capture.video_encoder import video_encoder
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.pose_formats.pose_format_registry import read_poses
from preprocess.poses.pose_file import write_motion
from studio import actor_motions, studio_cameras
from studio.actor import Actor
from studio.capture_files import lossless_video, to_uint8, write_cameras, write_png
from studio.draw_ahead import RenderedFrame, ShootProgress, draw_ahead
from studio.input_noise import add_mask_noise, add_pose_noise, to_camera_space
from studio.lighting import composite_over
from studio.phone.phone_capture import write_phone_capture
from studio.room import painted_backdrop
from studio.room.furnished_room import FurnishedRoom
from studio.shoot_config import ShootConfig as ShootConfig
from studio.studio_cameras import static_camera


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class StudioScene:
    """What a motion is filmed on.

    Attributes:
        actor: Who is filmed.
        cameras: One for all pictures, or one for each.
        background: A painted backdrop (for one camera), or a room.
        first_frame_number: Number of the first image, on which a room's noise depends.
    """

    actor: Actor
    cameras: tuple[Camera, ...]
    background: UInt8[np.ndarray, "height width 3"] | FurnishedRoom
    first_frame_number: int = 0

    def render(self, pose: BodyPose, number: int) -> RenderedFrame:
        """One picture."""
        camera = self.cameras[min(number, len(self.cameras) - 1)]
        rgb, alpha = self.actor.render_rgb_alpha(pose, camera)
        feet = self.actor.shaped.with_pose(pose).joints()[[10, 11]]
        return composite_over(rgb, alpha, self._render_background(camera, feet, number)), alpha

    def render_all(self, motion: Motion) -> Iterator[RenderedFrame]:
        """All pictures of a motion in order, a few drawn ahead on other threads."""
        return draw_ahead(lambda row: self.render(motion[row], row), len(motion))

    def _render_background(
        self, camera: Camera, feet: Float[np.ndarray, "feet 3"], number: int
    ) -> UInt8[np.ndarray, "height width 3"]:
        if isinstance(self.background, FurnishedRoom):
            return self.background.render(camera, feet, self.first_frame_number + number)
        return painted_backdrop.add_foot_shadows(self.background, feet, camera)


def film_capture(
    out: Path,
    config: ShootConfig,
    progress: ShootProgress | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Films the actor into the folder `out`, which appears whole or not at all.

    Args:
        out: Folder that will hold video.mp4, preview.webm, masks/, cameras.npz (a walkaround's lie
            in truth/), poses.npz, dance.npz and truth/; see `write_phone_capture` for a phone's.
        config: What is filmed.
        progress: Told after each picture; may raise to stop the shoot.
        overwrite: Whether an older capture in `out` gives way, if all of it was written by `shoot`.

    Raises:
        InputError: If `out` is in the way, or a number of `config` is out of its range.
        OSError: If the disk is full.
    """
    config.validate()
    _check_output(out, overwrite=overwrite)
    with atomic_folder(out) as unfinished:
        write = write_phone_capture if config.like_a_phone else _write_capture
        write(unfinished, config, progress or (lambda done, total: None))


def _check_output(out: Path, *, overwrite: bool) -> None:
    check_replaceable_folder(out)
    if not overwrite and out.exists() and any(out.iterdir()):
        raise InputError(f"{out} already exists. Choose another OUT, or give --overwrite.")


def _write_capture(folder: Path, config: ShootConfig, progress: ShootProgress) -> None:
    actor = Actor.of(config.subject, config.seed)
    truth = _choose_motion(actor, config)
    stages = _build_scenes(actor, truth, config)
    novel = actor_motions.novel_poses(actor)
    total = len(truth) + len(novel)
    _write_video(folder, stages[0], truth, config, lambda done: progress(done, total))
    _write_preview(folder, config.fps)
    _write_novel_poses(
        folder / "truth" / "novel", stages[1], novel,
        lambda done: progress(len(truth) + done, total),
    )  # fmt: skip
    cameras = stages[0].cameras
    given = (
        truth
        if not config.camera_moves
        else to_camera_space(truth, cameras, actor.shaped.joints[0])
    )
    given = add_pose_noise(
        given, degrees=config.pose_noise_deg, centimetres=config.pose_noise_cm, seed=config.seed
    )
    write_motion(folder / "poses.npz", given)
    write_motion(folder / "truth" / "poses.npz", truth)
    write_motion(folder / "dance.npz", actor_motions.unfilmed_dance(actor))
    if config.camera_moves:
        # A phone does not know where it is: the cameras are ground truth, where no command looks.
        write_cameras(folder / "truth" / "cameras.npz", cameras)
        write_cameras(folder / "truth" / "novel" / "cameras.npz", stages[1].cameras)
    else:
        write_cameras(folder / "cameras.npz", cameras)


def _choose_motion(actor: Actor, config: ShootConfig) -> Motion:
    if config.track is not None:
        track = read_poses(config.track)
        return actor_motions.tracked_motion(actor, track, frames=config.frames, fps=config.fps)
    acts = {
        "turn": actor_motions.turning_motion,
        "dance": actor_motions.dancing_motion,
        "walkaround": actor_motions.gesturing_motion,
    }
    turns = config.turns
    if turns is None:
        turns = -0.75 if config.camera_moves else 2.0
    return acts[config.motion](
        actor, frames=config.frames, fps=config.fps, turns=turns, seed=config.seed
    )


def _build_scenes(
    actor: Actor, truth: Motion, config: ShootConfig
) -> tuple[StudioScene, StudioScene]:
    """Where the film is made, and where the poses that no film holds are pictured."""
    kind = config.effective_background
    if config.camera_moves:
        tall = studio_cameras.actor_height_m(actor)
        at = (truth.root_translations + actor.shaped.joints[0])[:, [0, 2]]
        cameras = studio_cameras.handheld_cameras(at, tall, config.size, config.seed)
        apart = studio_cameras.standing_camera(tall, config.size)
    else:
        apart = static_camera(actor, config.size)
        cameras = (apart,)
    if kind == "room" or kind == "tiles":
        behind = FurnishedRoom.furnished(kind, config.size, config.seed)
    else:
        behind = painted_backdrop.paint_backdrop(
            kind, apart, np.random.default_rng([config.seed, 4])
        )
    filmed = StudioScene(actor=actor, cameras=cameras, background=behind)
    return filmed, replace(filmed, cameras=(apart,), first_frame_number=len(truth))


def _write_video(
    folder: Path,
    stage: StudioScene,
    motion: Motion,
    config: ShootConfig,
    done: Callable[[int], None],
) -> None:
    """video.mp4, lossless (FFV1), and masks/."""
    (folder / "masks").mkdir()
    generator = np.random.default_rng([config.seed, 5])
    size_px = stage.cameras[0].size_px
    with lossless_video(folder / "video.mp4", size_px, config.fps, len(motion)) as writer:
        for index, (rgb, alpha) in enumerate(stage.render_all(motion)):
            writer.write(np.ascontiguousarray(rgb[..., ::-1]))
            mask = add_mask_noise(alpha, config.mask_noise_px, generator)
            write_png(folder / "masks" / f"{index:04d}.png", to_uint8(mask))
            done(index + 1)


def _write_preview(folder: Path, fps: float) -> None:
    """Write preview.webm: the film for browsers and phones, which play no lossless video."""

    def frames() -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        video = cv2.VideoCapture(str(folder / "video.mp4"), cv2.CAP_FFMPEG)
        while (read := video.read())[0]:
            yield np.ascontiguousarray(read[1][..., ::-1])
        video.release()

    video_encoder(".webm", transparent=False).write(folder / "preview.webm", frames(), fps)


def _write_novel_poses(
    folder: Path, stage: StudioScene, motion: Motion, done: Callable[[int], None]
) -> None:
    """Never-seen poses with their true images and masks."""
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    for index, (rgb, alpha) in enumerate(stage.render_all(motion)):
        write_png(folder / "images" / f"{index:04d}.png", np.ascontiguousarray(rgb[..., ::-1]))
        write_png(folder / "masks" / f"{index:04d}.png", to_uint8(alpha))
        done(index + 1)
    write_motion(folder / "poses.npz", motion)
