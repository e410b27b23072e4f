"""What all systems are trained and scored on: one capture, opened and split by the product."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

from avatar.config import HELD_OUT_STRIDE, TrainConfig
from avatar.evaluation.held_out import HeldOutFrame
from avatar.rig import Rig
from avatar.training.frame_stream import TrainingFrame, prepare_stream
from avatar.training.train import warm_up
from avatar.training.trainer import Trainer
from capture.input_error import InputError
from preprocess.body.parametric_body import ShapedBody, load_body_model
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_session import Capture
from preprocess.fitting.capture_fitting import apply_fit, fit_capture
from preprocess.observation import Observation
from preprocess.open_capture import open_capture
from preprocess.poses.motion_builder import place_by_pixels

FIRST_NOVEL_FRAME = 1_000_000
"""Number of the first pose that was never filmed: no frame of the film is near it, whose errors of
pose and exposure would be taken for its own."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ComparedCapture:
    """Frames of a capture.

    Attributes:
        capture: The capture, with body, poses and focal length fitted to its masks.
        rig: Rig of the person.
        frames: To train on.
        held_out: Every tenth frame of the video.
        novel: Poses that were never filmed, with their true pictures; empty where there are none.
        ready_seconds: CPU time of making the frames ready for the product; it alone is charged.
    """

    capture: Capture
    rig: Rig
    frames: list[TrainingFrame]
    held_out: list[HeldOutFrame]
    novel: list[HeldOutFrame]
    ready_seconds: float

    @classmethod
    def open(
        cls, folder: Path, size_px: int | None, *, frames: slice | None = None
    ) -> "ComparedCapture":
        """Opens a capture as `ia-ingest` does, and the studio's truth in it, if there is one.

        Args:
            folder: Capture.
            size_px: Longer side; None for the pictures' own.
            frames: Frames of the film that are used; all if None.

        Raises:
            InputError: If it cannot be used.
        """
        capture = open_capture(CaptureInputs(video=folder, frames=frames), size_px=size_px)
        if capture.motion.proportions is None and (fit := fit_capture(capture)) is not None:
            capture = apply_fit(capture, fit)
        rig = Rig.from_shaped_body(capture.shaped)
        warm_up(Trainer(rig, TrainConfig()))
        began, learnt, held_out = time.process_time(), [], []
        for item in prepare_stream(
            capture.observations(), rig, stride=HELD_OUT_STRIDE, total=capture.source.frame_count
        ):
            if isinstance(item, TrainingFrame):
                learnt.append(item)
            elif isinstance(item, HeldOutFrame):
                held_out.append(item)
        ready_seconds = time.process_time() - began
        if not learnt or not held_out:
            raise InputError(
                f"{folder} has {len(learnt)} frames to train on and {len(held_out)} to score; at "
                "least one of each is needed."
            )
        novel = novel_observations(folder, capture.shaped, size_px)
        return cls(
            capture=capture,
            rig=rig,
            frames=learnt,
            held_out=held_out,
            novel=[HeldOutFrame(observation=seen) for seen in novel],
            ready_seconds=ready_seconds,
        )


def novel_observations(
    folder: Path, person: ShapedBody, size_px: int | None = None
) -> list[Observation]:
    """The poses of a sample that were never filmed, with their true pictures, for a person.

    Args:
        folder: Capture of the studio; any other has none.
        person: Body that was trained on; the poses of a sample like a phone's belong to another.
        size_px: Longer side; None for the pictures' own.
    """
    novel, body = folder / "truth" / "novel", folder / "truth" / "body.npz"
    if not novel.is_dir():
        return []
    cameras = next(
        (str(path) for path in (novel / "cameras.npz", folder / "cameras.npz") if path.exists()),
        None,
    )
    true_body = body if body.exists() else None
    inputs = CaptureInputs(video=novel, cameras=cameras, body=true_body, refine_masks=False)
    found = [
        replace(seen, frame=replace(seen.frame, index=FIRST_NOVEL_FRAME + seen.frame.index))
        for seen in open_capture(inputs, size_px=size_px).observations()
        if isinstance(seen, Observation)
    ]
    if true_body is None:
        return found
    truth = load_body_model(true_body).with_shape()
    return [place_in_true_view(seen, person, truth) for seen in found]


def place_in_true_view(seen: Observation, person: ShapedBody, true_body: ShapedBody) -> Observation:
    """The observation with its pose's root moved for a person of other proportions.

    Args:
        seen: With the true pose and camera.
        person: Whom the avatar was learnt on: its joints are to appear where the truth's do.
        true_body: Whose pose it is.
    """
    camera = seen.camera
    view = camera.camera_from_world
    pixels = camera.project(true_body.with_pose(seen.pose).joints())
    joints = person.with_pose(seen.pose).joints() @ view[:3, :3].T + view[:3, 3]
    shift = view[:3, :3].T @ place_by_pixels(joints, pixels, camera)
    moved = replace(seen.pose, root_translation=seen.pose.root_translation + shift)
    return replace(seen, pose=moved)
