"""Draws an avatar from all sides with the Player alone, several pictures at a time.

    python examples/3_turntable_with_workers.py AVATAR [PICTURE]

numpy, onnxruntime and Pillow are all it needs; torch is not imported. `ia-play AVATAR --turntable`
does the same from the command line.
"""

import sys
import time
from pathlib import Path

try:
    import numpy as np
    from PIL import Image

    from instant_avatar import BodyPose, Camera, InputError, Player
except ModuleNotFoundError as missing:
    sys.exit(f"{missing}. Install the player in the checkout's folder: pip install -e .")

PICTURES, SIZE, DISTANCE_M = 24, 270, 5.0


def camera_at(angle: float, looked_at: np.ndarray) -> Camera:
    """A camera that stands so far round the person and looks at a point (OpenCV axes)."""
    forward = -np.array([np.sin(angle), 0.0, np.cos(angle)])
    down = np.array([0.0, -1.0, 0.0])
    axes = np.stack([np.cross(down, forward), down, forward])
    return Camera.at(looked_at - DISTANCE_M * forward, axes, 2.0 * SIZE, (SIZE, SIZE))


def main(package: Path, moving: Path) -> None:
    player = Player.load(package, tier="lite")  # "hq" is finer
    standing = BodyPose(
        root_rotation=np.zeros(3),
        root_translation=np.zeros(3),
        joint_rotations=player.manifest.canonical_rotations,
    )
    middle = player.manifest.rest_joints[0] - [0.0, 0.1, 0.0]
    angles = np.linspace(0.0, 2.0 * np.pi, PICTURES, endpoint=False)
    shots = [(standing, camera_at(float(angle), middle)) for angle in angles]

    began = time.perf_counter()
    pictures = list(player.render_all(shots, workers=2))  # in order
    seconds = time.perf_counter() - began
    print(f"{len(pictures)} pictures of {SIZE} px, {len(pictures) / seconds:.0f} a second")

    close = player.render(standing, shots[0][1], size=2 * SIZE, samples=16)  # one, larger and finer
    print(f"and one of {close.shape[1]}x{close.shape[0]} px")
    first, *others = [Image.fromarray(rgba) for rgba in pictures]  # straight alpha
    first.save(moving, save_all=True, append_images=others, duration=80, loop=0)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    try:
        main(Path(sys.argv[1]), Path(sys.argv[2] if len(sys.argv) > 2 else "turntable.webp"))
    except InputError as error:  # no package there, or a damaged one
        sys.exit(str(error))
