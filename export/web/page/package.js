// The files that Python writes: zip archives, an avatar's tables in them (export/package/
// table_codec.py), and motions as numpy's arrays.

const SIDE = 8, NODES = 9; // voxels along a brick: its own, and with its next neighbors'
const CORNERS = [...Array(8).keys()].map((bits) => [bits >> 2, (bits >> 1) & 1, bits & 1]); // of a cell
const UNSTORED_M = 1e6, WEIGHT_SCALE = 65535, THICKNESS_STEP_M = 0.0005;
const NPY = {
  f4: Float32Array, f8: Float64Array, i4: Int32Array, i8: BigInt64Array, u1: Uint8Array, b1: Uint8Array,
};

/**
 * Fetch a file, compressed if `format` is one of DecompressionStream's.
 * arrived: called with bytes that arrived, and with {total} once it is known.
 */
export async function fetched(url, arrived = () => {}, format = "") {
  const name = String(url).split("/").pop();
  const answer = await fetch(url).catch(() => {
    throw new Error(`${name} could not be loaded: the server does not answer. Is it still running?`);
  });
  if (!answer.ok) throw new Error(`${name} could not be loaded (${answer.status}).`);
  arrived({ total: Number(answer.headers.get("Content-Length") ?? 0) });
  const counted = answer.body.pipeThrough(new TransformStream({
    transform(chunk, out) { arrived({ arrived: chunk.length }); out.enqueue(chunk); },
  }));
  const whole = format ? counted.pipeThrough(new DecompressionStream(format)) : counted;
  return new Response(whole).arrayBuffer().catch(() => {
    throw new Error(`${name} arrived damaged or incomplete. Load the page again.`);
  });
}

async function inflated(bytes, format) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream(format));
  return new Uint8Array(await new Response(stream).arrayBuffer().catch(() => {
    throw new Error("it is damaged or incomplete.");
  }));
}

/** Read a zip archive: an object of functions that return each entry's bytes, by name. */
export function unzip(buffer) {
  const view = new DataView(buffer);
  let end = buffer.byteLength - 22;
  while (end >= 0 && view.getUint32(end, true) !== 0x06054b50) end--;
  if (end < 0) throw new Error("it is damaged or incomplete. Copy it again.");
  const entries = {};
  let at = view.getUint32(end + 16, true);
  for (let left = view.getUint16(end + 10, true); left > 0; left--) {
    const [method, packed, start] = [view.getUint16(at + 10, true), view.getUint32(at + 20, true), view.getUint32(at + 42, true)];
    const [name, extra, comment] = [28, 30, 32].map((field) => view.getUint16(at + field, true));
    const from = start + 30 + view.getUint16(start + 26, true) + view.getUint16(start + 28, true);
    const bytes = new Uint8Array(buffer, from, packed);
    entries[new TextDecoder().decode(new Uint8Array(buffer, at + 46, name))] = async () => (
      method ? inflated(bytes, "deflate-raw") : bytes.slice()
    );
    at += 46 + name + extra + comment;
  }
  return entries;
}

/** An array of numpy's: {data, shape}. */
function array(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset);
  const [start, size] = bytes[6] === 1 ? [10, view.getUint16(8, true)] : [12, view.getUint32(8, true)];
  const head = new TextDecoder().decode(bytes.subarray(start, start + size));
  const [, type] = /'descr': '[<|](\w+)'/.exec(head) ?? [];
  if (!NPY[type] || /'fortran_order': True/.test(head)) return null;
  const shape = /'shape': \(([^)]*)\)/.exec(head)[1].split(",").filter((n) => n.trim()).map(Number);
  return { data: Array.from(new NPY[type](bytes.slice(start + size).buffer), Number), shape };
}

/**
 * Read a motion from an .npz file with InstantAvatar's keys, or those of AMASS: {poses, fps}.
 * A pose is 75 numbers: root rotation, root translation, 23 axis-angles.
 */
