"""Which frame each camera belongs to: by the picture's name, by the number in it, or by order."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from capture.errors import InputError
from capture.images import list_images
from capture.source import FrameSource
from preprocess.cameras.named import NamedCamera

MAX_INTERPOLATED_FRAMES = 12
"""EvaluationFrames without a camera between two that have one; longer gaps stay gaps."""
MIN_NUMBERED_COVERAGE = 0.9
"""Share of a video's frames that consecutive numbers must reach, to be its frames' own."""


def cameras_by_frame(found: Sequence[NamedCamera], source: FrameSource, path: Path) -> dict[int, Camera]:
    """The cameras by their frames' numbers.

    Args:
        found: In the order of their pictures' names.
        source: The frames.
        path: Of the cameras, for messages.

    Raises:
        InputError: If it cannot be said which frames they belong to.
    """
    found = _select_image_folder(found, source, path)
    names = [None if each.name is None else PurePosixPath(each.name).name for each in found]
    if source.path.is_dir():
        index = {file.stem: number for number, file in enumerate(list_images(source.path))}
        matched = {
            index[n]: each.camera for n, each in zip(names, found, strict=True) if n in index
        }
        if matched:
            return matched
    if len(found) == source.frames_in_file:
        return {number: each.camera for number, each in enumerate(found)}
    numbers = _frame_numbers(names, source.frames_in_file)
    if numbers is not None:
        return {n: each.camera for n, each in zip(numbers, found, strict=True)}
    raise InputError(
        f"{path} holds {len(found)} cameras, {source.path} {source.frames_in_file} frames, and "
        "their names do not tell which belong together. Give as VIDEO the folder of pictures that "
        "the cameras were made from, or a camera for every frame."
    )


def _select_image_folder(
    found: Sequence[NamedCamera], source: FrameSource, path: Path
) -> Sequence[NamedCamera]:
    """The cameras of the video's own pictures, where several folders hold pictures of one name.

    Raises:
        InputError: If none of the folders is named like the video.
    """
    places = [PurePosixPath(each.name or str(row)) for row, each in enumerate(found)]
    if len({place.name for place in places}) == len(found):
        return found
    own = {source.path.resolve().name, source.path.stem}
    chosen = [e for place, e in zip(places, found, strict=True) if own & set(place.parent.parts)]
    if not chosen or len({PurePosixPath(each.name or "").name for each in chosen}) < len(chosen):
        folders = ", ".join(sorted({str(place.parent) for place in places})[:12])
        raise InputError(
            f"{path} holds several cameras for pictures of one name, in the folders {folders}; "
            f"{source.path} is none of them. Give as VIDEO one of these folders of pictures."
        )
    return chosen


def interpolate_missing_cameras(cameras: dict[int, Camera], frames: int) -> tuple[tuple[Camera, ...], frozenset[int]]:
    """A camera for every frame; short gaps are filled in, longer ones named.

    ResectionResult two cameras rotations turn evenly (slerp) and centres move on a line.

    Returns:
        One camera a frame, and the frames whose camera is only a stand-in.
    """
    known = np.array(sorted(number for number in cameras if 0 <= number < frames))
    if not len(known):
        raise InputError("None of the cameras belongs to a frame of the video.")
    filled, missing = [], set()
    for frame in range(frames):
        after = int(np.searchsorted(known, frame))
        if after < len(known) and known[after] == frame:
            filled.append(cameras[frame])
            continue
        inside = 0 < after < len(known)
        if inside and known[after] - known[after - 1] <= MAX_INTERPOLATED_FRAMES + 1:
            early, late = int(known[after - 1]), int(known[after])
            share = (frame - early) / (late - early)
            filled.append(_interpolate_camera(cameras[early], cameras[late], share))
            continue
        missing.add(frame)
        filled.append(cameras[int(known[min(after, len(known) - 1)])])
    return tuple(filled), frozenset(missing)


def _interpolate_camera(a: Camera, b: Camera, share: float) -> Camera:
    start = Rotation.from_matrix(a.camera_from_world[:3, :3])
    turn = Rotation.from_matrix(b.camera_from_world[:3, :3]) * start.inv()
    rotation = (Rotation.from_rotvec(share * turn.as_rotvec()) * start).as_matrix()
    center = (1.0 - share) * a.center_world + share * b.center_world
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = rotation
    camera_from_world[:3, 3] = -rotation @ center
    return replace(a, camera_from_world=camera_from_world)


def _frame_numbers(names: Sequence[str | None], frames: int) -> list[int] | None:
    """Frame numbers in names such as frame_00042, counted from 0 or 1; None if there are none.

    Numbers without a gap that end long before the video does are the count of a few chosen frames.
    """
    parsed = [re.findall(r"\d+", name or "") for name in names]
    if not all(parsed):
        return None
    numbers = [int(digits[-1]) for digits in parsed]
    first = 0 if min(numbers) == 0 else 1
    numbers = [number - first for number in numbers]
    if len(set(numbers)) < len(numbers) or max(numbers) >= frames:
        return None
    chosen = len(numbers) == max(numbers) + 1 and len(numbers) < MIN_NUMBERED_COVERAGE * frames
    return None if chosen else numbers
