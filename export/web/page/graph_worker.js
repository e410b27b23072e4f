// Runs the package's own ONNX graph in WebAssembly, one thread, away from the page.

import { InferenceSession, Tensor, env } from "./runtime/ort.js";
import { load } from "./arrays.js";

const sessions = {};

async function open({ tier, note, runtime }) {
  if (sessions[tier]) return;
  const files = [runtime, note.graph, ...note.tables].map((entry) => load(entry, (bytes) => postMessage({ arrived: bytes })));
  const [wasm, graph, ...tables] = await Promise.all(files);
  env.wasm.numThreads = 1;
  env.wasm.wasmBinary ??= wasm;
  env.logLevel = "error";
  postMessage({ preparing: true });
  sessions[tier] = await InferenceSession.create(graph, {
    executionProviders: ["wasm"],
    externalData: tables.map((data, i) => ({ path: note.tables[i].name, data: new Uint8Array(data.buffer) })),
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

// "open" and "draw" are answered one after the other; draw returns {rgba: ArrayBuffer, ms}.
let before = Promise.resolve();
onmessage = ({ data: { number, kind, ...given } }) => {
  before = before.then(async () => {
    try {
      const found = (await (kind === "open" ? open(given) : draw(given))) ?? {};
      postMessage({ number, ...found }, found.rgba ? [found.rgba] : []);
    } catch (error) {
      postMessage({ number, failed: String((error && error.message) || error) });
    }
  });
};
