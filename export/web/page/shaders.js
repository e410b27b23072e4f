// The player's drawing rules as shaders: what the ONNX graph does with the same tables.
//
// Its parts have the names of the graph's (export/posing.py, surfels.py, raster.py, shading.py,
// march.py and lookup.py); the golden frames of every package hold both to the same pictures.

export const WIDTH_BITS = 12; // tables lie in textures of 4096 columns

/** Constants of a tier as GLSL. note: {rules, layout, constants} of avatar.json. */
function constants({ rules, layout, constants: fixed }) {
  const float = (value) => (Number.isInteger(value) ? `${value}.0` : `${value}`);
  const vec3 = (values) => `vec3(${values.map(float).join(", ")})`;
  const ivec3 = (values) => `ivec3(${values.join(", ")})`;
  const parts = rules.nodes_per_step; // of a step of the skin
  const perNode = layout.skin_step_m.map((step) => parts / step);
  const { samples, ...others } = rules; // how many there are is a uniform
  const lines = Object.entries(others).map(([name, value]) =>
    Number.isInteger(value) && WHOLE.has(name)
      ? `const int ${name} = ${value};`
      : `const float ${name} = ${float(value)};`);
  return `
    ${lines.join("\n    ")}
    const float usual_samples = ${float(samples)};
    const ivec3 brick_counts = ${ivec3(layout.brick_counts)};
    const vec3 brick_low = ${vec3(layout.brick_low)};
    const float voxel_m = ${float(layout.voxel_m)};
    const float spacing_m = ${float(layout.surfel_spacing_m)};
    const ivec3 node_counts = ${ivec3(layout.skin_counts.map((count) => parts * (count - 1) + 1))};
    const vec3 node_low = ${vec3(layout.skin_low)};
    const vec3 nodes_per_m = ${vec3(perNode)};
    const vec3 pelvis = ${vec3(layout.pelvis)};
    const float reach_m = ${float(layout.reach_m)};
    const int SURFEL_BITS = ${fixed.surfel_bits};
    const int DEPTH_STEPS = ${fixed.depth_steps};
    const int BRICK = ${fixed.brick};
    const int NODES = ${fixed.brick + 1};
    const vec2 LOG_DENSITY = vec2(${fixed.log_density.map(float).join(", ")});
    const int FULL = 256;
    const int FAR = 0x7fffffff;
    const int SURFEL_MASK = (1 << SURFEL_BITS) - 1;`;
}

const WHOLE = new Set(["layers", "block", "steady", "blocks", "second_block", "largest_footprint_px"]);

const COMMON = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler2DArray;
precision highp isampler2D;
precision highp usampler2D;
uniform vec4 bones[72];
uniform vec4 lens; // focal lengths, centre
uniform ivec2 size;
uniform float samples;
ivec2 at(int i) { return ivec2(i & ${(1 << WIDTH_BITS) - 1}, i >> ${WIDTH_BITS}); }
`;

const POSING = `
uniform sampler2D node_camera;
uniform isampler2D node;

vec3 node_at(int row) { return texelFetch(node_camera, at(row), 0).xyz; }

/** The cell of the skin that a canonical point lies in, and how far from its lowest corner. */
ivec3 cell_of(vec3 point, out vec3 fraction) {
  vec3 place = clamp((point - node_low) * nodes_per_m, vec3(0.0), vec3(node_counts - 1) - 1e-3);
  vec3 below = floor(place);
  fraction = place - below;
  return ivec3(below);
}

