"""Find the row of a file that belongs to a frame: by order, by time, or by the names of its images.

Poses have times or come one per frame, masks and cameras have names or come one per frame. What
cannot be associated with certainty is refused; a wrong association would train a wrong avatar.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from capture.image_folder import list_images
from capture.input_error import InputError
from capture.source import FrameSource
from preprocess.body.kinematics import rigid_transform
from preprocess.cameras.camera_formats import NamedCamera


def associate_by_order(rows: int, source: FrameSource, things: str) -> Callable[[int], int]:
    """Map a frame's number to its row: one row a frame, of all frames or of the selected ones.

    The container's claim counts, so that a truncated video still fits its poses; where it does not
    fit, the frames are counted by decoding them. `things` names the rows in the message ("poses in
    poses.npz").
    """
    for total in (source.frames_in_file, None):
        count = source.count_frames() if total is None else total
        if rows == count:
            return int
        if rows == source.selection.count(count):
            return source.selection.position
    or_say = "; or say which frame each belongs to (the keys `frame` or `time`)"
    hint = or_say if things.startswith("poses") else ""
    raise InputError(
        f"There are {rows} {things}, but {count} frames in {source.path}. Expected one for every "
        f"frame, in order{hint}.{_mismatch_hint(rows, count)}"
    )


def _mismatch_hint(rows: int, count: int) -> str:
    if rows > count:
        return " Was the video cut, or re-encoded with fewer frames per second?"
    step = round(count / rows)
    if step > 1 and rows == -(-count // step):
        return f" If they are those of one frame in {step}: --frames ::{step}."
    return f" If they are those of the first {rows} frames: --frames 0:{rows}."


def associate_by_time(
    times_s: Float[np.ndarray, "poses"], source: FrameSource
) -> Callable[[float], int | None]:
    """Map a frame's time to the row nearest to it, or to None where none is near.

    Times of poses are in any order, NaN where unknown; the frame rate says how near a row must be.
    """
    count = source.frame_count
    if not source.duration_s or not count:
        return _nearest_row(times_s, None)
    step = source.duration_s / count  # from one selected frame to the next, as the container claims
    row_of = _nearest_row(times_s, step)
    start = source.selection.start * step / source.selection.step
    found = {row_of(start + step * number) for number in range(count)} - {None}
    most = min(count, len(times_s))
    if len(found) < max(min(2, most), 0.1 * most):
        known = times_s[np.isfinite(times_s)]
        said = f"{known.min():.6g} to {known.max():.6g} s" if len(known) else "unknown times"
        raise InputError(
            f"The poses are those of {said}, the frames of {source.path} those of {start:.3g} to "
            f"{start + step * count:.3g} s; `time` was expected in seconds since the video's first "
            "frame. Is it in milliseconds, or by another clock?"
        )
    return row_of


def _nearest_row(
    times_s: Float[np.ndarray, "poses"], frame_step_s: float | None
) -> Callable[[float], int | None]:
    """The row nearest to a time, if it is nearer than half the usual step, and near at all."""
    finite = np.flatnonzero(np.isfinite(times_s))
    rows = finite[np.argsort(times_s[finite], kind="stable")]
    times = times_s[rows]
    steps = np.diff(times)
    reach = 0.5 * float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.02
    reach = min(reach, max(0.05, 0.5 * (frame_step_s or 0.0)))  # seconds

    def row(time_s: float) -> int | None:
        place = int(np.searchsorted(times, time_s))
        around = range(max(0, place - 1), min(len(times), place + 1))
        nearest = min(around, key=lambda i: abs(times[i] - time_s), default=None)
        if nearest is None or abs(times[nearest] - time_s) > reach + 1e-6:
            return None
        return int(rows[nearest])

    return row


def associate_by_name(names: Sequence[str], source: FrameSource) -> dict[int, int] | None:
    """Map frames' numbers to the rows of masks by file names, without endings; None if none tell.

    In a folder of images a mask belongs to the image of its name, or of its number. In a video
    numbers count the frames, from 0 if one is 0, from 1 if one is that of the last frame. Numbers
    without a gap are the count of a few chosen frames, and say nothing. Where half of the frames or
    more would have no mask, the masks are a choice that --frames has to state.
    """
    if 2 * len(names) <= source.frames_in_file:
        return None
    if source.path.is_dir():
        pictures = [file.stem for file in list_images(source.path)]
        return _match_names(names, pictures) or _match_names(
            _unique_numbers(names), _unique_numbers(pictures)
        )
    numbers, total = _unique_numbers(names), source.frames_in_file
    if numbers is None:
        return None
    first = 0 if min(numbers) == 0 else 1 if max(numbers) == total else None
    if first is None or max(numbers) - first >= total:
        return None
    if min(numbers) == first and max(numbers) - first + 1 == len(numbers):
        return None
    return {number - first: row for row, number in enumerate(numbers)}


def _match_names(
    masks: Sequence[str | int] | None, pictures: Sequence[str | int] | None
) -> dict[int, int] | None:
    """Rows by frames, if every mask has its own image."""
    if masks is None or pictures is None:
        return None
    frame_of = {picture: frame for frame, picture in enumerate(pictures)}
    rows = {frame_of[mask]: row for row, mask in enumerate(masks) if mask in frame_of}
    return rows if len(rows) == len(masks) else None


def _unique_numbers(names: Sequence[str]) -> list[int] | None:
    """The last number in each name; None unless all have one of their own."""
    found = [re.findall(r"\d+", name) for name in names]
    if not found or not all(found):
        return None
    numbers = [int(digits[-1]) for digits in found]
    return numbers if len(set(numbers)) == len(numbers) else None


def frame_numbers_from_names(names: Iterable[str]) -> list[int]:
    """The last number in each name; the place in order where a name has none, or two have one."""
    stems = [name.rsplit(".", 1)[0].rsplit("/", 1)[-1] for name in names]
    return _unique_numbers(stems) or list(range(len(stems)))


def cameras_by_frame(
    found: Sequence[NamedCamera], source: FrameSource, path: Path
) -> dict[int, Camera]:
    """The cameras by their frames' numbers; `found` is in the order of their images' names."""
    names = [None if each.name is None else PurePosixPath(each.name).name for each in found]
    if None not in names and len(set(names)) < len(names):
        raise InputError(
            f"{path} holds several cameras for pictures of one name, in several folders. Give "
            f"those of {source.path} alone."
        )
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


def interpolate_missing_cameras(
    cameras: dict[int, Camera], frames: int
) -> tuple[tuple[Camera, ...], frozenset[int]]:
    """A camera for every frame, and the frames whose camera is only a stand-in.

    Gaps of up to 12 frames are filled: rotations turn evenly (slerp), centres move on a line.
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
        if inside and known[after] - known[after - 1] <= 13:
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
    return replace(a, camera_from_world=rigid_transform(rotation, -rotation @ center))


def _frame_numbers(names: Sequence[str | None], frames: int) -> list[int] | None:
    """Frame numbers in names such as frame_00042, counted from 0 or 1; None if there are none.

    Numbers without a gap that end long before the video does are the count of a few chosen frames.
    """
    numbers = _unique_numbers([name or "" for name in names])
    if numbers is None:
        return None
    first = 0 if min(numbers) == 0 else 1
    numbers = [number - first for number in numbers]
    if max(numbers) >= frames:
        return None
    chosen = len(numbers) == max(numbers) + 1 and len(numbers) < 0.9 * frames
    return None if chosen else numbers
