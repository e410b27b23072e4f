// Runs the package's own ONNX graph in WebAssembly, one thread, away from the page.

import { InferenceSession, Tensor, env } from "./runtime/ort.js";
import { decodeTables, fetched, inflated } from "./package.js";

const sessions = {};
let package_, wasm;

/** Take the package's graphs, streams and manifest; fetch the runtime. */
async function load({ streams, graphs, tiers }) {
  package_ = { streams, graphs, tiers };
  const packed = await fetched(new URL("./runtime/ort.wasm.zlib", import.meta.url), (news) => postMessage(news));
  wasm = await inflated(packed, "deflate");
}

async function open({ tier }) {
  if (sessions[tier]) return;
  const { streams, graphs, tiers } = package_, { layout } = tiers.hq;
  env.wasm.numThreads = 1;
  env.wasm.wasmBinary ??= wasm;
  env.logLevel = "error";
  postMessage({ preparing: true });
  const voxels = streams.voxels.slice(); // decoded in place
  const tables = decodeTables({ ...streams, voxels }, layout, tiers[tier].settings.skinning_subdivision);
  sessions[tier] = await InferenceSession.create(graphs[tier], {
    executionProviders: ["wasm"],
    graphOptimizationLevel: "basic",
    executionMode: "parallel", // still one thread, but reuse of memory is not planned: 60 % of loading
    externalData: Object.entries(tables).map(([path, data]) => ({ path, data: new Uint8Array(data.buffer) })),
  });
}

async function draw({ tier, bones, camera, width, height, samples }) {
  const whole = (number) => new Tensor("int64", BigInt64Array.of(BigInt(number)), []);
  const began = performance.now();
  const { rgba } = await sessions[tier].run({
    bones: new Tensor("float32", bones, [24, 12]),
    camera: new Tensor("float32", Float32Array.from(camera), [4]),
    height: whole(height), width: whole(width), samples: whole(samples),
  });
  return { rgba: rgba.data.buffer, ms: performance.now() - began };
}

// "load", "open" and "draw" are answered one after the other; draw returns {rgba: ArrayBuffer, ms}.
let before = Promise.resolve();
onmessage = ({ data: { number, kind, ...given } }) => {
  before = before.then(async () => {
    try {
      const found = (await { load, open, draw }[kind](given)) ?? {};
      postMessage({ number, ...found }, found.rgba ? [found.rgba] : []);
    } catch (error) {
      postMessage({ number, failed: String((error && error.message) || error) });
    }
  });
};
