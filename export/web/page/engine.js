// Draws pictures in a worker, which runs the package's ONNX graph on the CPU.

import { fetched } from "./package.js";

/** Calls functions of a worker by name (worker_calls.js). */
class WorkerClient {
  constructor(url) {
    this.waiting = new Map();
    this.next = 0;
    this.worker = new Worker(url, { type: "module" });
    this.worker.onmessage = ({ data }) => {
      const { resolve, reject } = this.waiting.get(data.number);
      this.waiting.delete(data.number);
      return data.failed ? reject(new Error(data.failed)) : resolve(data);
    };
    this.worker.onerror = (event) => {
      const error = new Error(event.message || "The player's worker could not be started.");
      for (const { reject } of this.waiting.values()) reject(error);
      this.waiting.clear();
    };
  }

  ask(kind, content, transferred = []) {
    const number = this.next++;
    return new Promise((resolve, reject) => {
      this.waiting.set(number, { resolve, reject });
      this.worker.postMessage({ number, kind, ...content }, transferred);
    });
  }
}

export class Engine {
  /** onProgress: called with {total} and {arrived} bytes, and {preparing: true} as a tier is opened. */
  constructor(onProgress) {
    this.onProgress = onProgress;
    this.graphs = new WorkerClient(new URL("./graph_worker.js", import.meta.url));
    this.tables = new WorkerClient(new URL("./tables_worker.js", import.meta.url));
    this.opened = {};
    this.loaded = this.start(); // before there is a package: the runtime takes longest
    this.loaded.catch(() => {}); // awaited when a tier is opened
  }

  async start() {
    const wasm = await fetched(new URL("./runtime/ort.wasm.zlib", import.meta.url), this.onProgress, "deflate");
    await this.graphs.ask("load", { wasm }, [wasm]);
  }

  /** Take a package's file, its graphs and its tiers; the promise of the avatar's heights (`heights`). */
  take({ buffer, graphs, tiers }) {
    Object.assign(this, { tiers, graphOf: graphs });
    this.taken = this.tables.ask("take", { buffer });
    return this.taken;
  }

  /** Prepare a tier; its first picture is drawn by another graph, `coarse`, if there is one of that name. */
  open(tier, coarse) {
    this.opened[tier] ??= this.prepare(tier, this.graphOf[coarse]).catch((error) => {
      delete this.opened[tier];
      throw error;
    });
    return this.opened[tier];
  }

  async prepare(tier, coarse) {
    this.onProgress({ preparing: true });
    const decoded = this.taken.then(() => this.tables.ask("decode", { tier }));
    const [{ tables }] = await Promise.all([decoded, this.loaded]);
    const held = Object.values(tables).map((table) => table.buffer);
    await this.graphs.ask("open", { tier, graph: this.graphOf[tier], coarse, tables }, held);
  }

  close() {
    for (const { worker } of [this.graphs, this.tables]) worker.terminate();
  }

  /** Draw straight-alpha RGBA of width × height: {rgba, ms}. */
  async draw(tier, shot) {
    const samples = shot.samples ?? this.tiers[tier].settings.samples;
    const { rgba, ms } = await this.graphs.ask("draw", { tier, ...shot, samples });
    return { rgba: new Uint8ClampedArray(rgba), ms };
  }
}
