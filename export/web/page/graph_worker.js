// Runs the package's own ONNX graph in WebAssembly, away from the page.

import { InferenceSession, Tensor, env } from "./runtime/ort.js";
import { answer } from "./worker_calls.js";

const sessions = {}, finer = {}; // by tier; what to make before each of the next pictures

/** Start the runtime, a WebAssembly module. */
async function load({ wasm, threads }) {
  env.wasm.numThreads = threads;
  env.wasm.wasmBinary = wasm;
  env.logLevel = "fatal";
  await InferenceSession.create(new Uint8Array()).catch(() => {}); // no graph, but the runtime has started
  env.logLevel = "error";
}

async function open({ tier, graph, coarse, tables }) {
  sessions[tier] = await sessionOf(coarse ?? graph, tables);
  if (coarse) finer[tier] = [null, () => sessionOf(graph, tables)];
}

function sessionOf(graph, tables) {
  return InferenceSession.create(graph, {
    executionProviders: ["wasm"],
    graphOptimizationLevel: "disabled", // they take longer than they win: half of loading, 2 % of a picture
    executionMode: "parallel", // still one thread, but reuse of memory is not planned: 60 % of loading
    externalData: Object.entries(tables).map(([path, data]) => ({ path, data: new Uint8Array(data.buffer) })),
  });
}

async function draw({ tier, bones, camera, width, height, samples }) {
  const whole = (number) => new Tensor("int64", BigInt64Array.of(BigInt(number)), []);
  const make = finer[tier]?.shift(), coarse = sessions[tier];
  if (make) {
    sessions[tier] = await make();
    await coarse.release();
  }
  const began = performance.now();
  const { rgba } = await sessions[tier].run({
    bones: new Tensor("float32", bones, [24, 12]),
    camera: new Tensor("float32", Float32Array.from(camera), [4]),
    height: whole(height), width: whole(width), samples: whole(samples),
  });
  const { buffer } = rgba.data;
  return [{ rgba: buffer, ms: performance.now() - began }, [buffer]];
}

answer({ load, open, draw, end: () => close() });
