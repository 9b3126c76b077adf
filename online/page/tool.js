// Gestures: where the tool is and how deep it presses, and how the camera moves.

import { add } from "./vectors.js";

const SPEED = 15; // mm/s, of the tool in and out of the tissue
const AWAY = -1; // mm, depth of a tool that is off the surface
const TURN = 4; // rad, that a drag across the picture turns the camera
const STEP = 0.03; // of a key, in halves of the picture
const NOTCH = 0.04; // of the wheel or a key, in ranges of the level

export class Tool {
  /** On a canvas; `on.view()` is called when the camera has moved. */
  constructor(canvas, camera, on) {
    Object.assign(this, { canvas, camera, on, body: null, cursor: [0, 0], pointers: new Map() });
    this.reset(null, 1, 1);
    const listen = (name, what) => canvas.addEventListener(name, what, { passive: false });
    listen("pointerdown", (event) => this.down(event));
    listen("pointermove", (event) => this.move(event));
    listen("pointerup", (event) => this.up(event));
    listen("pointercancel", (event) => this.up(event));
    listen("pointerleave", () => { if (!this.pressing && !this.held) this.place = null; });
    listen("wheel", (event) => this.wheel(event));
    listen("keydown", (event) => this.key(event));
    listen("contextmenu", (event) => event.preventDefault());
  }

  /** Begin anew on a body; `most` is the largest level (mm or kPa), `level` the one to begin with. */
  reset(body, level, most) {
    Object.assign(this, { body, level, most, place: null, pressing: false, now: AWAY, held: false, beyond: false });
  }

  /** Put the tool on the surface where a ray through the cursor meets it; say whether it does. */
  aim() {
    const place = this.body?.touch(this.camera.ray(...this.cursor)) ?? null;
    if (place || !this.active) this.place = place;
    this.beyond = !place && this.active; // held at the rim
    this.canvas.style.cursor = place ? "crosshair" : "grab";
    return place !== null;
  }

  /** Whether the tool presses, by a pointer or because it is held. */
  get active() {
    return this.pressing || this.held;
  }

  /** Go on by `seconds`: into the tissue while it presses, out of it else. */
  step(seconds, jump) {
    const target = this.active ? this.level : AWAY;
    const most = jump ? Infinity : SPEED * seconds;
    this.now += Math.min(Math.max(target - this.now, -most), most);
  }

  /** Centre (mm) of a spherical tip of this radius. */
  centre(radius) {
    return add(this.place.point, this.place.normal, radius - this.now);
  }

  setLevel(level) {
    this.level = Math.min(Math.max(level, 0), this.most);
    this.on.level();
  }

  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return [
      (2 * (event.clientX - box.left)) / box.width - 1,
      1 - (2 * (event.clientY - box.top)) / box.height,
    ];
  }

  down(event) {
    this.canvas.focus({ preventScroll: true });
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, this.at(event));
    if (this.pointers.size > 1) {
      this.pressing = false;
      this.drag = "pinch";
      return;
    }
    this.cursor = this.at(event);
    if (event.button === 0 && !event.shiftKey && this.touches()) {
      this.held = false;
      this.aim();
      this.drag = "press";
      this.pressing = true;
      this.penPressure(event);
    } else {
      this.drag = event.shiftKey || event.button === 1 ? "pan" : "orbit";
    }
  }

  /** Whether the cursor is on the accessible surface. */
  touches() {
    return Boolean(this.body?.touch(this.camera.ray(...this.cursor)));
  }

  move(event) {
    const before = this.pointers.get(event.pointerId), at = this.at(event);
    if (!before) { // it hovers
      this.cursor = at;
      if (!this.active) this.aim();
      return;
    }
    this.pointers.set(event.pointerId, at);
    const dx = at[0] - before[0], dy = at[1] - before[1];
    if (this.drag === "press") {
      this.cursor = at;
      this.aim();
      this.penPressure(event);
    } else if (this.drag === "pinch") {
      this.pinch(event.pointerId, before, at);
    } else if (this.drag === "pan") {
      this.camera.pan(0.5 * dx * this.camera.aspect, 0.5 * dy);
    } else {
      this.camera.orbit(0.5 * TURN * dx, -0.5 * TURN * dy);
    }
    if (this.drag !== "press") this.on.view();
  }

  /** Two fingers: their middle pans, their distance zooms. */
  pinch(id, before, at) {
    const other = [...this.pointers].find(([key]) => key !== id)?.[1];
    if (!other) return;
    const { aspect } = this.camera;
    const apart = ([x, y]) => Math.hypot((x - other[0]) * aspect, y - other[1]);
    this.camera.zoom(apart(before) / Math.max(apart(at), 0.01));
    this.camera.pan(0.25 * (at[0] - before[0]) * aspect, 0.25 * (at[1] - before[1]));
  }

  up(event) {
    this.pointers.delete(event.pointerId);
    if (this.drag === "press" && this.pressing) {
      this.pressing = this.beyond = false;
      this.held = this.keeps;
      this.on.level();
    }
    if (!this.pointers.size) this.drag = null;
  }

  /** Put a cursor that is not on the accessible surface in its middle, for the keyboard. */
  show() {
    if (!this.body || this.place || this.aim()) return;
    this.place = this.body.middle();
    if (this.place) this.cursor = this.camera.project(this.place.point);
  }

  penPressure(event) {
    if (event.pointerType === "pen" && event.pressure > 0) this.setLevel(event.pressure * this.most);
  }

  wheel(event) {
    event.preventDefault();
    const notches = -Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY) / 100, 1);
    if (this.active) {
      this.setLevel(this.level + notches * NOTCH * this.most);
    } else {
      this.camera.zoom(1.15 ** -notches);
      this.on.view();
    }
  }

  key(event) {
    const turn = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const slide = { j: [-1, 0], l: [1, 0], i: [0, 1], k: [0, -1] };
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (key in turn) {
      const [x, y] = turn[key];
      if (event.shiftKey) this.camera.pan(STEP * x, STEP * y);
      else this.camera.orbit(-2 * STEP * x, 2 * STEP * y);
      this.on.view();
    } else if (key in slide) {
      this.cursor = this.cursor.map((c, axis) => c + STEP * 0.5 * slide[key][axis]);
      this.show();
      this.aim();
      this.on.level();
    } else if (key === " " || key === "Enter") {
      this.show();
      if (this.place) this.held = !this.held;
      this.beyond = false;
      this.on.level();
    } else if (key === "[" || key === "PageDown") {
      this.setLevel(this.level - NOTCH * this.most);
    } else if (key === "]" || key === "PageUp") {
      this.setLevel(this.level + NOTCH * this.most);
    } else if (key === "+" || key === "-") {
      this.camera.zoom(key === "+" ? 1 / 1.15 : 1.15);
      this.on.view();
    } else {
      return;
    }
    event.preventDefault();
  }
}
