// The worker's half of an engine: answers "open" and "draw", one after the other.

/** open and draw take what the page sent; draw returns {rgba: ArrayBuffer, ms}. */
export function answer({ open, draw }) {
  let before = Promise.resolve();
  onmessage = ({ data: { number, kind, ...given } }) => {
    before = before.then(async () => {
      try {
        const found = (await (kind === "open" ? open(given) : draw(given))) ?? {};
        postMessage({ number, ...found }, found.rgba ? [found.rgba] : []);
      } catch (error) {
        postMessage({ number, failed: String((error && error.message) || error) });
      }
    });
  };
}

export const arrived = (bytes) => postMessage({ arrived: bytes });
export const preparing = () => postMessage({ preparing: true });
