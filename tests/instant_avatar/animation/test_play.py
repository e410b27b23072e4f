"""The player's command: what it writes, what it refuses, and that it needs no torch."""

import json
import os
import shutil
from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper
from PIL import Image

from capture.atomic_files import LIST_NAME as LIST
from export import player_page
from export.package.package_file import read_package, write_package
from export.player import Player
from instant_avatar.animation import player_checks
from instant_avatar.animation.driving_motion import FollowingCamera
from instant_avatar.animation.player_checks import REFERENCE_GRAPH
from instant_avatar.animation.web_server import sample_motions
from preprocess.body.kinematics import rotation_matrices
from preprocess.poses.pose_format_registry import read_poses

SIZE = 64


def test_a_folder_gets_frames_with_alpha_and_nothing_else(
    call_play, package, novel, tmp_path, changed
):
    """Lost poses are left out."""
    poses, out = tmp_path / "poses.npz", tmp_path / "frames"
    poses.write_bytes(novel.read_bytes())
    changed(poses, valid=~np.isin(np.arange(12), (2, 5)))
    outcome = call_play(package, "--poses", poses, "--out", out, "--size", SIZE)
    assert outcome.code == 0
    assert outcome.out.strip() == str(out)
    assert "2 of 12" in outcome.err
    assert sorted(f.name for f in out.iterdir() if f.name != LIST) == [
        f"{i:04d}.png" for i in range(10)
    ]
    player, motion = Player.load(package), read_poses(poses)
    camera = FollowingCamera.of(player, motion, SIZE)
    for number, row in ((0, 0), (9, 11)):
        with Image.open(out / f"{number:04d}.png") as picture:
            assert picture.mode == "RGBA"
            expected = player.render(motion[row], camera.camera_for(motion[row]))
            np.testing.assert_array_equal(np.asarray(picture), expected)


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["--poses", "{novel}"], "poses.mp4"),
        (["--poses", "{novel}", "--still", "3"], "poses-3.png"),
        pytest.param([], "avatar.mp4", marks=pytest.mark.slow),
    ],
)
def test_what_gets_no_name_lies_beside_the_package(call_play, package, novel, words, name):
    given = [word.format(novel=novel) for word in words]
    outcome = call_play(package, *given, "--size", 32, "--tier", "lite")
    assert outcome.out.strip() == str(package.parent / name)
    (package.parent / name).unlink()


@pytest.fixture(scope="module")
def foggy(package, tmp_path_factory):
    """A package with a warning, and a golden frame that is darker than what is drawn."""
    sound = read_package(package, tier=None)
    dark = tuple(np.where(frame > 128, frame - 100, frame) for frame in sound.golden[1:])
    manifest = replace(sound.manifest, metrics={"warnings": ["It is fog."]})
    path = tmp_path_factory.mktemp("foggy") / "avatar.iavatar"
    write_package(replace(sound, golden=(sound.golden[0], *dark), manifest=manifest), path)
    return path


def test_the_benchmark_has_the_keys_that_were_agreed(
    call_play, foggy, novel, tmp_path, monkeypatch
):
    monkeypatch.setattr(player_checks, "MIN_IMAGES", 4)
    figures = tmp_path / "bench.json"
    words = ["--poses", novel, "--bench", "--size", SIZE, "--json", figures]
    outcome = call_play(foggy, *words)
    assert outcome.code == 0
    assert "It is fog." in outcome.err
    found = json.loads(figures.read_text())
    assert " ".join(found) == (
        "format tier size frames pixels_covered cpu_ms_per_frame wall_ms_per_frame load_ms "
        "reference_ms provider workers pictures_per_second"
    )
    assert found["size"] == SIZE
    assert 0.03 < found["pixels_covered"] < 0.6
    assert min(found[key] for key in ("cpu_ms_per_frame", "load_ms", "reference_ms")) > 0.0


def test_golden_frames_look_the_same_here(call_play, package, tmp_path):
    outcome = call_play(package, "--verify", "--json", tmp_path / "verdict.json")
    assert outcome.code == 0
    assert "golden frame 0: same" in outcome.err
    assert "verdict: same" in outcome.err
    assert f"CPUExecutionProvider, onnxruntime {onnxruntime.__version__}" in outcome.err
    found = json.loads((tmp_path / "verdict.json").read_text())
    assert found["verdict"] == "same"
    assert found["provider"] == "CPUExecutionProvider"
    assert min(frame["close"] for frame in found["frames"]) >= 0.999
    assert min(frame["psnr"] for frame in found["frames"]) >= 48.0


def test_different_golden_frames_set_the_exit_code(call_play, foggy):
    outcome = call_play(foggy, "--verify")
    assert outcome.code == 2
    assert "golden frame 0: same" in outcome.err
    assert "golden frame 1: DIFFERENT" in outcome.err
    assert "verdict: DIFFERENT" in outcome.err
    assert "It is fog." in outcome.err


