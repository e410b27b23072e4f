"""Exported files in other people's renderers against our own, as filmed.

    npm install --prefix NODE three @sparkjsdev/spark
    python -m benchmarks.exports RUN CAPTURE --node NODE [--keep FOLDER]

A run's avatar is drawn in the poses and by the cameras of held-out frames, on white: as a textured
mesh by three.js and as Gaussians by Spark, both in headless Chromium, and by the player. All
are compared with the volume renderer's pictures.
"""

import base64
import io
import json
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Float, Float32
from PIL import Image
from tyro.conf import Positional

from avatar.avatar_model import Avatar
from avatar.evaluation.image_metrics import composite_on_white, psnr
from avatar.training import checkpoint
from baselines.hardware import Hardware
from benchmarks.measurements import Measurement, markdown_rows
from benchmarks.player_fidelity import ComparedView, filmed_view, held_out_observations
from benchmarks.sample_training import open_sample
from capture.camera import Camera
from export.gltf import SkeletonAnimation, encode_glb
from export.package.package_file import AvatarPackage, read_package
from export.player import Player, premultiply
from export.skinned_mesh import extract_mesh
from export.splats import build_splats, encode_ply, encode_spz
from instant_avatar.animation.web_server import make_server
from instant_avatar.cli.command_line import run_command
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import world_from_body
from tests.instant_avatar.browser import Browser, until

Picture = Float32[np.ndarray, "height width 3"]
OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL's camera looks along -z, with y up."""
NEAR_M, FAR_M = 0.1, 100.0
"""Depths at which OpenGL cuts."""
SKINNING = Path(__file__).parents[1] / "examples" / "6_moving_splats.js"
"""Moves splats by the mesh's skeleton."""
FRAME_RATE = 30.0
"""Keys of the mesh's animation a second."""
PAGE = """<!doctype html><meta charset="utf-8"><body>
<script type="importmap">{"imports": {"three": "./three/build/three.module.js",
  "three/addons/": "./three/examples/jsm/",
  "@sparkjsdev/spark": "./@sparkjsdev/spark/dist/spark.module.js"}}</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "./three/examples/jsm/loaders/GLTFLoader.js";
const renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
renderer.setClearColor(0xffffff, 1);
document.body.append(renderer.domElement);
const camera = new THREE.PerspectiveCamera();
camera.matrixAutoUpdate = false;
const draw = (scene, { view, projection, width, height }) => {
  renderer.setSize(width, height);
  camera.matrixWorldInverse.fromArray(view);
  camera.matrixWorld.copy(camera.matrixWorldInverse).invert();
  camera.matrixWorldAutoUpdate = false;
  camera.projectionMatrix.fromArray(projection);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  renderer.render(scene, camera);
  return renderer.domElement.toDataURL();
};
const load = async (file) => {
  const { scene, animations: [clip] } = await new GLTFLoader().loadAsync(file);
  scene.getObjectByName("floor").position.set(0, 0, 0);
  scene.traverse((node) => { node.frustumCulled = false; });
  const mixer = new THREE.AnimationMixer(scene);
  Object.assign(mixer.clipAction(clip), { loop: THREE.LoopOnce, clampWhenFinished: true }).play();
  return { scene, mixer };
};
window.meshes = async (file, shots) => {
  const { scene, mixer } = await load(file);
  return shots.map((shot) => { mixer.setTime(shot.time); return draw(scene, shot); });
};
window.splats = async (url, shot, skeleton) => {
  const { SparkRenderer, SplatMesh } = await import("@sparkjsdev/spark");
  const scene = new THREE.Scene(), splats = new SplatMesh({ url });
  await splats.initialized;
  scene.add(new SparkRenderer({ renderer }), splats);
  if (skeleton) {
    const { followSkeleton } = await import("./6_moving_splats.js");
    const { scene: figure, mixer } = await load(skeleton);
    mixer.setTime(shot.time);
    figure.updateMatrixWorld();
    followSkeleton(splats, figure.getObjectByProperty("isSkinnedMesh", true))();
  }
  const empty = draw(new THREE.Scene(), shot);
  let picture, before;
  for (let same = 0, frame = 0; same < 2 && frame < 30; frame++) { // sorting takes its time
    picture = draw(scene, shot);
    same = picture === before && picture !== empty ? same + 1 : 0;
    before = picture;
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
  splats.dispose();
  return [picture];
};
window.ready = true;
</script>"""


