// <ia-avatar src="avatar.iavatar" motion="dance.npz" orbit>: an avatar in any page, from this one module.
//
// src: a package; motion: poses (.npz with global_orient, body_pose, transl; or poses, trans), without
// which it stands; orbit: mouse, touch and keys turn it, the wheel once it was clicked (at once if
// "wheel"); paused: it does not start by itself, nor does it for those who prefer reduced motion.
// It loads when it comes near the viewport, shows the package's preview meanwhile, and rests out of
// sight. Events: "progress", "ready" (detail.player), "picture", "failed". Beside this module lie its
// parts and runtime/ (onnxruntime-web), as `ia-play avatar.iavatar --web --out FOLDER` writes them.

import { listen } from "./gestures.js";
import { Orbit } from "./orbit.js";
import { Playback } from "./playback.js";
import { Player } from "./player.js";

const NEAR = "200px"; // distance from the viewport at which loading begins
const LABEL = "An avatar.", KEYS = " Arrow keys turn it, plus and minus zoom, Home shows it from the front.";
const style = new CSSStyleSheet(); // an element would need style-src 'unsafe-inline'
style.replaceSync(`
  :host { display: block; position: relative; min-height: 4em; outline-offset: -2px; }
  :host([hidden]) { display: none; }
  :host([orbit]) { cursor: grab; touch-action: pan-y; }
  :host([orbit]:active) { cursor: grabbing; }
  canvas { position: absolute; width: 100%; height: 100%; object-fit: contain; display: block; }
  p { position: absolute; inset: auto 1em 1em; margin: 0; text-align: center; }
  p:empty { display: none; }
`);

export class IaAvatar extends HTMLElement {
  static observedAttributes = ["src", "motion"];

  constructor() {
    super();
    const root = this.attachShadow({ mode: "open" });
    root.adoptedStyleSheets = [style];
    root.innerHTML = "<canvas></canvas><p role=status part=message></p>";
    [this.canvas, this.message] = root.children;
    this.state = { tier: "hq", sharpness: "auto", playing: false, speed: 1, barPx: 0, inSight: false };
    this.watch = new IntersectionObserver((news) => this.seen(news.at(-1).isIntersecting), { rootMargin: NEAR });
  }

  connectedCallback() {
    if (!this.hasAttribute("role")) this.setAttribute("role", "img");
    if (!this.hasAttribute("aria-label")) this.setAttribute("aria-label", LABEL + (this.hasAttribute("orbit") ? KEYS : ""));
    if (this.hasAttribute("orbit") && !this.hasAttribute("tabindex")) this.tabIndex = 0;
    this.watch.observe(this);
  }

  disconnectedCallback() {
    this.watch.disconnect();
    this.close();
  }

  attributeChangedCallback() {
    this.close();
    if (this.state.inSight) this.load();
  }

  seen(inSight) {
    this.state.inSight = inSight;
    if (inSight && !this.loading) this.load();
    this.playback?.play(this.state.playing);
  }

  /** Load what the attributes name; the promise of the Player, which "ready" announces. */
  load() {
    if (!this.hasAttribute("src")) return undefined;
    const url = (name) => this.hasAttribute(name) && new URL(this.getAttribute(name), document.baseURI);
    const mine = (this.loading = this.open(url("src"), url("motion"), () => this.loading !== mine));
    mine.catch((error) => { if (this.loading === mine) this.fail(error); });
    return mine;
  }

  async open(src, motion, isStale) {
    await null; // this.loading is set before anything else happens
    this.message.textContent = "";
    const progress = (news) => { if (!isStale()) this.tell("progress", news); };
    const player = await Player.load(src, motion, progress, (blob) => { if (!isStale()) this.preview(blob); });
    if (!(this.state.tier in player.avatar.tiers)) this.state.tier = "hq";
    await player.open(this.state, true);
    if (isStale()) return player.engine.close();
    const orbit = new Orbit(player.avatar.look);
    Object.assign(this, { player, orbit });
    this.playback = new Playback(this.canvas, player, orbit, this.state, (news) => (
      news.failed ? this.fail(news.failed) : this.tell("picture", news)
    ));
    if (this.hasAttribute("orbit") && !this.listening) this.listening = listen(this, () => this.orbit, () => this.playback?.changed());
    const calm = this.hasAttribute("paused") || matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.playback.play(player.count > 1 && !calm);
    this.playback.run();
    this.tell("ready", { player });
    return player;
  }

  /** Show the package's own small picture until the first one is drawn. */
  async preview(blob) {
    const image = await createImageBitmap(blob);
    if (this.playback) return;
    const bar = this.state.barPx / Math.max(1, this.clientHeight - this.state.barPx);
    Object.assign(this.canvas, { width: image.width, height: image.height * (1 + bar) });
    this.canvas.getContext("2d").drawImage(image, 0, 0);
  }

  play(playing = true) {
    this.playback?.play(playing);
  }

  pause() {
    this.play(false);
  }

  fail(error) {
    this.message.textContent = error.message;
    this.tell("failed", error);
  }

  tell(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  close() {
    this.playback?.stop();
    this.player?.engine.close();
    this.loading = this.playback = this.player = undefined;
  }
}

customElements.define("ia-avatar", IaAvatar);
