"""NeuMan as it is distributed: small files of the same layout, made from the actor's film."""

import json

import cv2
import numpy as np
import pytest

from instant_avatar import evaluate
from instant_avatar.cli.console import Console
from instant_avatar.evaluation.datasets import find_neuman, split_by_rule
from preprocess.capture_inputs import CaptureInputs
from preprocess.open_capture import open_capture


@pytest.fixture(scope="module")
def filmed(film):
    """The film: observations of all frames, and its poses' arrays."""
    return list(open_capture(CaptureInputs(video=film)).observations()), np.load(film / "poses.npz")


def open_splits(subject, tmp_path):
    return subject.open_splits(tmp_path / "out", Console())


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
def test_the_protocol_runs_on_the_original_files(
    neuman, call_ingest, without_baking, tmp_path, capsys
):
    scores = tmp_path / "scores.json"
    words = [neuman, "--out", tmp_path / "out", "--steps", 10, "--no-player", "--json", scores]
    code = evaluate.main([str(word) for word in words])
    said = capsys.readouterr()
    assert code == 0, said.err
    (avatar,) = json.loads(scores.read_text())["avatars"]
    ways = [(row["poses"], row["background"]) for row in avatar["rows"]]
    assert ways == [(p, on) for p in ("given", "fitted") for on in ("white", "black")]
    expected = len(split_by_rule(24)[1])
    assert [len(row["frames"]) for row in avatar["rows"]] == [expected] * 4
    assert "InstantAvatar (paper)" not in said.out
