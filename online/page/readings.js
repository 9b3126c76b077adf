// What is read: numbers with their error bars, the trace of the force, trust in words, times.

import { colourOf, roundUp } from "./colours.js";

const TRACE = 10; // s that the trace shows
const RECENT = 5; // s over which times are taken together

const NAMES = { displacement: "displacement", von_mises: "stress", force: "force" };

/** Three significant digits. */
export function digits(value) {
  if (!Number.isFinite(value)) return "–";
  const places = value === 0 ? 0 : Math.max(0, 2 - Math.floor(Math.log10(Math.abs(value))));
  return value.toFixed(Math.min(places, 3));
}

/** Whether an answer can be trusted, and in words why not: `{state, words}`. */
export function trust(answer, tolerance) {
  if (!answer) return { state: "none", words: "No answer yet" };
  if (answer.FALLBACK) {
    const why = ["", "no equilibrium was found there", "the tip's centre is below the surface"];
    const last = Math.hypot(...answer.force) > 0 ? " The last good one is shown." : "";
    return { state: "bad", words: `No answer here: ${why[answer.reason] || "unknown"}.${last}` };
  }
  const words = [];
  if (answer.CLAMPED) words.push("Clamped: the step was too long; the answer is short of the tool.");
  if (answer.TOO_DEEP) {
    words.push(`Out of range: depth. The model is trained to ${digits(answer.depth_limit)} mm here.`);
  }
  if (answer.BESIDE) words.push("Out of range: position. The tip presses beyond the rim.");
  for (const field of answer.out_of_range ?? []) words.push(`Out of range: ${field}.`);
  if (answer.STALLED) words.push("Stalled: more time passed than the tissue follows at once.");
  if (!words.length && !answer.CONTACT) return { state: "none", words: "The tool does not touch the tissue." };
  const most = { ...tolerance };
  if (answer.tip) Object.assign(most, { displacement: most.tip_displacement, von_mises: most.tip_von_mises });
  const percent = (share) => `${Number((100 * share).toFixed(1))} %`;
  const allowed = ([name]) => `${NAMES[name]} ${percent(most[name])}`;
  const known = Object.entries(answer.errors).filter(([, error]) => Number.isFinite(error));
  const beyond = known.filter(([name, error]) => error > most[name]).map(([name, error]) => (
    `${NAMES[name]} ± ${percent(error)}, allowed ${percent(most[name])}`
  ));
  if (beyond.length) words.push(`Estimated errors are larger than this scene allows: ${beyond.join("; ")}.`);
  if (words.length) return { state: "doubt", words: words.join(" ") };
  return { state: "good", words: `In range, converged, estimated errors within what this scene allows (${known.map(allowed).join(", ")}).` };
}

/** Median and 99th percentile of the numbers of the last seconds. */
class Times {
  constructor() {
    this.all = [];
  }

  add(now, value) {
    this.all.push([now, value]);
    while (this.all.length && this.all[0][0] < now - RECENT) this.all.shift();
  }

  text(now) {
    const sorted = this.all.filter(([t]) => t > now - RECENT).map(([, v]) => v).sort((a, b) => a - b);
    if (!sorted.length) return "–";
    const at = (share) => sorted[Math.min(Math.floor(share * sorted.length), sorted.length - 1)];
    return `${digits(at(0.5))} / ${digits(at(0.99))} ms`;
  }
}

