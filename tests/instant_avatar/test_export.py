"""ia-export: a package at any second, from what is on the disk."""

import io
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import KDTree

from avatar.evaluation.image_metrics import psnr
from avatar.training import checkpoint
from export.build import write_draft
from export.package.package_file import read_package
from export.player import Player, compare_golden_frames, picture_on_white, premultiply
from instant_avatar import export
from preprocess.body.kinematics import body_from_rest
from preprocess.poses.pose_format_registry import read_poses

NODE = shutil.which("node")
PACKAGES = Path(__file__).parents[2] / "build" / "npm"
"""Where `make test-all` has npm put Khronos' validator, three.js and three-vrm."""
VALIDATE = """
import { readFileSync } from "node:fs";
import { validateBytes } from "gltf-validator";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { VRMLoaderPlugin } from "@pixiv/three-vrm";
globalThis.self = globalThis; // as browsers have it
const complaints = [], files = [];
console.warn = console.error = (...said) => complaints.push(said.join(" "));
for (const file of process.argv.slice(1)) {
  const bytes = new Uint8Array(readFileSync(file));
  const { issues } = await validateBytes(bytes, { ignoredIssues: ["UNSUPPORTED_EXTENSION"] });
  files.push(issues.messages.map(({ code, message, pointer }) => `${code} ${message} ${pointer}`));
}
const loader = new GLTFLoader().register((parser) => new VRMLoaderPlugin(parser));
const { buffer } = new Uint8Array(readFileSync(process.argv[1]));
const { vrm } = (await loader.parseAsync(buffer, "")).userData;
const bones = Object.keys(vrm.humanoid.humanBones).length;
console.log(JSON.stringify({ files, complaints, bones, meta: vrm.meta }));
"""


def test_a_draft_draws_nearly_what_the_finished_package_draws(run, tmp_path):
    trainer, _ = checkpoint.load(run / "checkpoint")
    frame = read_package(run / "avatar.iavatar").manifest.golden[0]
    draft = tmp_path / "avatar.iavatar"
    write_draft(trainer.avatar, draft, (frame.pose, frame.camera))
    for tier in ("hq", "lite"):
        pictures = [
            picture_on_white(
                premultiply(Player.load(path, tier=tier).render(frame.pose, frame.camera))
            )
            for path in (draft, run / "avatar.iavatar")
        ]
        assert psnr(*pictures) > 30.0
    assert Image.open(io.BytesIO(read_package(draft).preview)).size == frame.camera.size_px


@pytest.fixture
def call_export(call):
    """Runs ia-export, and asserts that it is done."""

    def call_export(*arguments):
        ended = call(export, *arguments)
        assert ended.code == 0, ended.err
        return ended.err

    return call_export


@pytest.mark.slow
def test_a_runs_checkpoint_becomes_a_package_that_plays(run, call_export, tmp_path):
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    call_export(run, "--out", tmp_path / "now.iavatar")
    frames = compare_golden_frames(read_package(tmp_path / "now.iavatar"))
    assert all(frame.matches for frame in frames)
    golden = Player.load(tmp_path / "now.iavatar").manifest.golden[0]
    shown = Player.load(tmp_path / "now.iavatar").render(golden.pose, golden.camera)
    assert 0.03 < (shown[..., 3] > 127).mean() < 0.5
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before


def test_the_whole_person_is_in_the_views(rig):
    for _, camera in export.synthetic_views(rig):
        seen = camera.project(rig.seeds.astype(float))
        assert (seen > 0).all()
        assert (seen < np.array(camera.size_px)).all()


def person_in(path):
    """The one mesh of a file, which is as tall as a person."""
    (mesh,) = trimesh.load(path).geometry.values()
    assert 1.4 < np.ptp(mesh.bounds[:, 1]) < 2.1
    return mesh


@pytest.mark.slow
def test_a_run_becomes_a_mesh_that_dances(run, novel, call_export, tmp_path):
    call_export(run, "--to", "glb", "--poses", novel, "--out", tmp_path / "a.GLB")
    assert person_in(tmp_path / "a.GLB")
    assert [file.name for file in tmp_path.iterdir()] == ["a.GLB"]


def test_a_mesh_dances_what_any_file_of_poses_says_also_without_xatlas(
    package, novel, call, call_export, tmp_path, monkeypatch
):
    """AMASS's keys, which ia-play reads, say the same as our own."""
    monkeypatch.setattr("instant_avatar.export.find_spec", lambda name: None)
    ours = read_poses(novel)
    turned = np.concatenate([ours.root_rotations[:, None], ours.joint_rotations], axis=1)
    np.savez(
        tmp_path / "amass.npz",
        poses=np.pad(turned.reshape(len(ours), 72)[:, :66], [(0, 0), (0, 90)]),
        trans=ours.root_translations,
        betas=np.zeros(16),
        gender="neutral",
        mocap_framerate=30.0,
    )
    out = tmp_path / "a.glb"
    words = package, "--to", "glb", "--triangles", 2000, "--poses", tmp_path / "amass.npz"
    assert "colors of vertices" in call_export(*words, "--out", out)
    assert person_in(out)
    assert b"COLOR_0" in out.read_bytes()
    assert len(read_poses(out)) == len(ours)
    assert "7" in call(export, *words, "--out", out, "--overwrite", "--person", "7").refusal()


