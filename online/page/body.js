// The body at rest: vertices for drawing, its edges, and where a ray meets it.

import { add, cross, dot, norm, row, scale, unit } from "./vectors.js";

const CREASE = Math.cos(Math.PI / 5); // cosine of the angle from which an edge is a sharp one
const TOGETHER = 0.02; // mm, distance within which a node lies on the accessible surface

/** Triangles with their normals, and where a ray first meets one. */
class Triangles {
  constructor(vertices, triangles) {
    Object.assign(this, { vertices, triangles, count: triangles.length / 3 });
    this.normals = new Float32Array(triangles.length);
    for (let t = 0; t < this.count; t++) {
      const [a, b, c] = this.corners(t);
      this.normals.set(unit(cross(add(b, a, -1), add(c, a, -1))), 3 * t);
    }
  }

  corners(t) {
    return row(this.triangles, t).map((i) => row(this.vertices, i));
  }

  /** Nearest triangle before `most` that faces a ray: `{distance, triangle, shares}`, or null. */
  meet({ from, along }, most = Infinity) {
    let found = null;
    const { vertices: V, triangles: T } = this;
    for (let t = 0; t < T.length; t += 3) {
      // Möller and Trumbore, without arrays
      const a = 3 * T[t], b = 3 * T[t + 1], c = 3 * T[t + 2];
      const ax = V[a], ay = V[a + 1], az = V[a + 2];
      const ux = V[b] - ax, uy = V[b + 1] - ay, uz = V[b + 2] - az;
      const vx = V[c] - ax, vy = V[c + 1] - ay, vz = V[c + 2] - az;
      const px = along[1] * vz - along[2] * vy, py = along[2] * vx - along[0] * vz;
      const pz = along[0] * vy - along[1] * vx;
      const whole = ux * px + uy * py + uz * pz;
      if (whole <= 1e-12) continue; // it faces away
      const wx = from[0] - ax, wy = from[1] - ay, wz = from[2] - az;
      const s = wx * px + wy * py + wz * pz;
      if (s < 0 || s > whole) continue;
      const qx = wy * uz - wz * uy, qy = wz * ux - wx * uz, qz = wx * uy - wy * ux;
      const r = along[0] * qx + along[1] * qy + along[2] * qz;
      if (r < 0 || s + r > whole) continue;
      const distance = (vx * qx + vy * qy + vz * qz) / whole;
      if (distance > 0 && distance < most) {
        most = distance;
        found = { distance, triangle: t / 3, shares: [1 - (s + r) / whole, s / whole, r / whole] };
      }
    }
    return found;
  }
}

export class Body {
  /** Of the documents `mesh` and `accessible` of a scene. */
  constructor(mesh, accessible) {
    const { nodes, triangles, clamped } = mesh.arrays;
    this.nodes = nodes;
    this.count = nodes.length / 3;
    this.surface = new Triangles(nodes, triangles);
    this.touchable = new Triangles(accessible.arrays.vertices, accessible.arrays.triangles);
    this.limits = accessible.arrays;
    this.measure();
    this.split(clamped, this.onTouchable());
    this.findEdges();
  }

  /** Centre and radius of the body, and where its accessible part looks. */
  measure() {
    const low = [Infinity, Infinity, Infinity], high = low.map((x) => -x);
    this.nodes.forEach((x, i) => {
      low[i % 3] = Math.min(low[i % 3], x);
      high[i % 3] = Math.max(high[i % 3], x);
    });
    this.centre = scale(add(low, high), 0.5);
    this.radius = norm(add(high, low, -1)) / 2;
    let sum = [0, 0, 0];
    for (let i = 0; i < this.limits.normals.length / 3; i++) sum = add(sum, row(this.limits.normals, i));
    this.outward = unit(sum);
    this.leastDepth = (this.limits.depth_limit ?? []).reduce((a, b) => (b > 0 ? Math.min(a, b) : a), Infinity);
  }

  /** For every node the normal of the accessible surface there, if it lies on it. */
  onTouchable() {
    const key = (p) => p.map((x) => Math.round(x / TOGETHER)).join();
    const { vertices, normals } = this.limits, cells = new Map();
    for (let i = 0; i < vertices.length / 3; i++) {
      const at = row(vertices, i), normal = row(normals, i);
      // less than half a cell to either side, so that its own is among them
      for (const dx of [-0.4, 0.4]) {
        for (const dy of [-0.4, 0.4]) {
          for (const dz of [-0.4, 0.4]) cells.set(key(add(at, [dx, dy, dz], TOGETHER)), normal);
        }
      }
    }
    return Array.from({ length: this.count }, (_, i) => cells.get(key(row(this.nodes, i))));
  }

