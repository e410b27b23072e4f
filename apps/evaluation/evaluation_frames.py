"""Frames to evaluate on: held out of a run, or another capture's; pictures rendered of them."""

import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float32

from apps.evaluation.frame_scoring import BACKGROUNDS, PremultipliedImage
from apps.run.ingest_arguments import IngestArguments, trainable_longer_side_px
from apps.run.missing_inputs import read_tracked_poses
from apps.run.run_folder import RunFolder
from capture.image_folder import any_has_cutout_alpha, list_images, read_image
from capture.input_error import InputError
from capture.source import FrameSource
from preprocess.capture_session import Capture, CaptureInputs
from preprocess.fitting.capture_fit import load_capture_fit
from preprocess.fitting.capture_fitting import apply_fit
from preprocess.observation import Observation
from preprocess.open_capture import open_capture

PATH_ARGUMENTS = ("video", "poses", "masks", "body", "out", "json")
"""Arguments of ia-ingest that are paths in report.json."""


@dataclass(frozen=True, eq=False, kw_only=True)
class EvaluationFrames:
    """Frames of a capture.

    Attributes:
        recording: The capture.
        frame_indices: Numbers of the frames to score; None for all.
    """

    recording: Capture
    frame_indices: frozenset[int] | None = None

    @property
    def count(self) -> int | None:
        """Number of frames; None if unknown."""
        return (
            self.recording.source.frame_count
            if self.frame_indices is None
            else len(self.frame_indices)
        )

    def __iter__(self) -> Iterator[Observation]:
        """Yield the frames that show the person; reading ends after the last one needed."""
        recording, wanted = self.recording, self.frame_indices
        sequential = recording.segment is not None or recording.mask_refiner is not None
        observe, last = recording.observation_builder(), max(wanted, default=-1) if wanted else None
        for frame in recording.source.frames():
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
    """Open all frames of a capture.

    Args:
        inputs: Inputs as the user named them.
        body_file: Body of the avatar, to which poses are retargeted.
        size_px: Longer side; None for the original size.

    Raises:
        InputError: If a part is missing or does not match the others.
    """
    return EvaluationFrames(recording=open_capture(inputs, size_px=size_px, avatar_body=body_file))


def held_out_frames(run: RunFolder, size_px: int | None) -> EvaluationFrames:
    """Open the held-out frames of a run from its original capture.

    Raises:
        InputError: If its report or its capture is missing.
    """
    report = read_report(run)
    given = _run_arguments(report, run)
    if given.live or str(given.video).startswith("camera:"):
        raise InputError(
            f"{run.path} was trained from a live source, which was not recorded. Pass another "
            "capture of the same person with --on."
        )
    if given.tracks_stream:
        raise InputError(
            f"{run.path} was trained while its video was tracked, and those poses cannot be "
            "repeated. Run ia-track, and pass --on and --poses."
        )
    given = read_tracked_poses(given, run)
    inputs = given.capture_inputs()
    if given.cameras == "solve" and run.cameras.is_file():
        inputs = replace(inputs, cameras=str(run.cameras), poses=run.poses)
    recording = _open_as_trained(inputs, run)
    own_px = given.size or trainable_longer_side_px(given.training_seconds(recording))
    numbers = report["held_out"]["frames"]
    if not numbers:
        raise InputError(
            f"{run.path} has no held-out frames. Pass another capture of the same person with --on."
        )
    return EvaluationFrames(
        recording=replace(recording, size_px=size_px or own_px), frame_indices=frozenset(numbers)
    )


def _open_as_trained(inputs: CaptureInputs, run: RunFolder) -> Capture:
    """Open a run's own capture with the body and the poses that it was trained with."""
    recording = open_capture(inputs)
    fit = load_capture_fit(run.fit_file, recording.identity)
    if run.body_file.is_file() and (fit is None or not fit.fits_body):
        recording = open_capture(inputs, avatar_body=run.body_file)
    return recording if fit is None else apply_fit(recording, fit, height_m=inputs.height_m)


def trained_longer_side_px(run: RunFolder) -> int | None:
    """Return the longer side of a run's training images; None if unknown."""
    size = read_report(run)["held_out"].get("size") if run.report_json.is_file() else None
    return max(size) if size else None


def is_trained(run: RunFolder, *, seconds: float, steps: int | None) -> bool:
    """Whether a run was trained for the steps, or else for the seconds, by its report."""
    if not (run.has_checkpoint() and run.report_json.is_file()):
        return False
    training = read_report(run)["training"]
    return training["wall_seconds"] >= seconds if steps is None else training["steps"] >= steps


def read_report(run: RunFolder) -> dict[str, Any]:
    """Read a run's report.json.

    Raises:
        InputError: If it is missing or damaged.
    """
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
    return replace(given, **near, realtime=False)


