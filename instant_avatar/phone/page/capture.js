// The page: a film of the camera app, a file or the page's own camera in; an avatar out.

import { Growing, Stored, ask, send } from "./upload.js";

const $ = (id) => document.getElementById(id);
const COUNTDOWN_S = 5;
const PIECE_MS = 100; // length of what the camera hands over at once
const SPOKEN_AGAIN_MS = 9000;
const OFFERED_MS = 120000; // time in which a person may go on with a film after the page was loaded again
const HEARTBEAT_MS = 5000; // a film ends when nothing is heard of its page
const KINDS = ["video/webm;codecs=h264", "video/mp4;codecs=avc1.42E01E", "video/webm;codecs=vp8", "video/webm", "video/mp4"];
let resume = null, adding = "", making = "", facing = "environment", stream = null, shown = "", playing = "";

function view(name) {
  for (const id of ["home", "filming", "done"]) $(id).hidden = id !== name;
  $(name).focus({ preventScroll: true }); // what was pressed is hidden
  scrollTo(0, 0);
}

/** Offer to film a new person, or more of one whose avatar exists. */
function home(name = "") {
  adding = name;
  $("adding").textContent = `The next film is added to ${name}.`;
  $("back").textContent = `Back to ${name}`;
  $("adding").hidden = $("back").hidden = !name;
  $("naming").hidden = Boolean(name);
  view("home");
}

function warn(text) {
  $("warning").textContent = text;
  $("warning").hidden = false;
}

let spoken = "", spokenAt = 0;
function say(text) {
  $("advice").textContent = text;
  if (!$("speak").checked || !window.speechSynthesis || (text === spoken && Date.now() - spokenAt < SPOKEN_AGAIN_MS)) return;
  spoken = text; spokenAt = Date.now();
  speechSynthesis.cancel();
  speechSynthesis.speak(new SpeechSynthesisUtterance(text));
}

/** Begin a film; resolves when it is its turn. */
async function begin(type, size) {
  viewFilm();
  const body = JSON.stringify({ name: $("name").value, type, size, avatar: adding });
  const { film, avatar } = await ask("films", { method: "POST", body });
  await follow(film, avatar);
  return film;
}

function viewFilm() {
  view("filming");
  $("map").replaceChildren(); $("preview").hidden = true; $("preview").removeAttribute("src"); $("seconds").textContent = $("seen").textContent = $("sent").textContent = ""; $("progress").value = 0;
}

/** Listen to what the server tells of a film; resolves when it is its turn. */
async function follow(film, avatar) {
  making = avatar;
  const events = new EventSource(`films/${film}/messages`);
  const on = (kind, act) => events.addEventListener(kind, (event) => act(JSON.parse(event.data)));
  on("advice", ({ text, time }) => { if ($("offer").hidden) say(text); $("advice").dataset.time = time; });
  on("seconds", ({ seconds }) => {
    $("seconds").textContent = `${seconds.toFixed(0)} s looked at`;
    if (making && making === shown) $("note").textContent = `Making the avatar: ${$("seconds").textContent} …`; // a stored film
  });
  on("map", ({ svg, seen }) => { $("map").innerHTML = svg; $("seen").textContent = `${Math.round(100 * seen)} % of you seen`; });
  on("preview", ({ image }) => {
    $("preview").src = image; $("preview").hidden = false;
    if (making && making === shown) Object.assign($("poster"), { src: image, hidden: false });
  });
  on("progress", ({ text, share }) => { $("progress").value = share; if (shown === avatar) $("note").textContent = `${text} …`; });
  on("warning", ({ text }) => warn(text));
  let opened = false;
  on("avatar", ({ name, final }) => {
    if (opened && ($("done").hidden || shown !== name)) return; // a person films again, or looks at another avatar
    opened = true;
    making = "";
    open(name, final ? "It is ready." : "It can be played; finer detail follows.", final);
  });
  on("failed", ({ text }) => { making = shown = ""; finish(); home(); warn(text); });
  on("over", () => { events.close(); listEarlier(); });
  await new Promise((resolve) => on("state", ({ state, behind }) => {
    if (state === "waiting" && $("offer").hidden) say(`Waiting for ${behind.join(", ")} …`);
    if (state === "filming") resolve();
    if (state === "done" && shown === avatar) $("note").textContent = "It is ready.";
  }));
  play(avatar);
}

/** Go on with a film that this browser began before the page was loaded again. */
async function recall() {
  const begun = (await ask("films")).at(-1);
  if (!begun || $("home").hidden) return;
  const { film, avatar, size, received, ended } = begun, path = `films/${film}`;
  viewStored();
  follow(film, avatar);
  const file = ended ? null : await offer(path, begun);
  $("offer").hidden = true;
  if (file) await transfer(film, new Stored(file));
  else learn((await ask(`${path}/end?size=${received}`, { method: "POST" })).reason);
}

