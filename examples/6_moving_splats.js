// An avatar's splats, moved in Spark by the skeleton of its mesh in three.js.
// The mesh is the same avatar's .glb: splats take the skinning weights of the vertices near them.
import { Matrix4, Quaternion, Vector3, Vector4 } from "three";
import { SplatSkinning } from "@sparkjsdev/spark";

const REACH = 0.02; // metres within which vertices count
const JOINTS = 4;   // of a splat, as Spark has it

/** Bind splats (canonical pose) to a THREE.SkinnedMesh; returns a function that follows its pose. */
export const followSkeleton = (splats, mesh) => {
  const skinning = new SplatSkinning({ mesh: splats, numBones: mesh.skeleton.bones.length });
  const weightsAt = nearbyWeights(mesh);
  splats.forEachSplat((index, center) => {
    const found = weightsAt(center);
    skinning.setSplatBones(index, new Vector4(...found.joints), new Vector4(...found.weights));
  });
  splats.skinning = skinning;
  splats.updateGenerator(); // its shader is built again, with the skin
  const moved = new Matrix4(), place = new Vector3(), turn = new Quaternion(), size = new Vector3();
  return () => {
    mesh.skeleton.bones.forEach((bone, joint) => {
      moved.multiplyMatrices(bone.matrixWorld, mesh.skeleton.boneInverses[joint]);
      moved.decompose(place, turn, size);
      skinning.setBoneQuatPos(joint, turn, place);
    });
    skinning.updateBones();
  };
};

/** A function from a place in the canonical pose to the four joints that move it most. */
const nearbyWeights = ({ geometry, skeleton }) => {
  const { position, skinIndex, skinWeight } = geometry.attributes;
  const cell = (value) => Math.floor(value / REACH);
  const key = (x, y, z) => (x + 512) + 1024 * ((y + 512) + 1024 * (z + 512));
  const cells = new Map();
  for (let vertex = 0; vertex < position.count; vertex++) {
    const [x, y, z] = [position.getX(vertex), position.getY(vertex), position.getZ(vertex)];
    const place = key(cell(x), cell(y), cell(z));
    if (!cells.has(place)) cells.set(place, []);
    cells.get(place).push({ vertex, x, y, z });
  }
  const around = [-1, 0, 1];
  return ({ x, y, z }) => {
    const sums = new Float64Array(skeleton.bones.length);
    let nearest = null, least = Infinity;
    for (const i of around) for (const j of around) for (const k of around) {
      for (const near of cells.get(key(cell(x) + i, cell(y) + j, cell(z) + k)) ?? []) {
        const squared = (near.x - x) ** 2 + (near.y - y) ** 2 + (near.z - z) ** 2;
        if (squared < least) [nearest, least] = [near.vertex, squared];
        add(sums, near.vertex, Math.max(0, 1 - squared / REACH ** 2) ** 4);
      }
    }
    if (nearest === null) nearest = nearestOfAll(x, y, z); // a splat away from the surface
    add(sums, nearest, 1e-6); // if none lies within reach
    const order = [...sums.keys()].sort((a, b) => sums[b] - sums[a]).slice(0, JOINTS);
    const total = order.reduce((sum, joint) => sum + sums[joint], 0);
    return { joints: order, weights: order.map((joint) => sums[joint] / total) };
  };
  function nearestOfAll(x, y, z) {
    let nearest = 0, least = Infinity;
    for (let vertex = 0; vertex < position.count; vertex++) {
      const aside = position.getX(vertex) - x, above = position.getY(vertex) - y;
      const squared = aside ** 2 + above ** 2 + (position.getZ(vertex) - z) ** 2;
      if (squared < least) [nearest, least] = [vertex, squared];
    }
    return nearest;
  }
  function add(sums, vertex, share) {
    for (let slot = 0; slot < JOINTS; slot++) {
      sums[skinIndex.getComponent(vertex, slot)] += share * skinWeight.getComponent(vertex, slot);
    }
  }
};
