"""What a user names of a recording."""

from dataclasses import dataclass
from pathlib import Path

from capture.camera_device import camera_address
from capture.growing import IDLE_TIMEOUT_S
from preprocess.capture_folder import find_parts
from preprocess.masks.segmenter import segmenter_name


@dataclass(frozen=True, kw_only=True)
class CaptureInputs:
    """What the user named; the rest is looked for (see `find_capture_paths`).

    Attributes:
        video: Video file, folder of pictures, or capture folder.
        poses, masks: Files or folders, or None.
        cameras: A file, "static", "solve" (poses are then in the camera of each frame, and so is
            all the rest until cameras were solved), or None.
        body: A body file; None for the embedded body.
        frames: Which frames are wanted.
        mask_invert: Whether the person is dark in the masks; None finds out.
        live: Whether `video` is a folder that grows; a camera is live without it.
        person: Whose poses, where the file holds several people's; None for the longest track.
        idle_s: Of a live source: how long nothing new may come.
        height_m: How tall the person is; None if only the poses tell.
        transposed: Whether the film's width and height are exchanged before masks and cameras are
            compared with it; only to find out whether it was rotated.
    """

    video: Path
    poses: Path | None = None
    masks: Path | None = None
    cameras: str | None = None
    body: Path | None = None
    frames: slice | None = None
    invert_masks: bool | None = None
    live: bool = False
    person: str | None = None
    idle_s: float = IDLE_TIMEOUT_S
    height_m: float | None = None
    transposed: bool = False

    def input_paths(self) -> list[Path]:
        """What no output may touch: files and folders that were named, and that may be found."""
        named = [self.poses, self.body]
        if camera_address(self.video) is None:
            named.append(self.video)
        if segmenter_name(self.masks) is None:
            named.append(self.masks)
        if self.cameras not in (None, "static", "solve"):
            named.append(Path(self.cameras))
        given = [path for path in named if path is not None]
        near = {path if path.is_dir() else path.parent for path in (self.video, self.poses) if path}
        return [*given, *find_parts(sorted(near))]
