"""PeopleSnapshot's own files: small ones of the same layout, prepared for ia-evaluate."""

import pickle
import shutil

import cv2
import numpy as np
import pytest

from benchmarks.people_snapshot import prepare
from capture.input_error import InputError
from capture.source_opening import open_source
from instant_avatar.cli.console import Console
from instant_avatar.evaluation.datasets import find_people_snapshot
from preprocess.capture_inputs import CaptureInputs
from preprocess.open_capture import open_capture

h5py = pytest.importorskip("h5py")

NAME, SIDE, FRAMES = "male-3-casual", 64, 4
K = np.array([[80.0, 0.0, 32.0], [0.0, 80.0, 32.0], [0.0, 0.0, 1.0]])


def write_hdf5(path, **arrays):
    with h5py.File(path, "w") as file:
        for key, array in arrays.items():
            file[key] = array


@pytest.fixture
def subject(tmp_path):
    """A subject as it is distributed; its frames are a folder instead of a video."""
    place = tmp_path / NAME
    (place / "images").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for row in range(FRAMES):
        image = cv2.GaussianBlur(rng.integers(0, 255, (SIDE, SIDE, 3)).astype(np.uint8), (0, 0), 3)
        cv2.imwrite(str(place / "images" / f"{row}.png"), image)
    masks = np.zeros((FRAMES, SIDE, SIDE), np.uint8)
    masks[:, 8:56, 20:40] = 1
    write_hdf5(place / "masks.hdf5", masks=masks)
    places = np.tile([0.0, 0.0, 3.0], (FRAMES, 1))
    poses = {"pose": np.zeros((FRAMES, 72)), "trans": places, "betas": np.zeros(10)}
    write_hdf5(place / "reconstructed_poses.hdf5", **poses)
    lens = {"camera_f": K[[0, 1], [0, 1]], "camera_c": K[:2, 2], "camera_k": [0.1, 0, 0, 0, 0]}
    still = {"camera_rt": np.zeros(3), "camera_t": np.zeros(3), "width": SIDE, "height": SIDE}
    arrays = {key: np.asarray(value, dtype=np.float64) for key, value in lens.items()}
    (place / "camera.pkl").write_bytes(pickle.dumps(arrays | still, protocol=2))
    return place


def test_frames_become_undistorted_and_of_half_the_size(subject, tmp_path):
    out = tmp_path / "prepared" / NAME
    prepare(subject, out)
    frames = list(open_source(subject).frames())
    images = sorted((out / "images").iterdir())
    assert [path.name for path in images] == [f"{row:04d}.png" for row in range(FRAMES)]
    whole = cv2.undistort(frames[1].rgb, K, np.array([0.1, 0, 0, 0, 0])).astype(float)
    half = whole.reshape(SIDE // 2, 2, SIDE // 2, 2, 3).mean(axis=(1, 3))
    assert np.abs(cv2.imread(str(images[1]))[..., ::-1] - half).max() <= 1.0
    (first, *_) = open_capture(CaptureInputs(video=out)).observations()
    assert first.camera.size_px == (SIDE // 2, SIDE // 2)
    assert first.camera.focal_px[0] == pytest.approx(40.0)
    assert first.camera.distortion == ()
    assert set(np.unique(first.alpha)) == {0.0, 1.0}
    assert find_people_snapshot(out.parent)[0].name == NAME


def test_original_files_that_do_not_fit_are_refused_and_nothing_is_left(subject, tmp_path):
    write_hdf5(subject / "masks.hdf5", masks=np.zeros((FRAMES, 5, 5)))
    with pytest.raises(InputError, match=r"masks\.hdf5"):
        prepare(subject, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_ia_evaluate_refuses_the_original_files_and_says_what_prepares_them(subject, tmp_path):
    shutil.rmtree(subject / "images")
    (found,) = find_people_snapshot(subject)
    with pytest.raises(InputError, match=r"benchmarks\.people_snapshot"):
        found.open_splits(tmp_path / "out", Console())
