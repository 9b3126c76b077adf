// A session: positions of the tip go out, replies come in. The frames are those of PROTOCOL.md.

import { Refused, getJson, sessionAddress } from "./service.js";

const VERSION = 2;
const SIZES = { uint16: 2, uint32: 4, int32: 4, float32: 4, float64: 8 };
const GETTERS = {
  uint16: "getUint16", uint32: "getUint32", int32: "getInt32", float32: "getFloat32",
  float64: "getFloat64",
};
const LONGEST_WAIT = 5000; // ms between attempts to connect

/** Values of half precision by their bits. */
const HALVES = Float32Array.from({ length: 65536 }, (_, bits) => {
  const exponent = (bits >> 10) & 31, fraction = (bits & 1023) / 1024;
  const size = exponent === 0 ? fraction * 2 ** -14
    : exponent === 31 ? (fraction ? NaN : Infinity) : (1 + fraction) * 2 ** (exponent - 15);
  return bits & 0x8000 ? -size : size;
});

/** Reads replies by the layout that the greeting of a session states. */
class Reader {
  constructor(layout) {
    this.layout = layout;
    this.bits = layout.outputs;
  }

  read(buffer) {
    const view = new DataView(buffer), reply = {};
    for (const { name, type, shape, offset } of this.layout.reply.fields) {
      const get = (i) => view[GETTERS[type]](offset + SIZES[type] * i, true);
      reply[name] = shape.length
        ? Array.from({ length: shape.reduce((a, b) => a * b) }, (_, i) => get(i)) : get(0);
    }
    let at = this.layout.reply.size;
    const take = (Type, count) => {
      const found = new Type(buffer, at, count);
      at += found.byteLength;
      return found;
    };
    const has = (name) => reply.outputs & this.bits[name];
    const numbers = (count) => (has("HALF")
      ? Float32Array.from(take(Uint16Array, count), (bits) => HALVES[bits])
      : take(Float32Array, count));
    if (has("COORDINATES")) take(Float32Array, 4 * reply.coordinates);
    if (has("PARTS")) {
      const [models, modes, dented] = take(Uint32Array, 4);
      reply.parts = {
        models: take(Int32Array, models), states: take(Float32Array, models * modes), modes,
        dented: take(Int32Array, dented), dent: take(Float32Array, 3 * dented),
      };
    }
    if (has("DISPLACEMENT")) reply.displacement = numbers(3 * reply.nodes);
    if (has("VON_MISES")) reply.stress = numbers(reply.nodes);
    reply.measured = has("STRESS") !== 0;
    if (at !== buffer.byteLength) throw new Refused(0, "garbage", "A reply makes no sense.");
    for (const [name, bit] of Object.entries(this.layout.flags)) {
      reply[name] = (reply.flags & bit) !== 0;
    }
    return reply;
  }
}

/**
 * Keeps a session with a scene open, and says how it stands.
 *
 * `on.greeting(greeting)`, `on.reply(reply, roundTrip, frames)`, `on.obeyed(command, value)` and
 * `on.state(state, words)` are called;
 * states are "open", "waiting" (for the service), "refused" and "closed".
 */
export class Session {
  constructor(scene, on) {
    Object.assign(this, { scene, on, sequence: 0, sent: new Map(), wait: 250, ended: false });
    this.connect();
  }

  get ready() {
    return this.socket?.readyState === WebSocket.OPEN && this.reader && this.sent.size === 0;
  }

  async connect() {
    this.reader = null;
    this.sent.clear();
    try {
      await getJson(`scenes/${encodeURIComponent(this.scene)}`); // says why, if it is refused
      const address = await sessionAddress(this.scene);
      if (this.ended) return;
      this.socket = new WebSocket(address);
    } catch (error) {
      this.again(error.message, error.status >= 400 && error.status < 500);
      return;
    }
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = ({ data }) => this.take(data);
    this.socket.onclose = ({ code, reason }) => {
      if (!this.ended) this.again(reason || (code === 1006 ? "" : `code ${code}`));
    };
  }

  /** Try to connect again in a while, unless the service has refused for good. */
  again(why, forGood = false) {
    this.reader = null;
    if (this.ended) return;
    const words = why ? `: ${why}` : "";
    this.on.state(forGood ? "refused" : "waiting", forGood ? why
      : `The connection is lost${words}. Trying again …`);
    this.timer = setTimeout(() => this.connect(), this.wait);
    this.wait = Math.min(2 * this.wait, LONGEST_WAIT);
  }

  take(data) {
    if (typeof data !== "string") {
      const reply = this.reader.read(data), { at, request } = this.sent.get(reply.seq);
      this.sent.clear(); // those before it were passed over for it
      const head = new Uint8Array(data, 0, this.reader.layout.reply.size);
      this.on.reply(reply, performance.now() - at, { request, reply: head.slice() });
      return;
    }
    const said = JSON.parse(data);
    if (said.layout) {
      if (said.layout.version !== VERSION) {
        this.close();
        this.on.state("refused", "The service speaks another version; reload the page.");
        return;
      }
      this.wait = 250;
      this.reader = new Reader(said.layout);
      this.on.state("open", "");
      this.on.greeting(said);
    } else if (said.error) {
      this.sent.clear();
      this.on.state("open", said.error.message);
    } else {
      for (const [name, value] of Object.entries(said)) this.on.obeyed(name, value);
    }
  }

  /** Ask for the answer at a position (mm); `outputs` are names of what is wanted. */
  send(position, outputs) {
    const { request } = this.reader.layout, view = new DataView(new ArrayBuffer(request.size));
    const bits = outputs.reduce((sum, name) => sum | this.reader.bits[name], 0);
    this.sequence = (this.sequence + 1) >>> 0;
    view.setUint16(0, VERSION, true);
    view.setUint16(2, bits, true);
    view.setUint32(4, this.sequence, true);
    view.setFloat64(8, performance.now() / 1000, true);
    position.forEach((x, i) => view.setFloat64(16 + 8 * i, x, true));
    this.sent.set(this.sequence, { at: performance.now(), request: new Uint8Array(view.buffer) });
    this.socket.send(view.buffer);
  }

  /** Let the service keep the state of the tissue, or go back to it. */
  command(name, number = 0) {
    if (this.reader) this.socket.send(JSON.stringify({ [name]: number }));
  }

  close() {
    this.ended = true;
    clearTimeout(this.timer);
    this.socket?.close(1000);
  }
}