export async function readMotion(buffer) {
  const entries = unzip(buffer);
  const get = async (...names) => {
    const found = names.find((name) => `${name}.npy` in entries);
    return found && array(await entries[`${found}.npy`]());
  };
  const [root, body, both, places] = [
    await get("global_orient"), await get("body_pose"), await get("poses", "thetas"), await get("transl", "trans"),
  ];
  if (!places || !(root && body) && !both) {
    throw new Error("it holds no global_orient, body_pose and transl, nor poses and trans: axis-angles in radians, metres.");
  }
  const [count, valid] = [places.shape[0], await get("valid")];
  const rows = [...Array(count).keys()].filter((row) => !valid || valid.data[row]);
  const width = (given) => given.data.length / count;
  const poses = new Float32Array(75 * rows.length);
  rows.forEach((row, place) => {
    const part = (given, from, to) => given.data.slice(width(given) * row + from, width(given) * row + Math.min(to, width(given)));
    const joints = both ? part(both, 3, 66) : part(body, 0, 69);
    poses.set([...(both ? part(both, 0, 3) : part(root, 0, 3)), ...part(places, 0, 3), ...joints], 75 * place);
  });
  const [rate, times] = [await get("fps", "mocap_framerate", "mocap_frame_rate"), await get("time")];
  const span = times && times.data.at(-1) - times.data[0];
  return { poses, fps: rate ? rate.data[0] : span > 0 ? (count - 1) / span : 30 };
}

const STREAMS = ["blocks", "voxels", "positions", "normals", "thickness", "skin_nodes", "skin_weights"];

/** What the tables are decoded from: bytes by name. */
export async function readStreams(entries) {
  return Object.fromEntries(await Promise.all(STREAMS.map(async (name) => [name, await entries[`hq/${name}.bin`]()])));
}

/** The player's tables by name, as its graph takes them. */
export function decodeTables(streams, layout, subdivision) {
  const { low, step, counts, ...nodes } = subdivision === 2 ? subdivided(streams, layout) : stored(streams, layout);
  const found = surfels(streams, layout);
  return { ...bricks(streams, layout), ...found, ...nodes, ...surfelCells(found, nodes.node, low, step, counts) };
}

/** Heights of the standing avatar above its pelvis: {low, high}, metres. */
export function heights({ positions }, { surfels: count, surfel_low, surfel_extent_m, pelvis }) {
  const codes = sums(new Uint16Array(positions.buffer).slice(count, 2 * count));
  const metres = (code) => surfel_low[1] + (code / 65535) * surfel_extent_m - pelvis[1];
  return { low: metres(codes.reduce((a, b) => Math.min(a, b))), high: metres(codes.reduce((a, b) => Math.max(a, b))) };
}

function sums(codes) {
  for (let i = 1; i < codes.length; i++) codes[i] += codes[i - 1]; // modulo its type
  return codes;
}

/** Numbers of the set bits from 1 in order; 0 for the others. */
function numbered(bits, counts) {
  const found = new Int32Array(counts[0] * counts[1] * counts[2]);
  for (let i = 0, next = 1; i < found.length; i++) if (bits[i >> 3] & (128 >> (i & 7))) found[i] = next++;
  return found;
}

/** Sums of four bytes each, modulo 256. */
const added = (a, b) => ((a & 0x7f7f7f7f) + (b & 0x7f7f7f7f)) ^ ((a ^ b) & 0x80808080);

