// Forward kinematics of the 24 joints, as the package's manifest describes it.

import { IDENTITY, inverseOfRigid, moved, product, rigid } from "./matrices.js";

/** A pose is an array of 75: root rotation, root translation, 23 axis-angles. */
export class Skeleton {
  constructor({ rest_joints, parents, canonical_rotations }) {
    this.rest = rest_joints;
    this.parents = parents;
    const canonical = this.bodyFromRest(canonical_rotations.flat());
    this.restFromCanonical = canonical.map(inverseOfRigid);
  }

  /** Where each joint carries a point of the rest pose, the root at rest. */
  bodyFromRest(rotations) {
    const posed = [];
    for (const [joint, parent] of this.parents.entries()) {
      const own = parent < 0 ? [0, 0, 0] : Array.from(rotations.slice(3 * joint - 3, 3 * joint));
      const from = parent < 0 ? [0, 0, 0] : this.rest[parent];
      const local = rigid(own, this.rest[joint].map((v, axis) => v - from[axis]));
      posed.push(product(parent < 0 ? IDENTITY : posed[parent], local));
    }
    return posed.map((m, joint) => product(m, rigid([0, 0, 0], this.rest[joint].map((v) => -v))));
  }

  /** World-from-canonical matrices of the joints, and where the joints are. */
  posed(pose) {
    const pelvis = this.rest[0];
    const turned = rigid(pose.slice(0, 3));
    const back = moved(turned, pelvis);
    const shift = [0, 1, 2].map((axis) => pelvis[axis] + pose[3 + axis] - back[axis]);
    const root = rigid(pose.slice(0, 3), shift);
    const worldFromRest = this.bodyFromRest(pose.slice(6)).map((m) => product(root, m));
    return {
      worldFromCanonical: worldFromRest.map((m, j) => product(m, this.restFromCanonical[j])),
      joints: worldFromRest.map((m, j) => moved(m, this.rest[j])),
    };
  }
}

/** Camera-from-canonical matrices in one row of 24 × 12, as the player's graph takes them. */
export function bones(worldFromCanonical, cameraFromWorld) {
  const out = new Float32Array(24 * 12);
  worldFromCanonical.forEach((m, joint) => out.set(product(cameraFromWorld, m), 12 * joint));
  return out;
}
