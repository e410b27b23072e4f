"""Whether the doctor names what is wrong: 44 spoilt copies of samples, and 10 good ones.

    python -m benchmarks.capture_check [--keep DIR]

A mistake is found if the doctor's first cause is one that was made; of two that were made at once,
whether it names both is counted, too. A good capture must be called good, with no cause. Seconds
are core time (one thread), beside them wall time, which a busy machine makes longer.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from apps.checks.capture_validation import check_capture
from benchmarks import capture_corruptions
from benchmarks.capture_corruptions import CorruptedCapture
from benchmarks.hardware import Hardware
from preprocess.capture_session import CaptureInputs
from studio.shoot import ShootConfig, film_capture

CAPTURES = {
    "turn": ShootConfig(frames=120, size=256),
    "dance": ShootConfig(frames=120, size=256, motion="dance", subject=2),
    "noisy": ShootConfig(frames=90, size=192, pose_noise_deg=2.0, pose_noise_cm=1.0, seed=3),
    "rough": ShootConfig(frames=60, size=256, mask_noise_px=2.0, pose_noise_deg=1.0, subject=2),
    "small": ShootConfig(frames=48, size=128, motion="dance", seed=5),
}

CORRUPTED = (
    CorruptedCapture(
        capture="turn", corruptions=(("frame_offset", capture_corruptions.delay_poses(3)),)
    ),
    CorruptedCapture(
        capture="dance", corruptions=(("frame_offset", capture_corruptions.delay_poses(-7)),)
    ),
    CorruptedCapture(
        capture="noisy", corruptions=(("frame_offset", capture_corruptions.delay_poses(20)),)
    ),
    CorruptedCapture(
        capture="rough", corruptions=(("frame_offset", capture_corruptions.drop_first_poses(6)),)
    ),
    CorruptedCapture(
        capture="turn", corruptions=(("frame_rate", capture_corruptions.resample_poses(0.5)),)
    ),
    CorruptedCapture(
        capture="dance",
        corruptions=(("frame_rate", capture_corruptions.scale_timestamps(30.0 / 25.0)),),
    ),
    CorruptedCapture(
        capture="noisy",
        corruptions=(("frame_rate", capture_corruptions.resample_poses(25.0 / 30.0)),),
    ),
    CorruptedCapture(
        capture="turn", corruptions=(("opengl_axes", capture_corruptions.use_opengl_poses),)
    ),
    CorruptedCapture(
        capture="noisy", corruptions=(("opengl_axes", capture_corruptions.use_opengl_cameras),)
    ),
    CorruptedCapture(
        capture="dance", corruptions=(("opengl_axes", capture_corruptions.flip_translation_y),)
    ),
    CorruptedCapture(
        capture="turn",
        corruptions=(("root_rotation", capture_corruptions.rotate_tracker_input(90)),),
    ),
    CorruptedCapture(
        capture="dance",
        corruptions=(("root_rotation", capture_corruptions.rotate_tracker_input(180)),),
    ),
    CorruptedCapture(
        capture="noisy",
        corruptions=(("root_rotation", capture_corruptions.rotate_tracker_input(270)),),
    ),
    CorruptedCapture(
        capture="rough", corruptions=(("root_rotation", capture_corruptions.use_z_up_poses),)
    ),
    CorruptedCapture(
        capture="turn", corruptions=(("world_frame", capture_corruptions.apply_extrinsics_twice),)
    ),
    CorruptedCapture(
        capture="noisy", corruptions=(("world_frame", capture_corruptions.invert_extrinsics),)
    ),
    CorruptedCapture(
        capture="dance", corruptions=(("world_frame", capture_corruptions.reset_extrinsics),)
    ),
    CorruptedCapture(
        capture="dance", corruptions=(("focal", capture_corruptions.scale_focal(0.6)),)
    ),
    CorruptedCapture(
        capture="small", corruptions=(("focal", capture_corruptions.scale_focal(1.35)),)
    ),
    CorruptedCapture(
        capture="turn", corruptions=(("left_right", capture_corruptions.swap_left_right),)
    ),
    CorruptedCapture(
        capture="dance", corruptions=(("left_right", capture_corruptions.mirror_tracker_input),)
    ),
    CorruptedCapture(
        capture="noisy", corruptions=(("root_origin", capture_corruptions.root_about_origin),)
    ),
    CorruptedCapture(
        capture="dance", corruptions=(("body_scale", capture_corruptions.scale_translations(0.75)),)
    ),
    CorruptedCapture(
        capture="rough", corruptions=(("body_scale", capture_corruptions.change_units(1000.0)),)
    ),
    CorruptedCapture(
        capture="noisy", corruptions=(("mask_polarity", capture_corruptions.invert_masks),)
    ),
    CorruptedCapture(
        capture="turn",
        corruptions=(
            ("frame_offset", capture_corruptions.delay_poses(10)),
            ("focal", capture_corruptions.scale_focal(1.4)),
        ),
    ),
    CorruptedCapture(
        capture="dance",
        corruptions=(
            ("opengl_axes", capture_corruptions.use_opengl_poses),
            ("frame_offset", capture_corruptions.delay_poses(5)),
        ),
    ),
    CorruptedCapture(
        capture="noisy",
        corruptions=(
            ("root_rotation", capture_corruptions.rotate_tracker_input(90)),
            ("left_right", capture_corruptions.swap_left_right),
        ),
    ),
    CorruptedCapture(
        capture="rough",
        corruptions=(
            ("mask_polarity", capture_corruptions.invert_masks),
            ("root_origin", capture_corruptions.root_about_origin),
        ),
    ),
    CorruptedCapture(
        capture="turn",
        corruptions=(
            ("body_scale", capture_corruptions.change_units(100.0)),
            ("frame_rate", capture_corruptions.resample_poses(0.5)),
        ),
    ),
    CorruptedCapture(
        capture="turn",
        corruptions=(("root_rotation", capture_corruptions.use_z_up_poses_without_pelvis),),
    ),
    CorruptedCapture(
        capture="small", corruptions=(("frame_offset", capture_corruptions.keep_last_poses(30)),)
    ),
    CorruptedCapture(
        capture="dance", corruptions=(("second_person", capture_corruptions.add_second_person),)
    ),
    CorruptedCapture(
        capture="turn", corruptions=(("video_rotation", capture_corruptions.rotate_video(1)),)
    ),
    CorruptedCapture(
        capture="rough", corruptions=(("video_rotation", capture_corruptions.rotate_video(2)),)
    ),
    CorruptedCapture(
        capture="dance", corruptions=(("video_rotation", capture_corruptions.rotate_video(3)),)
    ),
    CorruptedCapture(
        capture="turn", corruptions=(("video_mirrored", capture_corruptions.mirror_video),)
    ),
    CorruptedCapture(
        capture="noisy", corruptions=(("video_mirrored", capture_corruptions.mirror_video),)
    ),
    CorruptedCapture(
        capture="dance",
        corruptions=(("video_crop", capture_corruptions.crop_video(0.05, 0.08, 0.87)),),
    ),
    CorruptedCapture(
        capture="rough",
        corruptions=(("video_crop", capture_corruptions.crop_video(-0.15, -0.15, 1.3)),),
    ),
    CorruptedCapture(
        capture="turn", corruptions=(("video_offset", capture_corruptions.trim_video(12)),)
    ),
    CorruptedCapture(
        capture="noisy", corruptions=(("video_offset", capture_corruptions.delay_video(4)),)
    ),
    CorruptedCapture(
        capture="small", corruptions=(("video_offset", capture_corruptions.reverse_video),)
    ),
    CorruptedCapture(
        capture="dance",
        corruptions=(
            ("frame_offset", capture_corruptions.delay_poses(5)),
            ("video_mirrored", capture_corruptions.mirror_video),
        ),
    ),
)

INTACT = (
    *(CorruptedCapture(capture=name, corruptions=()) for name in CAPTURES),
    *(
        CorruptedCapture(
            capture=name, corruptions=(("", capture_corruptions.convert_to_camera_space),)
        )
        for name in CAPTURES
    ),
)
"""As filmed, and told in the camera's own frame."""

