"""Check whether ia-check names what is wrong in 44 corrupted captures and 10 intact ones.

    python -m benchmarks.capture_check [--keep DIR]

A corruption counts as found if the first named cause is one that was made; of two made at once,
naming both is counted, too. An intact capture must be called good, with no cause. Seconds are core
time (one thread); wall time, in parentheses, is longer on a busy machine.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from baselines.hardware import Hardware
from benchmarks import capture_corruptions as corrupt
from benchmarks.capture_corruptions import CorruptedCapture, Corruption
from instant_avatar.capture_validation import check_capture
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.capture_inputs import CaptureInputs
from preprocess.open_capture import read_capture

CAPTURES = {
    "turn": ShootConfig(frames=120, size=256),
    "dance": ShootConfig(frames=120, size=256, motion="dance", subject=2),
    "noisy": ShootConfig(frames=90, size=192, pose_noise_deg=2.0, pose_noise_cm=1.0, seed=3),
    "rough": ShootConfig(frames=60, size=256, mask_noise_px=2.0, pose_noise_deg=1.0, subject=2),
    "small": ShootConfig(frames=48, size=128, motion="dance", seed=5),
}


def _case(capture: str, **corruptions: Corruption) -> CorruptedCapture:
    """A capture with corruptions, by their causes."""
    return CorruptedCapture(capture=capture, corruptions=tuple(corruptions.items()))


CORRUPTED = (
    _case("turn", frame_offset=corrupt.delay_poses(3)),
    _case("dance", frame_offset=corrupt.delay_poses(-7)),
    _case("noisy", frame_offset=corrupt.delay_poses(20)),
    _case("rough", frame_offset=corrupt.drop_first_poses(6)),
    _case("turn", frame_rate=corrupt.resample_poses(0.5)),
    _case("dance", frame_rate=corrupt.scale_timestamps(30.0 / 25.0)),
    _case("noisy", frame_rate=corrupt.resample_poses(25.0 / 30.0)),
    _case("turn", opengl_axes=corrupt.use_opengl_poses),
    _case("noisy", opengl_axes=corrupt.use_opengl_cameras),
    _case("dance", opengl_axes=corrupt.flip_translation_y),
    _case("turn", root_rotation=corrupt.rotate_tracker_input(90)),
    _case("dance", root_rotation=corrupt.rotate_tracker_input(180)),
    _case("noisy", root_rotation=corrupt.rotate_tracker_input(270)),
    _case("rough", root_rotation=corrupt.use_z_up_poses),
    _case("turn", world_frame=corrupt.apply_extrinsics_twice),
    _case("noisy", world_frame=corrupt.invert_extrinsics),
    _case("dance", world_frame=corrupt.reset_extrinsics),
    _case("dance", focal=corrupt.scale_focal(0.6)),
    _case("small", focal=corrupt.scale_focal(1.35)),
    _case("turn", left_right=corrupt.swap_left_right),
    _case("dance", left_right=corrupt.mirror_tracker_input),
    _case("noisy", root_origin=corrupt.root_about_origin),
    _case("dance", body_scale=corrupt.scale_translations(0.75)),
    _case("rough", body_scale=corrupt.change_units(1000.0)),
    _case("noisy", mask_polarity=corrupt.invert_masks),
    _case("turn", frame_offset=corrupt.delay_poses(10), focal=corrupt.scale_focal(1.4)),
    _case("dance", opengl_axes=corrupt.use_opengl_poses, frame_offset=corrupt.delay_poses(5)),
    _case(
        "noisy", root_rotation=corrupt.rotate_tracker_input(90), left_right=corrupt.swap_left_right
    ),
    _case("rough", mask_polarity=corrupt.invert_masks, root_origin=corrupt.root_about_origin),
    _case("turn", body_scale=corrupt.change_units(100.0), frame_rate=corrupt.resample_poses(0.5)),
    _case("turn", root_rotation=corrupt.use_z_up_poses_without_pelvis),
    _case("small", frame_offset=corrupt.keep_last_poses(30)),
    _case("dance", second_person=corrupt.add_second_person),
    _case("turn", video_rotation=corrupt.rotate_video(1)),
    _case("rough", video_rotation=corrupt.rotate_video(2)),
    _case("dance", video_rotation=corrupt.rotate_video(3)),
    _case("turn", video_mirrored=corrupt.mirror_video),
    _case("noisy", video_mirrored=corrupt.mirror_video),
    _case("dance", video_crop=corrupt.crop_video(0.05, 0.08, 0.87)),
    _case("rough", video_crop=corrupt.crop_video(-0.15, -0.15, 1.3)),
    _case("turn", video_offset=corrupt.trim_video(12)),
    _case("noisy", video_offset=corrupt.delay_video(4)),
    _case("small", video_offset=corrupt.reverse_video),
    _case("dance", frame_offset=corrupt.delay_poses(5), video_mirrored=corrupt.mirror_video),
)

INTACT = (
    *(CorruptedCapture(capture=name, corruptions=()) for name in CAPTURES),
    *(
        CorruptedCapture(capture=name, corruptions=(("", corrupt.convert_to_camera_space),))
        for name in CAPTURES
    ),
)
"""Captures as filmed, and converted to the camera's own frame."""

