"""Data sets as they are distributed: small files of the same layout, made from the actor's film."""

import json
import pickle
import shutil

import cv2
import numpy as np
import pytest

from capture.input_error import InputError
from capture.source_opening import open_source
from instant_avatar import evaluate
from instant_avatar.cli.console import Console
from instant_avatar.evaluation import datasets
from instant_avatar.evaluation.datasets import find_neuman, find_people_snapshot, split_by_rule
from preprocess.capture_inputs import CaptureInputs
from preprocess.open_capture import open_capture

h5py = pytest.importorskip("h5py")

NAME = "male-3-casual"
LENS = (0.1, 0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def filmed(film):
    """The film: observations of all frames, and its poses' arrays."""
    return list(open_capture(CaptureInputs(video=film)).observations()), np.load(film / "poses.npz")


@pytest.fixture(scope="module")
def seen_poses(film, filmed):
    """The poses in the camera's frame: angles (N, 72) and places (N, 3)."""
    seen, poses = filmed
    pelvis = open_capture(CaptureInputs(video=film)).shaped.joints[0]
    turn, way = (seen[0].camera.camera_from_world[:3, part] for part in (slice(3), 3))
    roots = [
        cv2.Rodrigues(turn @ cv2.Rodrigues(root)[0])[0].ravel()
        for root in poses["global_orient"].astype(float)
    ]
    places = (poses["transl"] + pelvis) @ turn.T + way - pelvis
    return np.concatenate([np.stack(roots), poses["body_pose"]], axis=1), places


def write_hdf5(path, **arrays):
    with h5py.File(path, "w") as file:
        for key, array in arrays.items():
            file[key] = array


@pytest.fixture
def snapshot(film, filmed, seen_poses, tmp_path, monkeypatch):
    """A subject of PeopleSnapshot as it is distributed, with shorter lists of frames."""
    monkeypatch.setitem(datasets.SPLITS, NAME, ("0:12:3", "12:24:4"))
    seen, _ = filmed
    place = tmp_path / "PeopleSnapshot" / NAME
    place.mkdir(parents=True)
    shutil.copyfile(open_source(film).path, place / f"{NAME}.mp4")
    masks = np.stack([observation.alpha > 0.5 for observation in seen]).astype(np.uint8)
    write_hdf5(place / "masks.hdf5", masks=masks)
    thetas, places = seen_poses
    arrays = {"pose": thetas, "trans": places, "betas": np.zeros(10)}
    write_hdf5(place / "reconstructed_poses.hdf5", **arrays)
    camera = seen[0].camera
    lens = {
        "camera_f": camera.focal_px,
        "camera_c": camera.center_px,
        "camera_k": [0.1, 0, 0, 0, 0],
    }
    still = {"camera_rt": np.zeros(3), "camera_t": np.zeros(3), "width": 64, "height": 64}
    arrays = {key: np.asarray(value, dtype=np.float64) for key, value in lens.items()}
    (place / "camera.pkl").write_bytes(pickle.dumps(arrays | still, protocol=2))
    return place


def open_splits(subject, tmp_path):
    return subject.open_splits(tmp_path / "out", Console())


def test_the_original_files_become_undistorted_frames_of_half_the_size(
    snapshot, filmed, seen_poses, tmp_path
):
    (subject,) = find_people_snapshot(snapshot.parent)
    splits = open_splits(subject, tmp_path)
    seen, _ = filmed
    camera = seen[0].camera
    for split, rows in zip(splits, (range(0, 12, 3), range(12, 24, 4)), strict=True):
        images = sorted((split.folder / "images").iterdir())
        assert [path.name for path in images] == [f"{row:04d}.png" for row in rows]
        lens = camera.intrinsic, np.array(LENS)
        whole = cv2.undistort(seen[rows[1]].frame.rgb, *lens).astype(float)
        half = whole.reshape(32, 2, 32, 2, 3).mean(axis=(1, 3))
        assert np.abs(cv2.imread(str(images[1]))[..., ::-1] - half).max() <= 1.0
        masks = cv2.imread(str(split.folder / "masks" / images[1].name), cv2.IMREAD_UNCHANGED)
        assert set(np.unique(masks)) == {0, 255}
        written = np.load(split.folder / "poses.npz")
        assert np.allclose(written["transl"], seen_poses[1][rows])
        (first, *_) = open_capture(CaptureInputs(video=split.folder)).observations()
        assert first.camera.size_px == (32, 32)
        assert first.camera.focal_px[0] == pytest.approx(camera.focal_px[0] / 2.0)
        assert first.camera.distortion == ()
    stamp = images[0].stat().st_mtime_ns
    assert open_splits(subject, tmp_path)[1].folder == splits[1].folder
    assert images[0].stat().st_mtime_ns == stamp  # written once


def few_masks(place):
    write_hdf5(place / "masks.hdf5", masks=np.zeros((5, 64, 64)))


def no_camera(place):
    (place / "camera.pkl").write_bytes(pickle.dumps({}))


@pytest.mark.parametrize(("spoil", "named"), [(few_masks, "masks.hdf5"), (no_camera, "camera.pkl")])
def test_original_files_that_do_not_fit_are_refused_and_nothing_is_left(
    snapshot, tmp_path, spoil, named
):
    spoil(snapshot)
    (subject,) = find_people_snapshot(snapshot)
    with pytest.raises(InputError, match=named):
        open_splits(subject, tmp_path)
    assert list((tmp_path / "out").rglob("*.png")) == []


UNIT = 2.5
"""Units of the COLMAP world per meter."""


@pytest.fixture
def neuman(filmed, tmp_path):
    """A subject of NeuMan: a world of another unit; one frame's person is nearer and smaller."""
    seen, poses = filmed
    place = tmp_path / "neuman" / "seattle"
    for part in ("images", "segmentations", "sparse", "4d_humans"):
        (place / part).mkdir(parents=True)
    camera, lines = seen[0].camera, []
    (fx, fy), (cx, cy) = camera.focal_px, camera.center_px
    (place / "sparse" / "cameras.txt").write_text(f"1 PINHOLE 64 64 {fx} {fy} {cx} {cy}\n")
    for row, observation in enumerate(seen):
        name = f"{row:05d}.png"
        colors = observation.frame.rgb[..., ::-1]
        cv2.imwrite(str(place / "images" / name), colors)
        person = np.where(observation.alpha > 0.5, 0, 255).astype(np.uint8)
        cv2.imwrite(str(place / "segmentations" / name), person)
        x, y, z = UNIT * camera.camera_from_world[:3, 3]
        w, *axis = quaternion(camera.camera_from_world[:3, :3])
        lines.append(f"{row + 1} {w} {axis[0]} {axis[1]} {axis[2]} {x} {y} {z} 1 {name}\n\n")
    (place / "sparse" / "images.txt").write_text("".join(reversed(lines)))
    (place / "sparse" / "points3D.txt").write_text("")
    nearer = np.ones(len(seen))
    nearer[4] = 0.8
    center = UNIT * camera.center_world
    places = center + nearer[:, None] * (UNIT * poses["transl"] - center)
    np.savez(
        place / "4d_humans/smpl_optimized_aligned_scale.npz",
        global_orient=poses["global_orient"], body_pose=poses["body_pose"], transl=places,
        betas=np.zeros((len(seen), 10)), scale=UNIT * nearer,
    )  # fmt: skip
    return place


def quaternion(rotation):
    turned = np.asarray(cv2.Rodrigues(rotation)[0]).ravel()
    angle = np.linalg.norm(turned)
    axis = turned / angle if angle > 1e-9 else np.zeros(3)
    return np.array([np.cos(angle / 2.0), *(np.sin(angle / 2.0) * axis)])


def test_neumans_frames_have_cameras_and_poses_in_meters(neuman, filmed, tmp_path):
    (neuman / "train_split.txt").write_text("00000.png\n00004.png\n00009.png\n")
    (neuman / "test_split.txt").write_text("00002.png\n00012.png\n")
    (subject,) = find_neuman(neuman.parent)
    assert (subject.name, subject.paper) == ("seattle", {})
    seen, poses = filmed
    for split, rows in zip(open_splits(subject, tmp_path), ([0, 4, 9], [2, 12]), strict=True):
        written = np.load(split.folder / "poses.npz")
        assert np.allclose(written["transl"], poses["transl"][rows], atol=1e-6)
        found = list(open_capture(CaptureInputs(video=split.folder)).observations())
        for observation, row in zip(found, rows, strict=True):
            assert (observation.frame.rgb == seen[row].frame.rgb).all()
            assert ((observation.alpha > 0.5) == (seen[row].alpha > 0.5)).all()
            expected = seen[row].camera.camera_from_world
            assert np.allclose(observation.camera.camera_from_world, expected, atol=1e-6)


def test_masks_of_the_poses_are_preferred_and_matched_in_order(neuman, filmed, tmp_path):
    (neuman / "4d_humans/sam_segmentations").mkdir()
    seen, _ = filmed
    for row in range(len(seen)):
        person = np.zeros((64, 64), np.uint8)
        person[:, 20 : 22 + row] = 255
        cv2.imwrite(str(neuman / f"4d_humans/sam_segmentations/mask_{row:04d}.png"), person)
    (subject,) = find_neuman(neuman)
    _, test = open_splits(subject, tmp_path)
    _, rows = split_by_rule(len(seen))
    for row in rows:
        mask = cv2.imread(str(test.folder / "masks" / f"{row:05d}.png"), cv2.IMREAD_UNCHANGED)
        assert (mask > 0).sum() == 64 * (2 + row)


@pytest.mark.slow
@pytest.mark.parametrize("dataset", ["snapshot", "neuman"])
def test_the_protocol_runs_on_the_original_files(
    dataset, request, call_ingest, without_baking, tmp_path, capsys
):
    place, scores = request.getfixturevalue(dataset), tmp_path / "scores.json"
    words = [place, "--out", tmp_path / "out", "--steps", 10, "--no-player", "--json", scores]
    code = evaluate.main([str(word) for word in words])
    said = capsys.readouterr()
    assert code == 0, said.err
    (avatar,) = json.loads(scores.read_text())["avatars"]
    ways = [(row["poses"], row["background"]) for row in avatar["rows"]]
    assert ways == [(p, on) for p in ("given", "fitted") for on in ("white", "black")]
    expected = 3 if dataset == "snapshot" else len(split_by_rule(24)[1])
    assert [len(row["frames"]) for row in avatar["rows"]] == [expected] * 4
    assert ("InstantAvatar (paper)" in said.out) == (dataset == "snapshot")
