// The avatar's arrays as they lie on the server: bytes in planes, deflated.

const KINDS = {
  float32: Float32Array, int32: Int32Array, uint32: Uint32Array, uint16: Uint16Array,
  uint8: Uint8Array, int8: Int8Array,
};

/** Load one array. entry: {file, dtype, shape}; arrived: called with the number of packed bytes. */
export async function load(entry, arrived = () => {}) {
  const answer = await fetched(entry.file);
  const counted = new TransformStream({
    transform(chunk, out) { arrived(chunk.length); out.enqueue(chunk); },
  });
  const unpacked = answer.body.pipeThrough(counted).pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(unpacked).arrayBuffer().catch(() => {
    throw new Error(`${entry.file} arrived damaged or incomplete. Load the page again; if that changes nothing, write its folder again.`);
  }));
  const Kind = KINDS[entry.dtype];
  const count = entry.shape.reduce((product, size) => product * size, 1);
  if (planes.length !== count * Kind.BYTES_PER_ELEMENT) {
    throw new Error(`${entry.file} is damaged: it holds ${planes.length} bytes.`);
  }
  return new Kind(interleaved(planes, Kind.BYTES_PER_ELEMENT).buffer);
}

/** Fetch a file of the page. */
export async function fetched(file) {
  const gone = () => { throw new Error(`${file} could not be loaded: the server does not answer. Is it still running?`); };
  const answer = await fetch(new URL(file, import.meta.url)).catch(gone);
  if (!answer.ok) throw new Error(`${file} could not be loaded (${answer.status}): the page's folder is not whole.`);
  return answer;
}

/** Interleave byte planes (first bytes of all elements, then all second ones, …) to elements. */
function interleaved(planes, width) {
  if (width === 1) return planes;
  const count = planes.length / width;
  const bytes = new Uint8Array(planes.length);
  for (let plane = 0; plane < width; plane++) {
    for (let from = plane * count, to = plane; to < bytes.length; from++, to += width) {
      bytes[to] = planes[from];
    }
  }
  return bytes;
}
