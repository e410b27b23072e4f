// Mouse, touch and keys on the picture move the camera.

const TURN = 0.008; // radians a pixel
const STEP = 0.12; // radians a key press

/** orbit: returns the camera to move; changed: called after each movement. */
export function listen(canvas, orbit, changed) {
  const fingers = new Map();

  const spread = () => {
    const [a, b] = [...fingers.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(a.x - b.x, a.y - b.y) };
  };

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });

  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY };
    if (fingers.size === 2) {
      const old = spread();
      fingers.set(event.pointerId, now);
      const { x, y, apart } = spread();
      orbit().shift(x - old.x, y - old.y, canvas.clientWidth, canvas.clientHeight);
      if (old.apart > 0) orbit().nearer(apart / old.apart);
    } else {
      fingers.set(event.pointerId, now);
      const [x, y] = [now.x - before.x, now.y - before.y];
      if (event.buttons & 6 || event.shiftKey) orbit().shift(x, y, canvas.clientWidth, canvas.clientHeight);
      else orbit().turn(-TURN * x, TURN * y);
    }
    changed();
  });

  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && canvas.getAttribute("orbit") !== "wheel") return; // the page scrolls
    event.preventDefault();
    orbit().nearer(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)));
    changed();
  }, { passive: false });
  canvas.addEventListener("dblclick", () => { orbit().reset(); changed(); });

  canvas.addEventListener("keydown", (event) => {
    const act = {
      ArrowLeft: () => orbit().turn(STEP, 0), ArrowRight: () => orbit().turn(-STEP, 0),
      ArrowUp: () => orbit().turn(0, STEP), ArrowDown: () => orbit().turn(0, -STEP),
      "+": () => orbit().nearer(1.15), "=": () => orbit().nearer(1.15), "-": () => orbit().nearer(1 / 1.15),
      Home: () => orbit().reset(),
    }[event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
    changed();
  });
  return true;
}
