// Draws as fast as it can while something moves, then one sharp picture, then nothing.

import { roomIn } from "./orbit.js";

export const QUICK_MS = 45; // below this a moving picture may become sharper …
const SLOW_MS = 75; // … and above this it becomes coarser
const COARSEST = 270, SHARPEST = 1080; // shorter side, pixels
const STILL_MS = 180; // delay of the sharp picture after the last movement

export class Playback {
  /** state: {tier, sharpness, playing, speed, barPx, inSight}; onNews: called for every picture and failure. */
  constructor(canvas, player, orbit, state, onNews) {
    Object.assign(this, { canvas, player, orbit, state, onNews });
    this.context = canvas.getContext("2d");
    this.row = 0; this.time = 0; this.moving = 540;
    this.shown = []; this.took = []; this.wake = () => {}; this.dirty = true; this.touched = 0; this.sharp = false;
    this.resized = new ResizeObserver(() => this.changed());
    this.resized.observe(canvas);
  }

  /** Request another picture. */
  changed() {
    this.dirty = true; this.sharp = false; this.touched = performance.now();
    this.wake();
  }

  seek(row) {
    const { count, fps } = this.player;
    this.row = ((row % count) + count) % count;
    this.time = this.row / fps;
    this.changed();
  }

  play(playing) {
    this.state.playing = playing;
    this.began = undefined;
    this.changed();
  }

  stop() {
    this.stopped = true;
    this.resized.disconnect();
    this.wake();
  }

  async run() {
    while (!this.stopped) {
      if (!this.state.inSight) {
        await new Promise((resolve) => { this.wake = resolve; });
        continue;
      }
      if (this.state.playing) this.advance();
      else if (!this.dirty && !(await this.settled())) continue;
      this.dirty = false;
      try {
        await this.picture(this.size());
      } catch (error) {
        return this.stopped || this.onNews({ failed: error });
      }
    }
  }

  /** Wait for a request; true when the sharp picture is due. */
  async settled() {
    if (this.sharp || this.state.sharpness !== "auto") {
      await new Promise((resolve) => { this.wake = resolve; });
      return this.dirty || this.state.playing;
    }
    const rest = STILL_MS - (performance.now() - this.touched);
    if (rest > 0) {
      await new Promise((resolve) => { this.wake = resolve; setTimeout(resolve, rest); });
      return this.dirty;
    }
    this.sharp = true;
    return true;
  }

  advance() {
    const now = performance.now();
    const { count, fps } = this.player;
    this.time += this.began === undefined ? 0 : (this.state.speed * (now - this.began)) / 1000;
    this.time %= count / fps;
    this.began = now;
    this.row = Math.min(count - 1, Math.floor(this.time * fps));
  }

  /** Pixels of the picture: the stage's own shape. */
  size() {
    const [wide, high] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const shorter = Math.max(1, Math.min(wide, high));
    const device = Math.min(SHARPEST, shorter * (window.devicePixelRatio || 1));
    const { sharpness } = this.state;
    const wanted = sharpness !== "auto" ? Number(sharpness) : this.sharp ? device : Math.min(this.moving, device);
    const scale = wanted / shorter;
    return [Math.max(16, Math.round(wide * scale)), Math.max(16, Math.round(high * scale))];
  }

  async picture([wide, high]) {
    const { player, orbit, state, row } = this;
    const pose = player.pose(row);
    const room = roomIn(this.canvas.clientHeight, state.barPx);
    const camera = player.drawable(state, pose, orbit.camera(pose, wide, high, room));
    const { width, height } = camera;
    const part = await player.draw(state, pose, camera);
    if (this.stopped) return;
    if (this.canvas.width !== width || this.canvas.height !== height) {
      Object.assign(this.canvas, { width, height });
    } else {
      this.context.clearRect(0, 0, width, height);
    }
    if (part) this.context.putImageData(new ImageData(part.rgba, part.width, part.height), part.x, part.y);
    if (part) this.took = [...this.took.slice(-30), part.ms];
    if (part && state.playing) this.adapt(part.ms);
    this.onNews({ row, ms: part ? part.ms : 0, rate: this.rate(), playing: state.playing });
    // lets the browser paint, clicks and keys come in
    await new Promise((resolve) => { const { port1, port2 } = new MessageChannel(); port1.onmessage = resolve; port2.postMessage(0); });
  }

  /** Median time of a picture so far, milliseconds; infinite before the first one. */
  typicalMs() {
    const sorted = [...this.took].sort((a, b) => a - b);
    return sorted[sorted.length >> 1] ?? Infinity;
  }

  /** Sharper or coarser, so that movement stays fluent. */
  adapt(ms) {
    const factor = ms > SLOW_MS ? 0.9 : ms < QUICK_MS ? 1.04 : 1;
    this.moving = Math.max(COARSEST, Math.min(SHARPEST, this.moving * factor));
  }

  /** Pictures shown in the last second. */
  rate() {
    const now = performance.now();
    this.shown.push(now);
    while (this.shown[0] < now - 1000) this.shown.shift();
    return this.shown.length;
  }
}
