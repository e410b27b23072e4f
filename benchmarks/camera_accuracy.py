"""Accuracy of solved cameras: a phone is carried around the actor, in a room and in one of tiles.

    python -m benchmarks.camera_accuracy [--seeds 3] [--size 640] [--frames 90] [--keep DIR]
                                         [--no-psnr]

For each film: errors of all cameras after the best alignment (rotation, shift, and scale, which is
a figure of its own), core time and memory of the solver. Between tiles it may refuse, but not give
wrong cameras. Then the scale for a tracker whose body is 4 % too tall, without and with the stated
height; and the PSNR that solved cameras cost an avatar.
"""

import argparse
import sys
import tempfile
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from baselines.hardware import Hardware
from capture.camera import Camera
from capture.input_error import InputError
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.alignment.capture_geometry import CaptureGeometry, rescale_motion
from preprocess.cameras.camera_file import CameraTrack, read_cameras
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_session import Capture
from preprocess.open_capture import open_capture
from preprocess.poses.pose_format_registry import read_poses
from preprocess.sfm.camera_solution import CameraSolution
from preprocess.sfm.camera_solver import apply_camera_solution, solve_capture_cameras

MOST_CENTER_CM, MOST_ROTATION_DEG, MOST_SCALE, MOST_SCALE_STATED = 1.0, 0.2, 0.03, 0.01
MOST_PSNR_LOSS = 0.5
TOO_TALL = 1.04
TRAINED_PX, TRAINED_CORE_S = 320, 20.0

Room = Literal["room", "tiles"]
ROOMS: tuple[Room, ...] = ("room", "tiles")


@dataclass(frozen=True, kw_only=True)
class CameraErrors:
    """Of a capture's cameras against the true ones.

    Attributes:
        center_rms_cm, center_max_cm: After the best similarity.
        rotation_max_deg: After the best rotation.
        scale: Relative, of the metric world.
        focal: Relative.
    """

    center_rms_cm: float
    center_max_cm: float
    rotation_max_deg: float
    scale: float
    focal: float

    @classmethod
    def of(cls, found: tuple[Camera, ...], true: tuple[Camera, ...]) -> "CameraErrors":
        a, b = (np.stack([camera.center_world for camera in track]) for track in (found, true))
        scale, turn, shift = fit_similarity(a, b)
        off = 100.0 * np.linalg.norm(scale * a @ turn.T + shift - b, axis=1)
        here, there = (
            np.stack([camera.camera_from_world[:3, :3] for camera in track])
            for track in (found, true)
        )
        way = Rotation.from_matrix(there.transpose(0, 2, 1) @ here).mean().as_matrix()
        angles = Rotation.from_matrix(there @ way @ here.transpose(0, 2, 1)).magnitude()
        return cls(
            center_rms_cm=float(np.sqrt((off**2).mean())),
            center_max_cm=float(off.max()),
            rotation_max_deg=float(np.degrees(angles.max())),
            scale=1.0 / scale - 1.0,
            focal=found[0].focal_px[0] / true[0].focal_px[0] - 1.0,
        )

    @property
    def good(self) -> bool:
        return (
            self.center_max_cm < MOST_CENTER_CM
            and self.rotation_max_deg < MOST_ROTATION_DEG
            and abs(self.scale) < MOST_SCALE
        )

    def __str__(self) -> str:
        return (
            f"centres {self.center_rms_cm:5.2f} cm r.m.s. {self.center_max_cm:5.2f} max, rotation "
            f"{self.rotation_max_deg:5.3f}° max, scale {100.0 * self.scale:+5.2f} %, focal "
            f"{100.0 * self.focal:+5.2f} %"
        )


def film_or_reuse(folder: Path, background: Room, seed: int, given: argparse.Namespace) -> Path:
    """A capture, unless it lies there already."""
    capture = folder / f"{background}{seed}-{given.size}-{given.frames}"
    if not capture.exists():
        config = ShootConfig(
            frames=given.frames, size=given.size, seed=seed, motion="walkaround",
            background=background, subject=2 if seed % 2 else 1,
        )  # fmt: skip
        film_capture(capture, config)
    return capture


def open_unsolved(capture: Path) -> Capture:
    """As `ia-ingest CAPTURE/video.mp4 --poses CAPTURE/poses.npz --cameras solve`."""
    named = CaptureInputs(
        video=capture / "video.mp4", poses=capture / "poses.npz", masks=capture / "masks",
        cameras="solve",
    )  # fmt: skip
    return open_capture(named)


def fit_similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation and shift that carry points nearest to others (Umeyama 1991, eq. 40-42)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    left, stretch, right = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    turn = left @ np.diag(sign) @ right
    scale = float((stretch * sign).sum() / max((a**2).sum(), 1e-300))
    return scale, turn, target.mean(axis=0) - scale * turn @ source.mean(axis=0)


def truth(capture: Path, recording: Capture) -> CameraTrack:
    return read_cameras(capture / "truth" / "cameras.npz", recording.source.size_px)


@cache
def solve_film(capture: Path) -> tuple[CameraSolution, Capture]:
    """As ia-ingest does.

    Raises:
        InputError: If it refuses.
    """
    plain = open_unsolved(capture)
    solved = solve_capture_cameras(plain, seed=0, threads=1, report_progress=lambda share: None)
    return solved, apply_camera_solution(plain, solved)


