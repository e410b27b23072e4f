// Draws pictures in a worker, which runs the package's ONNX graph on the CPU.

export class Engine {
  /** onProgress: called with {total} and {arrived} bytes, and {preparing: true} as a tier is opened. */
  constructor(avatar, { streams, graphs }, onProgress) {
    this.avatar = avatar;
    this.waiting = new Map();
    this.next = 0;
    this.worker = new Worker(new URL("./graph_worker.js", import.meta.url), { type: "module" });
    this.worker.onmessage = ({ data }) => {
      if (data.number === undefined) return onProgress(data);
      const { resolve, reject } = this.waiting.get(data.number);
      this.waiting.delete(data.number);
      return data.failed ? reject(new Error(data.failed)) : resolve(data);
    };
    this.worker.onerror = (event) => {
      const error = new Error(event.message || "The player's worker could not be started.");
      for (const { reject } of this.waiting.values()) reject(error);
      this.waiting.clear();
    };
    this.loaded = this.ask("load", { streams, graphs, tiers: avatar.tiers });
  }

  async open(tier) {
    await this.loaded;
    await this.ask("open", { tier });
  }

  close() {
    this.worker.terminate();
  }

  /** Draw straight-alpha RGBA of width × height: {rgba, ms}. */
  async draw(tier, shot) {
    const samples = shot.samples ?? this.avatar.tiers[tier].settings.samples;
    const { rgba, ms } = await this.ask("draw", { tier, ...shot, samples });
    return { rgba: new Uint8ClampedArray(rgba), ms };
  }

  ask(kind, content) {
    const number = this.next++;
    return new Promise((resolve, reject) => {
      this.waiting.set(number, { resolve, reject });
      this.worker.postMessage({ number, kind, ...content });
    });
  }
}
