"""Film the actor before a backdrop or in a room, and write a capture folder, exact or a phone's."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float, UInt8

from capture.atomic_files import atomic_folder, check_replaceable_folder
from capture.camera import Camera
from capture.hardware import usable_cores
from capture.image_folder import write_png
from capture.input_error import InputError
from capture.source import AlphaMask, FrameSelection, RgbImage
from capture.video import VideoFile
from capture.video_writer import FFV1, H264, open_video_writer, write_video
from capture.work_ahead import map_ahead
from instant_avatar.studio import painted_surfaces, staging
from instant_avatar.studio.actor import Actor
from instant_avatar.studio.furnished_room import FurnishedRoom
from instant_avatar.studio.input_errors import (
    SegmenterErrors,
    add_mask_noise,
    add_pose_noise,
    mistake_focal_length,
    to_camera_space,
    track_poses,
)
from instant_avatar.studio.lighting import RenderedFrame, composite_over
from instant_avatar.studio.outfit import SUBJECT_PROPORTIONS
from instant_avatar.studio.phone_pictures import (
    MovingCloth,
    PhoneScene,
    RoomLight,
    drifting_exposure,
    expose,
)
from instant_avatar.studio.shoot_config import ShootConfig as ShootConfig
from instant_avatar.studio.staging import portrait_camera, static_camera
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.parametric_body import ShapedBody, load_body_model
from preprocess.cameras.camera_file import CameraTrack, write_cameras
from preprocess.poses.pose_file import write_motion
from preprocess.poses.pose_format_registry import read_poses

ShootProgress = Callable[[int, int], None]
"""Called after each picture with how many are done and how many there will be."""


def draw_ahead(render: Callable[[int], RenderedFrame], count: int) -> Iterator[RenderedFrame]:
    """The pictures 0 … count - 1 in order, as `render` draws them."""
    return map_ahead(render, range(count), workers=min(4, usable_cores()))


def _to_uint8(alpha: AlphaMask) -> UInt8[np.ndarray, "height width"]:
    return (alpha * 255.0 + 0.5).astype(np.uint8)


def _write_track(path: Path, *cameras: Camera) -> None:
    write_cameras(path, CameraTrack(cameras=cameras, source="studio"))


PHONE_TURNS, WALK_TURNS, TURNS = 1.25, -0.75, 2.0
"""Turns of the actor before a phone, a phone that is carried around, or the studio's camera, if the
user names none."""


def _write_phone_capture(folder: Path, config: ShootConfig, progress: ShootProgress) -> None:
    """Film the actor as reality would, into an empty folder.

    It then holds video.mp4, masks/, cameras.npz and poses.npz, all of them a little wrong;
    dance.npz; and truth/: body.npz (the person, a body model without betas), poses.npz,
    cameras.npz, masks/, exposure.npz (gains of red, green and blue a frame), and novel/ (poses
    never filmed with sharp, neutrally exposed images, masks and cameras.npz).
    """
    actor = Actor.of(config.subject, config.seed, SUBJECT_PROPORTIONS[config.subject])
    camera = portrait_camera(actor, config.size, dances=config.motion == "dance")
    backdrop = painted_surfaces.paint_backdrop(
        "plain" if config.background == "plain" else "clutter",
        camera,
        np.random.default_rng([config.seed, 4]),
    )
    scene = PhoneScene(
        actor=actor,
        camera=camera,
        background=backdrop,
        light=RoomLight(actor),
        cloth=MovingCloth(actor, config.seed),
        fps=config.fps,
    )
    truth = _choose_motion(actor, config)
    novel = staging.novel_poses(actor)
    total = len(truth) + len(novel)
    _film(folder, scene, truth, config, lambda done: progress(done, total))
    stills = draw_ahead(lambda row: scene.still(novel[row]), len(novel))
    _write_novel(
        folder / "truth" / "novel", novel, stills, camera,
        lambda done: progress(len(truth) + done, total),
    )  # fmt: skip
    _write_body(folder / "truth" / "body.npz", actor.shaped)
    write_motion(folder / "truth" / "poses.npz", truth)
    _write_track(folder / "truth" / "cameras.npz", camera)
    write_motion(folder / "dance.npz", staging.unfilmed_dance(actor))
    _write_inputs(folder, scene, truth, config)


def _choose_motion(actor: Actor, config: ShootConfig) -> Motion:
    if config.track is not None:
        track = read_poses(config.track)
        return staging.tracked_motion(actor, track, frames=config.frames, fps=config.fps)
    turns = WALK_TURNS if config.camera_moves else TURNS
    acts = {
        "turn": staging.turning_motion,
        "dance": staging.dancing_motion,
        "walkaround": staging.gesturing_motion,
    }
    if config.like_a_phone:
        turns = PHONE_TURNS
        acts["turn"] = partial(acts["turn"], arm_lift_deg=-64.0)  # fits into a portrait
    return acts[config.motion](
        actor,
        frames=config.frames,
        fps=config.fps,
        turns=turns if config.turns is None else config.turns,
        seed=config.seed,
    )


def _film(
    folder: Path, scene: PhoneScene, truth: Motion, config: ShootConfig, done: Callable[[int], None]
) -> None:
    """video.mp4, masks/, and what is exact of them in truth/."""
    (folder / "masks").mkdir()
    (folder / "truth" / "masks").mkdir(parents=True)
    frames = len(truth)
    gains = drifting_exposure(frames, config.fps, config.seed)
    np.savez(folder / "truth" / "exposure.npz", gains=gains)
    segmenter = SegmenterErrors(frames, config.fps, config.seed)
    generator = np.random.default_rng([config.seed, 26])
    camera, body = scene.camera, scene.actor.shaped
    pictures = draw_ahead(lambda row: scene.frame(truth, row), frames)
    with open_video_writer(folder / "video.mp4", config.fps, FFV1) as write:
        for row, (rgb, alpha) in enumerate(pictures):
            stored = expose(rgb, gains[row], generator)
            write(stored)
            joints = body.with_pose(truth[row]).joints()
            away = float(np.linalg.norm(joints[0] - camera.center_world))
            mask = segmenter.apply(
                alpha, row, camera.project(joints[[22, 23]]), camera.focal_px[1] / away
            )
            write_png(folder / "masks" / f"{row:04d}.png", _to_uint8(mask))
            write_png(folder / "truth" / "masks" / f"{row:04d}.png", _to_uint8(alpha))
            done(row + 1)


def _write_novel(
    folder: Path,
    motion: Motion,
    pictures: Iterator[RenderedFrame],
    camera: Camera | None,
    done: Callable[[int], None],
) -> None:
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    for index, (rgb, alpha) in enumerate(pictures):
        write_png(folder / "images" / f"{index:04d}.png", rgb)
        write_png(folder / "masks" / f"{index:04d}.png", _to_uint8(alpha))
        done(index + 1)
    write_motion(folder / "poses.npz", motion)
    if camera is not None:
        _write_track(folder / "cameras.npz", camera)


def _write_inputs(folder: Path, scene: PhoneScene, truth: Motion, config: ShootConfig) -> None:
    """poses.npz and cameras.npz as the user has them."""
    amount = config.tracker_error
    assumed = mistake_focal_length(scene.camera, amount, config.seed + config.subject)
    body = load_body_model().with_shape()
    tracked = track_poses(
        truth,
        scene.actor.shaped,
        body,
        (scene.camera, assumed),
        amount=amount,
        fps=config.fps,
        seed=config.seed + config.subject,
    )
    write_motion(folder / "poses.npz", replace(tracked, betas=np.zeros(10)))
    _write_track(folder / "cameras.npz", assumed)


def _write_body(path: Path, shaped: ShapedBody) -> None:
    """The person as a body model whose betas do nothing."""
    body = shaped.body
    np.savez_compressed(
        path,
        v_template=shaped.vertices.astype(np.float32),
        shapedirs=np.zeros((*shaped.vertices.shape, 1), dtype=np.float32),
        weights=body.weights.astype(np.float32),
        kintree_table=np.stack([body.parents, np.arange(24)]),
        f=body.faces.astype(np.int32),
        J=shaped.joints,
        J_shapedirs=np.zeros((24, 3, 1)),
    )


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class StudioScene:
    """Actor, cameras and background that a motion is filmed with.

    Attributes:
        cameras: One for all pictures, or one for each.
        background: A painted backdrop (for one camera), or a room.
        first_frame_number: Number of the first image, on which a room's noise depends.
    """

    actor: Actor
    cameras: tuple[Camera, ...]
    background: RgbImage | FurnishedRoom
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
    ) -> RgbImage:
        if isinstance(self.background, FurnishedRoom):
            return self.background.render(camera, feet, self.first_frame_number + number)
        return painted_surfaces.add_foot_shadows(self.background, feet, camera)


def film_capture(
    out: Path,
    config: ShootConfig,
    progress: ShootProgress | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Film the actor into the folder `out`, which appears whole or not at all.

    Args:
        out: Folder that will hold video.mp4, preview.mp4, masks/, cameras.npz (a walkaround's lie
            in truth/), poses.npz, dance.npz and truth/; see `_write_phone_capture` for a phone's.
        progress: Called after each image; may raise to stop the shoot.
        overwrite: Whether an older capture in `out` gives way, if all of it was written by `shoot`.
    """
    config.validate()
    check_replaceable_folder(out)
    if not overwrite and out.exists() and any(out.iterdir()):
        raise InputError(f"{out} already exists. Choose another OUT, or give --overwrite.")
    with atomic_folder(out) as unfinished:
        write = _write_phone_capture if config.like_a_phone else _write_capture
        write(unfinished, config, progress or (lambda done, total: None))


