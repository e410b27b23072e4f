// The avatar, its motion and the engine that draws it, without the page around them.

import { Engine } from "./engine.js";
import { Skeleton, bones, moved, rigid } from "./kinematics.js";
import { Orbit, coarser, nearestOf, windowOf } from "./orbit.js";
import { fetched, readMotion, unzip } from "./package.js";

const CLOSE = 2; // largest difference of a premultiplied channel between close pixels, in 1/255
const ALIKE = 0.999; // least fraction of close pixels in pictures that count as the same
const COARSE = "coarse"; // the graph of one depth layer in one block (export/package/package_file.py)
const POSE = 75; // numbers in a pose: root rotation, root translation, 23 axis-angles

export class Player {
  /**
   * Read an .iavatar file and a motion (.npz; the canonical pose without one).
   * onProgress: as of Engine. onPreview: called with a small picture (Blob) before all else is there.
   */
  static async load(src, motion, onProgress, onPreview = () => {}) {
    const engine = new Engine(onProgress);
    return Player.read(src, motion, engine, onPreview).catch((error) => {
      engine.close();
      throw error;
    });
  }

  static async read(src, motion, engine, onPreview) {
    const read = async (url, parse) => {
      const buffer = await fetched(url, engine.onProgress);
      return Promise.resolve(buffer).then(parse).catch((error) => {
        throw new Error(`${String(url).split("/").pop()} cannot be read: ${error.message}`);
      });
    };
    const reading = motion ? read(motion, readMotion) : undefined;
    reading?.catch(() => {}); // awaited below
    const { buffer, entries } = await read(src, (held) => ({ buffer: held, entries: unzip(held) }));
    if (!entries["manifest.json"]) throw new Error(`${src} is no .iavatar file.`);
    const avatar = JSON.parse(new TextDecoder().decode(await entries["manifest.json"]()));
    const graphs = {};
    const taken = engine.take({ buffer, graphs, tiers: avatar.tiers });
    onPreview(new Blob([await entries["preview.png"]()], { type: "image/png" }));
    await Promise.all([COARSE, ...Object.keys(avatar.tiers)].map(async (tier) => {
      graphs[tier] = await entries[tier === "hq" ? "player.onnx" : `${tier}/player.onnx`]?.();
    }));
    const standing = new Float32Array(POSE);
    standing.set(avatar.canonical_rotations.flat(), 6);
    const moves = (await reading) || { poses: standing, fps: 30 };
    const { low, high } = await taken;
    avatar.look = { pelvis: avatar.rest_joints[0], height_m: high - low, middle_m: (high + low) / 2 };
    return new Player(avatar, entries, engine, moves);
  }

  constructor(avatar, entries, engine, moves) {
    Object.assign(this, { avatar, entries, engine });
    this.drive(moves);
    this.skeleton = new Skeleton(avatar);
  }

  /** Take a motion (`readMotion`), of which the first pose is upright and seen from the front. */
  drive({ poses, fps }) {
    Object.assign(this, { poses, fps, count: poses.length / POSE });
    const front = rigid(poses.slice(0, 3));
    this.avatar.look.axes = [1, -1, -1].map((sign, axis) => [0, 4, 8].map((row) => sign * front[row + axis]));
  }

  pose(row) {
    return this.poses.subarray(POSE * row, POSE * (row + 1));
  }

  /** Prepare a tier; soon: the first picture of "lite" is drawn by a coarser graph, if the package has one. */
  open({ tier }, soon = false) {
    return this.engine.open(tier, soon && tier === "lite" && COARSE);
  }

  /** The camera, coarser where surfels would leave gaps in a close-up (export/player_inputs.py). */
  drawable({ tier }, pose, camera) {
    const { settings, layout } = this.avatar.tiers[tier];
    const seen = this.skeleton.posed(pose).joints.map((joint) => moved(camera.cameraFromWorld, joint));
    const footprint = Math.max(...camera.focal) * layout.surfel_spacing_m * settings.footprint_spacings;
    const nearest = Math.max(settings.near_plane_m, nearestOf(camera, seen));
    const times = footprint / nearest / (settings.max_footprint_px - 1);
    return times > 1 ? coarser(camera, times) : camera;
  }

  /** Draw the part of a picture that shows the avatar: {x, y, width, height, rgba, ms}, or null. */
  async draw({ tier }, pose, camera) {
    const { worldFromCanonical, joints } = this.skeleton.posed(pose);
    const seen = joints.map((joint) => moved(camera.cameraFromWorld, joint));
    const part = windowOf(camera, seen);
    if (!part) return null;
    const center = [camera.center[0] - part.x, camera.center[1] - part.y];
    const drawn = await this.engine.draw(tier, {
      bones: bones(worldFromCanonical, camera.cameraFromWorld),
      camera: [...camera.focal, ...center],
      width: part.width,
      height: part.height,
    });
    return { ...part, ...drawn };
  }

  /** Draw the package's golden frames again; return the difference of each from the stored one. */
  async verify() {
    await this.open({ tier: "hq" });
    const differences = [];
    for (const [number, golden] of this.avatar.golden.entries()) {
      const stored = await this.entries[`golden/${number}.rgba`]();
      const pose = [...golden.root_rotation, ...golden.root_translation, ...golden.joint_rotations.flat()];
      const { rgba } = await this.engine.draw("hq", {
        bones: bones(this.skeleton.posed(pose).worldFromCanonical, golden.camera_from_world.flat()),
        camera: [...golden.focal_px, ...golden.center_px],
        width: golden.size_px[0],
        height: golden.size_px[1],
      });
      differences.push(pictureDifference(rgba, stored));
    }
    return differences;
  }

  /** Measure milliseconds of the motion's frames as square pictures from the front. */
  async measure({ tier = "hq", size = 540, frames = 24 } = {}) {
    await this.open({ tier });
    const orbit = new Orbit(this.avatar.look);
    const times = [];
    for (let frame = 0; frame < frames; frame++) {
      const pose = this.pose(frame % this.count);
      const camera = orbit.camera(pose, size, size);
      const { ms } = await this.engine.draw(tier, {
        bones: bones(this.skeleton.posed(pose).worldFromCanonical, camera.cameraFromWorld),
        camera: [...camera.focal, ...camera.center],
        width: size,
        height: size,
      });
      times.push(ms);
    }
    return times;
  }
}

/** Compare two straight-alpha pictures, premultiplied, as `ia-play --verify` does. */
export function pictureDifference(a, b) {
  let largest = 0, close = 0;
  for (let i = 0; i < a.length; i += 4) {
    let most = Math.abs(a[i + 3] - b[i + 3]);
    for (let c = i; c < i + 3; c++) {
      most = Math.max(most, Math.abs(a[c] * a[i + 3] - b[c] * b[i + 3]) / 255);
    }
    largest = Math.max(largest, most);
    if (most <= CLOSE) close++;
  }
  const share = close / (a.length / 4);
  return { largest, close: share, alike: a.length === b.length && share >= ALIKE };
}
