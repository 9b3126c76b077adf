// Recordings: what a session answers, as CSV and HDF5, and positions of one that are played again.

import { postArrays } from "./service.js";

const COLUMNS = [
  "time", "asked_x", "asked_y", "asked_z", "x", "y", "z", "force_x", "force_y", "force_z",
  "flags", "error_displacement", "error_von_mises", "error_force",
];
const MOST = 90000; // answers: some 25 minutes of a page; the service takes 100 000 at once
const ORDERS = ["snapshot", "restore", "young"]; // by their numbers in the HDF5 file
const AFTER = 0.2; // s that the last position of a recording is played

/**
 * Answers as they come from the beginning of a session: a CSV file of them is what `palpate
 * identify` reads, in s, mm and mN; an HDF5 file is what `palpate replay` answers again.
 */
export class Recording {
  constructor(scene, now) {
    const kept = { rows: [], requests: [], replies: [], received: [], commands: [] };
    Object.assign(this, { scene, start: now, greeting: null, ...kept });
  }

  take(now, asked, reply, frames) {
    if (this.rows.length >= MOST) return;
    this.requests.push(frames.request);
    this.replies.push(frames.reply);
    this.received.push(now);
    this.rows.push([
      now - this.start, ...asked, ...reply.position, ...reply.force, reply.flags,
      reply.error_displacement, reply.error_von_mises, reply.error_force,
    ]);
  }

  obeyed(name, value) {
    this.commands.push([this.rows.length, ORDERS.indexOf(name), value]);
  }

  csv() {
    const lines = [COLUMNS, ...this.rows].map((row) => `${row.join()}\n`);
    return new Blob(lines, { type: "text/csv" });
  }

  /** The HDF5 file, which the service makes. */
  async h5() {
    const { greeting, commands, requests, replies, received } = this;
    return postArrays("recordings", { greeting, commands }, {
      received: Float64Array.from(received), requests: joined(requests), replies: joined(replies),
    });
  }
}

function joined(frames) {
  const size = frames[0]?.length ?? 0, bytes = new Uint8Array(size * frames.length);
  frames.forEach((frame, i) => bytes.set(frame, i * size));
  return bytes;
}

/**
 * Positions (mm) of the tip over time, of a recording's text; throws what is wrong with it. `near`
 * says of a position whether it is of this scene.
 */
export class Player {
  constructor(text, near) {
    if (text.slice(1, 4) === "HDF") {
      throw new Error("An HDF5 file is for palpate replay; what plays here is the CSV file.");
    }
    const [names, ...rows] = text.trim().split(/\r?\n/).map((line) => line.split(","));
    const place = names.includes("asked_x") ? ["asked_x", "asked_y", "asked_z"] : ["x", "y", "z"];
    const wanted = ["time", ...place], missing = wanted.filter((name) => !names.includes(name));
    if (missing.length) throw new Error(`The recording's first line lacks ${missing.join(", ")}.`);
    const numbers = (row) => wanted.map((name) => Number(row[names.indexOf(name)] || NaN));
    this.rows = rows.map(numbers);
    const wrong = this.rows.findIndex((row, i) => (
      !row.every(Number.isFinite) || (i > 0 && row[0] < this.rows[i - 1][0])
    ));
    if (wrong >= 0) throw new Error(`Line ${wrong + 2} of the recording makes no sense.`);
    if (!rows.length) throw new Error("The recording has no positions.");
    if (!this.rows.some((row) => near(row.slice(1)))) {
      throw new Error("All its positions are far from this body: is it of another scene, or not in mm?");
    }
    this.next = 0;
  }

  /** How long it plays, s. */
  get length() {
    return this.rows.at(-1)[0] - this.rows[0][0];
  }

  /** Position so many seconds after the first one; null when all have been played. */
  at(passed) {
    const first = this.rows[0][0], last = this.rows.at(-1)[0];
    if (passed > last - first + AFTER) return null;
    while (this.next + 1 < this.rows.length && this.rows[this.next + 1][0] - first <= passed) {
      this.next += 1;
    }
    return this.rows[this.next].slice(1);
  }
}
