// Draws body, tool and force with WebGL2. A vertex shader makes the displacement of every node from
// the reduced coordinates of a frame and the modes of local models, once for all pictures of it.

import { TABLE } from "./colours.js";
import { add, placing, scale, unit } from "./vectors.js";

const WIDTH = 1024; // of the textures that hold a number for every node
export const MOST_PARTS = 32; // local models that can take part in a displacement
const MOST_BYTES = 64 * 2 ** 20; // of the graphics memory for modes

const NODES = `#version 300 es
precision highp float; precision highp int;
precision highp sampler2D; precision highp isampler2DArray;
ivec2 at(int node) { return ivec2(node % ${WIDTH}, node / ${WIDTH}); }
`;

const DISPLACEMENT = [`${NODES}
uniform sampler2D field;         // mm, by node: what is not in the modes, or all of it
uniform isampler2DArray modes;   // in steps: mode, node, place
uniform sampler2D states;        // mm a step: mode, part
uniform int places[${MOST_PARTS}];
uniform int parts, modesEach;
out vec3 moved;
void main() {
  vec3 u = texelFetch(field, at(gl_VertexID), 0).xyz;
  for (int part = 0; part < parts; part++)
    for (int m = 0; m < modesEach; m++)
      u += texelFetch(states, ivec2(m, part), 0).x
         * vec3(texelFetch(modes, ivec3(m, gl_VertexID, places[part]), 0).xyz);
  moved = u;
}`, `#version 300 es
precision highp float;
out vec4 colour;
void main() { colour = vec4(0.0); }`];

const BODY = [`${NODES}
layout(location = 0) in vec3 rest;
layout(location = 1) in vec3 normal;
layout(location = 2) in uint node;
layout(location = 3) in vec2 kind;
uniform mat4 camera;
uniform sampler2D displacement, stress; // mm and kPa, by node
uniform int colouring;
out vec3 restAt, movedAt, restNormal;
out vec2 kinds;
out float value;
void main() {
  vec3 u = texelFetch(displacement, at(int(node)), 0).xyz;
  restAt = rest; movedAt = rest + u; restNormal = normal; kinds = kind;
  value = colouring == 0 ? texelFetch(stress, at(int(node)), 0).x : length(u);
  gl_Position = camera * vec4(movedAt, 1.0);
}`, `#version 300 es
precision highp float; precision highp int;
in vec3 restAt, movedAt, restNormal;
in vec2 kinds;
in float value;
uniform sampler2D colours;
uniform vec3 eye;
uniform float range;
uniform int colouring;
out vec4 colour;
void main() {
  // the normals at rest are smooth; what the deformation changes of them is that of the triangle
  vec3 flatRest = normalize(cross(dFdx(restAt), dFdy(restAt)));
  vec3 flatMoved = normalize(cross(dFdx(movedAt), dFdy(movedAt)));
  vec3 n = normalize(normalize(restNormal) + flatMoved - flatRest);
  vec3 towards = normalize(eye - movedAt);
  float light = 0.45 + 0.55 * max(dot(n, normalize(towards + vec3(0.0, 0.0, 0.5))), 0.0);
  vec3 own = colouring == 2 ? vec3(0.86, 0.62, 0.58)
    : texture(colours, vec2((255.0 * clamp(value / range, 0.0, 1.0) + 0.5) / 256.0, 0.5)).rgb;
  if (kinds.y < 0.5) own = mix(own, vec3(0.5), 0.35);
  if (kinds.x > 0.5 && mod(gl_FragCoord.x + gl_FragCoord.y, 8.0) < 3.0) own = vec3(0.35);
  float shine = 0.12 * pow(max(dot(n, towards), 0.0), 24.0);
  colour = vec4(own * light + shine, 1.0);
}`];

const SOLID = [`#version 300 es
layout(location = 0) in vec3 rest;
layout(location = 1) in vec3 normal;
uniform mat4 camera, place;
out vec3 at, turned;
void main() {
  vec4 p = place * vec4(rest, 1.0);
  at = p.xyz; turned = mat3(place) * normal;
  gl_Position = camera * p;
}`, `#version 300 es
precision highp float;
in vec3 at, turned;
uniform vec3 eye;
uniform vec4 paint;
out vec4 colour;
void main() {
  float facing = abs(dot(normalize(turned), normalize(eye - at)));
  colour = vec4(paint.rgb * (0.4 + 0.6 * facing), mix(min(1.0, 2.0 * paint.a), paint.a, facing));
}`];

