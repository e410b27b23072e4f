// A camera that goes round the avatar and follows its pelvis.

import { moved, product, rigid } from "./matrices.js";

const SHARE = 0.8; // of the picture's height, how much the standing person takes
const AWAY = 3.5; // how far the camera stands, in heights of the person
const WIDEST = 1.3; // a narrow picture is treated as if it were this much wider than it is
const MARGIN_M = 0.35; // nothing of the avatar is farther from every joint
const NEAREST_M = 0.3;

export class Orbit {
  /** look: {axes: rows right, down, forward of the front view; pelvis; height_m; middle_m}. */
  constructor(look) {
    this.look = look;
    this.reset();
  }

  reset() {
    this.yaw = 0; this.pitch = 0; this.zoom = 1; this.right = 0; this.down = 0;
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.max(-1.5, Math.min(1.5, this.pitch + pitch));
  }

  nearer(factor) {
    this.zoom = Math.max(0.4, Math.min(12, this.zoom * factor));
  }

  /** Shift by pixels of a picture of that size. */
  shift(x, y, width, height) {
    const perPixel = this.distance() / this.focal(width, height);
    const most = 1.5 * this.look.height_m;
    this.right = Math.max(-most, Math.min(most, this.right + x * perPixel));
    this.down = Math.max(-most, Math.min(most, this.down + y * perPixel));
  }

  distance() {
    return Math.max(NEAREST_M, (AWAY * this.look.height_m) / this.zoom);
  }

  focal(width, height) {
    return SHARE * AWAY * Math.min(height, WIDEST * width);
  }

  /**
   * The camera for a pose: focal length, centre, size, and the rigid 3×4 camera-from-world.
   * The person's middle is `lift` of the height above the picture's.
   */
  camera(pose, width, height, lift = 0) {
    const { axes, pelvis, middle_m } = this.look;
    const front = [...axes[0], 0, ...axes[1], 0, ...axes[2], 0];
    const turned = product(rigid([this.pitch, 0, 0]), product(rigid([0, this.yaw, 0]), front));
    const middle = [0, 1, 2].map((axis) => pelvis[axis] + pose[3 + axis] - middle_m * axes[1][axis]);
    const back = moved(turned, middle);
    const place = [this.right, this.down, this.distance()];
    [3, 7, 11].forEach((entry, axis) => { turned[entry] = place[axis] - back[axis]; });
    const focal = this.focal(width, height);
    return { focal: [focal, focal], center: [width / 2, (0.5 - lift) * height], width, height, cameraFromWorld: turned };
  }
}

/** The part of a camera's picture in which the avatar can be, from its joints in the camera's frame. */
export function windowOf({ focal, center, width, height }, joints) {
  let [left, top, right, bottom] = [Infinity, Infinity, -Infinity, -Infinity];
  for (const [x, y, z] of joints) {
    if (z < -MARGIN_M) continue;
    for (const depth of [Math.max(z - MARGIN_M, 1e-3), z + MARGIN_M]) {
      left = Math.min(left, (x - MARGIN_M) / depth);
      right = Math.max(right, (x + MARGIN_M) / depth);
      top = Math.min(top, (y - MARGIN_M) / depth);
      bottom = Math.max(bottom, (y + MARGIN_M) / depth);
    }
  }
  const x = Math.max(0, Math.floor(center[0] + focal[0] * left));
  const y = Math.max(0, Math.floor(center[1] + focal[1] * top));
  const across = Math.min(width, Math.ceil(center[0] + focal[0] * right)) - x;
  const along = Math.min(height, Math.ceil(center[1] + focal[1] * bottom)) - y;
  return across > 0 && along > 0 ? { x, y, width: across, height: along } : null;
}
