"""Draws docs/avatar.webp from a demo: the video, the avatar in its poses, the avatar dancing."""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from PIL import Image

from capture.atomic_files import atomic_file
from capture.source_opening import open_source
from export.player import Player
from instant_avatar.animation.clip_file import background_compositor
from instant_avatar.animation.driving_motion import FollowingCamera
from preprocess.cameras.camera_file import read_cameras
from preprocess.poses.pose_format_registry import read_poses

FRAMES, STEP, FPS = 40, 3, 10


@dataclass(frozen=True, kw_only=True)
class PictureArguments:
    """Draws the picture of the README from what `make demo` leaves."""

    demo: tyro.conf.Positional[Path] = Path("demo")
    """The demo's folder."""
    out: Path = Path("docs/avatar.webp")
    """Picture to write."""
    size: int = 256
    """Pixels of each of the three parts."""


def main() -> None:
    """The command."""
    given = tyro.cli(PictureArguments)
    size = given.size
    capture = given.demo / "capture"
    player = Player.load(given.demo / "run" / "avatar.iavatar")
    source, poses = open_source(capture), read_poses(capture / "poses.npz")
    camera = read_cameras(capture / "cameras.npz", source.size_px)[0].resize((size, size))
    dance = read_poses(capture / "dance.npz")
    following = FollowingCamera.of(player, dance, size)
    blend = background_compositor("#f4f1ea")
    rows = []
    for frame in source.frames():
        if frame.index % STEP or len(rows) == FRAMES:
            continue
        pose = dance[len(rows) * STEP % len(dance)]
        video = np.asarray(Image.fromarray(frame.rgb).resize((size, size)))
        same = blend(player.render(poses[frame.index], camera))
        rows.append(
            np.hstack([video, same, blend(player.render(pose, following.camera_for(pose)))])
        )
    first, *others = [Image.fromarray(row) for row in rows]
    with atomic_file(given.out) as part:
        first.save(
            part, save_all=True, append_images=others, duration=1000 // FPS, loop=0, quality=70
        )


if __name__ == "__main__":
    sys.exit(main())
