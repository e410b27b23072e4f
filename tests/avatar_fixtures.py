"""Shared fixtures: a body, an actor, a rig, poses, hash levels and a short training."""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from jaxtyping import UInt8

from avatar.config import TrainConfig
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.evaluation.held_out import HeldOutFrame, score_frame
from avatar.events import HeldOutScore
from avatar.kernels.operands import HashLevels
from avatar.rig import Rig
from avatar.training.frame_stream import prepare_stream
from avatar.training.pose_correction import SIGMA_OF_ROW
from avatar.training.pose_optimizer import PoseOptimizer
from avatar.training.trainer import Trainer, cosine_decay
from capture.camera import Camera
from capture.source import Frame
from instant_avatar.studio import staging
from instant_avatar.studio.actor import Actor
from instant_avatar.studio.lighting import composite_over
from instant_avatar.studio.staging import static_camera
from preprocess.body.body_pose import BodyPose
from preprocess.body.parametric_body import ShapedBody, load_body_model
from preprocess.observation import Observation


@pytest.fixture(scope="session")
def shaped() -> ShapedBody:
    return load_body_model().with_shape()


@pytest.fixture(scope="session", autouse=True)
def one_actor_and_rig_per_body():
    """The same actor, dance and rig of a body wherever they are made: each takes a second."""
    make_rig, rigs = Rig.from_shaped_body, {}

    def rig_of(shaped: ShapedBody, *, coarseness: float = 1.0) -> Rig:
        arrays = shaped.vertices, shaped.joints, shaped.body.weights
        key = coarseness, *(array.tobytes() for array in arrays)
        if key not in rigs:
            rigs[key] = make_rig(shaped, coarseness=coarseness)
        return rigs[key]

    with pytest.MonkeyPatch.context() as patch:
        make_actor = functools.cache(Actor.of)
        patch.setattr(
            Actor, "of", lambda subject=1, seed=0, sized=None: make_actor(subject, seed, sized)
        )
        patch.setattr(staging, "unfilmed_dance", functools.cache(staging.unfilmed_dance))
        patch.setattr(Rig, "from_shaped_body", rig_of)
        yield


@pytest.fixture(scope="session")
def rig(shaped) -> Rig:
    return Rig.from_shaped_body(shaped)


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def levels() -> HashLevels:
    """Four levels over a box that is no cube: the first two are dense, the others hashed."""
    low, high = np.array([-1.0, -0.5, 0.0]), np.array([1.0, 0.9, 0.4])
    return HashLevels.spanning(
        low.astype(np.float32), high.astype(np.float32),
        coarsest_m=0.2, finest_m=0.02, levels=4, table_size=4096,
    )  # fmt: skip


def pixel_centers(camera: Camera) -> np.ndarray:
    """The centre (x, y) of every pixel, row after row."""
    width, height = camera.size_px
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def pose_gradient(poses: PoseOptimizer, slot: int) -> np.ndarray:
    """Gradient of the accumulated rays' losses with respect to a slot's correction, (25, 3)."""
    return poses._rays.equations(slot).gradient[:75].reshape(25, 3) / SIGMA_OF_ROW[:, None]


@pytest.fixture
def bent_pose() -> np.ndarray:
    """Arms down, an elbow bent, a knee lifted: folds, but no contact."""
    rotations = np.zeros((23, 3))
    rotations[15] = 0.0, 0.0, -1.0
    rotations[16] = 0.0, 0.3, 0.8
    rotations[17] = 0.0, -0.8, 0.0
    rotations[0] = -0.6, 0.0, 0.1
    rotations[3] = 0.9, 0.0, 0.0
    return rotations


def lowered_arms(angle: float) -> np.ndarray:
    """Joint rotations with both arms lowered from the T-pose by `angle` radians."""
    rotations = np.zeros((23, 3))
    rotations[15, 2], rotations[16, 2] = -angle, angle
    return rotations