@dataclass(frozen=True, kw_only=True)
class ExportJob:
    """Draws exports in three.js and prints one table."""

    run: Positional[Path]
    """Written by ia-ingest, with its checkpoint."""
    capture: Positional[Path]
    """The capture that it was trained on, with poses."""
    node: Path
    """Folder below which npm has put three."""
    keep: Path | None = None
    """Folder for the pictures."""
    triangles: int = 20_000
    """Of the mesh."""
    stride: int = 1
    """Take every n-th held-out frame."""
    size: int | None = None
    """Longer side of the pictures (default: as filmed)."""


def main() -> int:
    """The benchmark; returns its exit code."""
    job = tyro.cli(ExportJob, prog="python -m benchmarks.exports", description=__doc__)
    return run_command("benchmarks.exports", lambda: measure(job))


def measure(job: ExportJob) -> int:
    """Measures and prints."""
    trainer, _ = checkpoint.load(job.run / "checkpoint")
    package = read_package(job.run / "avatar.iavatar")
    views = filmed_views(job, trainer.avatar)
    player = Player(package)
    drawn = {
        "player": [
            composite_on_white(premultiply(player.render(view.pose, view.camera))) for view in views
        ]
    }
    mesh = mesh_file(package, views, job.triangles)
    splats = [build_splats(package, view.pose) for view in views]
    files = {f"{number}.ply": encode_ply(each) for number, each in enumerate(splats)}
    files |= {f"{number}.spz": encode_spz(each) for number, each in enumerate(splats)}
    files |= {"index.html": PAGE.encode(), "mesh.glb": mesh, **packages(job.node)}
    files["rest.spz"] = encode_spz(build_splats(package, None))
    files[SKINNING.name] = SKINNING.read_bytes()
    with serve(files) as browser:
        drawn[f"mesh of {job.triangles:,} triangles"] = draw_meshes(browser, package, views)
        for kind, axes in (("ply", np.diag([1.0, -1.0, -1.0, 1.0])), ("spz", np.eye(4))):
            drawn[f"splats, .{kind}"] = draw_splats(browser, kind, axes, views)
        drawn["splats, .spz, moved"] = draw_moved_splats(browser, package, views)
    rows = [row for name, pictures in drawn.items() for row in marks(name, pictures, views)]
    if job.keep is not None:
        keep(job.keep, {"renderer": [view.rendered for view in views], **drawn})
    rows += [
        Measurement(name=f"{name}, MB", value=len(files[name]) / 1e6)
        for name in ("mesh.glb", "0.ply", "0.spz")
    ]
    print("\n".join([*Hardware.here().lines(), "", *markdown_rows(rows)]))
    return 0


def filmed_views(job: ExportJob, avatar: Avatar) -> list[ComparedView]:
    """Held-out frames."""
    recording = open_sample(job.capture, size=job.size)
    held = held_out_observations(recording, avatar, recording.source.frame_count)
    return [filmed_view(seen, avatar) for seen in held[:: job.stride]]


def packages(node: Path) -> dict[str, bytes]:
    """The files of npm's packages that the page imports, by address."""
    folder = node / "node_modules"
    chosen = [
        *(folder / "three" / "build").glob("three.*.js"),
        folder / "@sparkjsdev" / "spark" / "dist" / "spark.module.js",
        *(folder / "three" / "examples" / "jsm").rglob("*.js"),
    ]
    return {str(file.relative_to(folder)): file.read_bytes() for file in chosen}


@contextmanager
def serve(files: dict[str, bytes]) -> Iterator[Browser]:
    """A page in headless Chromium, opened and ready."""
    server = make_server(files, 8190)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        # Chromium may still write while its folder is removed
        kept = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        with kept as folder, Browser(Path(folder)) as browser:
            browser.go(f"http://127.0.0.1:{server.server_port}/")
            until(lambda: browser.run("window.ready"), 60.0)
            yield browser
    finally:
        server.shutdown()
        server.server_close()


