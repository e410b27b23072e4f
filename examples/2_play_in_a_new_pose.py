"""Plays a package in a pose of your own, with numpy and onnxruntime alone.

    python examples/2_play_in_a_new_pose.py AVATAR [PICTURE]

A pose is 24 axis-angles: the root's and 23 joints' (SMPL's order), and a place in metres.
"""

import sys
from pathlib import Path

try:
    import numpy as np
    from PIL import Image

    from instant_avatar import JOINT_NAMES, BodyPose, Camera, InputError, Player
except ModuleNotFoundError as missing:
    sys.exit(f"{missing}. Install the player in the checkout's folder: pip install -e .")


def joints(**rotations: tuple[float, float, float]) -> np.ndarray:
    """Axis-angles in radians by the joints' names; the others stay at rest (the T-pose)."""
    turned = np.zeros((23, 3))
    for name, rotation in rotations.items():
        turned[JOINT_NAMES.index(name) - 1] = rotation
    return turned


def main(package: Path, picture: Path) -> None:
    player = Player.load(package)
    pose = BodyPose(
        root_rotation=np.array([0.0, 0.5, 0.0]),  # about the vertical axis: half to the left
        root_translation=np.zeros(3),
        joint_rotations=joints(
            left_shoulder=(0.0, 0.0, 1.1),  # up, and the forearm further
            left_elbow=(0.0, 0.0, 0.5),
            right_shoulder=(0.0, 0.0, 1.0),  # down
            right_hip=(-0.9, 0.0, 0.0),  # a knee lifted
            right_knee=(1.2, 0.0, 0.0),
        ),
    )

    # A camera 4 m before the pelvis. OpenCV axes: x right, y down, z forward.
    eye, axes = player.manifest.rest_joints[0] + [0.0, 0.0, 4.0], np.diag([1.0, -1.0, -1.0])
    camera = Camera.at(eye, axes, focal_px=1.6 * 540, size_px=(540, 540))

    rgba = player.render(pose, camera)  # straight alpha
    Image.fromarray(rgba).save(picture)
    print(f"{picture}: {np.mean(rgba[..., 3] > 0):.0%} of it is the person")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    try:
        main(Path(sys.argv[1]), Path(sys.argv[2] if len(sys.argv) > 2 else "pose.png"))
    except InputError as error:  # no package there, or a damaged one
        sys.exit(str(error))