def test_a_mesh_of_few_triangles_has_a_texture(package, call_export, tmp_path):
    pytest.importorskip("xatlas")
    out = tmp_path / "few.gltf"
    said = call_export(package, "--to", "glb", "--triangles", 2000, "--out", out)
    assert "2,000 triangles" in said
    mesh = person_in(out)
    assert len(mesh.faces) == 2000
    assert mesh.visual.kind == "texture"
    assert np.asarray(mesh.visual.material.baseColorTexture)[..., :3].std() > 20.0


@pytest.mark.slow
@pytest.mark.skipif(NODE is None, reason="there is no Node.js here")
@pytest.mark.skipif(
    not all((PACKAGES / "node_modules" / name).exists() for name in ("gltf-validator", "@pixiv")),
    reason="`make test-all` fetches Khronos' validator and three-vrm",
)
def test_validators_and_three_vrm_have_nothing_to_say(run, film, call_export, tmp_path):
    """Of VRM's extension Khronos' validator says that it does not know it; npm has no other."""
    poses = ("--poses", film / "truth" / "novel" / "poses.npz")
    few = ("--triangles", 2000)
    wanted = {
        "a.vrm": ("--to", "vrm", "--author", "Anna"),
        "few.vrm": ("--to", "vrm", "--author", "Anna", *few),
        "a.glb": ("--to", "glb", *poses),
        "few.glb": ("--to", "glb", *few),
        "few.gltf": ("--to", "glb", *few),
    }
    for name, words in wanted.items():
        call_export(run / "avatar.iavatar", *words, "--out", tmp_path / name)
    command = [NODE, "--input-type=module", "--eval", VALIDATE]
    command += [str(tmp_path / name) for name in wanted]
    done = subprocess.run(command, cwd=PACKAGES, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["files"] == [[]] * len(wanted)
    assert found["complaints"] == []
    assert (found["bones"], found["meta"]["authors"]) == (22, ["Anna"])


@pytest.mark.parametrize("name", ["A.PLY", pytest.param("a.OBJ", marks=pytest.mark.slow)])
def test_a_package_becomes_a_still_mesh_in_color(run, call_export, tmp_path, name):
    out = tmp_path / name
    call_export(run / "avatar.iavatar", "--to", name[2:].lower(), "--out", out)
    mesh = trimesh.load(out)
    assert len(mesh.faces) > 10_000
    assert mesh.visual.kind == "vertex"
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3].astype(float)
    assert colors.std(axis=0).max() > 20.0  # a shirt is no skin


def test_splats_stand_in_the_pose_of_a_file(package, player, novel, call_export, tmp_path):
    out = tmp_path / "a.ply"
    assert "Gaussians" in call_export(package, "--to", "splats", "--poses", novel, "--out", out)
    head, rows = out.read_bytes().split(b"end_header\n", 1)
    columns = np.frombuffer(rows, "<f4").reshape(-1, head.count(b"property float"))
    gaussians = KDTree(columns[:, :3] * [1.0, -1.0, -1.0])
    held, (pose, *_) = player.manifest, read_poses(novel)
    for rotations, stands_so in ((pose.joint_rotations, True), (held.canonical_rotations, False)):
        bones = body_from_rest(held.rest_joints, held.parents, rotations)
        joints = np.einsum("jab,jb->ja", bones[:, :3, :3], held.rest_joints) + bones[:, :3, 3]
        assert bool(gaussians.query(joints)[0].max() < 0.08) is stands_so


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (". --out a.iavatar", "checkpoint"),
        ("none --out a.iavatar", "none does not exist"),
        ("{run} --out a.zip", "iavatar"),
        ("{run} --out none/a.iavatar", "does not exist"),
        ("{package} --out a.iavatar", "--to glb"),
        ("{package} --to splats --out a.glb", ".ply or .spz"),
        ("{package} --to splats --out a.spz --triangles 1000", "--to glb, vrm, ply or obj"),
        ("{package} --to glb --out a.ply", ".glb"),
        ("{package} --to ply --out a.ply --poses poses.npz", "--poses"),
        ("{package} --to glb --out a.glb --poses nowhere.npz", "nowhere.npz"),
        ("{package} --to glb --out a.glb --triangles 10", "at least 500"),
        ("{package} --to glb --out a.glb --author Anna", "--author requires --to vrm"),
        ("{package} --out a.iavatar --triangles 1000", "--to glb, vrm, ply or obj"),
    ],
)
def test_what_cannot_be_exported_is_refused_and_writes_nothing(
    run, package, call, tmp_path, monkeypatch, line, told
):
    monkeypatch.chdir(tmp_path)
    assert told in call(export, *line.format(run=run, package=package).split()).refusal()
    assert list(tmp_path.iterdir()) == []
