// The worker's side of WorkerClient (engine.js).

/** Answer calls by name, one after the other; a function returns [answer, transferred buffers] or nothing. */
export function answer(functions) {
  let before = Promise.resolve();
  onmessage = ({ data: { number, kind, ...given } }) => {
    before = before.then(async () => {
      try {
        const [found, transferred] = (await functions[kind](given)) ?? [{}, []];
        postMessage({ number, ...found }, transferred);
      } catch (error) {
        postMessage({ number, failed: String((error && error.message) || error) });
      }
    });
  };
}
