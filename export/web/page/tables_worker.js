// Decodes a package's tables, beside the worker that starts the runtime.

import { decodeTables, heights, readStreams, unzip } from "./package.js";
import { answer } from "./worker_calls.js";

let tiers, streams;

/** Take a package's file; the answer: heights of the avatar. */
async function take({ buffer }) {
  const entries = unzip(buffer);
  ({ tiers } = JSON.parse(new TextDecoder().decode(await entries["manifest.json"]())));
  streams = await readStreams(entries);
  return [heights(streams, tiers.hq.layout), []];
}

function decode({ tier }) {
  const voxels = streams.voxels.slice(); // decoded in place
  const tables = decodeTables({ ...streams, voxels }, tiers.hq.layout, tiers[tier].settings.skinning_subdivision);
  return [{ tables }, Object.values(tables).map((table) => table.buffer)];
}

answer({ take, decode });
