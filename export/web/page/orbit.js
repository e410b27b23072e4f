// A camera that orbits the avatar and follows its pelvis.

import { moved, product, rigid } from "./kinematics.js";

const SHARE = 0.8; // height of the standing person, in picture heights
const AWAY = 3.5; // distance of the camera, in heights of the person
const WIDEST = 1.3; // factor by which narrow pictures count as wider
const MARGIN_M = 0.35; // largest distance of the avatar's surface from the nearest joint
const NEAREST_M = 0.3;
const ABOUT_M = 0.25; // depth about a joint that belongs to it, metres
const LIFT = 0.035; // height of the person's middle above the picture's, in picture heights

/** Fraction of a picture that the person takes, and its lift above a bar at its end; CSS pixels. */
export function roomIn(height, barPx) {
  const bar = barPx / Math.max(1, height);
  const share = Math.max(0.3, Math.min(SHARE, 0.97 - bar));
  return { share, lift: Math.max(LIFT, share / 2 - 0.5 + bar) };
}

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

  focal(width, height, share = SHARE) {
    return AWAY * Math.min(share * height, SHARE * WIDEST * width);
  }

  /**
   * The camera for a pose: focal length, center, size, and the rigid 3×4 camera-from-world.
   * The standing person takes `share` of the height, its middle is `lift` of it above the picture's.
   */
  camera(pose, width, height, { share = SHARE, lift = 0 } = {}) {
    const { axes, pelvis, middle_m } = this.look;
    const front = [...axes[0], 0, ...axes[1], 0, ...axes[2], 0];
    const turned = product(rigid([this.pitch, 0, 0]), product(rigid([0, this.yaw, 0]), front));
    const middle = [0, 1, 2].map((axis) => pelvis[axis] + pose[3 + axis] - middle_m * axes[1][axis]);
    const back = moved(turned, middle);
    const place = [this.right, this.down, this.distance()];
    [3, 7, 11].forEach((entry, axis) => { turned[entry] = place[axis] - back[axis]; });
    const focal = this.focal(width, height, share);
    return { focal: [focal, focal], center: [width / 2, (0.5 - lift) * height], width, height, cameraFromWorld: turned };
  }
}

/** The camera of a picture coarser by a factor. */
export function coarser({ focal, center, width, height, cameraFromWorld }, times) {
  const [wide, high] = [width, height].map((side) => Math.max(16, Math.ceil(side / times)));
  const [x, y] = [wide / width, high / height];
  return {
    focal: [focal[0] * x, focal[1] * y], center: [center[0] * x, center[1] * y],
    width: wide, height: high, cameraFromWorld,
  };
}

/** The least depth of the avatar in the picture, metres. */
export function nearestOf({ focal, center, width, height }, joints) {
  let nearest = Infinity;
  for (const [x, y, z] of joints) {
    const far = z + ABOUT_M;
    const right = (far * (width - center[0])) / focal[0], left = (-far * center[0]) / focal[0];
    const low = (far * (height - center[1])) / focal[1], high = (-far * center[1]) / focal[1];
    const beside = x - ABOUT_M > right || x + ABOUT_M < left || y - ABOUT_M > low || y + ABOUT_M < high;
    if (far > 0 && !beside) nearest = Math.min(nearest, z - ABOUT_M);
  }
  return nearest;
}

/** The part of a picture that may show the avatar, from its joints in the camera's frame. */
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
