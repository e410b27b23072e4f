"""The poses of a clip as rotation matrices, all frames at once."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.kinematics import axis_angles_from_matrices, rigid_transform, rotation_matrices


class PosedJoints(NamedTuple):
    """Where the joints of a clip's frames are.

    Attributes:
        turns: World rotation of each joint.
        places: World position of each joint, metres.
    """

    turns: Float[np.ndarray, "frames 24 3 3"]
    places: Float[np.ndarray, "frames 24 3"]

    def world_from_rest(
        self, rest_joints: Float[np.ndarray, "24 3"]
    ) -> Float[np.ndarray, "frames 24 4 4"]:
        """Transforms that carry points of the rest pose with their joints."""
        return rigid_transform(
            self.turns, self.places - (self.turns @ rest_joints[..., None])[..., 0]
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class ClipPoses:
    """Poses of a clip's frames.

    Attributes:
        rotations: Of the root and of each joint relative to its parent.
        translations: As in `BodyPose`, metres.
    """

    rotations: Float[np.ndarray, "frames 24 3 3"]
    translations: Float[np.ndarray, "frames 3"]

    @classmethod
    def of(cls, motion: Motion, rows: Sequence[int]) -> "ClipPoses":
        """Some rows of a motion."""
        some = list(rows)
        vectors = [motion.root_rotations[some][:, None], motion.joint_rotations[some]]
        return cls(
            rotations=rotation_matrices(np.concatenate(vectors, axis=1)),
            translations=motion.root_translations[some].astype(np.float64),
        )

    def __getitem__(self, index: int) -> BodyPose:
        """The pose of one frame."""
        turned = axis_angles_from_matrices(self.rotations[index])
        return BodyPose(
            root_rotation=turned[0],
            root_translation=self.translations[index],
            joint_rotations=turned[1:],
        )

    def moved(
        self,
        steps: Float[np.ndarray, "frames 75"],
        camera_rotations: Float[np.ndarray, "frames 3 3"],
    ) -> "ClipPoses":
        """The poses after a step.

        Args:
            steps: Rotations in the joints' axes, radians; translation in the camera's, metres.
            camera_rotations: Camera from world.
        """
        turned = rotation_matrices(steps[:, :72].reshape(-1, 24, 3))
        shifted = (steps[:, None, 72:] @ camera_rotations)[:, 0]
        return ClipPoses(
            rotations=self.rotations @ turned, translations=self.translations + shifted
        )

    def steps_from(
        self, other: "ClipPoses", camera_rotations: Float[np.ndarray, "frames 3 3"]
    ) -> Float[np.ndarray, "frames 75"]:
        """The steps that `moved` takes from other poses to these."""
        turned = rotation_vectors(other.rotations.swapaxes(-1, -2) @ self.rotations)
        shifted = (camera_rotations @ (self.translations - other.translations)[..., None])[..., 0]
        return np.concatenate([turned.reshape(-1, 72), shifted], axis=1)

    def joints(
        self, rest_joints: Float[np.ndarray, "24 3"], parents: Int[np.ndarray, "24"]
    ) -> PosedJoints:
        """Where the joints are, for a person's rest joints."""
        turns, places = np.empty_like(self.rotations), np.empty((len(self.rotations), 24, 3))
        for joint, parent in enumerate(parents):
            if parent < 0:
                turns[:, joint] = self.rotations[:, joint]
                places[:, joint] = rest_joints[joint] + self.translations
            else:
                turns[:, joint] = turns[:, parent] @ self.rotations[:, joint]
                bone = rest_joints[joint] - rest_joints[parent]
                places[:, joint] = places[:, parent] + turns[:, parent] @ bone
        return PosedJoints(turns, places)


def rotation_vectors(
    matrices: Float[np.ndarray, "*batch 3 3"],
) -> Float[np.ndarray, "*batch 3"]:
    """Axis-angles of exact rotation matrices, radians."""
    flat = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec()
    return flat.reshape(matrices.shape[:-1])
