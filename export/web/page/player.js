// The avatar, its motion and the engine that draws it, without the page around them.

import { fetched, load } from "./arrays.js";
import { Engine } from "./engine.js";
import { Skeleton, bones, moved } from "./kinematics.js";
import { Orbit, coarser, nearestOf, windowOf } from "./orbit.js";

const CLOSE = 2; // largest difference of a premultiplied channel between close pixels, in 1/255
const ALIKE = 0.999; // least fraction of close pixels in pictures that count as the same
const POSE = 75; // numbers in a pose: root rotation, root translation, 23 axis-angles

export class Player {
  /** onProgress: see Engine. */
  static async load(onProgress) {
    const avatar = await (await fetched("avatar.json")).json();
    return new Player(avatar, await load(avatar.motion.poses), onProgress);
  }

  constructor(avatar, poses, onProgress) {
    this.avatar = avatar;
    this.poses = poses;
    this.count = poses.length / POSE;
    this.fps = avatar.motion.fps;
    this.skeleton = new Skeleton(avatar);
    this.engine = new Engine(avatar, onProgress);
  }

  pose(row) {
    return this.poses.subarray(POSE * row, POSE * (row + 1));
  }

  open({ tier }) {
    return this.engine.open(tier);
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
    for (const golden of this.avatar.golden) {
      const stored = await load(golden.picture);
      const { worldFromCanonical } = this.skeleton.posed(golden.pose);
      const { rgba } = await this.engine.draw("hq", {
        bones: bones(worldFromCanonical, golden.camera.cameraFromWorld),
        camera: [...golden.camera.focal, ...golden.camera.center],
        width: golden.camera.width,
        height: golden.camera.height,
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