def _write_capture(folder: Path, config: ShootConfig, progress: ShootProgress) -> None:
    actor = Actor.of(config.subject, config.seed)
    truth = _choose_motion(actor, config)
    stages = _build_scenes(actor, truth, config)
    novel = staging.novel_poses(actor)
    total = len(truth) + len(novel)
    _write_video(folder, stages[0], truth, config, lambda done: progress(done, total))
    # browsers and phones play no lossless video
    video = VideoFile(folder / "video.mp4", FrameSelection()).frames()
    write_video(folder / "preview.mp4", (frame.rgb for frame in video), config.fps, H264)
    cameras, apart = stages[0].cameras, stages[1].cameras[0]
    _write_novel(
        folder / "truth" / "novel", novel, stages[1].render_all(novel),
        apart if config.camera_moves else None, lambda done: progress(len(truth) + done, total),
    )  # fmt: skip
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
    write_motion(folder / "dance.npz", staging.unfilmed_dance(actor))
    if config.camera_moves:
        # A phone does not know where it is: the cameras are ground truth, where no command looks.
        _write_track(folder / "truth" / "cameras.npz", *cameras)
    else:
        _write_track(folder / "cameras.npz", *cameras)


def _build_scenes(
    actor: Actor, truth: Motion, config: ShootConfig
) -> tuple[StudioScene, StudioScene]:
    """Return the scene of the film, and the scene of the poses that no film holds."""
    kind = config.effective_background
    if config.camera_moves:
        tall = staging.actor_height_m(actor)
        at = (truth.root_translations + actor.shaped.joints[0])[:, [0, 2]]
        cameras = staging.handheld_cameras(at, tall, config.size, config.seed)
        apart = staging.standing_camera(tall, config.size)
    else:
        apart = static_camera(actor, config.size)
        cameras = (apart,)
    if kind == "room" or kind == "tiles":
        behind = FurnishedRoom.furnished(kind, config.size, config.seed)
    else:
        behind = painted_surfaces.paint_backdrop(
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
    with open_video_writer(folder / "video.mp4", config.fps, FFV1) as write:
        for index, (rgb, alpha) in enumerate(stage.render_all(motion)):
            write(rgb)
            mask = add_mask_noise(alpha, config.mask_noise_px, generator)
            write_png(folder / "masks" / f"{index:04d}.png", _to_uint8(mask))
            done(index + 1)
