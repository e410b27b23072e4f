// The page: buttons, settings and words around the playback.

import "./ia-avatar.js";
import { fetched, readMotion } from "./package.js";
import { QUICK_MS } from "./playback.js";

const TIERS = { hq: "Full", lite: "Lite" };
const BACKGROUNDS = { "As the page": "", White: "#ffffff", Grey: "#8c8c8c", Black: "#000000", Green: "#00b140" };
const THEMES = { system: "System", light: "Light", dark: "Dark" };
const SAID_MS = 6000;
const TRIED_MS = 1000; // time in which a page finds out what the device manages
const FULL_COSTS = 1.7; // time of a picture in Full, in pictures in Lite
const BAR_PX = 76; // the bar's height and the gap below it
const $ = (id) => document.getElementById(id);

export function start() {
  const loading = new Loading(), avatar = $("picture"), { state } = avatar;
  $("name").textContent = document.title;
  state.barPx = BAR_PX;
  const options = new URLSearchParams(location.search);
  state.tier = options.get("start") ?? "hq";
  avatar.addEventListener("progress", ({ detail }) => loading.onProgress(detail));
  avatar.addEventListener("failed", ({ detail }) => loading.failed(detail.message));
  avatar.addEventListener("picture", ({ detail }) => tell(detail, avatar.player));
  avatar.addEventListener("picture", () => parent.postMessage("drawn", location.origin), { once: true });
  avatar.addEventListener("ready", ({ detail: { player } }) => {
    $("licence").textContent = player.avatar.licence;
    settings(player, state, avatar.playback, loading);
    transport(player, state, avatar.playback, avatar.orbit);
    window.player = player; // for scripts: verify(), measure()
    markPlaying(state);
    loading.done();
    setTimeout(() => adapt(player, state, avatar.playback, loading), TRIED_MS);
  });
  if (options.has("warm-up")) { // out of sight: draws one coarse picture and one sharp one
    avatar.toggleAttribute("paused", true);
    state.chosen = true;
    avatar.seen(true);
  } else if (!avatar.loading) avatar.load(); // also where it is not seen yet
  document.addEventListener("keydown", (event) => { // before anything was clicked
    const { key, ctrlKey, metaKey, altKey } = event;
    if (event.target === document.body) avatar.dispatchEvent(new KeyboardEvent("keydown", { key, ctrlKey, metaKey, altKey }));
  });
}

/** Draw with more threads where the device is slow and they pay, and in Full where it is fast, unless a tier was chosen. */
async function adapt(player, state, playback, loading) {
  const isQuick = () => playback.typicalMs() * (state.tier === "hq" ? 1 : FULL_COSTS) <= QUICK_MS;
  if (state.chosen) return;
  if (!isQuick() && await player.engine.spread().catch(() => false)) { // or there is no room for another worker
    playback.took = [];
    await new Promise((resolve) => setTimeout(resolve, TRIED_MS));
  }
  if (state.chosen || state.tier === "hq" || !isQuick()) return;
  const opened = player.open({ tier: "hq" });
  loading.done(); // there is a picture meanwhile
  await opened;
  if (state.chosen) return;
  state.tier = "hq";
  playback.changed();
  markTier(state);
}

function markTier(state) {
  for (const input of document.getElementsByName("tiers")) input.checked = input.value === state.tier;
}

/** The status shown while a tier is being loaded. */
class Loading {
  constructor() {
    this.bytes = this.total = 0;
  }

  onProgress({ total = 0, arrived = 0, preparing }) {
    if ($("status").classList.contains("failed")) return; // other files may still be coming
    this.bytes += arrived;
    this.total += total;
    const [done, all] = [this.bytes, Math.max(this.bytes, this.total)].map((bytes) => (bytes / 1e6).toFixed(1));
    $("status").hidden = false;
    $("status-bar").value = preparing ? 1 : Math.min(1, this.bytes / Math.max(1, this.total));
    $("status-text").textContent = preparing ? "Preparing …" : `Loading ${done} of ${all} MB`;
  }

  done() {
    $("status").hidden = true;
  }

  /** Report a failed request; the picture stays. */
  showError(message) {
    this.failed(message);
    setTimeout(() => { $("status").hidden = true; $("status").classList.remove("failed"); }, SAID_MS);
  }

  failed(message) {
    $("status").hidden = false;
    $("status").classList.add("failed");
    $("status-text").textContent = message;
  }
}

