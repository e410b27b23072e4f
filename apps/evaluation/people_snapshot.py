"""The paper's protocol on PeopleSnapshot: which frames are learnt, which are scored, what came out.

InstantAvatar (Jiang et al. 2023), Tab. 1, which follows Anim-NeRF (Chen et al. 2021): frames of one
turn are learnt from for a minute, frames of another are scored, whole and on white, in poses that
are fitted to them with the avatar frozen. The data has to be asked for from its makers.
"""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class DatasetSubject:
    """A subject of the dataset.

    Attributes:
        name: Of its folder.
        train, test: Frames, START:STOP:STEP counted from 0.
        paper: InstantAvatar's own figures after a minute, at 540 px.
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
        paper={"psnr": 27.90, "ssim": 0.9722},
    ),
    DatasetSubject(
        name="female-4-casual",
        train="0:336:4",
        test="335:524:4",
        paper={"psnr": 28.92, "ssim": 0.9692},
    ),
    DatasetSubject(
        name="male-3-casual",
        train="0:456:4",
        test="456:676:4",
        paper={"psnr": 29.65, "ssim": 0.9730},
    ),
    DatasetSubject(
        name="male-4-casual",
        train="0:660:6",
        test="660:873:6",
        paper={"psnr": 27.97, "ssim": 0.9649},
    ),
)
LONGER_SIDE_PX = 540
TRAIN_POSES, TEST_POSES = Path("poses/anim_nerf_train.npz"), Path("poses/anim_nerf_test.npz")
"""Anim-NeRF's poses, a row for each frame of the list; where they are not, poses.npz serves."""


def find_subjects(folder: Path) -> list[tuple[DatasetSubject, Path]]:
    """The subjects that lie in a folder, or the one that it is."""
    found = []
    for subject in SUBJECTS:
        for place in (folder / subject.name, folder):
            if place.resolve().name == subject.name and place.is_dir():
                found.append((subject, place))
                break
    return found


def subject_poses(folder: Path, relative_path: Path) -> Path | None:
    """Poses of one list of frames, if they lie there; None leaves it to the capture folder."""
    return folder / relative_path if (folder / relative_path).is_file() else None