/** A bar with a value, its error, a limit where there is one, and what its end stands for. */
function drawGauge(canvas, { value, error, limit, most }) {
  const { context: c, width, height, ink } = sheet(canvas);
  const x = (v) => Math.min(Math.max(v / most, 0), 1) * width;
  c.globalAlpha = 0.15;
  c.fillStyle = ink;
  c.fillRect(0, height * 0.3, width, height * 0.4);
  c.globalAlpha = 1;
  c.fillStyle = "#2a9d8f";
  c.fillRect(0, height * 0.3, x(value), height * 0.4);
  c.strokeStyle = ink;
  c.lineWidth = 2;
  const line = (...points) => {
    c.beginPath();
    points.forEach(([px, py], i) => (i ? c.lineTo(px, py) : c.moveTo(px, py)));
    c.stroke();
  };
  if (Number.isFinite(error)) {
    const ends = [value * (1 - error), value * (1 + error)];
    line(...ends.map((end) => [x(end), height / 2]));
    // without a cap where it goes on beyond the bar
    for (const end of ends.filter((v) => v >= 0 && v <= most)) line([x(end), height * 0.1], [x(end), height * 0.9]);
  } else if (value > 0) { // anything
    c.setLineDash([3, 3]);
    line([0, height / 2], [width, height / 2]);
    c.setLineDash([]);
  }
  if (limit > 0) {
    c.strokeStyle = "#e07a1f";
    line([x(limit), 0], [x(limit), height]);
  }
  c.fillStyle = ink;
  c.textAlign = "right";
  c.font = "10px system-ui, sans-serif";
  c.fillText(digits(most), width - 2, height / 2 + 3.5);
}

/** A canvas of the right fineness, wiped: its context, size, and the colour of text. */
function sheet(canvas) {
  const fine = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * fine) || canvas.height !== Math.round(height * fine)) {
    canvas.width = Math.round(width * fine);
    canvas.height = Math.round(height * fine);
  }
  const context = canvas.getContext("2d");
  context.textAlign = "left";
  context.setTransform(fine, 0, 0, fine, 0, 0);
  context.clearRect(0, 0, width, height);
  context.font = "11px system-ui, sans-serif";
  return { context, width, height, ink: getComputedStyle(canvas).color };
}

export class Readings {
  constructor() {
    const ids = [
      "lamp", "trust", "force", "force-bar", "depth", "depth-bar", "depth-name", "moved", "stress",
      "stress-bar", "trace", "where", "solve", "trip", "frames", "legend", "legend-name",
    ];
    for (const id of ids) this[id] = document.getElementById(id);
    this.clear();
  }

  clear() {
    this.solves = new Times();
    this.trips = new Times();
    this.points = []; // of the trace: time in s, force in mN, error
    this.drawn = [];
    this.most = { force: 1, stress: 0.1 };
  }

  /** Take an answer that came at a time (s): see `trust` for its fields. */
  take(answer, now) {
    this.answer = answer;
    this.solves.add(now, answer.solve_ms);
    this.trips.add(now, answer.trip_ms);
    const size = Math.hypot(...answer.force);
    this.points.push([now, size, answer.errors.force]);
    while (this.points.length && this.points[0][0] < now - TRACE - 1) this.points.shift();
    this.most.force = Math.max(this.most.force, roundUp(1.1 * size));
    this.most.stress = Math.max(this.most.stress, roundUp(1.1 * (answer.largest_stress || 0)));
  }

  countFrame(now) {
    this.drawn.push(now);
    while (this.drawn[0] < now - 1) this.drawn.shift();
  }

  /** Write everything; `level` says what the tool is set to: `{name, unit, value, limit, most}`. */
  show(now, tolerance, level, atRim) {
    const { answer } = this, { state, words } = trust(answer, tolerance);
    this.lamp.dataset.state = state;
    this.lamp.textContent = { good: "✓", doubt: "!", bad: "✕", none: "–" }[state];
    this.trust.textContent = atRim ? `The tool is held at the rim of what can be touched. ${words}` : words;
    const errors = answer?.errors ?? {}, size = answer ? Math.hypot(...answer.force) : 0;
    const told = (value, unit, error) => {
      const doubt = Number.isFinite(error) ? `± ${digits(value * error)}` : "± unknown";
      return error === null || value === 0 ? `${digits(value)} ${unit}` : `${digits(value)} ${doubt} ${unit}`;
    };
    this.force.textContent = told(size, "mN", errors.force);
    drawGauge(this["force-bar"], { value: size, error: errors.force ?? 0, most: this.most.force });
    this["depth-name"].textContent = level.name;
    const apart = Number.isFinite(level.error) ? `± ${digits(100 * level.error)} %` : "± unknown";
    this.moved.textContent = level.error === null ? "–" : apart;
    const range = level.limit > 0 ? `, range ${digits(level.limit)}` : "";
    this.depth.textContent = `${digits(level.value)} ${level.unit}${range}`;
    drawGauge(this["depth-bar"], { ...level, error: level.error ?? 0 });
    const stress = answer?.largest_stress ?? 0;
    this.stress.textContent = told(stress, "kPa", errors.von_mises);
    drawGauge(this["stress-bar"], { value: stress, error: errors.von_mises ?? 0, most: this.most.stress });
    const at = answer?.CONTACT ? answer.contact_point : null;
    this.where.textContent = at ? Array.from(at, (x) => x.toFixed(1)).join(", ") : "–";
    this.solve.textContent = this.solves.text(now);
    this.trip.textContent = this.trips.text(now);
    while (this.drawn.length && this.drawn[0] < now - 1) this.drawn.shift();
    this.frames.textContent = `${this.drawn.length} /s`;
    this.drawTrace(now);
  }

