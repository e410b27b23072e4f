// Sends a film in pieces, a file or what is being filmed, and goes on after any break.

const PIECE = 2 << 20; // bytes
const LONGEST_WAIT_MS = 4000; // between two attempts

/** What is being filmed: pieces that have come and were not received yet. */
export class Growing {
  constructor() {
    this.start = 0; this.parts = []; this.end = 0; this.ended = false; this.wake = () => {};
  }

  add(blob) {
    this.parts.push(blob); this.end += blob.size; this.wake();
  }

  finish() {
    this.ended = true; this.wake();
  }

  /** Bytes from an offset on; waits until there are some, null after the end. */
  async slice(offset) {
    while (this.parts.length && this.start + this.parts[0].size <= offset) this.start += this.parts.shift().size;
    while (this.end <= offset) {
      if (this.ended) return null;
      await new Promise((resolve) => { this.wake = resolve; });
    }
    return new Blob(this.parts).slice(offset - this.start, offset - this.start + PIECE);
  }
}

/** A file as it lies there. */
export class Stored {
  constructor(file) {
    this.file = file; this.end = file.size;
  }

  async slice(offset) {
    return offset < this.end ? this.file.slice(offset, offset + PIECE) : null;
  }
}

export class Refused extends Error {}

async function refusal(answer) {
  const { message } = await answer.json().catch(() => ({}));
  return new Refused(message ?? `The computer answered with error ${answer.status}: its terminal says more.`);
}

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/** Ask the server until it answers; a refusal is an error, a broken connection is not. */
export async function ask(path, options = {}) {
  for (let wait = 250; ; wait = Math.min(2 * wait, LONGEST_WAIT_MS)) {
    let answer;
    try {
      answer = await fetch(path, options);
    } catch { /* the connection is broken */ }
    if (answer && answer.ok) return answer.json();
    if (answer && answer.status !== 429 && answer.status < 502) throw await refusal(answer);
    if (options.once) return null;
    if (answer && answer.status === 507) throw await refusal(answer);
    await pause(wait);
  }
}

/** Send a film to its end; the server names the piece that it needs next, and why a film ended early. */
export async function send(film, source, onProgress) {
  const path = `films/${film}`;
  let state = { next: 0 };
  for (;;) {
    const piece = await source.slice(state.next);
    if (!piece) {
      state = await ask(`${path}/end?size=${source.end}`, { method: "POST" });
      if (state.ended) return state.reason;
      continue;
    }
    const sent = await ask(`${path}?offset=${state.next}`, { method: "PUT", body: piece, once: true });
    if (!sent) await pause(500);
    state = sent ?? await ask(path); // what came through before the break counts
    onProgress(state.received);
    if (state.ended) return state.reason;
  }
}