function bricks({ blocks, voxels }, { bricks: count, brick_counts }) {
  const index = numbered(blocks, brick_counts), own = SIDE ** 3, whole = NODES ** 3;
  const words = new Uint32Array(voxels.buffer, voxels.byteOffset, voxels.length >> 2); // four voxels along z
  for (let base = 0; base < words.length; base += own >> 2) { // sums along x, then y
    for (let i = base + 16; i < base + 128; i++) words[i] = added(words[i], words[i - 16]);
    for (let i = base + 2; i < base + 128; i++) if (i & 14) words[i] = added(words[i], words[i - 2]);
  }
  for (let i = 1; i < voxels.length; i++) if (i & 7) voxels[i] += voxels[i - 1];
  const voxel_color = new Int32Array((count + 1) * whole), voxel_density = new Uint8Array((count + 1) * whole);
  const channel = (number) => voxels.subarray(number * count * own, (number + 1) * count * own);
  const [red, green, blue, density] = [0, 1, 2, 3].map(channel); // red and blue as differences from green
  const colors = new Int32Array(green.length);
  for (let i = 0; i < colors.length; i++) {
    const g = green[i];
    colors[i] = ((red[i] + g) & 255) | (g << 8) | (((blue[i] + g) & 255) << 16);
  }
  const [nx, ny, nz] = brick_counts;
  const places = [...Array(whole).keys()].map((node) => [Math.floor(node / NODES ** 2), Math.floor(node / NODES) % NODES, node % NODES]);
  const corner = Uint8Array.from(places, ([i, j, k]) => ((i >> 3) << 2) | ((j >> 3) << 1) | (k >> 3)); // whose voxel a node is
  const inside = Uint16Array.from(places, ([i, j, k]) => ((i & 7) * SIDE + (j & 7)) * SIDE + (k & 7));
  for (let place = 0; place < index.length; place++) {
    if (!index[place]) continue;
    const [x, y, z] = [Math.floor(place / (ny * nz)), Math.floor(place / nz) % ny, place % nz];
    const near = CORNERS.map(([i, j, k]) => (x + i < nx && y + j < ny && z + k < nz ? index[((x + i) * ny + y + j) * nz + z + k] : 0));
    for (let node = 0, to = index[place] * whole; node < whole; node++, to++) {
      const brick = near[corner[node]];
      if (!brick) continue;
      const from = (brick - 1) * own + inside[node];
      voxel_color[to] = colors[from];
      voxel_density[to] = density[from];
    }
  }
  return { voxel_color, voxel_density, brick_offset: index.map((number) => number * whole) };
}

function surfels({ positions, normals, thickness }, { surfels: count, surfel_low, surfel_extent_m }) {
  const f = Math.fround, step = f(surfel_extent_m / 65535);
  const floats = (codes, value) => { // three times as fast as Float32Array.from
    const found = new Float32Array(codes.length);
    for (let i = 0; i < found.length; i++) found[i] = value(codes[i]);
    return found;
  };
  const found = { thickness: floats(thickness, (code) => f(code) * f(THICKNESS_STEP_M)) };
  [..."xyz"].forEach((letter, axis) => {
    const part = [axis * count, (axis + 1) * count], low = f(surfel_low[axis]);
    const codes = sums(new Uint16Array(positions.buffer).slice(...part));
    found[`position_${letter}`] = floats(codes, (code) => low + f(code * step));
    found[`normal_${letter}`] = floats(new Int8Array(normals.buffer).subarray(...part), (code) => code / 127);
  });
  return found;
}

/** Where surfels lie between skinning nodes (export/player_inputs.py). */
function surfelCells(surfels, node, low, step, counts) {
  const count = surfels.position_x.length, [, ny, nz] = counts;
  const ints = (length) => Array.from({ length }, () => new Int32Array(count));
  const floats = (length) => Array.from({ length }, () => new Float32Array(count));
  const [cell, tetrahedron, fraction, share, edge_normal] = [ints(4), [null, ...ints(3)], floats(3), floats(4), floats(3)];
  const of = (name) => [..."xyz"].map((letter) => surfels[`${name}_${letter}`]);
  const positions = of("position"), normals = of("normal");
  const strides = [ny * nz, nz, 1], steps = [0, nz, ny * nz, ny * nz + nz], part = new Float64Array(3), walk = new Uint8Array(3);
  for (let i = 0; i < count; i++) {
    let number = 0;
    for (let axis = 0; axis < 3; axis++) {
      const place = Math.min(Math.max((positions[axis][i] - low[axis]) / step[axis], 0), counts[axis] - 1 - 1e-3);
      const below = Math.floor(place);
      fraction[axis][i] = part[axis] = place - below;
      number += below * strides[axis];
    }
    for (let corner = 0; corner < 4; corner++) cell[corner][i] = node[number + steps[corner]];
    const first = part[0] >= part[1] && part[0] >= part[2] ? 0 : part[1] >= part[2] ? 1 : 2;
    const others = first === 0 ? 1 : 0, rest = 3 - first - others;
    walk[0] = first; walk[1] = part[others] >= part[rest] ? others : rest; walk[2] = 3 - first - walk[1];
    let corner = 0, before = 1;
    for (let turn = 0; turn < 3; turn++) {
      const axis = walk[turn];
      corner += 4 >> axis;
      tetrahedron[turn + 1][i] = cell[corner >> 1][i] + (corner & 1);
      share[turn][i] = before - part[axis];
      before = part[axis];
      edge_normal[turn][i] = normals[axis][i] * step[axis];
    }
    share[3][i] = before;
  }
  const named = Object.entries({ cell, tetrahedron, share, edge_normal }).flatMap(([name, columns]) => (
    columns.map((values, number) => [`${name}_${number}`, values])
  ));
  return Object.fromEntries([...named.filter(([, values]) => values), ...[..."xyz"].map((letter, axis) => [`fraction_${letter}`, fraction[axis]])]);
}

