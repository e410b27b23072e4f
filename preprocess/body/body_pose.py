"""One pose of the 24-joint tree, and poses over time."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from capture.camera import Matrix3, Vector3
from preprocess.body.kinematics import slerp
from preprocess.tracking.keypoints import KeypointTrack


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyPose:
    """One pose of the SMPL tree (Loper et al. 2015): axis-angles in world-aligned rest frames.

    The root turns about the rest pelvis J0 of the shaped body:
    `world = R(root_rotation) (x - J0) + J0 + root_translation`.

    Attributes:
        root_rotation: Axis-angle of the pelvis, radians (SMPL's global_orient).
        root_translation: Metres (SMPL's transl).
        joint_rotations: Axis-angle of joints 1 … 23 relative to their parents, radians.
    """

    root_rotation: Vector3
    root_translation: Vector3
    joint_rotations: Float[np.ndarray, "23 3"]

    @classmethod
    def rest(cls) -> "BodyPose":
        """The T-pose at the origin."""
        return cls(
            root_rotation=np.zeros(3),
            root_translation=np.zeros(3),
            joint_rotations=np.zeros((23, 3)),
        )

    def towards(self, other: "BodyPose", share: float) -> "BodyPose":
        """The pose at a share of the way to another: joints turn evenly, the root goes straight."""
        before, after = (
            np.concatenate([pose.root_rotation[None], pose.joint_rotations])
            for pose in (self, other)
        )
        turned = slerp(before, after, share)
        place = (1.0 - share) * self.root_translation + share * other.root_translation
        return BodyPose(root_rotation=turned[0], root_translation=place, joint_rotations=turned[1:])


RootAnchor = Literal["pelvis", "origin", "hips"]
PoseSpace = Literal["camera", "world"]


@dataclass(frozen=True, kw_only=True)
class RelativeFocalLength:
    """A focal length that is known only as a fraction of the image's size, looking at its middle.

    Attributes:
        ratio: Focal length as a fraction of `reference`.
        reference: The image's longer side, or its diagonal.
    """

    ratio: float
    reference: Literal["longer side", "diagonal"] = "longer side"

    def intrinsic_matrix(self, size_px: tuple[int, int]) -> Matrix3:
        """The camera matrix K for images of a size (width, height)."""
        width, height = size_px
        unit = max(size_px) if self.reference == "longer side" else float(np.hypot(width, height))
        focal = self.ratio * unit
        return np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])

    @property
    def is_plausible(self) -> bool:
        """Return whether a camera may have it; trackers that crop the person assume longer ones."""
        return 0.4 <= self.ratio <= 2.5


DIAGONAL_FOCAL = RelativeFocalLength(ratio=1.0, reference="diagonal")
"""What CLIFF, WHAM and SAM 3D Body assume where nothing is known."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Motion:
    """Poses over time, as one pose file holds them.

    Attributes:
        root_rotations, root_translations, joint_rotations: As in `BodyPose`, one row a pose.
        valid: Which rows may be used (finite, and not marked as lost by the tracker).
        betas: Shape coefficients; they are valid only for the body family named in `body_model`.
        body_model: Body family whose tracker made the poses: "smpl" or "body24".
        frames: Index of the video frame that each row belongs to, if the file says so.
        times_s: Time of each row in seconds, if the file says so.
        intrinsic: The tracker's own camera matrix K, if the file holds one.
        assumed_focal: Focal length that the tracker assumed, where the file holds no K.
        anchor: Point of the resting body that `root_translations` refer to. "pelvis": SMPL's
            convention, the root rotates about it. "origin" (EasyMocap) and "hips" (BEV; the middle
            between both): that point moves to `root_translations`; `motion_builder` converts them
            to SMPL's convention once the body is known.
        space: "world", or "camera": each row in the camera of its frame.
        camera_from_world: The camera of each row, if the file holds them.
        proportions: Coefficients of `ProportionSpace` around the mean of the embedded body, if the
            poses were fitted together with them; then they are the person's shape, not the betas.
        keypoints: Key points in the video's frames that the poses were made of, if there are any.
        program: Name of the program that made the poses, if it is known.
        note: Message for the user about how the file was read.
    """

    root_rotations: Float[np.ndarray, "poses 3"]
    root_translations: Float[np.ndarray, "poses 3"]
    joint_rotations: Float[np.ndarray, "poses 23 3"]
    valid: Bool[np.ndarray, "poses"]
    betas: Float[np.ndarray, "betas"]
    body_model: str
    frames: Int[np.ndarray, "poses"] | None = None
    times_s: Float[np.ndarray, "poses"] | None = None
    intrinsic: Matrix3 | None = None
    assumed_focal: RelativeFocalLength | None = None
    anchor: RootAnchor = "pelvis"
    space: PoseSpace = "world"
    camera_from_world: Float[np.ndarray, "poses 4 4"] | None = None
    proportions: Float[np.ndarray, "coefficients"] | None = None
    keypoints: KeypointTrack | None = None
    program: str | None = None
    note: str | None = None

    def __len__(self) -> int:
        """Number of rows, valid or not."""
        return len(self.root_rotations)

    @property
    def is_fitted(self) -> bool:
        """Whether the poses were tracked here, and fitted to the film together with proportions."""
        return self.proportions is not None and self.keypoints is not None

    def __getitem__(self, row: int) -> BodyPose:
        """The pose in one row."""
        return BodyPose(
            root_rotation=self.root_rotations[row],
            root_translation=self.root_translations[row],
            joint_rotations=self.joint_rotations[row],
        )

    def select_rows(
        self, rows: Int[np.ndarray, "some"], frames: Int[np.ndarray, "some"] | None = None
    ) -> "Motion":
        """Some of its rows in a new order, for frames of other numbers; without the key points."""
        cameras = self.camera_from_world
        return replace(
            self,
            root_rotations=self.root_rotations[rows],
            root_translations=self.root_translations[rows],
            joint_rotations=self.joint_rotations[rows],
            valid=self.valid[rows],
            frames=frames,
            times_s=None,
            camera_from_world=None if cameras is None else cameras[rows],
            keypoints=None,
        )