  /**
   * Vertices for drawing: a node on a sharp edge is as many as there are sides that meet, and one on
   * the rim of what may be touched is two.
   */
  split(clamped, touchable) {
    const { triangles, normals, count } = this.surface;
    const sides = Array.from({ length: this.count }, () => []);
    const index = new Uint32Array(triangles.length), vertices = [];
    for (let t = 0; t < count; t++) {
      const normal = row(normals, t), corners = row(triangles, t);
      const touched = corners.every((node) => touchable[node] && dot(normal, touchable[node]) > 0.5);
      corners.forEach((node, i) => {
        const smooth = sides[node].find(({ side }) => dot(unit(side.normal), normal) > CREASE);
        const side = smooth?.side ?? { normal: [0, 0, 0] };
        side.normal = add(side.normal, normal);
        let own = sides[node].find((other) => other.side === side && other.touched === touched);
        if (!own) {
          own = { node, side, touched, number: vertices.length };
          sides[node].push(own);
          vertices.push(own);
        }
        index[3 * t + i] = own.number;
      });
    }
    this.index = index;
    this.vertexNodes = Uint32Array.from(vertices, ({ node }) => node);
    this.vertexNormals = Float32Array.from(vertices.flatMap(({ side }) => unit(side.normal)));
    this.vertexPlaces = Float32Array.from(vertices.flatMap(({ node }) => row(this.nodes, node)));
    this.vertexKinds = Uint8Array.from(
      vertices.flatMap(({ node, touched }) => [clamped[node] ? 255 : 0, touched ? 255 : 0]),
    );
  }

  /** Edges of the body, `[node, node, triangle, triangle]`, and the rim that may be touched. */
  findEdges() {
    this.edges = edges(this.surface.triangles);
    const free = edges(this.touchable.triangles).filter(([, , , other]) => other < 0);
    this.rim = Float32Array.from(
      free.flatMap(([a, b]) => [...row(this.limits.vertices, a), ...row(this.limits.vertices, b)]),
    );
  }

  /** Nodes at the ends of the edges that are the outline at rest, seen from `eye`. */
  outline(eye) {
    const { normals, triangles } = this.surface, seen = new Uint8Array(this.surface.count);
    for (let t = 0; t < seen.length; t++) {
      seen[t] = dot(add(eye, row(this.nodes, triangles[3 * t]), -1), row(normals, t)) > 0;
    }
    const found = [];
    for (const [a, b, s, t] of this.edges) {
      const sharp = dot(row(normals, s), row(normals, t)) < CREASE;
      if (seen[s] !== seen[t] || (sharp && (seen[s] || seen[t]))) found.push(a, b);
    }
    return Float32Array.from(found.flatMap((i) => row(this.nodes, i)));
  }

  /** Place on the accessible surface that a ray meets: point, normal and limits there; or null. */
  touch(ray) {
    const hit = this.touchable.meet(ray);
    const before = hit && this.surface.meet(ray, hit.distance - 0.05 * this.radius);
    if (!hit || before) return null;
    const corners = row(this.touchable.triangles, hit.triangle);
    const mean = (values) => hit.shares.reduce((sum, s, i) => sum + s * values[corners[i]], 0);
    const vector = (values) => [0, 1, 2].map((axis) => (
      hit.shares.reduce((sum, s, i) => sum + s * values[3 * corners[i] + axis], 0)
    ));
    return {
      point: vector(this.limits.vertices), normal: unit(vector(this.limits.normals)),
      pressureLimit: mean(this.limits.pressure_limit),
      depthLimit: this.limits.depth_limit ? mean(this.limits.depth_limit) : 0,
    };
  }

  /** Number of the vertex of the accessible surface that is nearest to a point. */
  vertexNear(point) {
    const { vertices } = this.limits, away = (i) => norm(add(row(vertices, i), point, -1));
    let best = 0;
    for (let i = 1; i < vertices.length / 3; i++) if (away(i) < away(best)) best = i;
    return best;
  }

  /** Distance (mm) of a point from what can be touched, about. */
  gap(point) {
    const nearest = this.touchNear(point)?.point ?? row(this.limits.vertices, this.vertexNear(point));
    return norm(add(nearest, point, -1));
  }

  /** Place in the middle of what can be touched. */
  middle() {
    const { vertices } = this.limits, count = vertices.length / 3;
    let sum = [0, 0, 0];
    for (let i = 0; i < count; i++) sum = add(sum, row(vertices, i));
    return this.touchNear(row(vertices, this.vertexNear(scale(sum, 1 / count))));
  }

  /** As `touch`, of the point of the accessible surface that is nearest to one. */
  touchNear(point) {
    const normal = row(this.limits.normals, this.vertexNear(point));
    const ray = { from: add(point, normal, 0.2 * this.radius), along: scale(normal, -1) };
    return this.touch(ray);
  }
}

/** Edges of triangles: two nodes and the two triangles at them, -1 where there is none. */
function edges(triangles) {
  const found = new Map();
  for (let i = 0; i < triangles.length; i++) {
    const t = Math.floor(i / 3), a = triangles[i], b = triangles[3 * t + ((i + 1) % 3)];
    const key = a < b ? `${a},${b}` : `${b},${a}`, edge = found.get(key);
    if (edge) edge[3] = t;
    else found.set(key, [a, b, t, -1]);
  }
  return [...found.values()];
}