REQUIRED_FIRST = 40
"""Corruptions whose cause must be named first."""
MAX_CORE_SECONDS = 10.0
"""Core seconds of the slowest check."""


def shoot_captures(folder: Path) -> Path:
    """Film the sample captures that are not there yet."""
    for name, config in CAPTURES.items():
        if not (folder / name).exists():
            film_capture(folder / name, config)
    return folder


def check_case(case: CorruptedCapture, folder: Path) -> tuple[bool, bool, float, str]:
    """Whether the first cause is right, whether all are, core seconds, and a line of text."""
    began, core = time.perf_counter(), time.process_time()
    examined = check_capture(read_capture(CaptureInputs(video=folder)))
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
    """Check every capture and print a line each."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument(
        "--keep", type=Path, help="folder in which the sample captures are kept for later runs"
    )
    arguments.add_argument(
        "--only", nargs="+", type=int, metavar="N", help="numbers of the cases to check, from 0"
    )
    parsed = arguments.parse_args()
    keep: Path | None = parsed.keep
    cases = list(enumerate((*CORRUPTED, *INTACT)))
    chosen = [cases[number] for number in parsed.only] if parsed.only else cases
    print("\n".join(Hardware.here().lines()))
    with tempfile.TemporaryDirectory(dir=keep and _make_folder(keep)) as scratch:
        samples = shoot_captures(keep or Path(scratch) / "captures")
        found = whole = quiet = 0
        slowest = 0.0
        for number, case in chosen:
            folder = case.write(samples, Path(scratch) / f"case{number}")
            right, all_named, seconds, said = check_case(case, folder)
            slowest = max(slowest, seconds)
            corrupted = number < len(CORRUPTED)
            found, quiet = found + (right and corrupted), quiet + (right and not corrupted)
            whole += all_named and corrupted
            wanted = " + ".join(cause for cause, _ in case.corruptions if cause) or "good"
            mark = " " if right else "✗"
            print(
                f"{mark} {number:2d} {case.capture:<6} {wanted:<30} {seconds:4.1f} s  {said}",
                flush=True,
            )
    print(
        f"right cause first: {found} of {len(CORRUPTED)} (target: {REQUIRED_FIRST}); "
        f"all causes: {whole}"
    )
    print(f"intact ones called good: {quiet} of {len(INTACT)} (target: all)")
    print(f"slowest: {slowest:.1f} core-s (target: {MAX_CORE_SECONDS:.0f})")
    sys.exit(
        0 if found >= REQUIRED_FIRST and quiet == len(INTACT) and slowest <= MAX_CORE_SECONDS else 1
    )


def _make_folder(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


if __name__ == "__main__":
    main()