  /** Draw the force over the last seconds with the band of its estimated error. */
  drawTrace(now) {
    const { context: c, width, height, ink } = sheet(this.trace);
    const most = this.most.force, left = 40, bottom = height - 14;
    const x = (t) => left + (1 - (now - t) / TRACE) * (width - left);
    const y = (f) => bottom - (Math.min(f, 1.05 * most) / most) * (bottom - 6);
    c.fillStyle = c.strokeStyle = ink;
    c.globalAlpha = 0.25;
    for (const share of [0, 0.5, 1]) c.fillRect(left, y(share * most), width - left, 1);
    c.globalAlpha = 0.8;
    c.textAlign = "right";
    for (const share of [0, 0.5, 1]) c.fillText(digits(share * most), left - 4, y(share * most) + 4);
    c.textAlign = "left";
    c.fillText(`−${TRACE} s`, left, height - 2);
    c.textAlign = "right";
    c.fillText("force, mN", width, height - 2);
    const points = this.points.filter(([t]) => t > now - TRACE);
    if (!points.length) return;
    c.beginPath();
    points.forEach(([t, f, e]) => c.lineTo(x(t), y(f * (1 + (Number.isFinite(e) ? e : 0)))));
    [...points].reverse().forEach(([t, f, e]) => c.lineTo(x(t), y(f * (1 - (Number.isFinite(e) ? e : 0)))));
    c.globalAlpha = 0.3;
    c.fillStyle = "#2a9d8f";
    c.fill();
    c.globalAlpha = 1;
    c.strokeStyle = "#2a9d8f";
    c.lineWidth = 1.5;
    c.beginPath();
    points.forEach(([t, f]) => c.lineTo(x(t), y(f)));
    c.lineTo(x(now), y(points.at(-1)[1])); // nothing has changed since
    c.stroke();
  }

  /** Draw the colour bar of a range; `mark` is the 99th percentile where it is known. */
  drawLegend({ name, unit, range, mark }) {
    this["legend-name"].textContent = name ? `${name}, ${unit}` : "";
    this.legend.hidden = !name;
    if (!name) return;
    const { context: c, width, height, ink } = sheet(this.legend);
    const top = 8, tall = height - 16, bar = 14;
    for (let i = 0; i < tall; i++) {
      c.fillStyle = `rgb(${colourOf(1 - i / (tall - 1)).join()})`;
      c.fillRect(0, top + i, bar, 1.5);
    }
    c.fillStyle = ink;
    for (let i = 0; i <= 4; i++) {
      const y = top + tall * (1 - i / 4);
      c.fillRect(bar, y - 0.5, 4, 1);
      c.fillText(digits((range * i) / 4), bar + 7, y + 4);
    }
    if (mark > 0) {
      const y = top + tall * (1 - Math.min(mark / range, 1));
      c.fillRect(0, y - 1, bar + 4, 2);
      c.textAlign = "right";
      c.fillText("99 % below", width, y - 3);
    }
  }
}
