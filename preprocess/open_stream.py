"""Opens a stream that comes without poses: its person is tracked while its frames come."""

from collections.abc import Callable
from pathlib import Path

from capture.input_error import InputError
from capture.live.camera_device import camera_address
from capture.live.pacing_clock import PacingClock
from capture.live.realtime_playback import RealtimePlayback
from capture.source import FrameSource
from capture.source_opening import open_live_source, open_source
from preprocess.body.body_file import load_body_model, read_shaped_body
from preprocess.cameras.camera_orientation import assume_camera
from preprocess.capture_paths import CapturePaths
from preprocess.capture_session import Capture, CaptureInputs
from preprocess.live.tracked_stream import LiveTracking, TrackedStream
from preprocess.tracking.person_tracker import PersonTracker
from preprocess.tracking.video_tracking import MaskRefinement


def open_tracked_stream(
    wanted: CaptureInputs,
    tracker: PersonTracker,
    make_refinement: Callable[[tuple[int, int]], MaskRefinement],
    poses: Path,
    *,
    avatar_body: Path | None = None,
) -> Capture:
    """Open a live source, or a recording that is played at its own speed, and find the person.

    Args:
        wanted: What the user named; without poses and masks.
        tracker: Follows the person.
        make_refinement: From the frames' width and height to what makes masks from the tracker's.
        poses: File to which the poses will be written in the end.
        avatar_body: File of a finished avatar's person, who is filmed again.

    Raises:
        InputError: If it cannot be read, or no person is found in it.
    """
    if wanted.cameras == "solve" or wanted.height_m is not None:
        raise InputError(
            "--cameras solve and --height-cm need the poses of the whole recording. Run ia-track "
            "first, and give its poses; or leave out --realtime."
        )
    stream = TrackedStream(_open_source(wanted))
    tracking = LiveTracking(stream, tracker, make_refinement(stream.size_px))
    shaped = load_body_model(wanted.body).with_shape()
    if avatar_body is not None:
        shaped = read_shaped_body(avatar_body, shaped.body)
    found = tracking.start(
        shaped,
        assume_camera(wanted.video, wanted.cameras, stream),
        fixed_body=avatar_body is not None,
    )
    return Capture(
        paths=CapturePaths(video=wanted.video, poses=poses, masks=None, cameras=None),
        source=stream,
        motion=found.motion,
        masks=None,
        cameras=found.cameras,
        shaped=found.shaped,
        size_px=None,
        notes=(),
        live=tracking,
    )


def _open_source(wanted: CaptureInputs) -> FrameSource:
    pace, camera = PacingClock(), camera_address(wanted.video)
    if wanted.live or camera is not None:
        return open_live_source(wanted.video, camera, wanted.frames, pace, idle_s=wanted.idle_s)
    return RealtimePlayback(open_source(wanted.video, frames=wanted.frames), pace)