const LINE = [`#version 300 es
layout(location = 0) in vec3 rest;
uniform mat4 camera;
uniform float closer;
void main() {
  gl_Position = camera * vec4(rest, 1.0);
  gl_Position.z -= closer * gl_Position.w;
}`, `#version 300 es
precision highp float;
uniform vec4 paint;
out vec4 colour;
void main() { colour = paint; }`];

/** Whether the processor draws, for which smooth edges take as long again as the picture. */
function drawsByItself() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = gl?.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER) ?? "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /SwiftShader|llvmpipe|softpipe|Basic Render|software/i.test(name);
}

export class View {
  /** Of a canvas; throws where there is no WebGL2. */
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: !drawsByItself(), alpha: true });
    if (!gl) throw new Error("no WebGL2");
    this.canvas = canvas;
    this.gl = gl;
    this.body = this.program(...BODY);
    this.solid = this.program(...SOLID);
    this.line = this.program(...LINE);
    this.reader = this.program(...DISPLACEMENT, ["moved"]);
    this.colours = this.texture(gl.RGBA8, 256, 1, gl.RGBA, gl.UNSIGNED_BYTE, TABLE);
    this.shapes = { sphere: this.shape(sphere()), rod: this.shape(turned(ROD)), cone: this.shape(turned(CONE)) };
    this.outlineArray = this.lines(new Float32Array());
    gl.enable(gl.DEPTH_TEST);
  }

  program(vertex, fragment, captured = []) {
    const { gl } = this, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) {
        throw new Error(gl.getShaderInfoLog(shader));
      }
      gl.attachShader(program, shader);
    }
    if (captured.length) gl.transformFeedbackVaryings(program, captured, gl.SEPARATE_ATTRIBS);
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      throw new Error(gl.getProgramInfoLog(program));
    }
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(program, i);
      uniforms[name.replace("[0]", "")] = gl.getUniformLocation(program, name);
    }
    return { program, uniforms };
  }

  texture(internal, width, height, format, type, data = null) {
    const { gl } = this, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, internal, width, height);
    for (const which of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, which, gl.NEAREST);
    }
    if (data) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, format, type, data);
    return texture;
  }

  buffer(data, usage = this.gl.STATIC_DRAW, target = this.gl.ARRAY_BUFFER) {
    const buffer = this.gl.createBuffer();
    this.gl.bindBuffer(target, buffer);
    this.gl.bufferData(target, data, usage);
    return buffer;
  }

  shape({ places, normals, index }) {
    const { gl } = this, array = gl.createVertexArray();
    gl.bindVertexArray(array);
    [places, normals].forEach((data, i) => {
      this.buffer(Float32Array.from(data));
      gl.enableVertexAttribArray(i);
      gl.vertexAttribPointer(i, 3, gl.FLOAT, false, 0, 0);
    });
    this.buffer(Uint16Array.from(index), gl.STATIC_DRAW, gl.ELEMENT_ARRAY_BUFFER);
    return { array, count: index.length };
  }

  lines(places) {
    const { gl } = this, array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const buffer = this.buffer(places, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    return { array, buffer, count: places.length / 3 };
  }

  /** Show another body; forget the modes of the one before. */
  setBody(body) {
    const { gl } = this;
    this.forget();
    this.shown = body;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const buffers = [body.vertexPlaces, body.vertexNormals, body.vertexNodes, body.vertexKinds];
    this.bodyBuffers = buffers.map((data, i) => {
      const buffer = this.buffer(data);
      gl.enableVertexAttribArray(i);
      if (i < 2) gl.vertexAttribPointer(i, 3, gl.FLOAT, false, 0, 0);
      if (i === 2) gl.vertexAttribIPointer(i, 1, gl.UNSIGNED_INT, 0, 0);
      if (i === 3) gl.vertexAttribPointer(i, 2, gl.UNSIGNED_BYTE, true, 0, 0);
      return buffer;
    });
    this.bodyBuffers.push(this.buffer(body.index, gl.STATIC_DRAW, gl.ELEMENT_ARRAY_BUFFER));
    this.bodyArray = array;
    this.rim = this.lines(body.rim);
    const height = Math.ceil(body.count / WIDTH);
    this.height = height;
    this.field = this.texture(gl.RGB32F, WIDTH, height);
    this.stress = this.texture(gl.R32F, WIDTH, height);
    this.displacement = this.texture(gl.RGB32F, WIDTH, height);
    this.moved = this.buffer(12 * WIDTH * height, gl.DYNAMIC_COPY); // the same
    this.showField(null);
    this.showStress(null);
  }

  /** Give the graphics memory of a body back. */
  forget() {
    const { gl } = this;
    for (const name of ["field", "displacement", "stress", "modes", "states"]) {
      gl.deleteTexture(this[name] ?? null);
      this[name] = null;
    }
    for (const buffer of [...(this.bodyBuffers ?? []), this.moved ?? null, this.rim?.buffer ?? null]) {
      gl.deleteBuffer(buffer);
    }
    for (const array of [this.bodyArray ?? null, this.rim?.array ?? null]) gl.deleteVertexArray(array);
    this.places = new Map(); // of the local models in the texture, the least recently used first
    this.parts = 0;
  }

  /** Whether the modes of local models are in the graphics memory. */
  has(models) {
    return models.every((k) => this.places.has(k));
  }

  /** Whether modes of so many nodes fit into a texture at all. */
  get canHoldModes() {
    return this.shown.count <= this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE);
  }

  /** Take the modes of a local model; those not used for longest make room. */
  addModes(number, { steps, modes }) {
    const { gl } = this, each = steps.length, { count } = this.shown;
    if (modes.length !== 3 * each * count) throw new Error("These modes are of another body.");
    gl.activeTexture(gl.TEXTURE1);
    if (!this.modes) {
      const room = Math.floor(MOST_BYTES / (8 * each * count));
      this.room = Math.min(Math.max(room, 4), 2 * MOST_PARTS);
      this.modesEach = each;
      this.steps = new Map();
      this.modes = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.modes);
      gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGB16I, each, count, this.room);
      for (const which of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
        gl.texParameteri(gl.TEXTURE_2D_ARRAY, which, gl.NEAREST);
      }
      this.states = this.texture(gl.R32F, each, MOST_PARTS);
    }
    let place = this.places.size;
    if (place >= this.room) {
      const [oldest, freed] = this.places.entries().next().value;
      this.places.delete(oldest);
      place = freed;
    }
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 2);
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.modes);
    gl.texSubImage3D(
      gl.TEXTURE_2D_ARRAY, 0, 0, 0, place, each, count, 1, gl.RGB_INTEGER, gl.SHORT, modes,
    );
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 4);
    this.places.set(number, place);
    this.steps.set(number, steps);
  }

  /** Show the displacement that is made of the parts of a frame. */
  showParts({ models, states, modes, dented, dent }) {
    const { gl } = this, each = this.modesEach;
    if (models.length && modes !== each) throw new Error("These states are of another scene.");
    const field = new Float32Array(3 * this.shown.count);
    dented.forEach((node, i) => field.set(dent.subarray(3 * i, 3 * i + 3), 3 * node));
    this.showField(field);
    const steps = new Float32Array(states.length);
    this.used = Array.from(models, (k, part) => {
      const own = this.steps.get(k), place = this.places.get(k);
      for (let m = 0; m < each; m++) steps[each * part + m] = own[m] * states[each * part + m];
      this.places.delete(k); // and last again
      this.places.set(k, place);
      return place;
    });
    this.parts = models.length;
    if (this.parts) {
      gl.bindTexture(gl.TEXTURE_2D, this.states);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, each, this.parts, gl.RED, gl.FLOAT, steps);
    }
  }

  /** Show a displacement (mm) given at the nodes. */
  showField(field) {
    this.parts = 0;
    this.made = false;
    this.put(this.field, 3, this.gl.RGB, field);
  }

  showStress(stress) {
    this.put(this.stress, 1, this.gl.RED, stress);
  }

  /** Fill a texture with so many numbers for every node; null is zero. */
  put(texture, each, format, values) {
    const { gl } = this, all = new Float32Array(each * WIDTH * this.height);
    if (values) all.set(values);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, this.height, format, gl.FLOAT, all);
  }

  /** Use a program with textures: name, kind and texture of each. */
  use({ program, uniforms }, textures) {
    const { gl } = this;
    gl.useProgram(program);
    textures.forEach(([name, target, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(target, texture);
      gl.uniform1i(uniforms[name], unit);
    });
  }

  /** Make the displacement of every node, unless it is there. */
  deform() {
    if (this.made) return;
    const { gl } = this, { uniforms } = this.reader;
    this.use(this.reader, [
      ["field", gl.TEXTURE_2D, this.field], ["modes", gl.TEXTURE_2D_ARRAY, this.modes ?? null],
      ["states", gl.TEXTURE_2D, this.states ?? this.field],
    ]);
    gl.uniform1i(uniforms.parts, this.parts);
    gl.uniform1i(uniforms.modesEach, this.modesEach ?? 0);
    if (this.parts) gl.uniform1iv(uniforms.places, this.used);
    gl.bindVertexArray(null);
    gl.bindBuffer(gl.ARRAY_BUFFER, null);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, this.moved);
    gl.enable(gl.RASTERIZER_DISCARD);
    gl.beginTransformFeedback(gl.POINTS);
    gl.drawArrays(gl.POINTS, 0, this.shown.count);
    gl.endTransformFeedback();
    gl.disable(gl.RASTERIZER_DISCARD);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, this.moved);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.displacement);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, this.height, gl.RGB, gl.FLOAT, 0);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, null);
    this.made = true;
  }

  /** The displacement that the shader makes, read back: mm, three numbers for every node. */
  readBack() {
    this.deform();
    const { gl } = this, moved = new Float32Array(3 * this.shown.count);
    gl.bindBuffer(gl.COPY_READ_BUFFER, this.moved);
    gl.getBufferSubData(gl.COPY_READ_BUFFER, 0, moved);
    gl.bindBuffer(gl.COPY_READ_BUFFER, null);
    return moved;
  }

  /** Have as many pixels as are shown, times `sharpness`; return whether that is new. */
  fit(sharpness) {
    const finer = sharpness * Math.min(window.devicePixelRatio || 1, 2), { canvas } = this;
    const wanted = [canvas.clientWidth, canvas.clientHeight].map((x) => Math.max(1, Math.round(x * finer)));
    if (canvas.width === wanted[0] && canvas.height === wanted[1]) return false;
    [canvas.width, canvas.height] = wanted;
    return true;
  }

  /** Draw `{camera, colouring, range, task, tool, arrow, dark}`; see `drawTool` for the tool. */
  draw(scene) {
    const { gl } = this, matrix = scene.camera.matrix(), eye = scene.camera.eye();
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.deform();
    const { uniforms } = this.body;
    this.use(this.body, [
      ["displacement", gl.TEXTURE_2D, this.displacement], ["stress", gl.TEXTURE_2D, this.stress],
      ["colours", gl.TEXTURE_2D, this.colours],
    ]);
    gl.uniformMatrix4fv(uniforms.camera, false, matrix);
    gl.uniform3fv(uniforms.eye, eye);
    gl.uniform1f(uniforms.range, scene.range);
    gl.uniform1i(uniforms.colouring, scene.colouring);
    gl.bindVertexArray(this.bodyArray);
    gl.drawElements(gl.TRIANGLES, this.shown.index.length, gl.UNSIGNED_INT, 0);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.drawOutlines(matrix, eye, scene.dark);
    gl.useProgram(this.solid.program);
    gl.uniformMatrix4fv(this.solid.uniforms.camera, false, matrix);
    gl.uniform3fv(this.solid.uniforms.eye, eye);
    if (scene.task) this.drawTask(scene.task);
    if (scene.tool) this.drawTool(scene.tool);
    if (scene.arrow) this.drawArrow(scene.arrow);
    gl.disable(gl.BLEND);
  }

  /** Draw the outline of the body at rest, and the rim of what may be touched. */
  drawOutlines(matrix, eye, dark) {
    const { gl } = this, { uniforms } = this.line, light = dark ? 1 : 0;
    const key = eye.join();
    if (this.outlineKey !== key || this.outlined !== this.shown) {
      const places = this.shown.outline(eye);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.outlineArray.buffer);
      gl.bufferData(gl.ARRAY_BUFFER, places, gl.DYNAMIC_DRAW);
      this.outlineArray.count = places.length / 3;
      Object.assign(this, { outlineKey: key, outlined: this.shown });
    }
    gl.useProgram(this.line.program);
    gl.uniformMatrix4fv(uniforms.camera, false, matrix);
    for (const [{ array, count }, paint, closer] of [
      [this.outlineArray, [light, light, light, 0.5], 0.0005], [this.rim, [1, 0.6, 0.1, 0.9], 0.001],
    ]) {
      gl.uniform4fv(uniforms.paint, paint);
      gl.uniform1f(uniforms.closer, closer);
      gl.bindVertexArray(array);
      gl.drawArrays(gl.LINES, 0, count);
    }
  }

  drawShape({ array, count }, place, paint) {
    const { gl } = this;
    gl.uniformMatrix4fv(this.solid.uniforms.place, false, place);
    gl.uniform4fv(this.solid.uniforms.paint, paint);
    gl.bindVertexArray(array);
    gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_SHORT, 0);
  }

  /** Draw a tool: `{centre, axis, radius, length, tip, ghost}`; without a tip it ends flat. */
  drawTool({ centre, axis, radius, length, tip, ghost }) {
    const { gl } = this, paint = [0.75, 0.8, 0.86, ghost ? 0.18 : 0.32];
    gl.depthMask(false);
    gl.enable(gl.CULL_FACE);
    if (tip) this.drawShape(this.shapes.sphere, placing(centre, axis, radius, radius), paint);
    this.drawShape(this.shapes.rod, placing(centre, axis, radius, length), [0.75, 0.8, 0.86, 0.5 * paint[3]]);
    gl.disable(gl.CULL_FACE);
    gl.depthMask(true);
  }

  /** Draw the points of a task: those passed, the next, and those to come. */
  drawTask({ path, passed, reach }) {
    path.forEach((point, i) => {
      const paint = i < passed ? [0.3, 0.8, 0.4, 0.9] : i === passed ? [1, 0.85, 0.1, 1] : [0.9, 0.9, 0.95, 0.8];
      const radius = (i === passed ? 0.5 : 0.3) * reach;
      this.drawShape(this.shapes.sphere, placing(point, [0, 0, 1], radius, radius), paint);
    });
  }

  /** Draw an arrow: `{from, along, width}`, seen through whatever is before it. */
  drawArrow({ from, along, width }) {
    const { gl } = this, length = Math.hypot(...along), axis = unit(along), paint = [1, 0.45, 0.1, 1];
    const head = Math.min(4 * width, length);
    gl.disable(gl.DEPTH_TEST);
    this.drawShape(this.shapes.rod, placing(from, axis, width, length - head), paint);
    const at = add(from, scale(axis, length - head));
    this.drawShape(this.shapes.cone, placing(at, axis, 2.2 * width, head), paint);
    gl.enable(gl.DEPTH_TEST);
  }
}