def mesh_file(package: AvatarPackage, views: Sequence[ComparedView], triangles: int) -> bytes:
    """A .glb as ia-export writes it, with the views' poses as its animation."""
    poses = [view.pose for view in views]
    motion = Motion(
        root_rotations=np.stack([pose.root_rotation for pose in poses]),
        root_translations=np.stack([pose.root_translation for pose in poses]),
        joint_rotations=np.stack([pose.joint_rotations for pose in poses]),
        valid=np.ones(len(poses), dtype=bool),
        betas=np.zeros(10),
        body_model="body24",
    )
    manifest = package.manifest
    rows = tuple(range(len(poses)))
    animation = SkeletonAnimation.of(motion, rows, FRAME_RATE, manifest.rest_joints[0])
    mesh = extract_mesh(
        package.tables["hq"], triangles=triangles, picture_by=Player(package).render_canonical
    )
    return encode_glb(mesh, manifest, animation, name="avatar")


def draw_meshes(
    browser: Browser, package: AvatarPackage, views: Sequence[ComparedView]
) -> list[Picture]:
    """The mesh in three.js, in the pose and by the camera of each view."""
    return run(browser, f"meshes('mesh.glb', {json.dumps(animated_shots(package, views))})")


def draw_moved_splats(
    browser: Browser, package: AvatarPackage, views: Sequence[ComparedView]
) -> list[Picture]:
    """Splats of the canonical pose in Spark, moved by the mesh's skeleton."""
    pictures = []
    for each in animated_shots(package, views):
        pictures += run(browser, f"splats('rest.spz', {json.dumps(each)}, 'mesh.glb')")
    return pictures


def animated_shots(package: AvatarPackage, views: Sequence[ComparedView]) -> list[dict[str, Any]]:
    """Cameras in the world of the mesh's animation, and its times."""
    rest, first = package.manifest.rest_joints[0], views[0].pose
    # the animation starts upright at the rest joints; the page removes the floor's height
    from_animation = world_from_body(rest, first.root_rotation, first.root_translation)
    return [
        shot(view.camera, from_animation) | {"time": number / FRAME_RATE}
        for number, view in enumerate(views)
    ]


def draw_splats(
    browser: Browser,
    kind: str,
    world_from_file: Float[np.ndarray, "4 4"],
    views: list[ComparedView],
) -> list[Picture]:
    """Splats in Spark, each view's own file."""
    pictures = []
    for number, view in enumerate(views):  # half a minute each without a graphics card
        given = json.dumps(f"{number}.{kind}"), json.dumps(shot(view.camera, world_from_file))
        pictures += run(browser, f"splats({', '.join(given)})")
    return pictures


def run(browser: Browser, script: str) -> list[Picture]:
    """Pictures that a script of the page draws."""
    return [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB"))
        .astype(np.float32) / 255.0
        for url in browser.run(script, seconds=300.0)
    ]  # fmt: skip


def shot(camera: Camera, world_from_scene: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    """A camera as OpenGL has it, column after column."""
    (fx, fy), (cx, cy), (width, height) = camera.focal_px, camera.center_px, camera.size_px
    depth = np.array([FAR_M + NEAR_M, 2.0 * FAR_M * NEAR_M]) / (NEAR_M - FAR_M)
    projection = np.array(
        [
            [2.0 * fx / width, 0.0, 1.0 - 2.0 * cx / width, 0.0],
            [0.0, 2.0 * fy / height, 2.0 * cy / height - 1.0, 0.0],
            [0.0, 0.0, *depth],
            [0.0, 0.0, -1.0, 0.0],
        ]
    )
    view = OPENGL_AXES @ camera.camera_from_world @ world_from_scene
    return {
        "view": view.T.ravel().tolist(),
        "projection": projection.T.ravel().tolist(),
        "width": width,
        "height": height,
    }


def marks(name: str, drawn: list[Picture], views: list[ComparedView]) -> Iterator[Measurement]:
    """How near pictures are to the volume renderer's."""
    near = [psnr(picture, view.rendered) for picture, view in zip(drawn, views, strict=True)]
    yield Measurement(
        name=f"{name}: PSNR to the volume renderer, dB",
        value=float(np.mean(near)),
        context=f"{len(near)} pictures, {min(near):.1f} to {max(near):.1f}",
    )


def keep(folder: Path, drawn: dict[str, list[Picture]]) -> None:
    """Write each kind's picture of a view side by side."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, row in enumerate(zip(*drawn.values(), strict=True)):
        picture = np.clip(np.concatenate(row, axis=1) * 255.0, 0.0, 255.0).round()
        Image.fromarray(picture.astype(np.uint8)).save(folder / f"{number:03d}.png")


if __name__ == "__main__":
    sys.exit(main())
