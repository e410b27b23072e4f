// Draws pictures in a worker, which runs the package's ONNX graph on the CPU.

import { fetched } from "./package.js";

const MOST_THREADS = 4; // fast cores of a phone
const TRIED_PICTURES = 7; // drawn with more threads, too
const PAYS = 0.8; // time of a picture with more threads, in those of one, below which they pay for their cores

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
    this.tables = new WorkerClient(new URL("./tables_worker.js", import.meta.url));
    this.opened = {};
    this.graphs = this.start(1, onProgress); // before there is a package: the runtime takes longest
  }

  /** A worker whose runtime has started (`loaded`), on some threads. */
  start(threads, onProgress) {
    const graphs = new WorkerClient(new URL("./graph_worker.js", import.meta.url));
    const module = fetched(new URL("./runtime/ort.wasm.zlib", import.meta.url), onProgress, "deflate");
    graphs.threads = threads;
    graphs.loaded = module.then((wasm) => graphs.ask("load", { wasm, threads }, [wasm]));
    graphs.loaded.catch(() => {}); // awaited when a tier is opened
    return graphs;
  }

  /** Take a package's file, its graphs and its tiers; the promise of the avatar's heights (`heights`). */
  take({ buffer, graphs, tiers }) {
    Object.assign(this, { tiers, graphOf: graphs });
    this.taken = this.tables.ask("take", { buffer });
    return this.taken;
  }

  /** Prepare a tier; its first picture is drawn by another graph, `coarse`, if there is one of that name. */
  open(tier, coarse) {
    if (!this.opened[tier]) this.onProgress({ preparing: true });
    this.opened[tier] ??= this.prepare(this.graphs, tier, this.graphOf[coarse]).catch((error) => {
      delete this.opened[tier];
      throw error;
    });
    return this.opened[tier];
  }

  async prepare(graphs, tier, coarse) {
    const decoded = this.taken.then(() => this.tables.ask("decode", { tier }));
    const [{ tables }] = await Promise.all([decoded, graphs.loaded]);
    const held = Object.values(tables).map((table) => table.buffer);
    await graphs.ask("open", { tier, graph: this.graphOf[tier], coarse, tables }, held);
  }

  /** Where the page is isolated, draw some pictures twice, also on several threads; whether it goes on with these. */
  spread() {
    return (this.spreading ??= this.tryThreads());
  }

  async tryThreads() {
    const threads = Math.min(MOST_THREADS, navigator.hardwareConcurrency >> 1); // half of a phone's cores are slow
    if (!crossOriginIsolated || threads < 2) return false;
    const other = this.start(threads), tiers = Object.keys(this.opened);
    for (const tier of tiers) await this.prepare(other, tier);
    return new Promise((decided) => { this.trial = { other, tiers, times: [], decided }; });
  }

  /** Compare a picture with that of the worker on trial, in vain once another tier was opened. */
  async compare(shot, ms) {
    const { trial } = this, { other, times } = trial;
    const isCurrent = () => Object.keys(this.opened).length === trial.tiers.length;
    this.trial = null; // until it is drawn
    if (isCurrent()) times.push((await other.ask("draw", shot).catch(() => ({ ms: Infinity }))).ms / ms);
    if (isCurrent() && times.length < TRIED_PICTURES) {
      this.trial = trial;
      return;
    }
    const pays = isCurrent() && times.sort((a, b) => a - b)[TRIED_PICTURES >> 1] < PAYS;
    (pays ? this.graphs : other).ask("end", {}); // after what it still draws
    if (pays) this.graphs = other;
    trial.decided(pays);
  }

  close() {
    for (const { worker } of [this.graphs, this.tables]) worker.terminate();
  }

  /** Draw straight-alpha RGBA of width × height: {rgba, ms}. */
  async draw(tier, shot) {
    const samples = shot.samples ?? this.tiers[tier].settings.samples;
    const { rgba, ms } = await this.graphs.ask("draw", { tier, ...shot, samples });
    if (this.trial) await this.compare({ tier, ...shot, samples }, ms);
    return { rgba: new Uint8ClampedArray(rgba), ms };
  }
}
