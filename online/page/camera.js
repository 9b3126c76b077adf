// A camera that looks at a point from a distance; z is up.

import { add, cross, dot, multiply, scale, unit } from "./vectors.js";

const FIELD = Math.PI / 6; // angle that the height of the picture covers
const STEEPEST = 1.55; // of the pitch, rad

export class Camera {
  constructor() {
    Object.assign(this, { yaw: 0.6, pitch: 0.5, distance: 50, target: [0, 0, 0], aspect: 1 });
  }

  /** Look at a body of this centre and radius (mm) from a direction. */
  frame(centre, radius, from) {
    const wide = Math.min(1, this.aspect);
    this.target = centre;
    this.distance = 1.05 * radius / Math.sin(FIELD / 2) / wide;
    const level = Math.hypot(from[0], from[1]);
    this.yaw = (level > 0.3 ? Math.atan2(from[1], from[0]) : -Math.PI / 2) + 0.5;
    this.pitch = Math.min(Math.max(Math.atan2(from[2], level), 0.25), 0.7);
  }

  /** Unit vectors to the right, up, and from the target to the eye. */
  axes() {
    const [c, s, e, f] = [this.yaw, this.pitch].flatMap((a) => [Math.cos(a), Math.sin(a)]);
    const back = [c * e, s * e, f], right = [-s, c, 0];
    return { right, back, up: cross(back, right) };
  }

  eye() {
    return add(this.target, this.axes().back, this.distance);
  }

  orbit(dx, dy) {
    this.yaw -= dx;
    this.pitch = Math.min(Math.max(this.pitch + dy, -STEEPEST), STEEPEST);
  }

  /** Move what is seen to the right and up, by parts of the height of the picture. */
  pan(dx, dy) {
    const { right, up } = this.axes(), height = 2 * this.distance * Math.tan(FIELD / 2);
    this.target = add(add(this.target, right, -dx * height), up, -dy * height);
  }

  zoom(factor) {
    this.distance = Math.min(Math.max(this.distance * factor, 1), 1e4);
  }

  /** Matrix from space to the picture. */
  matrix() {
    const { right, up, back } = this.axes(), eye = this.eye();
    const view = new Float32Array([
      right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
      -dot(right, eye), -dot(up, eye), -dot(back, eye), 1,
    ]);
    const f = 1 / Math.tan(FIELD / 2), near = this.distance / 50, far = this.distance * 20;
    const depth = 1 / (near - far);
    return multiply(new Float32Array([
      f / this.aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (near + far) * depth, -1,
      0, 0, 2 * near * far * depth, 0,
    ]), view);
  }

  /** Ray through a point of the picture, x and y from -1 to 1: where it starts, and whereto. */
  ray(x, y) {
    const { right, up, back } = this.axes(), half = Math.tan(FIELD / 2);
    const sideways = add(scale(right, x * half * this.aspect), up, y * half);
    return { from: this.eye(), along: unit(add(sideways, back, -1)) };
  }

  /** Where a point (mm) is in the picture, x and y from -1 to 1. */
  project(point) {
    const { right, up, back } = this.axes(), away = add(point, this.eye(), -1);
    const half = -dot(away, back) * Math.tan(FIELD / 2);
    return [dot(away, right) / (half * this.aspect), dot(away, up) / half];
  }

  toText() {
    return [this.yaw, this.pitch, this.distance, ...this.target].map((x) => x.toFixed(2)).join(",");
  }

  fromText(text) {
    const numbers = text.split(",").map(Number);
    if (numbers.length !== 6 || !numbers.every(Number.isFinite)) return false;
    [this.yaw, this.pitch, this.distance] = numbers;
    this.target = numbers.slice(3);
    this.orbit(0, 0);
    this.zoom(1);
    return true;
  }
}