def _original_working_folder(arguments: IngestArguments, run: RunFolder) -> Path:
    """Return the folder that the command was run in: here, or where --out is this folder."""
    if arguments.video.exists() or arguments.out is None or arguments.out.is_absolute():
        return Path()
    above = Path(os.path.abspath(run.path))
    for _ in arguments.out.parts:
        above = above.parent
    return above if (above / arguments.video).exists() else Path()


MAX_RIM_DIFFERENCE = 0.5
"""Largest difference between the median of a picture's rim and the stated background."""
LISTED_FRAMES = 12
"""Frames without a picture that a message lists."""


@final
class PictureFolder:
    """Pictures by frame: by file name, by the last number in it, or by order.

    Attributes:
        missing: Numbers of frames that were asked for and have no picture.
        order_note: How pictures were matched, if by their order; else None.
    """

    def __init__(self, folder: Path, source: FrameSource, backgrounds: tuple[str, ...]) -> None:
        """List the pictures.

        Args:
            folder: The folder.
            source: Frames that were rendered.
            backgrounds: What is behind the person, names of `BACKGROUNDS`.

        Raises:
            InputError: If there are no pictures, or no alpha channel to change the background.
        """
        if not folder.is_dir():
            raise InputError(f"--pictures is {folder}, which is no folder of pictures.")
        self._folder, self._source, self._backgrounds = folder, source, backgrounds
        self._files = list_images(folder)
        if not self._files:
            raise InputError(f"--pictures {folder} holds no pictures (.png, .jpg, .webp …).")
        self._has_alpha = any_has_cutout_alpha(self._files)
        if not self._has_alpha and len(backgrounds) > 1:
            raise InputError(
                f"The pictures in {folder} have no alpha channel, so their background cannot be "
                f"changed: state the one they have, --background {backgrounds[0]}."
            )
        self._by_stem = {file.stem: file for file in self._files}
        self._by_number = {
            int(numbers[-1]): file
            for file in self._files
            if (numbers := re.findall(r"\d+", file.stem))
        }
        wanted = source.selection
        self._selected = range(
            wanted.start,
            min(source.frames_in_file, wanted.stop or source.frames_in_file),
            wanted.step,
        )
        self._in_order = len(self._files) == len(self._selected) and not all(
            index in self._by_number for index in self._selected
        )
        self.missing = list[int]()
        self.order_note: str | None = None

    def __call__(self, observation: Observation) -> PremultipliedImage | None:
        """Read the picture of a frame, with premultiplied alpha; None if it has none.

        Raises:
            InputError: If it has another size, or another background than stated.
        """
        frame = observation.frame
        file = self._by_stem.get(frame.name or "") or self._by_number.get(frame.index)
        if self._in_order and (frame.name is None or frame.name not in self._by_stem):
            file = self._files[self._source.selection.position(frame.index)]
            self.order_note = (
                f"The pictures in {self._folder} are not numbered like the frames; as there are as "
                "many of both, they are matched in order."
            )
        if file is None:
            self.missing.append(frame.index)
            return None
        rgb, alpha = read_image(file)
        if rgb.shape[:2] != observation.alpha.shape:
            stored, wanted = (f"{w}x{h}" for h, w in (rgb.shape[:2], observation.alpha.shape))
            raise InputError(
                f"{file} has {stored} px, its frame {wanted}. Name the longer side at which frames "
                f"are compared: --size {max(rgb.shape[:2])}."
            )
        picture = rgb.astype(np.float32) / np.float32(255.0)
        if not self._has_alpha:
            self._check_background(picture, file)
            return np.concatenate([picture, np.ones_like(picture[..., :1])], axis=-1)
        if alpha is None:
            raise InputError(f"{file} has no alpha channel, but others in {self._folder} have.")
        opacity = alpha[..., None].astype(np.float32) / np.float32(255.0)
        return np.concatenate([picture * opacity, opacity], axis=-1)

    def describe_missing(self) -> str | None:
        """Name the frames without a picture, in a sentence; None if all have one."""
        if not self.missing:
            return None
        listed = ", ".join(map(str, self.missing[:LISTED_FRAMES]))
        more = len(self.missing) - LISTED_FRAMES
        return (
            f"{self._folder} has no picture of {len(self.missing)} frames, which are not scored: "
            f"{listed}{f' and {more} more' if more > 0 else ''}. Pictures are found by the name of "
            "the frame's file, or by the frame's number in the video, counted from 0."
        )

    def _check_background(self, picture: Float32[np.ndarray, "height width 3"], file: Path) -> None:
        (name,) = self._backgrounds
        rim = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
        gray = float(np.median(rim))
        if abs(gray - BACKGROUNDS[name]) > MAX_RIM_DIFFERENCE:
            other = next(each for each in BACKGROUNDS if each != name)
            raise InputError(
                f"{file} is not on {name}: the median of its rim is {255 * gray:.0f} of 255. State "
                f"its background (--background {other})."
            )
