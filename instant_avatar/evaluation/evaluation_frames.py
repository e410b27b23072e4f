"""Frames to evaluate on: held out of a run, or another capture's."""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from capture.input_error import InputError
from instant_avatar.run.ingest_arguments import IngestArguments
from instant_avatar.run.run_capture import open_as_trained
from instant_avatar.run.run_folder import RunFolder
from instant_avatar.run.run_tracking import inputs_as_tracked
from preprocess.capture_inputs import CaptureInputs, InputKind
from preprocess.capture_session import Capture
from preprocess.observation import Observation
from preprocess.open_capture import open_capture, read_capture

PATH_ARGUMENTS = ("video", "poses", "masks", "body", "out", "json")
"""Arguments of ia-ingest that are paths in report.json."""


@dataclass(frozen=True, eq=False, kw_only=True)
class EvaluationFrames:
    """Frames of a capture: those numbered in `frame_indices`, or all if it is None.

    Attributes:
        poses: "tracked" by ia-ingest, or "given".
    """

    capture: Capture
    frame_indices: frozenset[int] | None = None
    poses: str = "given"

    @property
    def count(self) -> int | None:
        """Number of frames; None if unknown."""
        chosen = self.frame_indices
        return self.capture.source.frame_count if chosen is None else len(chosen)

    def __iter__(self) -> Iterator[Observation]:
        """Yield the frames that show the person; reading ends after the last one needed."""
        capture, wanted = self.capture, self.frame_indices
        sequential = capture.masks.needs_all_frames
        observe, last = capture.observation_builder(), max(wanted, default=-1) if wanted else None
        for frame in capture.source.frames():
            counts = wanted is None or frame.index in wanted
            if counts or sequential:  # masks are estimated and refined in the frames' order
                seen = observe(frame)
                if counts and isinstance(seen, Observation):
                    yield seen
            if frame.index == last:
                return


def capture_frames(
    inputs: CaptureInputs, body_file: Path | None, size_px: int | None
) -> EvaluationFrames:
    """Open all frames of a capture, with the poses retargeted to the avatar's body.

    `size_px` is the longer side of the images; None for the original size.
    """
    return EvaluationFrames(capture=open_capture(inputs, size_px=size_px, avatar_body=body_file))


def held_out_frames(run: RunFolder, size_px: int | None) -> EvaluationFrames:
    """Open the held-out frames of a run from its original capture."""
    report = read_report(run)
    given = _run_arguments(report, run)
    inputs = given.capture_inputs()
    if inputs.kind is InputKind.STREAMED:
        raise InputError(
            f"{run.path} was trained on a stream: its frames, or the poses that were tracked while "
            "they came, cannot be repeated. Pass another capture of the same person with --on, or "
            "this video with --on and --poses of ia-track."
        )
    inputs = inputs_as_tracked(given, inputs, run)
    if given.cameras == "solve" and run.cameras.is_file():
        inputs = replace(inputs, cameras=str(run.cameras), poses=run.poses)
    imported = read_capture(inputs)
    own_px = given.longer_side_px(imported.source)
    numbers = report["held_out"]["frames"]
    if not numbers:
        raise InputError(
            f"{run.path} has no held-out frames. Pass another capture of the same person with --on."
        )
    return EvaluationFrames(
        capture=open_as_trained(imported, run, size_px or own_px),
        frame_indices=frozenset(numbers),
        poses="tracked" if inputs.poses == run.tracked_poses else "given",
    )


def trained_longer_side_px(run: RunFolder) -> int | None:
    """Return the longer side of a run's training images; None if unknown."""
    size = read_report(run)["held_out"].get("size") if run.report_json.is_file() else None
    return max(size) if size else None


def is_trained(run: RunFolder, *, seconds: float, steps: int | None) -> bool:
    """True if a run was trained for the steps, or else for the seconds, by its report."""
    if not (run.has_checkpoint() and run.report_json.is_file()):
        return False
    training = read_report(run)["training"]
    return training["wall_seconds"] >= seconds if steps is None else training["steps"] >= steps


def read_report(run: RunFolder) -> dict[str, Any]:
    """Read a run's report.json."""
    try:
        report = json.loads(run.report_json.read_text(encoding="utf-8"))
        if isinstance(report["command"], dict) and isinstance(report["held_out"]["frames"], list):
            return report
        raise KeyError("command")
    except FileNotFoundError as error:
        raise InputError(
            f"{run.path} holds no {run.report_json.name}, which names its capture: finish the run "
            "(ia-ingest … --resume), or pass a capture with --on."
        ) from error
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{run.report_json} is not a report of ia-ingest ({type(error).__name__}: {error}). "
            "Rewrite it (ia-ingest … --resume), or pass both --on and --size."
        ) from error


def _run_arguments(report: dict[str, Any], run: RunFolder) -> IngestArguments:
    """Restore the arguments of the run; relative paths are searched for near it as well."""
    known = {item.name for item in fields(IngestArguments)}
    words = {key: value for key, value in report["command"].items() if key in known}
    try:
        words |= {key: Path(words[key]) for key in PATH_ARGUMENTS if words.get(key) is not None}
        given = IngestArguments(**words)
    except TypeError as error:
        raise InputError(
            f"{run.report_json} does not name the capture; pass one with --on."
        ) from error
    base = _original_working_folder(given, run)
    near = {key: base / words[key] for key in PATH_ARGUMENTS if words.get(key) is not None}
    if given.cameras is not None and (base / given.cameras).exists():
        near["cameras"] = str(base / given.cameras)
    return replace(given, **near)


def _original_working_folder(arguments: IngestArguments, run: RunFolder) -> Path:
    """Return the folder that the command was run in: here, or where --out is this folder."""
    if arguments.video.exists() or arguments.out is None or arguments.out.is_absolute():
        return Path()
    above = Path(os.path.abspath(run.path))
    for _ in arguments.out.parts:
        above = above.parent
    return above if (above / arguments.video).exists() else Path()
