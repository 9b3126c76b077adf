// Requests to the service, its refusals, and the binary layout of its answers.

const BINARY = "application/octet-stream";
const MAGIC = 0x504c5054;
const TOKEN = "palpate-token";
const TYPES = {
  float64: Float64Array, float32: Float32Array, int32: Int32Array, int16: Int16Array,
  uint8: Uint8Array,
};

/** A request that the service refused, or that did not reach it (status 0). */
export class Refused extends Error {
  constructor(status, code, message) {
    super(message);
    this.status = status;
    this.code = code;
  }
}

let asking = null;

/** Send a request; return the response. Asks for the token where the service wants one. */
async function send(path, options = {}) {
  for (;;) {
    const token = sessionStorage.getItem(TOKEN);
    const headers = { ...options.headers, ...(token && { Authorization: `Bearer ${token}` }) };
    let response;
    try {
      response = await fetch(path, { ...options, headers });
    } catch {
      throw new Refused(0, "unreachable", "The service does not answer.");
    }
    if (response.ok) return response;
    const { code, field, message } = await refusal(response);
    if (code !== "unauthorized") {
      throw new Refused(response.status, code, field ? `${field}: ${message}` : message);
    }
    asking ??= askForToken(token !== null).finally(() => { asking = null; });
    await asking;
  }
}

async function refusal(response) {
  try {
    return (await response.json()).error;
  } catch {
    return { code: "unknown", field: "", message: `The service says ${response.status}.` };
  }
}

/** Ask the person for the token, which is kept until the browser's tab is closed. */
function askForToken(again) {
  const dialog = document.getElementById("ask");
  dialog.querySelector("#wrong").hidden = !again;
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.querySelector("form").onsubmit = () => {
      const field = dialog.querySelector("input");
      sessionStorage.setItem(TOKEN, field.value.trim());
      field.value = "";
      resolve();
    };
  });
}

export async function getJson(path) {
  return (await send(path, { headers: { Accept: "application/json" } })).json();
}

/** Get a document of the binary layout: `{head, arrays}`. */
export async function getArrays(path) {
  const response = await send(path, { headers: { Accept: BINARY } });
  return decode(await response.arrayBuffer());
}

export async function postForArrays(path, body) {
  const headers = { Accept: BINARY, "Content-Type": "application/json" };
  const response = await send(path, { method: "POST", headers, body: JSON.stringify(body) });
  return decode(await response.arrayBuffer());
}

/** Send a document of the binary layout; return the file that comes back. */
export async function postArrays(path, head, arrays) {
  const headers = { "Content-Type": BINARY };
  const response = await send(path, { method: "POST", headers, body: encode(head, arrays) });
  return response.blob();
}

/** Address of a session; with a ticket where the service asks for a token. */
export async function sessionAddress(scene) {
  const address = new URL(`scenes/${encodeURIComponent(scene)}/session`, document.baseURI);
  address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
  address.hash = "";
  if (sessionStorage.getItem(TOKEN)) {
    const { ticket } = await (await send("tickets", { method: "POST" })).json();
    if (ticket) address.searchParams.set("ticket", ticket);
  }
  return address.href;
}

/** Write the binary layout; arrays are typed, wider ones first. */
function encode(head, arrays) {
  let offset = 0;
  const entries = Object.entries(arrays).map(([name, array]) => {
    const [dtype] = Object.entries(TYPES).find(([, Type]) => array instanceof Type);
    offset += array.byteLength;
    return { name, dtype, shape: [array.length], offset: offset - array.byteLength };
  });
  const text = new TextEncoder().encode(JSON.stringify({ ...head, arrays: entries }));
  const padded = new Uint8Array(8 * Math.ceil(text.length / 8)).fill(0x20);
  padded.set(text);
  const prefix = new DataView(new ArrayBuffer(16));
  prefix.setUint32(0, MAGIC);
  prefix.setUint16(4, 1, true);
  prefix.setUint16(6, entries.length, true);
  prefix.setUint32(8, padded.length, true);
  prefix.setUint32(12, offset, true);
  return new Blob([prefix, padded, ...Object.values(arrays)]);
}

/** Read the binary layout: a prefix of 16 bytes, a head in JSON, arrays viewed in place. */
export function decode(buffer) {
  const wrong = new Refused(0, "garbage", "The service's answer makes no sense.");
  const view = new DataView(buffer);
  if (buffer.byteLength < 16 || view.getUint32(0) !== MAGIC) throw wrong;
  const start = 16 + view.getUint32(8, true);
  if (start + view.getUint32(12, true) !== buffer.byteLength) throw wrong;
  try {
    const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 16, start - 16)));
    const arrays = {};
    for (const { name, dtype, shape, offset } of head.arrays) {
      const count = shape.reduce((product, n) => product * n, 1);
      arrays[name] = new TYPES[dtype](buffer, start + offset, count);
    }
    return { head, arrays };
  } catch {
    throw wrong;
  }
}
