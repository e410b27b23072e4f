"""PeopleSnapshot protocol of InstantAvatar: training and test frames, and the paper's scores.

InstantAvatar (Jiang et al. 2023), Tab. 1, follows Anim-NeRF (Chen et al. 2021): train on frames of
one turn for a minute, score whole frames of another turn on white, in poses fitted to them with the
avatar frozen. The data set is available from its authors on request.
"""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class DatasetSubject:
    """A subject of the data set.

    Attributes:
        name: Name of its folder.
        train: Training frames, START:STOP:STEP counted from 0.
        test: Test frames, START:STOP:STEP counted from 0.
        paper: InstantAvatar's scores after a minute, at 540 px.
    """

    name: str
    train: str
    test: str
    paper: dict[str, float]


SUBJECTS = (
    DatasetSubject(
        name="female-3-casual",
        train="0:446:4",
        test="446:648:4",
        paper={"psnr": 27.90, "ssim": 0.9722, "lpips_alex01": 0.0249},
    ),
    DatasetSubject(
        name="female-4-casual",
        train="0:336:4",
        test="335:524:4",
        paper={"psnr": 28.92, "ssim": 0.9692, "lpips_alex01": 0.0180},
    ),
    DatasetSubject(
        name="male-3-casual",
        train="0:456:4",
        test="456:676:4",
        paper={"psnr": 29.65, "ssim": 0.9730, "lpips_alex01": 0.0192},
    ),
    DatasetSubject(
        name="male-4-casual",
        train="0:660:6",
        test="660:873:6",
        paper={"psnr": 27.97, "ssim": 0.9649, "lpips_alex01": 0.0346},
    ),
)
"""Subjects of the paper's table."""
LONGER_SIDE_PX = 540
"""Longer side of the paper's images."""
TRAIN_POSES, TEST_POSES = Path("poses/anim_nerf_train.npz"), Path("poses/anim_nerf_test.npz")
"""Anim-NeRF's poses, one row per listed frame; poses.npz replaces missing ones."""


def find_subjects(folder: Path) -> list[tuple[DatasetSubject, Path]]:
    """Find the subjects in a folder, which may be a subject itself."""
    found = []
    for subject in SUBJECTS:
        for place in (folder / subject.name, folder):
            if place.resolve().name == subject.name and place.is_dir():
                found.append((subject, place))
                break
    return found


def subject_poses(folder: Path, relative_path: Path) -> Path | None:
    """Return the poses of a list of frames; None to use those of the capture folder."""
    return folder / relative_path if (folder / relative_path).is_file() else None
