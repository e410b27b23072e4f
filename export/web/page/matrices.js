// Rigid and affine 3×4 matrices, row after row in arrays of twelve.

export const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];

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
export function inverseOfRigid(m) {
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
