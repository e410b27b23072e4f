// Whoever draws: asks a worker, which runs the ONNX graph on the CPU or shaders on the GPU.

const WORKERS = { wasm: "./graph_worker.js", webgl: "./shader_worker.js" };

export class Engine {
  /** heard: called with {arrived: bytes} and {preparing: true} while a tier is being opened. */
  constructor(kind, avatar, heard) {
    this.avatar = avatar;
    this.waiting = new Map();
    this.next = 0;
    this.worker = new Worker(new URL(WORKERS[kind], import.meta.url), { type: "module" });
    this.worker.onmessage = ({ data }) => {
      if (data.number === undefined) return heard(data);
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

  async open(tier) {
    await this.ask("open", { tier, note: this.avatar.tiers[tier], runtime: this.avatar.runtime });
  }

  /** Straight-alpha RGBA of width × height, and the milliseconds it took. */
  async draw(tier, shot) {
    const samples = shot.samples ?? this.avatar.tiers[tier].rules.samples;
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

const SOFTWARE = /swiftshader|llvmpipe|software|basic render|softpipe/i;

/** Whether there is WebGL2 with float targets, and whether hardware is behind it. */
export function graphics() {
  const gl = typeof OffscreenCanvas !== "undefined" && document.createElement("canvas").getContext("webgl2");
  if (!gl || !gl.getExtension("EXT_color_buffer_float")) return { there: false, hardware: false };
  const told = gl.getExtension("WEBGL_debug_renderer_info");
  const name = told ? gl.getParameter(told.UNMASKED_RENDERER_WEBGL) : gl.getParameter(gl.RENDERER);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return { there: true, hardware: !SOFTWARE.test(name), name };
}