// Half outlines of bodies that are turned about z: distance from the axis, height, and the normal.
const ROD = [[[0, 0], [0, -1]], [[1, 0], [0, -1]], [[1, 0], [1, 0]], [[1, 1], [1, 0]]];
const CONE = [[[0, 0], [0, -1]], [[1, 0], [0, -1]], [[1, 0], [0.9, 0.4]], [[0, 1], [0.9, 0.4]]];

/** Turn half an outline about z. */
function turned(outline, around = 32) {
  const places = [], normals = [], index = [], n = outline.length;
  for (let i = 0; i <= around; i++) {
    const c = Math.cos((2 * Math.PI * i) / around), s = Math.sin((2 * Math.PI * i) / around);
    for (const [[r, z], [out, up]] of outline) {
      places.push(r * c, r * s, z);
      normals.push(out * c, out * s, up);
    }
  }
  for (let i = 0; i < around; i++) {
    for (let j = 0; j < n - 1; j++) {
      const a = n * i + j, b = a + n;
      index.push(a, b, b + 1, a, b + 1, a + 1);
    }
  }
  return { places, normals, index };
}

function sphere(rings = 16) {
  const outline = Array.from({ length: rings + 1 }, (_, i) => {
    const angle = Math.PI * (i / rings - 0.5), at = [Math.cos(angle), Math.sin(angle)];
    return [at, at];
  });
  return turned(outline);
}
