// Forward kinematics of the 24 joints, as the package's manifest describes it, by rigid and affine 3×4
// matrices: row after row in arrays of twelve.

const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];

/** a ∘ b: b first. */
export function product(a, b) {
  const out = new Float64Array(12);
  for (let row = 0; row < 12; row += 4) {
    for (let column = 0; column < 4; column++) {
      out[row + column] = a[row] * b[column] + a[row + 1] * b[4 + column] + a[row + 2] * b[8 + column];
    }
    out[row + 3] += a[row + 3];
  }
  return out;
}

/** A matrix applied to a point. */
export function moved(m, [x, y, z]) {
  return [0, 4, 8].map((row) => m[row] * x + m[row + 1] * y + m[row + 2] * z + m[row + 3]);
}

/** The inverse of a rotation and a shift. */
function inverseOfRigid(m) {
  const out = [m[0], m[4], m[8], 0, m[1], m[5], m[9], 0, m[2], m[6], m[10], 0];
  const back = moved(out, [m[3], m[7], m[11]]);
  [out[3], out[7], out[11]] = back.map((v) => -v);
  return out;
}

/** Rotation by an axis-angle in radians (Rodrigues), then a shift. */
export function rigid([x, y, z], [tx, ty, tz] = [0, 0, 0]) {
  const angle = Math.hypot(x, y, z);
  const half = angle / 2;
  const s = angle > 1e-8 ? Math.sin(angle) / angle : 1;
  const c = half > 1e-8 ? 0.5 * (Math.sin(half) / half) ** 2 : 0.5;
  return [
    1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y, tx,
    c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x, ty,
    c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y), tz,
  ];
}

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