def test_a_provider_that_is_not_there_is_named(call_play, package):
    for arguments in (["--verify"], ["--bench"], ["--out", "never.webm"]):
        refusal = call_play(package, *arguments, "--provider", "abacus").refusal()
        assert "no provider 'abacus' here; it has: " in refusal


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--out", "clip.avi"], ".avi"),
        (["--background", "no-such-color"], "--background"),
        (["--size", "4"], "--size"),
        (["--speed", "0"], "--speed"),
        (["--still", "12"], "0 to 11"),
        (["--close-up", "nose"], "left_hand"),
        (["--turntable", "0"], "--turntable"),
        (["--orbit", "inf"], "--orbit"),
        (["--elevation", "nan"], "--elevation"),
        (["--bench", "--out", "a.webm"], "leave out --out"),
        (["--bench", "--verify"], "leave out --"),
        (["--camera", "none.npz", "--orbit", "-20"], "leave out --orbit"),
        (["--out", "clip.mp4", "--background", "transparent"], "no transparency"),
        (["--camera", "none.npz"], "none.npz"),
        (["--json", "figures.json"], "--bench"),
        (["--web", "0"], "but must be a port"),
        (["--web", "--bench"], "--bench"),
        (["--web", "--tier", "lite"], "--tier"),
        (["--web", "--size", "200"], "--size"),
        (["--web", "--camera", "cameras.npz"], "--camera"),
    ],
)
def test_wrong_wishes(call_play, package, novel, tmp_path, monkeypatch, arguments, word):
    monkeypatch.chdir(tmp_path)
    assert word in call_play(package, "--poses", novel, *arguments).refusal()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "other"),
    [
        (["--out", "a.webm"], lambda turned, places: {"body_pose": np.rad2deg(turned)}),
        (["--bench"], lambda turned, places: {"transl": 1000.0 * places}),
        (["--web", "--out", "page"], lambda turned, places: {"transl": 1000.0 * places}),
    ],
)
def test_poses_in_other_units_are_refused(
    call_play, package, novel, tmp_path, monkeypatch, changed, words, other
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(player_page, "runtime_files", dict)
    with np.load(novel) as given:
        turned, places = given["body_pose"], given["transl"] + np.array([0.0, 0.0, 3.0])
    shutil.copy(novel, "poses.npz")
    changed(tmp_path / "poses.npz", **other(turned, places))
    assert "poses.npz" in call_play(package, "--poses", "poses.npz", *words).refusal()
    assert [file.name for file in tmp_path.iterdir()] == ["poses.npz"]


def test_what_is_no_package_is_named(call_play, package, tmp_path):
    said = call_play(package.parent, "--verify").complaint()
    assert f"the package in it is {package}" in said
    (video := tmp_path / "video.mp4").write_bytes(b"\0" * 100)
    assert "video.mp4 is not a package" in call_play(video).complaint()
    assert "is a folder" in call_play(tmp_path, "--verify").complaint()
    os.mkfifo(tmp_path / "pipe.iavatar")  # it would be waited on for ever
    assert "is no file" in call_play(tmp_path / "pipe.iavatar", "--verify").complaint()


@pytest.mark.parametrize(
    "name", [pytest.param("clip.webm", marks=pytest.mark.slow), "clip.mp4", "clip.webp", "frames"]
)  # a GIF is written as a WebP is
def test_a_full_disk_leaves_nothing(call_play, package, novel, tmp_path, monkeypatch, name):
    resource = pytest.importorskip("resource")  # Windows has none
    monkeypatch.chdir(tmp_path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        outcome = call_play(package, "--poses", novel, "--size", SIZE, "--out", name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert outcome.code == 3
    assert "the disk is full" in outcome.complaint()
    assert list(tmp_path.iterdir()) == []


def reference_model() -> onnx.ModelProto:
    """GatherElements, MatMul and ScatterElements of fixed sizes."""
    nodes = [
        helper.make_node("GatherElements", ["table", "places"], ["taken"], axis=0),
        helper.make_node("MatMul", ["taken", "matrix"], ["product"]),
        helper.make_node(
            "ScatterElements", ["table", "places", "product"], ["out"], axis=0, reduction="min"
        ),
    ]
    shapes = {"table": [1 << 15, 16], "matrix": [16, 16]}
    inputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in shapes.items()]
    inputs.append(helper.make_tensor_value_info("places", TensorProto.INT64, [1 << 15, 16]))
    outputs = [helper.make_tensor_value_info("out", TensorProto.FLOAT, [1 << 15, 16])]
    graph = helper.make_graph(nodes, "reference", inputs, outputs)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)


def test_the_stored_graph_is_the_one_described_here():
    assert onnx.load(REFERENCE_GRAPH) == reference_model()


if __name__ == "__main__":
    REFERENCE_GRAPH.write_bytes(reference_model().SerializeToString())


@pytest.mark.parametrize("name", list(sample_motions()))
def test_a_sample_motion_begins_again_without_a_jump(name):
    motion = sample_motions()[name]
    rotations = np.concatenate([motion.root_rotations[:, None], motion.joint_rotations], axis=1)
    turned = rotation_matrices(rotations.reshape(-1, 3)).reshape(len(motion), 24, 3, 3)
    steps = np.abs(np.diff(turned, axis=0, append=turned[:1])).max(axis=(1, 2, 3))
    assert steps.max() > 0.02  # it moves
    assert steps[-1] <= 1.1 * steps[:-1].max()
