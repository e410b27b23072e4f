"""Trains an avatar from a video in one call, and draws it in the poses of the video.

    python examples/1_train_from_python.py VIDEO [FOLDER]

`make demo` films an actor if you have no video at hand: demo/video.mp4.
"""

import sys
from pathlib import Path

try:
    from instant_avatar import InputError, Player, train
except ModuleNotFoundError as missing:
    sys.exit(f"{missing}. To train, install in the checkout's folder: pip install -e '.[learn]'")

STEPS = 500


def main(video: Path, folder: Path) -> None:
    # Poses and masks are tracked in the video; poses="poses.npz" takes another tracker's.
    avatar = train(video, folder, steps=STEPS, overwrite=True)

    # All that is known about it: scores of frames it never saw, and what was filmed of the person.
    held_out = avatar.report["held_out"]
    print(f"{avatar.verdict}: {held_out['psnr']:.1f} dB on {len(held_out['frames'])} frames")
    if avatar.package is None:
        sys.exit(f"There is nothing to draw. Look at {folder / 'report.html'}.")

    # The package plays with numpy and onnxruntime alone, on any machine.
    player = Player.load(avatar.package)
    tiers = ", ".join(player.manifest.tiers)
    print(f"{avatar.package}: {avatar.package.stat().st_size / 1e6:.1f} MB, {tiers}")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    try:
        main(Path(sys.argv[1]), Path(sys.argv[2] if len(sys.argv) > 2 else "runs/python"))
    except InputError as error:
        sys.exit(str(error))
    except ModuleNotFoundError as missing:
        sys.exit(
            f"{missing}. To train, install in the checkout's folder: pip install -e '.[learn]'"
        )