/** Let a person choose how a film ends; resolves with the rest of it, a file, or null. */
async function offer(path, { avatar, size, received }) {
  const megabytes = (bytes) => (bytes / 1e6).toFixed(1);
  $("advice").textContent = size
    ? `This page was loaded again when ${megabytes(received)} of ${megabytes(size)} MB of ${avatar} were sent. Choose the same video: the rest follows.`
    : `This page was loaded again while it filmed ${avatar}. What was filmed until then is kept; “Film more” adds to its avatar.`;
  $("same").hidden = !size;
  $("offer").hidden = false;
  const heartbeat = setInterval(() => ask(path, { once: true }).catch(() => {}), HEARTBEAT_MS);
  const file = await new Promise((resolve) => {
    resume = (given) => { if (given.size === size) resolve(given); else warn(`That is another video: ${avatar} has ${megabytes(size)} MB.`); };
    $("same").onclick = () => { $("stored").value = ""; $("stored").click(); };
    $("finish").onclick = () => resolve(null);
    setTimeout(() => resolve(null), OFFERED_MS);
  });
  resume = null;
  clearInterval(heartbeat);
  return file;
}

/** Start the player of an avatar; before there is one, it waits for the film's package. */
function play(name) {
  playing = name;
  $("player").src = `avatars/${encodeURIComponent(name)}/?start=lite`;
}

const hasFailed = () => $("player").contentDocument?.querySelector("#status.failed");

async function transfer(film, source) {
  const reason = await send(film, source, (bytes) => {
    $("sent").textContent = `${(bytes / 1e6).toFixed(1)} MB sent`;
    if (source instanceof Stored) $("progress").value = bytes / source.end;
  });
  learn(reason);
}

/** Show what is made of a film that has come, or why it ended early. */
function learn(reason) {
  if (making) {
    say("Making the avatar …");
    open(making, "Making the avatar …");
  }
  if (reason) warn(reason);
}

/** The view of a film without a camera. */
function viewStored() {
  viewFilm();
  $("stage").classList.add("ended");
  $("stop").hidden = $("turn").hidden = true;
}

async function upload(file) {
  if (!file) return;
  if (resume) {
    resume(file);
    return;
  }
  viewStored();
  try {
    const film = await begin(file.type || "video/mp4", file.size);
    say("Learning while the film arrives …");
    await transfer(film, new Stored(file));
  } catch (error) {
    home(adding);
    warn(error.message);
  }
}

async function openCamera() {
  finish();
  const video = { facingMode: facing, width: { ideal: 1280 }, height: { ideal: 720 }, frameRate: { ideal: 30 }, resizeMode: "none" }; // not cropped
  stream = await navigator.mediaDevices.getUserMedia({ video, audio: false });
  $("camera").srcObject = stream;
  $("camera").classList.toggle("front", facing === "user");
}

function finish() {
  for (const track of stream?.getTracks() ?? []) track.stop();
  stream = null;
  $("camera").srcObject = null;
}

async function live() {
  if (document.documentElement.dataset.live === "elsewhere" && !window.isSecureContext) {
    location.href = "live";
    return;
  }
  window.speechSynthesis?.speak(new SpeechSynthesisUtterance("")); // iOS speaks only once it has in a tap
  try {
    $("stage").classList.remove("ended"); $("stop").hidden = true; $("turn").hidden = false;
    await openCamera();
    const type = KINDS.find((kind) => MediaRecorder.isTypeSupported(kind)) ?? "";
    const film = await begin(type || "video/mp4", null);
    for (let left = Number(new URLSearchParams(location.search).get("countdown") ?? COUNTDOWN_S); left > 0; left--) {
      $("countdown").textContent = left;
      say(left === COUNTDOWN_S ? "Step into the outline." : $("advice").textContent);
      await new Promise((resolve) => setTimeout(resolve, 1000));
    }
    $("countdown").textContent = "";
    $("turn").hidden = true;
    await record(film, type);
  } catch (error) {
    finish();
    home(adding);
    warn(error.name === "NotAllowedError" ? "The camera may not be used: allow it in the browser's settings for this page." : error.message);
  }
}

async function record(film, type) {
  const source = new Growing();
  const recorder = new MediaRecorder(stream, { ...(type && { mimeType: type }), videoBitsPerSecond: 8e6 });
  recorder.ondataavailable = ({ data }) => { if (data.size) source.add(data); };
  recorder.onstop = () => { source.finish(); finish(); $("stage").classList.add("ended"); };
  recorder.start(PIECE_MS);
  $("stop").hidden = false;
  $("stop").onclick = () => { $("stop").hidden = true; recorder.stop(); };
  const lock = await navigator.wakeLock?.request("screen").catch(() => null);
  await transfer(film, source);
  await lock?.release();
}