@pytest.fixture
def observed(shaped) -> Callable[..., Observation]:
    """The body before a level camera of 200 px; what the picture shows plays no part.

    At `turned` = 0 radians the body faces the camera, which stands `distance_m`
    away and `up_m` above the pelvis. The mask is white unless it is given.
    """

    def observe(*, turned=0.0, lowered=0.8, alpha=None, up_m=0.0, distance_m=4.0) -> Observation:
        eye = shaped.joints[0] + [0.0, up_m, distance_m]
        camera = Camera.at(eye, np.diag([1.0, -1.0, -1.0]), 350.0, (200, 200))
        pose = BodyPose(
            root_rotation=np.array([0.0, turned, 0.0]),
            root_translation=np.zeros(3),
            joint_rotations=lowered_arms(lowered),
        )
        rgb = np.zeros((200, 200, 3), dtype=np.uint8)
        alpha = np.ones((200, 200), dtype=np.float32) if alpha is None else alpha
        return Observation(
            frame=Frame(index=0, time_s=0.0, rgb=rgb), alpha=alpha, pose=pose, camera=camera
        )

    return observe


@dataclass(frozen=True, eq=False, kw_only=True)
class Clip:
    """The studio's actor, turning once: observations, and a pose that was never filmed."""

    observations: list[Observation]
    novel: Observation


def render_on_white(
    actor: Actor, pose: BodyPose, camera: Camera
) -> tuple[UInt8[np.ndarray, "height width 3"], UInt8[np.ndarray, "height width"]]:
    """The person in front of white, and the soft mask."""
    rgb, alpha = actor.render_rgb_alpha(pose, camera)
    return composite_over(rgb, alpha), (alpha * 255.0 + 0.5).astype(np.uint8)


def film_turning(actor: Actor, camera: Camera, *, frames: int) -> Clip:
    """The actor, turning once before the camera."""

    def observed(index: int, pose: BodyPose) -> Observation:
        rgb, alpha = render_on_white(actor, pose, camera)
        frame = Frame(index=index, time_s=index / 30.0, rgb=rgb)
        return Observation(
            frame=frame, alpha=alpha.astype(np.float32) / 255.0, pose=pose, camera=camera
        )

    filmed = staging.turning_motion(actor, frames=frames, fps=30.0, turns=1.0, seed=0)
    return Clip(
        observations=[observed(i, filmed[i]) for i in range(len(filmed))],
        novel=observed(100, staging.novel_poses(actor)[0]),
    )


@pytest.fixture(scope="session")
def clip() -> Clip:
    actor = Actor.of(1, 0)
    return film_turning(actor, static_camera(actor, 72), frames=24)


LEARNT_STEPS, MARK_EVERY = 400, 100
FRAMES_ARRIVE_FOR = 200


@dataclass(frozen=True, eq=False, kw_only=True)
class Learnt:
    """What a few seconds of training make of the clip. Tests look at it and leave it as it is.

    Attributes:
        trainer: After its last step.
        held: Frames that it has never seen.
        novel: A pose that was never filmed.
        marks: Scores of the held-out frames and the novel pose, every `MARK_EVERY` steps.
    """

    trainer: Trainer
    held: list[HeldOutFrame]
    novel: HeldOutFrame
    marks: list[list[HeldOutScore]]


COARSE = TrainConfig(
    rays=512, sample_step_m=0.015, finest_m=0.03, levels=6, table_size=1 << 14, refine_poses=False
)


def untaught(
    rig: Rig, clip: Clip, config: TrainConfig = COARSE, *, stride: int = 6
) -> tuple[Trainer, list[HeldOutFrame]]:
    """A trainer that has a clip's frames, and those that are held out."""
    trainer, held = Trainer(rig, config), []
    for item in prepare_stream(iter(clip.observations), rig, stride=stride, total=None):
        if isinstance(item, HeldOutFrame):
            held.append(item)
        else:
            trainer.add_frame(item)
    return trainer, held


@pytest.fixture(scope="session")
def learnt(rig, clip) -> Learnt:
    """Trained once for all tests, with a rate that falls after half of the steps."""
    trainer, held = untaught(rig, clip)
    cells = CorrespondenceGrid.solve(rig, clip.novel.pose.joint_rotations)
    novel = HeldOutFrame(observation=clip.novel, correspondences=cells)
    marks = []
    for step in range(LEARNT_STEPS):
        falling = (step - FRAMES_ARRIVE_FOR) / (LEARNT_STEPS - FRAMES_ARRIVE_FOR)
        trainer.step(
            rate=cosine_decay(falling), hard_surface_share=min(1.0, 4.0 * step / LEARNT_STEPS)
        )
        if trainer.steps % MARK_EVERY == 0:
            marks.append([score_frame(trainer.avatar, frame) for frame in [*held, novel]])
    return Learnt(trainer=trainer, held=held, novel=novel, marks=marks)