/** Nodes of the skinning grid (export/player_inputs.py). weigh(x, y, z, shares): sets joints' weights. */
function nodesOf(index, counts, low, step, weigh) {
  const rows = index.reduce((sum, number) => sum + (number > 0), 0) + 2, [, ny, nz] = counts;
  const found = { low, step, counts, node: new Int32Array(index.length), node_weights: new Float32Array(24 * rows) };
  const axes = [..."xyz"].map((letter) => (found[`node_${letter}`] = new Float32Array(rows).fill(UNSTORED_M)));
  const shares = new Float64Array(24);
  found.node_weights[0] = found.node_weights[rows - 1] = 1;
  for (let place = 0; place < index.length; place++) {
    const row = index[place];
    if (!row) continue;
    const x = Math.floor(place / (ny * nz)), y = Math.floor(place / nz) % ny, z = place % nz;
    if (z + 1 < nz && index[place + 1]) found.node[place] = row;
    [axes[0][row], axes[1][row], axes[2][row]] = [x * step[0] + low[0], y * step[1] + low[1], z * step[2] + low[2]];
    weigh(x, y, z, shares);
    for (let joint = 0; joint < 24; joint++) found.node_weights[joint * rows + row] = shares[joint];
  }
  return found;
}

const codesOf = ({ skin_weights }) => new Uint16Array(skin_weights.buffer);

function stored(streams, { skin_counts, skin_nodes, skin_low, skin_step_m }) {
  const index = numbered(streams.skin_nodes, skin_counts), codes = codesOf(streams), [, ny, nz] = skin_counts;
  return nodesOf(index, skin_counts, skin_low, skin_step_m, (x, y, z, shares) => {
    const column = index[(x * ny + y) * nz + z] - 1;
    for (let joint = 0; joint < 24; joint++) shares[joint] = codes[joint * skin_nodes + column] / WEIGHT_SCALE;
  });
}

/** At half the step, in cells whose corners are all stored; a node between others takes their mean. */
function subdivided(streams, { skin_counts, skin_nodes, skin_low, skin_step_m }) {
  const coarse = numbered(streams.skin_nodes, skin_counts), codes = codesOf(streams);
  const [nx, ny, nz] = skin_counts, counts = skin_counts.map((count) => 2 * count - 1);
  const column = (x, y, z) => coarse[(x * ny + y) * nz + z] - 1;
  const within = new Int32Array(counts[0] * counts[1] * counts[2]);
  for (let x = 0; x < nx - 1; x++) for (let y = 0; y < ny - 1; y++) for (let z = 0; z < nz - 1; z++) {
    if (CORNERS.some(([i, j, k]) => column(x + i, y + j, z + k) < 0)) continue;
    for (let part = 0; part < 27; part++) {
      const i = Math.floor(part / 9), j = Math.floor(part / 3) % 3, k = part % 3;
      within[((2 * x + i) * counts[1] + 2 * y + j) * counts[2] + 2 * z + k] = 1;
    }
  }
  for (let place = 0, next = 1; place < within.length; place++) if (within[place]) within[place] = next++;
  const step = skin_step_m.map((metres) => metres / 2);
  return nodesOf(within, counts, skin_low, step, (x, y, z, shares) => {
    shares.fill(0);
    let all = 0;
    for (let i = 0; i <= (x & 1); i++) for (let j = 0; j <= (y & 1); j++) for (let k = 0; k <= (z & 1); k++) {
      let at = column((x >> 1) + i, (y >> 1) + j, (z >> 1) + k);
      for (let joint = 0; joint < 24; joint++, at += skin_nodes) { shares[joint] += codes[at]; all += codes[at]; }
    }
    for (let joint = 0; joint < 24; joint++) shares[joint] /= Math.max(all, 1);
  });
}
