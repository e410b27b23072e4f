"""A capture as an average user has it, from a phone, a tracker and a segmenter, and its truth."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from preprocess.body.body_file import load_body_model
from preprocess.body.body_pose import Motion
from preprocess.body.parametric_body import ShapedBody
from preprocess.pose_formats.pose_format_registry import read_poses
from preprocess.poses.pose_file import write_motion
from studio import actor_motions
from studio.actor import Actor
from studio.capture_files import lossless_video, to_uint8, write_cameras, write_png
from studio.draw_ahead import ShootProgress, draw_ahead
from studio.phone.moving_cloth import MovingCloth
from studio.phone.phone_pictures import PhoneScene, drifting_exposure, expose
from studio.phone.proportions import SUBJECT_PROPORTIONS
from studio.phone.room_light import RoomLight
from studio.phone.segmenter_errors import SegmenterErrors
from studio.phone.tracker_errors import mistake_focal_length, track_poses
from studio.room import painted_backdrop
from studio.shoot_config import ShootConfig
from studio.studio_cameras import portrait_camera

ARM_LIFT_DEG = -64.0
"""Arms near the body: they fit into a portrait."""
TURNS = 1.25
"""How often the actor turns round, if the user does not say."""


def write_phone_capture(folder: Path, config: ShootConfig, progress: ShootProgress) -> None:
    """Films the actor as reality would, into an empty folder.

    It then holds video.mp4, masks/, cameras.npz and poses.npz, all of them a little wrong;
    dance.npz; and truth/: body.npz (the person, a body model without betas), poses.npz,
    cameras.npz, masks/, exposure.npz (gains of red, green and blue a frame), and novel/ (poses
    never filmed with sharp, neutrally exposed images, masks and cameras.npz).
    """
    actor = Actor.of(config.subject, config.seed, SUBJECT_PROPORTIONS[config.subject])
    camera = portrait_camera(actor, config.size, dances=config.motion == "dance")
    backdrop = painted_backdrop.paint_backdrop(
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
    novel = actor_motions.novel_poses(actor)
    total = len(truth) + len(novel)
    _film(folder, scene, truth, config, lambda done: progress(done, total))
    _write_novel(
        folder / "truth" / "novel", scene, novel, lambda done: progress(len(truth) + done, total)
    )
    _write_body(folder / "truth" / "body.npz", actor.shaped)
    write_motion(folder / "truth" / "poses.npz", truth)
    write_cameras(folder / "truth" / "cameras.npz", (camera,))
    write_motion(folder / "dance.npz", actor_motions.unfilmed_dance(actor))
    _write_inputs(folder, scene, truth, config)


def _choose_motion(actor: Actor, config: ShootConfig) -> Motion:
    if config.track is not None:
        track = read_poses(config.track)
        return actor_motions.tracked_motion(actor, track, frames=config.frames, fps=config.fps)
    turns = TURNS if config.turns is None else config.turns
    if config.motion == "dance":
        return actor_motions.dancing_motion(
            actor, frames=config.frames, fps=config.fps, turns=turns, seed=config.seed
        )
    return actor_motions.turning_motion(
        actor,
        frames=config.frames,
        fps=config.fps,
        turns=turns,
        seed=config.seed,
        arm_lift_deg=ARM_LIFT_DEG,
    )


def _film(
    folder: Path,
    scene: PhoneScene,
    truth: Motion,
    config: ShootConfig,
    done: Callable[[int], None],
) -> None:
    """video.mp4, masks/, and what is exact of them in truth/."""
    (folder / "masks").mkdir()
    (folder / "truth" / "masks").mkdir(parents=True)
    (folder / "truth" / "novel" / "images").mkdir(parents=True)
    (folder / "truth" / "novel" / "masks").mkdir()
    frames = len(truth)
    gains = drifting_exposure(frames, config.fps, config.seed)
    np.savez(folder / "truth" / "exposure.npz", gains=gains)
    segmenter = SegmenterErrors(frames, config.fps, config.seed)
    generator = np.random.default_rng([config.seed, 26])
    camera, body = scene.camera, scene.actor.shaped
    pictures = draw_ahead(lambda row: scene.frame(truth, row), frames)
    with lossless_video(folder / "video.mp4", camera.size_px, config.fps, frames) as writer:
        for row, (rgb, alpha) in enumerate(pictures):
            stored = expose(rgb, gains[row], generator)
            writer.write(np.ascontiguousarray(stored[..., ::-1]))
            joints = body.with_pose(truth[row]).joints()
            away = float(np.linalg.norm(joints[0] - camera.center_world))
            mask = segmenter.apply(
                alpha, row, camera.project(joints[[22, 23]]), camera.focal_px[1] / away
            )
            write_png(folder / "masks" / f"{row:04d}.png", to_uint8(mask))
            write_png(folder / "truth" / "masks" / f"{row:04d}.png", to_uint8(alpha))
            done(row + 1)


def _write_novel(
    folder: Path, scene: PhoneScene, novel: Motion, done: Callable[[int], None]
) -> None:
    """Poses never filmed, with their sharp images, masks and camera."""
    for index in range(len(novel)):
        rgb, alpha = scene.still(novel[index])
        image = np.ascontiguousarray(rgb[..., ::-1])
        write_png(folder / "images" / f"{index:04d}.png", image)
        write_png(folder / "masks" / f"{index:04d}.png", to_uint8(alpha))
        done(index + 1)
    write_motion(folder / "poses.npz", novel)
    write_cameras(folder / "cameras.npz", (scene.camera,))


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
    write_cameras(folder / "cameras.npz", (assumed,))


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