/** Show an avatar: its poster until the player has drawn, the older player until a finer one has. */
function open(name, note, final = false) {
  finish();
  adding = "";
  const address = `avatars/${encodeURIComponent(name)}/`, isFirst = $("done").hidden || shown !== name;
  $("offers").inert = Boolean(making);
  $("player").classList.toggle("early", Boolean(making)); // it waits for the package
  if (isFirst) {
    view("done");
    $("poster").hidden = Boolean(making) && !$("preview").src;
    if (playing !== name || hasFailed()) play(name);
    playing = "";
  }
  $("poster").src = making ? $("preview").src : `${address}poster.png`;
  if (final && !isFirst) {
    const finer = $("player").cloneNode();
    Object.assign(finer, { src: `${address}?start=hq`, className: "coming", id: "" });
    $("player").after(finer);
  }
  shown = name;
  if (!making && document.documentElement.dataset.player === "missing") {
    warn("This page cannot draw avatars yet: the terminal of the computer says what it needs. Reload the page then.");
  }
  $("title").textContent = name;
  $("note").textContent = note;
  for (const [id, file] of [["package", "avatar.iavatar"], ["glb", "avatar.glb"], ["spz", "avatar.spz"], ["ply", "avatar.ply"], ["obj", "avatar.obj"]]) {
    $(id).href = address + file;
  }
  $("author").oninput = () => { $("vrm").href = `${address}avatar.vrm?author=${encodeURIComponent($("author").value)}`; };
  $("author").oninput();
  $("share").onclick = () => share(name);
  $("more").onclick = () => home(name);
  $("back").onclick = () => open(name, "");
}

addEventListener("message", ({ source, origin, data }) => {
  if (origin !== location.origin || data !== "drawn") return;
  if (source === $("warm-up")?.contentWindow) return;
  $("poster").hidden = true;
  $("warm-up")?.remove(); // the others share what it has compiled
  const finer = document.querySelector(".coming");
  if (finer?.contentWindow !== source) return;
  $("player").remove();
  Object.assign(finer, { className: "", id: "player" });
});

/** Save a file for other programs, which the computer makes when it is wanted: half a minute of its time. */
async function save(event) {
  event.preventDefault();
  const link = event.currentTarget, { href, textContent } = link, name = shown;
  if (link.ariaBusy === "true") return; // pressed again
  link.ariaBusy = "true";
  $("saving").textContent = `Making the ${textContent} of ${name}: half a minute on an idle computer, longer while it learns …`;
  $("saving").hidden = false;
  try {
    const answer = await fetch(href);
    if (!answer.ok) throw new Error((await answer.json()).message);
    const address = URL.createObjectURL(await answer.blob());
    Object.assign(document.createElement("a"), { href: address, download: `${name}.${link.id}` }).click();
    $("saving").textContent = `The ${textContent} of ${name} is saved.`;
  } catch (error) {
    $("saving").hidden = true;
    warn(`The ${textContent} was not saved: ${error.message}`);
  }
  link.ariaBusy = "false";
}

async function share(name) {
  const blob = await (await fetch($("package").href)).blob();
  const file = new File([blob], `${name}.iavatar`, { type: "application/zip" });
  if (navigator.canShare?.({ files: [file] })) await navigator.share({ files: [file], title: name }).catch(() => {});
  else $("package").click();
}

async function listEarlier() {
  const names = await ask("avatars");
  $("earlier").hidden = !names.length;
  $("avatars").replaceChildren(...names.map((name) => {
    const [item, button, image] = ["li", "button", "img"].map((tag) => document.createElement(tag));
    Object.assign(image, { src: `avatars/${encodeURIComponent(name)}/poster.png`, alt: "", loading: "lazy" });
    button.type = "button";
    button.append(image, name);
    button.onclick = () => open(name, "");
    item.append(button);
    return item;
  }));
}

for (const id of ["glb", "vrm", "spz", "ply", "obj"]) $(id).onclick = save;
$("file").onchange = () => upload($("file").files[0]);
$("stored").onchange = () => upload($("stored").files[0]);
$("live").onclick = live;
$("turn").onclick = () => { facing = facing === "user" ? "environment" : "user"; openCamera().catch((error) => warn(error.message)); };
$("again").onclick = () => { $("name").value = ""; home(); };
$("live").hidden = document.documentElement.dataset.live === "no" && !window.isSecureContext;
$("why").hidden = document.documentElement.dataset.live !== "elsewhere" || window.isSecureContext;
for (const kind of ["dragover", "dragleave", "drop"]) {
  document.addEventListener(kind, (event) => {
    event.preventDefault();
    document.body.classList.toggle("over", kind === "dragover");
    if (kind === "drop") upload(event.dataTransfer.files[0]);
  });
}
for (const kind of ["click", "drop"]) addEventListener(kind, () => { $("warning").hidden = true; }, true); // seen
listEarlier();
recall().catch((error) => { home(); warn(error.message); });