/** Where a canonical point is in the camera's frame; derivative has a column for each axis. */
vec3 carried(vec3 point, out mat3 derivative) {
  vec3 f;
  ivec3 b = cell_of(point, f);
  int number = (b.x * node_counts.y + b.y) * node_counts.z + b.z;
  int across = node_counts.z, far_across = node_counts.y * node_counts.z;
  int r00 = texelFetch(node, at(number), 0).x, r01 = texelFetch(node, at(number + across), 0).x;
  int r10 = texelFetch(node, at(number + far_across), 0).x;
  int r11 = texelFetch(node, at(number + far_across + across), 0).x;
  vec3 c000 = node_at(r00), c010 = node_at(r01), c100 = node_at(r10), c110 = node_at(r11);
  vec3 z00 = node_at(r00 + 1) - c000, z01 = node_at(r01 + 1) - c010;
  vec3 z10 = node_at(r10 + 1) - c100, z11 = node_at(r11 + 1) - c110;
  vec3 on00 = c000 + f.z * z00, on01 = c010 + f.z * z01;
  vec3 on10 = c100 + f.z * z10, on11 = c110 + f.z * z11;
  vec3 y0 = on01 - on00, y1 = on11 - on10;
  vec3 on0 = on00 + f.y * y0, on1 = on10 + f.y * y1;
  derivative[0] = (on1 - on0) * nodes_per_m.x;
  derivative[1] = mix(y0, y1, f.x) * nodes_per_m.y;
  derivative[2] = mix(mix(z00, z01, f.y), mix(z10, z11, f.y), f.x) * nodes_per_m.z;
  return on0 + f.x * (on1 - on0);
}

vec3 corner_at(ivec3 b, ivec3 step) {
  int number = ((b.x + step.x) * node_counts.y + b.y + step.y) * node_counts.z + b.z;
  return node_at(texelFetch(node, at(number), 0).x + step.z); // along z rows follow each other
}

/** The same, linear in tetrahedra: from the lowest corner along the axis of the largest fraction. */
vec3 carried_in_tetrahedra(vec3 point, out mat3 derivative) {
  vec3 f;
  ivec3 b = cell_of(point, f);
  bool xy = f.x > f.y, xz = f.x > f.z, yz = f.y > f.z;
  ivec3 first = xy ? (xz ? ivec3(1, 0, 0) : ivec3(0, 0, 1)) : (yz ? ivec3(0, 1, 0) : ivec3(0, 0, 1));
  ivec3 two = xy ? (yz ? ivec3(1, 1, 0) : ivec3(1, 0, 1)) : (xz ? ivec3(1, 1, 0) : ivec3(0, 1, 1));
  float largest = max(f.x, max(f.y, f.z)), smallest = min(f.x, min(f.y, f.z));
  float middle = (f.x + f.y + f.z) - largest - smallest;
  vec3 c0 = corner_at(b, ivec3(0)), c1 = corner_at(b, first), c2 = corner_at(b, two), c3 = corner_at(b, ivec3(1));
  vec3 along[3] = vec3[3](c1 - c0, c2 - c1, c3 - c2);
  ivec3 order = first + 2 * (two - first) + 3 * (ivec3(1) - two); // which edge is along x, y, z
  derivative[0] = along[order.x - 1] * nodes_per_m.x;
  derivative[1] = along[order.y - 1] * nodes_per_m.y;
  derivative[2] = along[order.z - 1] * nodes_per_m.z;
  return c0 * (1.0 - largest) + c1 * (largest - middle) + c2 * (middle - smallest) + c3 * smallest;
}

bool sound(float volume) { return volume > 1.0 / stretch && volume < stretch; }
`;

/** Linear blend skinning of every node of the skin. */
const NODES = `
uniform sampler2DArray node_weights;
uniform sampler2D node_place;
layout(location = 0) out vec4 camera;
void main() {
  ivec2 here = ivec2(gl_FragCoord.xy);
  vec4 rows[3] = vec4[3](vec4(0.0), vec4(0.0), vec4(0.0));
  for (int layer = 0; layer < 6; layer++) {
    vec4 weights = texelFetch(node_weights, ivec3(here, layer), 0);
    for (int k = 0; k < 4; k++) {
      if (weights[k] == 0.0) continue;
      int bone = 3 * (4 * layer + k);
      for (int row = 0; row < 3; row++) rows[row] += weights[k] * bones[bone + row];
    }
  }
  vec4 place = vec4(texelFetch(node_place, here, 0).xyz, 1.0);
  camera = vec4(dot(rows[0], place), dot(rows[1], place), dot(rows[2], place), 1.0);
}`;

const SURFEL = `
uniform sampler2D surfel_place; // and thickness
uniform sampler2D surfel_normal;
uniform float near; // where the depth window begins

