// Draws with shaders over the package's own tables (WebGL2), away from the page.

import { answer, arrived, preparing } from "./answering.js";
import { load } from "./arrays.js";
import { WIDTH_BITS, sources } from "./shaders.js";

const WIDTH = 1 << WIDTH_BITS;
const gl = new OffscreenCanvas(1, 1).getContext("webgl2", { antialias: false, powerPreference: "high-performance" });
const tiers = {};
const held = {}; // textures by the files that they were made of: tiers mostly share them

async function open({ tier, note }) {
  if (tiers[tier]) return;
  if (!gl || !gl.getExtension("EXT_color_buffer_float")) throw new Error("There is no WebGL2 with float targets here.");
  const files = note.tables.map((entry) => entry.file).join();
  held[files] ??= await tablesOf(note.tables);
  const programs = {};
  for (const [name, [vertex, fragment]] of Object.entries(sources(note))) programs[name] = program(vertex, fragment);
  tiers[tier] = { note, programs, textures: held[files], targets: {} };
}

async function tablesOf(entries) {
  const loaded = await Promise.all(entries.map((entry) => load(entry, arrived)));
  preparing();
  return tables(Object.fromEntries(entries.map(({ name }, i) => [name, loaded[i]])));
}

function program(vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const places = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(made, i);
    places[name.replace("[0]", "")] = gl.getUniformLocation(made, name);
  }
  return { made, places };
}

/** Numbers in rows of a texture; each texel takes as many as the format has channels. */
function texture(format, rows, values, channels) {
  const [inside, outside, type, Kind] = {
    rgba32f: [gl.RGBA32F, gl.RGBA, gl.FLOAT, Float32Array],
    r32i: [gl.R32I, gl.RED_INTEGER, gl.INT, Int32Array],
    rgba8ui: [gl.RGBA8UI, gl.RGBA_INTEGER, gl.UNSIGNED_BYTE, Uint8Array],
  }[format];
  if (Math.max(rows, WIDTH) > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("The avatar is too large for this GPU.");
  const padded = new Kind(WIDTH * rows * channels);
  padded.set(values);
  const made = plain(gl.TEXTURE_2D);
  gl.texImage2D(gl.TEXTURE_2D, 0, inside, WIDTH, rows, 0, outside, type, padded);
  return made;
}

function plain(target) {
  const made = gl.createTexture();
  gl.bindTexture(target, made);
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(target, filter, gl.NEAREST);
  for (const wrap of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(target, wrap, gl.CLAMP_TO_EDGE);
  return made;
}

const rowsFor = (count) => Math.ceil(count / WIDTH);

/** Columns side by side, four to a texel. */
function beside(...columns) {
  const count = columns[0].length;
  const out = new Float32Array(4 * count);
  columns.forEach((column, channel) => { for (let i = 0; i < count; i++) out[4 * i + channel] = column[i]; });
  return texture("rgba32f", rowsFor(count), out, 4);
}

function tables(columns) {
  const nodes = columns.node_x.length;
  return {
    surfel_place: beside(columns.position_x, columns.position_y, columns.position_z, columns.thickness),
    surfel_normal: beside(columns.normal_x, columns.normal_y, columns.normal_z),
    node_place: beside(columns.node_x, columns.node_y, columns.node_z),
    node_weights: weightsOf(columns.node_weights, nodes),
    node: texture("r32i", rowsFor(columns.node.length), columns.node, 1),
    brick_offset: texture("r32i", rowsFor(columns.brick_offset.length), columns.brick_offset, 1),
    voxels: voxelsOf(columns.voxel_color, columns.voxel_density),
    nodes: rowsFor(nodes),
    surfels: columns.thickness.length,
  };
}

/** 24 weights of every node in six layers of four. */
function weightsOf(weights, nodes) {
  const rows = rowsFor(nodes);
  const made = plain(gl.TEXTURE_2D_ARRAY);
  gl.texImage3D(gl.TEXTURE_2D_ARRAY, 0, gl.RGBA32F, WIDTH, rows, 6, 0, gl.RGBA, gl.FLOAT, null);
  for (let layer = 0; layer < 6; layer++) {
    const texels = new Float32Array(4 * WIDTH * rows);
    for (let k = 0; k < 4; k++) {
      const start = (4 * layer + k) * nodes;
      for (let i = 0; i < nodes; i++) texels[4 * i + k] = weights[start + i];
    }
    gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, layer, WIDTH, rows, 1, gl.RGBA, gl.FLOAT, texels);
  }
  return made;
}

/** Red, green, blue and log-density in four bytes. */
function voxelsOf(color, density) {
  const bytes = new Uint8Array(4 * color.length);
  const words = new Uint32Array(bytes.buffer);
  for (let i = 0; i < words.length; i++) words[i] = color[i] | (density[i] << 24);
  return texture("rgba8ui", rowsFor(words.length), bytes, 4);
}

/** A texture that is drawn into. */
function target(inside, width, height) {
  const made = plain(gl.TEXTURE_2D);
  gl.texStorage2D(gl.TEXTURE_2D, 1, inside, width, height);
  return made;
}

function framebuffer(colors, depth) {
  const made = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, made);
  colors.forEach((color, i) => gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, color, 0));
  if (depth) gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depth, 0);
  gl.drawBuffers(colors.map((_, i) => gl.COLOR_ATTACHMENT0 + i));
  return made;
}