REQUIRED_FIRST, MAX_CORE_SECONDS = 40, 10.0
"""Right first causes, and core seconds of the slowest."""


def shoot_captures(folder: Path) -> Path:
    """Films the samples that are not there yet."""
    for name, config in CAPTURES.items():
        if not (folder / name).exists():
            film_capture(folder / name, config)
    return folder


def check_case(case: CorruptedCapture, folder: Path) -> tuple[bool, bool, float, str]:
    """Whether the first cause is right, whether all are, core seconds, and a line of words."""
    began, core = time.perf_counter(), time.process_time()
    examined = check_capture(CaptureInputs(video=folder))
    seconds, wall = time.process_time() - core, time.perf_counter() - began
    named = examined.causes
    right = named[:1] == () if not case.causes - {""} else bool(set(named[:1]) & case.causes)
    if not case.causes - {""}:
        right = right and examined.verdict == "good"
    whole = set(named) == case.causes - {""}
    agreed = f"{examined.stored_iou:.2f} -> {examined.corrected_iou:.2f}"
    said = f"({wall:4.1f}) {examined.verdict:<8} {agreed}  {', '.join(named)}"
    return right, whole, seconds, said


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--keep", type=Path, help="folder for the samples, kept and used again")
    keep = arguments.parse_args().keep
    print("\n".join(Hardware.here().lines()))
    with tempfile.TemporaryDirectory(dir=keep and _make_folder(keep)) as scratch:
        samples = shoot_captures(keep or Path(scratch) / "films")
        found = whole = quiet = 0
        slowest = 0.0
        for number, case in enumerate((*CORRUPTED, *INTACT)):
            folder = case.write(samples, Path(scratch) / f"case{number}")
            right, all_named, seconds, said = check_case(case, folder)
            slowest = max(slowest, seconds)
            spoilt = number < len(CORRUPTED)
            found, quiet = found + (right and spoilt), quiet + (right and not spoilt)
            whole += all_named and spoilt
            wanted = " + ".join(cause for cause, _ in case.corruptions if cause) or "good"
            mark = " " if right else "✗"
            print(f"{mark} {case.capture:<6} {wanted:<30} {seconds:4.1f} s  {said}", flush=True)
    print(
        f"right cause first: {found} of {len(CORRUPTED)} (asked: {REQUIRED_FIRST}); all causes: {whole}"
    )
    print(f"good ones called good: {quiet} of {len(INTACT)} (asked: all)")
    print(f"slowest: {slowest:.1f} core-s (asked: {MAX_CORE_SECONDS:.0f})")
    sys.exit(
        0 if found >= REQUIRED_FIRST and quiet == len(INTACT) and slowest <= MAX_CORE_SECONDS else 1
    )


def _make_folder(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


if __name__ == "__main__":
    main()