struct Seen { vec3 camera; vec2 uv; bool seen; mat3 derivative; };

Seen project(int surfel) {
  Seen s;
  s.camera = carried_in_tetrahedra(texelFetch(surfel_place, at(surfel), 0).xyz, s.derivative);
  float depth = s.camera.z;
  s.uv = lens.xy * s.camera.xy / max(depth, nearest_m) + lens.zw;
  float reach = 0.5 * float(largest_footprint_px);
  s.seen = depth > nearest_m && all(greaterThan(s.uv, vec2(-reach))) && all(lessThan(s.uv, vec2(size) + reach));
  return s;
}

bool faces(int surfel, Seen s) {
  vec3 from_eye = inverse(s.derivative) * s.camera;
  return dot(texelFetch(surfel_normal, at(surfel), 0).xyz, from_eye) < s.camera.z * -facing;
}
`;

/** Pixels along the edge of every footprint. */
const SIDE = `
uniform sampler2D nearest_depth;
float footprint_side(float begin) {
  float nearest = begin + texelFetch(nearest_depth, ivec2(0), 0).x * 2.0 * reach_m;
  float spacing_px = max(lens.x, lens.y) * spacing_m / nearest;
  return clamp(floor(spacing_px * footprint_spacings + 0.999), 2.0, float(largest_footprint_px));
}
`;

/** Of all surfels that are seen the nearest one's depth, into one pixel's depth buffer. */
const NEAREST = `
void main() {
  Seen s = project(gl_VertexID);
  gl_PointSize = 1.0;
  float z = (s.camera.z - near) / (2.0 * reach_m);
  gl_Position = s.seen ? vec4(0.0, 0.0, 2.0 * clamp(z, 0.0, 1.0) - 1.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
}`;

/** Each surfel's footprint into the z-buffer. */
const SPLAT = `
flat out int key;
flat out float deep_enough;
void main() {
  Seen s = project(gl_VertexID);
  float depth = s.camera.z;
  float side = footprint_side(near);
  bool seen = s.seen && all(greaterThan(s.uv, vec2(-0.5 * side))) && all(lessThan(s.uv, vec2(size) + 0.5 * side));
  float code = floor(clamp((depth - near) * (float(DEPTH_STEPS - 1) / (2.0 * reach_m)), 0.0, float(DEPTH_STEPS - 1)));
  bool folded = determinant(s.derivative) < fold_volume; // then a neighbour shows the place better
  if (folded) code = min(code + floor(fold_setback_m / (2.0 * reach_m) * float(DEPTH_STEPS)), float(DEPTH_STEPS - 1));
  key = (int(code) << SURFEL_BITS) | gl_VertexID;
#ifdef BEHIND
  deep_enough = faces(gl_VertexID, s) ? depth : 0.0;
#else
  deep_enough = 0.0;
#endif
  // in the middle of the pixels that are meant, for GPUs round the places of points; and in a
  // picture with a border, so that points beyond its edge are not cut off with their footprints
  vec2 middle = floor(s.uv - 0.5 * (side - 1.0)) + 0.5 * side;
  vec2 border = vec2(largest_footprint_px);
  vec2 place = 2.0 * (middle + border) / (vec2(size) + 2.0 * border) - 1.0;
  gl_PointSize = side;
  gl_Position = seen ? vec4(place, 2.0 * (code + 0.5) / float(DEPTH_STEPS) - 1.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
}`;

const SPLATTED = `
flat in int key;
flat in float deep_enough;
layout(location = 0) out int nearest_key;
#ifdef BEHIND
uniform sampler2D first_extent;
#endif
void main() {
#ifdef BEHIND
  ivec2 here = ivec2(gl_FragCoord.xy) - largest_footprint_px;
  if (any(lessThan(here, ivec2(0))) || any(greaterThanEqual(here, size))) discard;
  vec4 before = texelFetch(first_extent, here, 0);
  float slack = max(gap_m - sheet_gap_m, 0.0); // surfels of another sheet may fall so much short
  if (!(deep_enough > before.x - slack)) discard;
  if (deep_enough <= before.x) {
    mat3 unused;
    vec3 mine = texelFetch(surfel_place, at(key & SURFEL_MASK), 0).xyz;
    vec3 other = texelFetch(surfel_place, at(int(before.z)), 0).xyz;
    float posed = distance(carried(mine, unused), carried(other, unused));
    if (distance(mine, other) < posed * same_share + same_m) discard;
  }
#endif
  nearest_key = key;
}`;

const LOOKUP = `
uniform usampler2D voxels;
uniform isampler2D brick_offset;

ivec4 voxel_at(int place) { return ivec4(texelFetch(voxels, at(place), 0)); }

/** Colour in [0, 1] and density in 1/m: tetrahedral interpolation, of colours with whole weights. */
vec4 read_bricks(vec3 lattice) {
  vec3 inside = clamp(lattice, vec3(0.0), vec3(brick_counts * BRICK) - 1e-3);
  ivec3 voxel = ivec3(floor(inside));
  vec3 f = inside - vec3(voxel);
  ivec3 brick = voxel / BRICK;
  ivec3 local = voxel - brick * BRICK;
  int base = texelFetch(brick_offset, at((brick.x * brick_counts.y + brick.y) * brick_counts.z + brick.z), 0).x
    + (local.x * NODES + local.y) * NODES + local.z;
  int sx = NODES * NODES, sy = NODES, sz = 1;
  bool xy = f.x > f.y, xz = f.x > f.z, yz = f.y > f.z;
  int first = xy ? (xz ? sx : sz) : (yz ? sy : sz);
  int two = xy ? (yz ? sx + sy : sx + sz) : (xz ? sx + sy : sy + sz);
  float largest = max(f.x, max(f.y, f.z)), smallest = min(f.x, min(f.y, f.z));
  float middle = (f.x + f.y + f.z) - largest - smallest;
  int a = int(largest * float(FULL) + 0.5), b = int(middle * float(FULL) + 0.5), c = int(smallest * float(FULL) + 0.5);
  ivec4 v0 = voxel_at(base), v1 = voxel_at(base + first), v2 = voxel_at(base + two), v3 = voxel_at(base + sx + sy + sz);
  ivec3 color = v0.rgb * (FULL - a) + v1.rgb * (a - b) + v2.rgb * (b - c) + v3.rgb * c;
  vec4 codes = vec4(v0.a, v1.a, v2.a, v3.a);
  float code = codes.x + largest * (codes.y - codes.x) + middle * (codes.z - codes.y) + smallest * (codes.w - codes.z);
  float density = exp(code * ((LOG_DENSITY.y - LOG_DENSITY.x) / 255.0) + LOG_DENSITY.x);
  return vec4(vec3(color) / (255.0 * float(FULL)), code > 0.5 ? density : 0.0);
}
`;

const MARCH = `
/** Factor by which lengths along rays shrink where the pose compresses canonical space. */
float unsquashed(vec3 direction) { return min(squash_limit / length(direction), 1.0); }

/** Premultiplied colour and the light that is left of it after a block of samples. */
vec4 sampled(vec3 point, vec3 direction, float stride, float light, int count) {
  vec3 start = (point - brick_low) / voxel_m, slope = direction * (stride / voxel_m);
  float weight = 0.0, mean = 0.0;
  for (int k = 0; k < count; k++) {
    float along = float(k) + 0.5;
    float left = light * exp(-read_bricks(start + along * slope).a * stride);
    weight += light - left;
    mean += (light - left) * along;
    light = left;
  }
  return vec4(read_bricks(start + mean / max(weight, 1e-9) * slope).rgb * weight, light);
}

/** Premultiplied colour and alpha along a piece of a ray. */
vec4 march(vec3 ray, float begin, float end, vec3 point, vec3 direction) {
  float place = begin, light = 1.0;
  vec3 color = vec3(0.0);
  int scale = int(ceil(samples / usual_samples)), most = blocks * scale;
  for (int turn = 0; turn < most; turn++) {
    if (turn > 0) {
      mat3 derivative;
      vec3 off = place * ray - carried(point, derivative);
      if (sound(determinant(derivative))) {
        mat3 back = inverse(derivative);
        vec3 shift = back * off;
        point += shift * min(longest_correction_m / sqrt(dot(shift, shift) + 1e-20), 1.0);
        direction = back * ray;
      }
    }
    float longest = span_m / samples * exp2(max(float(turn + 1 - steady * scale), 0.0)) * unsquashed(direction);
    if (turn > 0 && turn == most - 1) longest = longest_m;
    float stride = min((end - place) / float(block), longest);
    vec4 found = sampled(point, direction, stride, light, block);
    color += found.rgb;
    light = found.a;
    float way = stride * float(block);
    place += way;
    point += direction * way;
    if (!(light > ended && place < end - 1e-5)) break;
  }
  return vec4(color, 1.0 - light);
}
`;

const SHADE = `
uniform isampler2D keys;

int key_at(ivec2 pixel) { return texelFetch(keys, pixel + largest_footprint_px, 0).x; }

vec3 ray_of(ivec2 pixel) { return normalize(vec3((vec2(pixel) + 0.5 - lens.zw) / lens.xy, 1.0)); }

struct Entry { vec3 canonical, camera, beside, direction; float along, enter, begin, end; bool there; };

/** Where a pixel's ray enters the hull, and from where to where it is followed. */
Entry entry_of(int surfel, vec3 ray) {
  Entry e;
  mat3 derivative;
  vec4 table = texelFetch(surfel_place, at(surfel), 0);
  e.canonical = table.xyz;
  e.camera = carried(e.canonical, derivative);
  e.there = sound(determinant(derivative));
  mat3 back = e.there ? inverse(derivative) : mat3(0.0);
  e.along = dot(e.camera, ray);
  e.beside = back * (e.along * ray - e.camera);
  vec3 normal = texelFetch(surfel_normal, at(surfel), 0).xyz;
  e.direction = e.there ? back * ray : -normal; // a folded hull is looked at from straight above
  float falling = dot(normal, e.direction), shallow = -0.5 * steepest;
  float hit = -dot(normal, e.beside) / min(falling, shallow);
  e.enter = e.along + clamp(falling < shallow ? hit : 0.0, -slack_m, slack_m);
  float cosine = max(-falling, steepest);
  float lead = min(lead_m / cosine, most_lead_m * unsquashed(e.direction));
  float sine = 1.0 - falling * falling / max(dot(e.direction, e.direction), 1e-12);
  e.begin = e.enter - lead;
  float bent = min(cosine, squash_limit);
  e.end = e.begin + min(table.w * min((sine * grazing + 1.0) / bent, lengthened) + lead, longest_m);
  return e;
}

vec3 start_of(Entry e) { return e.canonical + e.beside + (e.begin - e.along) * e.direction; }
`;

const FIRST = `
layout(location = 0) out vec4 color;
layout(location = 1) out vec4 extent; // depth that the next layer must exceed, end, surfel
void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  int key = key_at(pixel);
  int side = int(footprint_side(near)); // two pixels so far away tell a hole
  int across = max(key_at(pixel - ivec2(side, 0)), key_at(pixel + ivec2(side, 0)));
  int along = max(key_at(pixel - ivec2(0, side)), key_at(pixel + ivec2(0, side)));
  int neighbours = min(across, along);
  int steps = int(hole_m / (2.0 * reach_m) * float(DEPTH_STEPS));
  if (key - (steps << SURFEL_BITS) > neighbours) key = neighbours;
  color = vec4(0.0);
  extent = vec4(1e6, 0.0, 0.0, 0.0);
  if (key == FAR) return;
  int surfel = key & SURFEL_MASK;
  vec3 ray = ray_of(pixel);
  Entry e = entry_of(surfel, ray);
  color = march(ray, e.begin, e.end, start_of(e), e.direction);
  bool wanted = layers > 1 && 1.0 - color.a > transmitted;
  extent = vec4(wanted ? e.enter * ray.z + gap_m : 1e6, e.end, float(surfel), 1.0);
}`;

const FURTHER = `
uniform sampler2D first_color; // of the layer before
uniform sampler2D first_extent;
layout(location = 0) out vec4 color;
layout(location = 1) out vec4 extent; // as in the first layer
void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  color = texelFetch(first_color, pixel, 0);
  extent = vec4(1e6, 0.0, 0.0, 0.0);
  int key = key_at(pixel);
  if (key == FAR) return;
  vec4 before = texelFetch(first_extent, pixel, 0);
  vec3 ray = ray_of(pixel);
  int surfel = key & SURFEL_MASK;
  Entry e = entry_of(surfel, ray);
  mat3 unused;
  vec3 first = texelFetch(surfel_place, at(int(before.z)), 0).xyz;
  bool one_sheet = distance(e.canonical, first) < distance(e.camera, carried(first, unused)) * same_share + same_m;
  if (one_sheet) e.begin = min(max(e.begin, before.y), e.end);
  float stride = (e.end - e.begin) / float(second_block);
  vec4 found = sampled(start_of(e), e.direction, stride, 1.0, second_block);
  if (e.there) color += (1.0 - color.a) * vec4(found.rgb, 1.0 - found.a);
  extent = vec4(1.0 - color.a > transmitted ? e.enter * ray.z + gap_m : 1e6, e.end, float(surfel), 1.0);
}`;

const SHOWN = `
uniform sampler2D first_color;
layout(location = 0) out vec4 rgba;
void main() {
  vec4 color = texelFetch(first_color, ivec2(gl_FragCoord.xy), 0);
  rgba = clamp(vec4(color.rgb / max(color.a, 1e-6), color.a), 0.0, 1.0);
}`;

const WHOLE_SCREEN = `
void main() {
  vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
  gl_Position = vec4(corner, 0.0, 1.0);
}`;

const NOTHING = `layout(location = 0) out vec4 nothing;
void main() { nothing = vec4(0.0); }`;

const behind = (source) => source.replace("es\n", "es\n#define BEHIND\n");

/** Sources of the seven passes, [vertex, fragment] each. */
export function sources(note) {
  const head = COMMON + constants(note);
  const surfels = head + POSING + SURFEL;
  const shading = head + POSING + SURFEL + LOOKUP + MARCH + SHADE;
  return {
    nodes: [head + WHOLE_SCREEN, head + NODES],
    nearest: [surfels + NEAREST, head + NOTHING],
    splat: [surfels + SIDE + SPLAT, head + SPLATTED],
    first: [head + WHOLE_SCREEN, shading + SIDE + FIRST],
    behind: [behind(surfels + SIDE + SPLAT), behind(surfels + SPLATTED)],
    further: [head + WHOLE_SCREEN, shading + FURTHER],
    shown: [head + WHOLE_SCREEN, head + SHOWN],
  };
}