def measure_film(capture: Path) -> tuple[str, bool | None]:
    """A line for one film, and whether it is good; None if the cameras were refused."""
    try:
        solved, recording = solve_film(capture)
    except InputError as refusal:
        return f"refused: {str(refusal).split(';')[0]}", None
    errors = CameraErrors.of(recording.cameras.cameras, truth(capture, recording).cameras)
    costs = solved.costs
    report = recording.figures("cameras")
    assert report is not None
    frames = report["frames"]
    return (
        f"{errors}; {solved.keyframe_count} key frames + {frames['placed']}; "
        f"{costs['cpu_seconds']:.0f} core-s, {costs['peak_memory_mb']:.0f} MB; "
        f"by {report['scale']['cues']}",
        errors.good,
    )


def scale_errors_by_height(capture: Path) -> tuple[float, float]:
    """Errors of the scale if the tracker's body is too tall: without, and with the height."""
    solved, _ = solve_film(capture)
    plain = open_unsolved(capture)
    tall = plain.shaped.height_m

    def sized(recording: Capture, height_m: float) -> Capture:
        body = recording.shaped.scaled_to(height_m)
        claim = CaptureGeometry.of(recording.motion, recording.cameras, recording.source)
        return replace(recording, shaped=body, motion=rescale_motion(claim, recording.shaped, body))

    biased = sized(plain, TOO_TALL * tall)
    stated = sized(biased, round(tall, 2))  # people know theirs to a centimetre
    true = truth(capture, plain).cameras
    found = [apply_camera_solution(each, solved).cameras.cameras for each in (biased, stated)]
    return CameraErrors.of(found[0], true).scale, CameraErrors.of(found[1], true).scale


def psnr_by_cameras(capture: Path) -> dict[str, float]:
    """Held-out PSNR, dB, of short runs that differ in their cameras alone."""

    from avatar.rig import Rig
    from avatar.training.train import warm_up
    from benchmarks.sample_training import load_trainer, train_for_core_seconds, training_config
    from benchmarks.stopwatch import limit_threads
    from benchmarks.training_quality import mean_psnr

    _, recording = solve_film(capture)
    paths, true = recording.paths, truth(capture, recording)
    exact = read_poses(capture / "truth" / "poses.npz")
    # Stricter than what anybody does, and not asked: exact poses of the true world, seen by solved
    # cameras that were moved there as a whole.
    a, b = (
        np.stack([camera.center_world for camera in track.cameras])
        for track in (recording.cameras, true)
    )
    scale, turn, shift = fit_similarity(a, b)
    there = tuple(_moved(camera, scale, turn, shift) for camera in recording.cameras.cameras)
    variants = {
        "true cameras": replace(recording, cameras=true, motion=exact),
        "solved": recording,
        "solved, with poses of the true world": replace(
            recording, cameras=replace(recording.cameras, cameras=there), motion=exact
        ),
    }
    found = {}
    for name, each in variants.items():
        limit_threads(1)
        each = replace(each, paths=paths, size_px=TRAINED_PX)
        rig = Rig.from_shaped_body(each.shaped)
        config = replace(training_config(each, TRAINED_CORE_S), refine_poses=False)
        seen = load_trainer(each, rig, config)
        warm_up(seen.trainer)
        train_for_core_seconds(seen.trainer, TRAINED_CORE_S)
        found[name] = mean_psnr(seen.trainer.avatar, seen.held_out).psnr
    return found


def _moved(camera: Camera, scale: float, turn: np.ndarray, shift: np.ndarray) -> Camera:
    view = camera.camera_from_world.copy()
    view[:3, :3] = view[:3, :3] @ turn.T
    view[:3, 3] = -view[:3, :3] @ (scale * turn @ camera.center_world + shift)
    return replace(camera, camera_from_world=view)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--seeds", type=int, default=3)
    arguments.add_argument("--size", type=int, default=640, help="width of the pictures")
    arguments.add_argument("--frames", type=int, default=90)
    arguments.add_argument("--keep", type=Path, help="folder for films, used again")
    arguments.add_argument("--no-psnr", action="store_true", help="leave out the avatars")
    given = arguments.parse_args()
    print("\n".join(Hardware.here().lines()))
    fine = True
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        for background in ROOMS:
            for seed in range(given.seeds):
                said, good = measure_film(film_or_reuse(folder, background, seed, given))
                fine &= good is True or (good is None and background == "tiles")
                mark = "✓" if good else "✗" if good is False else "·"
                print(f"{mark} {background:<5} seed {seed}: {said}", flush=True)
        first = film_or_reuse(folder, "room", 0, given)
        without, stated = scale_errors_by_height(first)
        fine &= abs(stated) < MOST_SCALE_STATED
        tall = f"{100.0 * (TOO_TALL - 1.0):.0f} % too tall"
        print(
            f"scale, tracker's body {tall}: {100.0 * without:+.2f} %; "
            f"with the stated height {100.0 * stated:+.2f} % (asked: under 1 %)"
        )
        if not given.no_psnr:
            scores = psnr_by_cameras(first)
            for name, psnr in scores.items():
                lost = scores["true cameras"] - psnr
                fine &= name != "solved" or lost < MOST_PSNR_LOSS
                print(f"held out, {name}: {psnr:.2f} dB ({-lost:+.2f})", flush=True)
    print(
        f"target: centers under {MOST_CENTER_CM} cm, rotation under {MOST_ROTATION_DEG}°, scale "
        f"within {100.0 * MOST_SCALE:.0f} %; tiles may be refused"
    )
    sys.exit(0 if fine else 1)


if __name__ == "__main__":
    main()