function tell({ row, ms, rate, playing }, player) {
  const second = (value) => (value / player.fps).toFixed(1);
  $("timeline").value = row;
  $("time").textContent = `${second(row)} / ${second(player.count)} s`;
  const figures = { ms: `${ms.toFixed(0)} ms`, ...(playing && { fps: `${rate} fps` }) };
  $("rate").replaceChildren(...Object.entries(figures).map(([className, textContent]) => (
    Object.assign(document.createElement("span"), { className, textContent })
  )));
}

/** Radio buttons; chosen is called with the value. */
function choices(fieldset, values, current, chosen, dress = (span, label) => { span.textContent = label; }) {
  const box = fieldset.querySelector(".choices");
  for (const [value, label] of Object.entries(values)) {
    const [line, input, span] = ["label", "input", "span"].map((tag) => document.createElement(tag));
    Object.assign(input, { type: "radio", name: fieldset.id, value, checked: value === current });
    input.addEventListener("change", () => chosen(value));
    dress(span, label, value, input);
    line.append(input, span);
    box.append(line);
  }
  fieldset.hidden = Object.keys(values).length < 2;
  return box;
}

const known = (names, there) => Object.fromEntries(there.map((name) => [name, names[name] ?? name]));

function settings(player, state, playback, loading) {
  const changeTier = async (tier) => {
    state.chosen = true;
    try {
      await player.open({ tier });
      state.tier = tier;
      playback.changed();
      loading.done();
    } catch (error) {
      loading.showError(error.message);
      markTier(state);
    }
  };
  choices($("tiers"), known(TIERS, Object.keys(player.avatar.tiers)), state.tier, changeTier);
  choices($("themes"), THEMES, "system", (theme) => { document.documentElement.dataset.theme = theme; });
  backgrounds();
  $("motions").hidden = $("motions").length < 2;
  $("motions").onchange = async () => {
    try {
      player.drive(await readMotion(await fetched($("motions").value)));
      $("timeline").max = player.count - 1;
      playback.seek(0);
      playback.play(true);
      markPlaying(state);
    } catch (error) {
      loading.showError(error.message);
    }
  };
  $("sharpness").onchange = () => { state.sharpness = $("sharpness").value; playback.changed(); };
  $("speed").onchange = () => { state.speed = Number($("speed").value); };
  $("check").onclick = () => check(player);
  $("save").onclick = () => save(document.title, playback);
}

function backgrounds() {
  const paint = (color) => document.documentElement.style.setProperty("--stage", color || "var(--paper)");
  const names = Object.fromEntries(Object.entries(BACKGROUNDS).map(([name, color]) => [color, name]));
  const box = choices($("backgrounds"), names, "", paint, (span, name, color, input) => {
    span.style.background = color || "linear-gradient(135deg, #fbfaf7 50%, #181715 50%)";
    span.title = name;
    input.setAttribute("aria-label", name);
  });
  const other = document.createElement("input");
  Object.assign(other, { type: "color", value: "#203040", title: "Another color" });
  other.setAttribute("aria-label", "Another color");
  other.oninput = () => {
    for (const input of box.querySelectorAll("input[type=radio]")) input.checked = false;
    paint(other.value);
  };
  box.append(other);
}

async function check(player) {
  $("checked").textContent = "Drawing the golden frames …";
  try {
    const found = await player.verify();
    const alike = found.filter((each) => each.alike).length;
    const worst = Math.max(...found.map((each) => each.largest));
    $("checked").textContent = alike === found.length
      ? `All ${alike} golden frames look the same here (largest difference ${worst.toFixed(0)}/255).`
      : `${found.length - alike} of ${found.length} golden frames look DIFFERENT here.`;
  } catch (error) {
    $("checked").textContent = error.message;
  }
}

/** The picture as it is shown, with its alpha. */
function save(name, playback) {
  playback.canvas.toBlob((blob) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = `${name}-${String(playback.row).padStart(4, "0")}.png`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  });
}

function markPlaying({ playing }) {
  $("play").classList.toggle("playing", playing);
  $("play").setAttribute("aria-label", playing ? "Pause" : "Play");
}

function transport(player, state, playback, orbit) {
  const play = (playing) => { playback.play(playing); markPlaying(state); };
  const step = (by) => { play(false); playback.seek(playback.row + by); };
  $("timeline").max = player.count - 1;
  $("timeline").oninput = () => { play(false); playback.seek(Number($("timeline").value)); };
  $("play").onclick = () => play(!state.playing);
  $("front").onclick = () => { orbit.reset(); playback.changed(); };
  document.addEventListener("visibilitychange", () => { playback.began = undefined; });
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const typing = event.target.closest("button, select, #panel");
    if (event.key === " " && !typing) { event.preventDefault(); play(!state.playing); }
    if (event.key === ",") step(-1);
    if (event.key === ".") step(1);
  });
}
