// A task: a path over the surface to be followed within a limit of force, and how well it went.

import { roundUp } from "./colours.js";
import { across, add, norm } from "./vectors.js";

const REACH = 1; // mm from a point of the path within which it is passed, unless the task says
const MOST = 500; // points of a path
const EXAMPLE = [-0.25, -0.15, -0.05, 0.05, 0.15, 0.25]; // points of one, in radii of the body
const FIRM = 0.25; // its limit, in Young's moduli times the tool's radius squared

/** What is wrong with a task that a person wrote; nothing if it can be done. */
function faults({ path, force_limit: limit, reach = REACH }) {
  const isPoint = (x) => Array.isArray(x) && x.length === 3 && x.every(Number.isFinite);
  if (!Array.isArray(path) || path.length < 2 || path.length > MOST || !path.every(isPoint)) {
    return `"path" must be 2 to ${MOST} points [x, y, z] in mm.`;
  }
  if (!(limit > 0 && limit < Infinity)) return '"force_limit" must be a force above 0 in mN.';
  if (!(reach > 0 && reach < Infinity)) return '"reach" must be a distance above 0 in mm.';
  return "";
}

/** The text of a task over the middle of what can be touched of a body, for tissue and tool. */
export function exampleTask(body, young, radius) {
  const { point, normal } = body.middle(), along = across(normal);
  const path = EXAMPLE.map((s) => body.touchNear(add(point, along, s * body.radius))?.point).filter(Boolean);
  return JSON.stringify({ name: "Example", path, force_limit: roundUp(FIRM * young * radius ** 2) });
}

/**
 * Of the text of a JSON file `{"name", "path", "force_limit", "reach"}`; throws what is wrong. `gap`
 * is the distance of a point from what can be touched at rest, and may be `deep`, mm.
 */
export class Task {
  constructor(text, gap, deep) {
    let said;
    try {
      said = JSON.parse(text);
    } catch (error) {
      throw new Error(`This is no JSON (${error.message}).`);
    }
    const wrong = faults(said ?? {});
    if (wrong) throw new Error(wrong);
    const { name = "Task", path, force_limit: limit, reach = REACH } = said;
    const far = path.findIndex((point) => gap(point) > deep + reach);
    if (far >= 0) {
      const away = gap(path[far]).toFixed(1);
      throw new Error(`Point ${far + 1} of the path is ${away} mm from what can be touched here.`);
    }
    Object.assign(this, { name: String(name), path, limit, reach });
    this.again();
  }

  again() {
    Object.assign(this, { passed: 0, time: 0, length: 0, peak: 0, over: 0, last: null });
  }

  get done() {
    return this.passed === this.path.length;
  }

  /** Take an answer: where the tool touches (null if it does not) and its force, mN, at `now`, s. */
  take(now, point, force) {
    if (this.done) return;
    if (this.passed > 0) {
      const since = now - this.last.now;
      this.time += since;
      if (this.last.force > this.limit) this.over += since;
      if (point && this.last.point) this.length += apart(point, this.last.point);
    }
    this.last = { now, point, force };
    while (point && !this.done && apart(point, this.path[this.passed]) <= this.reach) this.passed += 1;
    if (this.passed > 0) this.peak = Math.max(this.peak, force);
  }

  /** Whether it is "good" or "bad" so far, or "" before it has begun. */
  get state() {
    if (this.over > 0) return "bad";
    return this.done ? "good" : "";
  }

  /** How it stands, in words. */
  words() {
    const { name, passed, path, time, length, peak, over, limit } = this;
    const state = this.done ? "done" : passed ? `${passed} of ${path.length} points` : "touch its first point";
    return `${name}: ${state}. Time ${time.toFixed(1)} s, path ${length.toFixed(1)} mm, largest force `
      + `${peak.toFixed(1)} of ${limit} mN, ${over.toFixed(1)} s above it.`;
  }
}

const apart = (a, b) => norm(add(a, b, -1));