/** Targets of a picture's size; the largest so far are kept, and used in part. */
function targetsOf(tier, width, height) {
  const old = tier.targets;
  if (old.width >= width && old.height >= height) return old;
  const border = 2 * tier.note.rules.largest_footprint_px;
  const [w, h] = [Math.max(width, old.width ?? 0), Math.max(height, old.height ?? 0)];
  old.all?.forEach((each) => gl.deleteTexture(each));
  old.buffers?.forEach((each) => gl.deleteFramebuffer(each));
  const t = {
    width: w, height: h,
    node_camera: target(gl.RGBA32F, WIDTH, tier.textures.nodes),
    nearest_color: target(gl.RGBA8, 1, 1), nearest_depth: target(gl.DEPTH_COMPONENT32F, 1, 1),
    keys: target(gl.R32I, w + border, h + border), depth: target(gl.DEPTH_COMPONENT24, w + border, h + border),
    first_color: target(gl.RGBA32F, w, h), first_extent: target(gl.RGBA32F, w, h),
    further_color: target(gl.RGBA32F, w, h), further_extent: target(gl.RGBA32F, w, h),
    rgba: target(gl.RGBA8, w, h),
  };
  t.all = Object.values(t).filter((value) => typeof value === "object");
  t.into = {
    nodes: framebuffer([t.node_camera]),
    nearest: framebuffer([t.nearest_color], t.nearest_depth),
    keys: framebuffer([t.keys], t.depth),
    first: framebuffer([t.first_color, t.first_extent]),
    further: framebuffer([t.further_color, t.further_extent]),
    shown: framebuffer([t.rgba]),
  };
  t.buffers = Object.values(t.into);
  tier.targets = t;
  return t;
}

function draw({ tier: name, bones, camera, width, height, samples }) {
  const began = performance.now();
  const tier = tiers[name], t = targetsOf(tier, width, height);
  const { pelvis, reach_m } = tier.note.layout;
  const near = bones[8] * pelvis[0] + bones[9] * pelvis[1] + bones[10] * pelvis[2] + bones[11] - reach_m;
  const uniforms = { bones, lens: camera, size: [width, height], samples, near };
  const border = 2 * tier.note.rules.largest_footprint_px;
  const pass = (program, into, [w, h], points) => run(tier, t, program, into, [w, h], points, uniforms);
  gl.disable(gl.BLEND);
  gl.disable(gl.DEPTH_TEST);
  pass("nodes", "nodes", [WIDTH, tier.textures.nodes]);
  gl.enable(gl.DEPTH_TEST);
  gl.depthFunc(gl.LESS);
  clear(t, "nearest");
  pass("nearest", "nearest", [1, 1], tier.textures.surfels);
  clear(t, "keys");
  pass("splat", "keys", [width + border, height + border], tier.textures.surfels);
  gl.disable(gl.DEPTH_TEST);
  pass("first", "first", [width, height]);
  for (let layer = 1; layer < tier.note.rules.layers; layer++) {
    gl.enable(gl.DEPTH_TEST);
    clear(t, "keys");
    pass("behind", "keys", [width + border, height + border], tier.textures.surfels);
    gl.disable(gl.DEPTH_TEST);
    pass("further", "further", [width, height]);
    for (const part of [t, t.into]) swap(part); // what was drawn last is what the next begins with
  }
  pass("shown", "shown", [width, height]);
  const rgba = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
  if (gl.isContextLost()) throw new Error("The GPU was taken away; choose the CPU, or load the page again.");
  return { rgba: rgba.buffer, ms: performance.now() - began };
}

/** Exchanges the two sets of targets that layers are drawn into by turns. */
function swap(part) {
  for (const name of Object.keys(part).filter((each) => each.startsWith("first"))) {
    const other = name.replace("first", "further");
    [part[name], part[other]] = [part[other], part[name]];
  }
}

function clear(t, into) {
  gl.bindFramebuffer(gl.FRAMEBUFFER, t.into[into]);
  if (into === "keys") gl.clearBufferiv(gl.COLOR, 0, [0x7fffffff, 0, 0, 0]);
  gl.clearBufferfv(gl.DEPTH, 0, [1]);
}

function run(tier, t, name, into, [width, height], points, uniforms) {
  const { made, places } = tier.programs[name];
  gl.useProgram(made);
  gl.bindFramebuffer(gl.FRAMEBUFFER, t.into[into]);
  gl.viewport(0, 0, width, height);
  let unit = 0;
  for (const [uniform, place] of Object.entries(places)) {
    if (uniform === "bones") gl.uniform4fv(place, uniforms.bones);
    else if (uniform === "lens") gl.uniform4fv(place, uniforms.lens);
    else if (uniform === "size") gl.uniform2iv(place, uniforms.size);
    else if (uniform === "samples" || uniform === "near") gl.uniform1f(place, uniforms[uniform]);
    else {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(uniform === "node_weights" ? gl.TEXTURE_2D_ARRAY : gl.TEXTURE_2D, tier.textures[uniform] ?? t[uniform]);
      gl.uniform1i(place, unit++);
    }
  }
  points ? gl.drawArrays(gl.POINTS, 0, points) : gl.drawArrays(gl.TRIANGLES, 0, 3);
}

answer({ open, draw });
