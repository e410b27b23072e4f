"""Scores of tracked poses and masks, and of avatars learnt from them, against the truth."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from avatar.evaluation.held_out import HeldOutFrame, score_frame, subsample_evenly
from avatar.training import checkpoint
from avatar.training.held_out_pose_fitting import fit_test_poses
from benchmarks.real_scores import TRACKED_JOINTS
from capture.input_error import InputError
from instant_avatar.evaluation.evaluation_frames import held_out_frames
from instant_avatar.run.run_folder import RunFolder
from preprocess.alignment.silhouette_objective import spaced_indices
from preprocess.body.body_surface import DENSE_SKIN_POINTS, SkinPoints, soft_iou
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_session import Capture
from preprocess.masks.mask_files import open_masks
from preprocess.open_capture import open_capture

SIDES = ((1, 2), (16, 17))
"""Left and right: hips, and shoulders."""
COMPARED_FRAMES = 60
"""Most frames, evenly spread, whose masks are compared."""
SCORED_FRAMES = 12
"""Most held-out frames, evenly spread, that are scored."""

Joints = Float[np.ndarray, "frames 24 3"]


class JointScore(NamedTuple):
    """How near tracked joints are to the truth.

    Attributes:
        error_mm: Mean distance over joints and frames, pelvis on pelvis in each frame, in the one
            scale for the film that brings them nearest.
        swapped_percent: Share of the frames in which left and right hip, or left and right
            shoulder, are exchanged.
        missing_percent: Share of the film's frames without a pose; they count in neither.
    """

    error_mm: float
    swapped_percent: float
    missing_percent: float


def score_joints(tracked: Path, film: Path, truth: Path) -> JointScore:
    """Compares the poses that were tracked in a film with its truth.

    Args:
        tracked: Folder of poses.npz and masks/.
        film: What they were tracked in.
        truth: Folder of the exact poses, body, camera and masks.
    """
    exact = {name: truth / f"{name}.npz" for name in ("poses", "body", "cameras")}
    there = open_capture(
        CaptureInputs(
            video=film,
            poses=exact["poses"],
            body=exact["body"],
            cameras=str(exact["cameras"]),
            masks=truth / "masks",
        )
    )
    found = joints_in_camera(open_tracked(tracked, film))
    true = joints_in_camera(there)
    common = sorted(found.keys() & true.keys())
    one, other = (np.stack([joints[number] for number in common]) for joints in (found, true))
    return JointScore(
        error_mm=joint_distance_mm(one, other),
        swapped_percent=100.0 * float(are_sides_swapped(one, other).mean()),
        missing_percent=100.0 * (1.0 - len(common) / len(true)),
    )


def open_tracked(tracked: Path, film: Path, masks: Path | None = None) -> Capture:
    """A film with the poses that were tracked in it.

    Args:
        tracked: Folder of poses.npz and masks/.
        film: What they were tracked in.
        masks: Other masks than the tracked ones.
    """
    named = CaptureInputs(
        video=film, poses=tracked / "poses.npz", masks=masks or tracked / "masks", cameras="static"
    )
    return open_capture(named, skip_checks=True)


def joints_in_camera(capture: Capture) -> dict[int, Float[np.ndarray, "24 3"]]:
    """Joints of each frame with a pose in the axes of its camera, by the frame's number, metres."""
    motion = capture.motion
    numbers = np.arange(len(motion)) if motion.frames is None else motion.frames
    found = {}
    for row in np.flatnonzero(motion.valid).tolist():
        view = capture.camera_of_pose(row).camera_from_world
        joints = capture.shaped.with_pose(motion[row]).joints()
        found[int(numbers[row])] = joints @ view[:3, :3].T + view[:3, 3]
    return found


def joint_distance_mm(found: Joints, true: Joints) -> float:
    """Mean distance of joints, pelvis on pelvis in each frame, in one scale for all frames."""
    a, b = (each[:, 1:TRACKED_JOINTS] - each[:, :1] for each in (found, true))
    scale = float((a * b).sum() / (a * a).sum())
    return 1000.0 * float(np.linalg.norm(scale * a - b, axis=2).mean())


def are_sides_swapped(found: Joints, true: Joints) -> Bool[np.ndarray, "frames"]:
    """Whether left and right hip, or left and right shoulder, are exchanged in each frame."""
    swapped = [
        ((found[:, left] - found[:, right]) * (true[:, left] - true[:, right])).sum(axis=1) < 0.0
        for left, right in SIDES
    ]
    return np.any(swapped, axis=0)


def mask_iou(tracked: Path, given: Path, size_px: tuple[int, int]) -> float:
    """Mean IoU of tracked masks with others of the same frames, of which each has one.

    Args:
        tracked, given: Folders, a mask for each frame.
        size_px: Width and height in which they are compared.
    """
    one, other = open_masks(tracked, invert=False), open_masks(given)
    rows = np.unique(np.linspace(0, one.count - 1, COMPARED_FRAMES).round().astype(int)).tolist()
    return float(
        np.mean(
            [soft_iou(one.alpha(row, size_px) > 0.5, other.alpha(row, size_px)) for row in rows]
        )
    )


def body_iou(recording: Capture) -> float:
    """Mean IoU of the posed body with the masks of a recording; 0 for frames without a pose.

    The skin is drawn at the frames' own size, and masks count from 0.5 on. (The
    product's grades compare small silhouettes of skin points with soft masks, quickly: there a body
    scores 0.90 against its own masks, here 0.99.)
    """
    source, motion = recording.source, recording.motion
    skin = SkinPoints.of(recording.shaped, 50 * DENSE_SKIN_POINTS)
    assert motion.frames is not None
    poses = {int(motion.frames[row]): int(row) for row in np.flatnonzero(motion.valid)}
    ious = []
    for place in spaced_indices(source.frame_count or 0, COMPARED_FRAMES):
        number = source.selection.start + source.selection.step * place
        try:
            mask = recording.masks.read(number, source.size_px) > 0.5
        except InputError:  # a frame that was not looked at
            continue
        ious.append(0.0)
        if number in poses:
            row = poses[number]
            drawn = skin.draw(motion[row], recording.camera_of_pose(row))
            ious[-1] = soft_iou(drawn, mask.astype(np.float32))
    return float(np.mean(ious))


def held_out_on_exact_masks(run: Path, truth: Path) -> float:
    """Mean PSNR of a run's held-out frames, cut out by their exact masks, at fitted poses, dB.

    Two runs with masks of their own are then compared with the same pictures.
    """
    trainer, _ = checkpoint.load(run / "checkpoint")
    masks = open_masks(truth / "masks")
    frames = []
    for seen in held_out_frames(RunFolder(path=run), None):
        alpha = masks.alpha(seen.frame.index, seen.camera.size_px)
        frames.append(HeldOutFrame(observation=dataclasses.replace(seen, alpha=alpha)))
    fitted = fit_test_poses(trainer, subsample_evenly(frames, SCORED_FRAMES))
    return float(np.mean([score_frame(trainer.avatar, frame).psnr for frame in fitted]))
