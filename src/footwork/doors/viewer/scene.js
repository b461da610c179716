// The ant in 3-D, for the replay and for the live page: forward kinematics, a small WebGL 2 renderer, and a stage of
// panels with a camera. It fetches nothing.
"use strict";

// ---------------------------------------------------------------- kinematics (3 x 3 matrices row by row, z up)

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot3 = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const unit = (a) => times(a, 1 / (Math.hypot(...a) || 1));

function fromQuaternion([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

function aboutAxis(axis, angle) {
  const [x, y, z] = times(unit(axis), Math.sin(angle / 2));
  return fromQuaternion([Math.cos(angle / 2), x, y, z]);
}

function product(a, b) {
  const c = new Array(9);
  for (let i = 0; i < 3; i++) {
    for (let j = 0; j < 3; j++) c[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
  }
  return c;
}

const turn = (m, v) => [dot3(m.slice(0, 3), v), dot3(m.slice(3, 6), v), dot3(m.slice(6, 9), v)];

// Where every geom is: [{ position, rotation }] in the world, from the skeleton that comes with the footage.
function geomPoses(skeleton, qpos) {
  const bodies = [];
  for (const body of skeleton.bodies) {
    if (body.free) {
      bodies.push({ position: qpos.slice(0, 3), rotation: fromQuaternion(qpos.slice(3, 7)) });
      continue;
    }
    const parent = bodies[body.parent];
    const position = plus(parent.position, turn(parent.rotation, body.position));
    let rotation = product(parent.rotation, fromQuaternion(body.rotation));
    if (body.axis) rotation = product(rotation, aboutAxis(body.axis, qpos[body.index]));
    bodies.push({ position, rotation });
  }
  return skeleton.geoms.map((geom) => {
    const body = bodies[geom.body];
    return {
      position: plus(body.position, turn(body.rotation, geom.position)),
      rotation: product(body.rotation, fromQuaternion(geom.rotation)),
    };
  });
}

// ---------------------------------------------------------------- 4 x 4 matrices (column by column)

function matrix(rotation, position) {
  const r = rotation;
  return [r[0], r[3], r[6], 0, r[1], r[4], r[7], 0, r[2], r[5], r[8], 0, ...position, 1];
}

function multiply(a, b) {
  const c = new Array(16).fill(0);
  for (let j = 0; j < 4; j++) {
    for (let i = 0; i < 4; i++) for (let k = 0; k < 4; k++) c[4 * j + i] += a[4 * k + i] * b[4 * j + k];
  }
  return c;
}

function lookAt(eye, target, up) {
  const back = unit(minus(eye, target));
  const right = unit(cross(up, back));
  const top = cross(back, right);
  return [
    right[0], top[0], back[0], 0, right[1], top[1], back[1], 0, right[2], top[2], back[2], 0,
    -dot3(right, eye), -dot3(top, eye), -dot3(back, eye), 1,
  ];
}

function perspective(fov, aspect, near, far) {
  const f = 1 / Math.tan(fov / 2);
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0];
}

const orthographic = (half, near, far) =>
  [1 / half, 0, 0, 0, 0, 1 / half, 0, 0, 0, 0, 2 / (near - far), 0, 0, 0, (far + near) / (near - far), 1];

// ---------------------------------------------------------------- WebGL

const MAX_WALLS = 48; // as many get a soft edge on the floor
const SHADOW_HALF = 13; // m around the ant

const COMMON = `#version 300 es
precision highp float;
precision highp sampler2DShadow;
`;
const VERTEX = COMMON + `
layout(location = 0) in vec3 aNormal;
layout(location = 1) in vec3 aOffset; // of capsules and boxes: which end, which corner
layout(location = 2) in vec3 aColour;
uniform mat4 uModel, uView;
uniform vec3 uSize;
uniform float uRadius;
uniform int uFlat; // 1: aOffset is the place itself
out vec3 vPlace, vNormal, vColour;
void main() {
  vec3 local = uFlat == 1 ? aOffset : aNormal * uRadius + aOffset * uSize;
  vec4 place = uModel * vec4(local, 1.0);
  vPlace = place.xyz;
  vNormal = mat3(uModel) * aNormal;
  vColour = aColour;
  gl_Position = uView * place;
}`;
const DEPTH_FRAGMENT = COMMON + "void main() {}";
const fragment = (shadowSize, taps) => COMMON + `
in vec3 vPlace, vNormal, vColour;
uniform vec3 uColour, uEye, uLight, uBack, uFocus, uLine;
uniform mat4 uShadow;
uniform sampler2DShadow uDepth;
uniform int uKind; // 0 the ant and the flag, 1 a wall, 2 the floor, 3 a path
uniform vec4 uGoal; // x, y, radius, 1 where there is one
uniform vec4 uStart;
uniform vec3 uGoalColour;
uniform vec4 uWalls[${MAX_WALLS}];
uniform int uNumWalls;
uniform float uDark, uFog;
out vec4 colour;

float lit(vec3 normal) {
  vec4 p = uShadow * vec4(vPlace + normal * 0.02, 1.0);
  vec3 q = p.xyz * 0.5 + 0.5;
  if (any(lessThan(q, vec3(0.0))) || any(greaterThan(q, vec3(1.0)))) return 1.0;
  float sum = 0.0;
  for (int i = -${taps}; i <= ${taps}; i++)
    for (int j = -${taps}; j <= ${taps}; j++)
      sum += texture(uDepth, vec3(q.xy + vec2(i, j) * 1.1 / ${shadowSize}.0, q.z - 0.0012));
  vec2 edge = smoothstep(vec2(0.5), vec2(0.44), abs(q.xy - 0.5));
  return mix(1.0, sum / ${(2 * taps + 1) ** 2}.0, edge.x * edge.y);
}

float lines(vec2 p, float spacing, float width) {
  vec2 d = fwidth(p), away = abs(fract(p / spacing + 0.5) - 0.5) * spacing;
  vec2 on = 1.0 - smoothstep(vec2(width) , vec2(width) + d * 1.2, away);
  on *= smoothstep(vec2(spacing * 0.6), vec2(spacing * 0.15), d);
  return max(on.x, on.y);
}

float nearWalls(vec2 p) {
  float nearest = 9.0;
  for (int i = 0; i < ${MAX_WALLS}; i++) {
    if (i >= uNumWalls) break;
    vec2 d = abs(p - uWalls[i].xy) - uWalls[i].zw;
    if (max(d.x, d.y) < 0.0) return 9.0; // below a wall, seen through its glass
    nearest = min(nearest, length(max(d, 0.0)));
  }
  return nearest;
}

vec3 floorColour() {
  vec3 base = mix(uBack, uLine, 0.10);
  base = mix(base, uLine, 0.28 * lines(vPlace.xy, 1.0, 0.004));
  base = mix(base, uLine, 0.5 * lines(vPlace.xy, 4.0, 0.012));
  float d = fwidth(vPlace.x) + fwidth(vPlace.y);
  float s = abs(distance(vPlace.xy, uStart.xy) - 0.45);
  base = mix(base, mix(uLine, vec3(uDark), 0.55), (1.0 - smoothstep(0.03, 0.03 + d, s)) * uStart.w);
  float g = distance(vPlace.xy, uGoal.xy);
  float disc = 1.0 - smoothstep(uGoal.z, uGoal.z + d, g);
  float ring = 1.0 - smoothstep(0.05, 0.05 + d, abs(g - uGoal.z));
  base = mix(base, uGoalColour, uGoal.w * max(0.35 * disc, ring));
  return base * mix(0.62, 1.0, smoothstep(0.0, 0.7, nearWalls(vPlace.xy)));
}

// Walls between the eye and the ant are glass.
float glass() {
  vec3 ray = uFocus - uEye;
  float t = dot(vPlace - uEye, ray) / dot(ray, ray);
  float keep = smoothstep(0.9, 2.6, distance(vPlace, uEye + clamp(t, 0.0, 1.0) * ray));
  vec2 here = vPlace.xy - uFocus.xy, side = -ray.xy / max(length(ray.xy), 1e-3);
  keep = max(keep, 1.0 - smoothstep(0.0, 0.5, dot(here, side))); // what stands behind the ant hides nothing
  return mix(0.14, 1.0, keep);
}

void main() {
  vec3 normal = normalize(vNormal);
  vec3 base = uKind == 2 ? floorColour() : uKind == 3 ? vColour : uColour;
  float opacity = 1.0;
  if (uKind == 1) {
    opacity = glass();
    base *= mix(0.8, 1.0, smoothstep(0.0, 1.2, vPlace.z));
  }
  float sun = max(dot(normal, uLight), 0.0);
  if (sun > 0.0) sun *= lit(normal);
  float sky = 0.5 + 0.5 * normal.z;
  vec3 light = vec3(1.0, 0.97, 0.92) * sun * 0.62 + mix(vec3(0.50, 0.48, 0.46), vec3(0.50, 0.53, 0.58), sky) * 0.9;
  vec3 c = base * (uKind >= 2 ? mix(vec3(1.0), light, uKind == 2 ? 0.85 : 0.45) : light);
  if (uKind == 0) {
    vec3 half_ = normalize(uLight + normalize(uEye - vPlace));
    c += 0.16 * pow(max(dot(normal, half_), 0.0), 40.0) * step(0.01, sun);
    c += 0.10 * pow(1.0 - max(dot(normal, normalize(uEye - vPlace)), 0.0), 3.0);
  }
  float fog = smoothstep(uFog, uFog * 2.2, distance(vPlace, uFocus));
  c = mix(c, uBack, uKind == 0 ? 0.0 : fog);
  colour = vec4(c, opacity);
}`;

// A sphere cut in two, its halves to be moved apart along z: spheres and capsules of any size.
function capsuleMesh() {
  const normals = [], offsets = [], index = [];
  const rings = 9, sectors = 28;
  for (const end of [1, -1]) {
    for (let i = 0; i <= rings; i++) {
      const polar = ((end > 0 ? i : rings + i) * Math.PI) / 2 / rings;
      for (let j = 0; j <= sectors; j++) {
        const around = (2 * Math.PI * j) / sectors;
        normals.push(Math.sin(polar) * Math.cos(around), Math.sin(polar) * Math.sin(around), Math.cos(polar));
        offsets.push(0, 0, end);
      }
    }
  }
  for (let i = 0; i < 2 * rings + 1; i++) {
    for (let j = 0; j < sectors; j++) {
      const a = i * (sectors + 1) + j, b = a + sectors + 1;
      index.push(a, b, a + 1, a + 1, b, b + 1);
    }
  }
  return { normals, offsets, index };
}

function boxMesh() {
  const normals = [], offsets = [], index = [];
  for (let axis = 0; axis < 3; axis++) {
    for (const side of [1, -1]) {
      const first = normals.length / 3;
      for (const [u, v] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) {
        const n = [0, 0, 0], p = [0, 0, 0];
        n[axis] = p[axis] = side;
        p[(axis + 1) % 3] = u * side;
        p[(axis + 2) % 3] = v;
        normals.push(...n);
        offsets.push(...p);
      }
      index.push(first, first + 1, first + 2, first, first + 2, first + 3);
    }
  }
  return { normals, offsets, index };
}

// The path as a ribbon on the floor: two triangles per control step, in the colour of the sub-policy.
function ribbonMesh(data, colours, half) {
  const place = (i) => [data.frames[i * data.width], data.frames[i * data.width + 1]];
  const normals = [], offsets = [], tints = [], index = [];
  const sides = [];
  let heading = [1, 0];
  for (let i = 0; i <= data.steps; i++) {
    const a = place(Math.max(i - 3, 0)), b = place(Math.min(i + 3, data.steps));
    const length = Math.hypot(b[0] - a[0], b[1] - a[1]);
    if (length > 1e-3) heading = [(b[0] - a[0]) / length, (b[1] - a[1]) / length];
    const p = place(i);
    sides.push([[p[0] - heading[1] * half, p[1] + heading[0] * half], [p[0] + heading[1] * half, p[1] - heading[0] * half]]);
  }
  for (let i = 0; i < data.steps; i++) {
    const tint = colours(data.choice[i]);
    const first = offsets.length / 3;
    for (const side of [...sides[i], ...sides[i + 1]]) {
      normals.push(0, 0, 1);
      offsets.push(side[0], side[1], 0.012);
      tints.push(...tint);
    }
    index.push(first, first + 1, first + 2, first + 1, first + 3, first + 2);
  }
  return { normals, offsets, tints, index };
}

// Whether OpenGL runs in software here: then less is drawn, and as smoothly.
function isLean() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl && gl.getExtension("WEBGL_debug_renderer_info");
  return /swiftshader|llvmpipe|softpipe|software/i.test(info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "");
}

class Renderer {
  constructor(gl, lean) {
    this.gl = gl;
    this.shadowSize = lean ? 1024 : 2048;
    this.main = this.program(VERTEX, fragment(this.shadowSize, lean ? 0 : 1));
    this.depth = this.program(VERTEX, DEPTH_FRAGMENT);
    this.capsule = this.mesh(capsuleMesh());
    this.box = this.mesh(boxMesh());
    this.shadowMap = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.shadowMap);
    gl.texImage2D(
      gl.TEXTURE_2D, 0, gl.DEPTH_COMPONENT24, this.shadowSize, this.shadowSize, 0, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, null);
    for (const [name, value] of [
      [gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
      [gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE], [gl.TEXTURE_COMPARE_FUNC, gl.LEQUAL],
    ]) gl.texParameteri(gl.TEXTURE_2D, name, value);
    this.target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, this.shadowMap, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.SCISSOR_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  // Before the panels: the ground between them.
  wipe(colour, width, height) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.scissor(0, 0, width, height);
    gl.clearColor(...colour, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }

  program(vertex, fragment) {
    const gl = this.gl, handle = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(handle, shader);
    }
    gl.linkProgram(handle);
    if (!gl.getProgramParameter(handle, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(handle));
    const places = {};
    for (let i = 0; i < gl.getProgramParameter(handle, gl.ACTIVE_UNIFORMS); i++) {
      const name = gl.getActiveUniform(handle, i).name;
      places[name.replace("[0]", "")] = gl.getUniformLocation(handle, name);
    }
    return { handle, places };
  }

  mesh(data) {
    const gl = this.gl, buffers = [0, 1, 2, 3].map(() => gl.createBuffer());
    return this.refill({ array: gl.createVertexArray(), buffers }, data);
  }

  // Other vertices in a mesh that is there.
  refill(mesh, { normals, offsets, tints, index }) {
    const gl = this.gl;
    gl.bindVertexArray(mesh.array);
    [normals, offsets, tints].forEach((numbers, i) => {
      if (!numbers) return;
      gl.bindBuffer(gl.ARRAY_BUFFER, mesh.buffers[i]);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(numbers), gl.STATIC_DRAW);
      gl.enableVertexAttribArray(i);
      gl.vertexAttribPointer(i, 3, gl.FLOAT, false, 0, 0);
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, mesh.buffers[3]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(index), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    mesh.count = index.length;
    return mesh;
  }

  set(values) {
    const gl = this.gl, places = this.active.places;
    for (const [name, value] of Object.entries(values)) {
      const place = places[name];
      if (place === undefined) continue;
      if (name === "uKind" || name === "uFlat" || name === "uNumWalls" || name === "uDepth") gl.uniform1i(place, value);
      else if (typeof value === "number") gl.uniform1f(place, value);
      else if (name === "uWalls") gl.uniform4fv(place, value);
      else if (value.length === 16) gl.uniformMatrix4fv(place, false, value);
      else if (value.length === 4) gl.uniform4fv(place, value);
      else gl.uniform3fv(place, value);
    }
  }

  draw(thing) {
    const gl = this.gl;
    this.set({
      uModel: thing.model, uSize: thing.size, uRadius: thing.radius, uFlat: thing.flat ? 1 : 0,
      uKind: thing.kind, uColour: thing.colour,
    });
    gl.bindVertexArray(thing.mesh.array);
    gl.drawElements(gl.TRIANGLES, thing.count ?? thing.mesh.count, gl.UNSIGNED_INT, 0);
  }

  // One scene into one rectangle [x, y, width, height] of the canvas, in pixels from the lower left.
  render(scene, rectangle) {
    const gl = this.gl, light = unit([0.42, -0.5, 0.95]);
    const sun = lookAt(plus(scene.focus, times(light, 30)), scene.focus, [0, 1, 0]);
    const shadow = multiply(orthographic(SHADOW_HALF, 5, 60), sun);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.viewport(0, 0, this.shadowSize, this.shadowSize);
    gl.scissor(0, 0, this.shadowSize, this.shadowSize);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    this.use(this.depth);
    this.set({ uView: shadow });
    scene.things.filter((thing) => thing.kind < 2).forEach((thing) => this.draw(thing));
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(...rectangle);
    gl.scissor(...rectangle);
    gl.clearColor(...scene.uniforms.uBack, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.use(this.main);
    gl.bindTexture(gl.TEXTURE_2D, this.shadowMap);
    this.set({ ...scene.uniforms, uView: scene.view, uShadow: shadow, uLight: light, uDepth: 0 });
    const away = (thing) => -Math.hypot(...minus(thing.model.slice(12, 15), scene.eye));
    const walls = scene.things.filter((thing) => thing.kind === 1).sort((a, b) => away(a) - away(b));
    scene.things.filter((thing) => thing.kind !== 1).forEach((thing) => this.draw(thing));
    gl.enable(gl.BLEND);
    gl.enable(gl.CULL_FACE);
    walls.forEach((thing) => this.draw(thing));
    gl.disable(gl.BLEND);
    gl.disable(gl.CULL_FACE);
  }

  use(program) {
    this.active = program;
    this.gl.useProgram(program.handle);
  }
}

// ---------------------------------------------------------------- the stage

const THEMES = {
  light: { back: "#f4f3ef", line: "#8d8a80", wall: "#b9bbc2", shin: "#4d525c", dark: 0 },
  dark: { back: "#17191d", line: "#7d828c", wall: "#4b505a", shin: "#a9aeb8", dark: 1 },
};
const FOV = 0.72; // rad, vertical
const CARD = 250; // px that the card takes of a panel
const GOAL = "#D55E00";
const ARROWS = ["→", "↑", "←", "↓"];
const IDENTITY = [1, 0, 0, 0, 1, 0, 0, 0, 1];

const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);
const mix = (a, b, t) => a.map((v, i) => v + (b[i] - v) * t);
const element = (tag, className, parent, text) => {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  if (parent) parent.append(made);
  return made;
};
let fineness = 1; // less where pictures come slowly
const pixels = () => Math.min(window.devicePixelRatio || 1, 2) * fineness;

// Panels side by side on one canvas, and the camera they share. Whoever extends it fills `panels`: each has walls,
// wall_height, start, goal, goal_radius, extent, and `element`, its section of the page.
class Stage {
  constructor({ skeleton, colours, flat_colour, directions }) {
    this.skeleton = skeleton;
    this.hex = colours;
    this.colours = colours.map(rgb);
    this.flatHex = flat_colour;
    this.flatColour = rgb(flat_colour);
    this.directions = directions;
    this.panels = [];
    this.theme = window.matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
    this.view = { azimuth: -Math.PI / 2, elevation: 0.98, distance: 10.5, shift: [0, 0, 0] };
    this.canvas = document.getElementById("view");
    const lean = isLean(), gl = this.canvas.getContext("webgl2", { antialias: !lean, alpha: false });
    this.renderer = gl ? new Renderer(gl, lean) : null;
    document.getElementById("camera").addEventListener("change", (event) => this.setCamera(event.target.value));
    document.getElementById("theme").addEventListener("click", () => this.toggleTheme());
    document.getElementById("help").addEventListener("click", () => document.getElementById("keys").showModal());
    this.buildPointer();
    this.setTheme(this.theme);
  }

  // Called once the panels are there.
  open() {
    this.setCamera("follow");
    new ResizeObserver(() => this.layout()).observe(document.getElementById("stage"));
    this.layout();
  }

  colourOf(choice) {
    return choice < 0 ? this.flatColour : this.colours[choice];
  }

  buildLegend(used) {
    const legend = document.getElementById("legend");
    const add = (colour, text) => {
      const entry = element("span", "", legend);
      element("i", "", entry).style.background = colour;
      entry.append(text);
    };
    this.directions.forEach((name, i) => used.has(i) && add(this.hex[i], `${ARROWS[i]} ${name}`));
    if (used.has(-1)) add(this.flatHex, "flat policy");
  }

  // The corner of a panel that tells of its ant: a chip, rows of figures, and bars of the master's odds.
  buildCard(panel, title, label, rows, hasOdds) {
    panel.element = element("section", "panel", document.getElementById("stage"));
    const card = element("div", "card", panel.element), hud = { card };
    hud.title = element("h2", "", card, title);
    hud.label = element("small", "", card, label);
    hud.chip = element("span", "chip", card);
    const list = element("dl", "", card);
    for (const [key, name] of rows) {
      element("dt", "", list, name);
      hud[key] = element("dd", "", list, "");
    }
    if (hasOdds) {
      hud.oddsRow = element("div", "odds", card);
      hud.odds = ARROWS.map((arrow, i) => {
        const column = element("span", "", hud.oddsRow), bar = element("b", "", element("i", "", column));
        bar.style.background = this.hex[i];
        column.append(arrow);
        return bar;
      });
    }
    hud.badge = element("div", "badge", panel.element);
    return (panel.hud = hud);
  }

  showChoice(hud, choice) {
    hud.chip.textContent = choice < 0 ? "flat policy" : `${ARROWS[choice]} ${this.directions[choice]}`;
    hud.chip.style.background = choice < 0 ? this.flatHex : this.hex[choice];
  }

  showBadge(hud, text, colour) {
    hud.badge.classList.toggle("on", Boolean(text));
    if (!text) return;
    hud.badge.textContent = text;
    hud.badge.style.background = colour;
  }

  buildPointer() {
    const canvas = this.canvas, fingers = new Map();
    let spread = 0, down = null;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, event);
      spread = 0;
      down = event;
    });
    const lift = (event) => {
      const still = down && Math.hypot(event.clientX - down.clientX, event.clientY - down.clientY) < 4;
      if (still && event.button === 0 && fingers.size === 1) this.pick(event);
      down = null;
      fingers.delete(event.pointerId);
    };
    canvas.addEventListener("pointerup", lift);
    canvas.addEventListener("pointercancel", lift);
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      fingers.set(event.pointerId, event);
      if (fingers.size === 2) {
        const [a, b] = [...fingers.values()];
        const now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
        if (spread) this.zoom(spread / now);
        spread = now;
        return;
      }
      const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY;
      if (event.buttons === 2 || event.shiftKey) this.pan(dx, dy);
      else this.orbit(dx, dy);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY * 0.001));
    }, { passive: false });
  }

  // A click on the floor: whoever cares overrides onFloor(panel, [x, y]).
  pick(event) {
    const box = this.canvas.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
    const panel = this.panels.find((p) => x >= p.box.x && x <= p.box.x + p.box.w && y >= p.box.y && y <= p.box.y + p.box.h);
    if (!panel || !panel.lastPose) return;
    if (!this.renderer) {
      const { at, origin, zoom } = this.flatView(panel, panel.lastPose);
      this.onFloor(panel, [at[0] + (x - origin[0]) / zoom, at[1] - (y - origin[1]) / zoom]);
      return;
    }
    const { eye, axes } = this.cameraOf(panel, panel.lastPose), half = Math.tan(FOV / 2), { box: b } = panel;
    const u = (((x - b.x) / b.w) * 2 - 1) * half * (b.w / b.h), v = (1 - ((y - b.y) / b.h) * 2) * half;
    const ray = plus(plus(times(axes.right, u), times(axes.top, v)), times(axes.back, -1));
    if (ray[2] < -1e-3) this.onFloor(panel, plus(eye, times(ray, -eye[2] / ray[2])).slice(0, 2));
  }

  // Where a point of the floor is on the screen, [x, y] px from the canvas' corner: the other way round.
  project(panel, [x, y]) {
    if (!this.renderer) {
      const { at, origin, zoom } = this.flatView(panel, panel.lastPose);
      return [origin[0] + (x - at[0]) * zoom, origin[1] - (y - at[1]) * zoom];
    }
    const { eye, axes } = this.cameraOf(panel, panel.lastPose), half = Math.tan(FOV / 2), { box: b } = panel;
    const d = minus([x, y, 0], eye), depth = -dot3(d, axes.back);
    const u = dot3(d, axes.right) / depth / half / (b.w / b.h), v = dot3(d, axes.top) / depth / half;
    return [b.x + ((u + 1) / 2) * b.w, b.y + ((1 - v) / 2) * b.h];
  }

  onFloor() {}

  draw() {}

  toggleTheme() {
    this.setTheme(this.theme === "dark" ? "light" : "dark");
  }

  nextCamera() {
    const cameras = ["follow", "whole", "above"];
    this.setCamera(cameras[(cameras.indexOf(this.camera) + 1) % 3]);
  }

  orbit(dx, dy) {
    this.view.azimuth -= dx * 0.006;
    this.view.elevation = Math.max(0.04, Math.min(Math.PI / 2 - 0.001, this.view.elevation + dy * 0.006));
    this.dirty = true;
  }

  zoom(factor) {
    this.view.distance = Math.max(1.5, Math.min(200, this.view.distance * factor));
    this.dirty = true;
  }

  pan(dx, dy) {
    const { azimuth, distance, shift } = this.view, scale = distance * 0.0016;
    const right = [-Math.sin(azimuth), Math.cos(azimuth), 0], ahead = [-Math.cos(azimuth), -Math.sin(azimuth), 0];
    this.view.shift = plus(shift, plus(times(right, -dx * scale), times(ahead, dy * scale)));
    this.dirty = true;
  }

  setTheme(theme) {
    this.theme = theme;
    document.documentElement.classList.toggle("dark", theme === "dark");
    this.dirty = true;
  }

  setCamera(camera) {
    this.camera = camera;
    document.getElementById("camera").value = camera;
    Object.assign(this.view, { azimuth: -Math.PI / 2, shift: [0, 0, 0], fit: camera !== "follow" });
    this.view.elevation = camera === "above" ? Math.PI / 2 - 0.001 : camera === "whole" ? 1.16 : 0.98;
    this.view.distance = 10.5;
    this.dirty = true;
  }

  // Panels in a grid: as many columns as make them nearest to 4 : 3.
  layout() {
    const stage = document.getElementById("stage"), n = this.panels.length, gap = 8;
    const width = stage.clientWidth - 2 * gap, height = stage.clientHeight;
    let best = { error: Infinity };
    for (let columns = 1; columns <= n; columns++) {
      const rows = Math.ceil(n / columns);
      const error = Math.abs(Math.log((width / columns) / (height / rows) / 1.33)) + 0.2 * (columns * rows - n);
      if (error < best.error) best = { error, columns, rows };
    }
    const w = (width - gap * (best.columns - 1)) / best.columns, h = (height - gap * (best.rows - 1)) / best.rows;
    this.panels.forEach((panel, i) => {
      const x = gap + (i % best.columns) * (w + gap), y = Math.floor(i / best.columns) * (h + gap);
      panel.box = { x, y, w, h };
      Object.assign(panel.element.style, { left: `${x}px`, top: `${y}px`, width: `${w}px`, height: `${h}px` });
    });
    this.canvas.width = stage.clientWidth * pixels();
    this.canvas.height = stage.clientHeight * pixels();
    this.draw(); // at once: the canvas is empty now
  }

  scene(panel, pose, tint, ways) {
    const look = THEMES[this.theme], shin = rgb(look.shin);
    const things = [];
    geomPoses(this.skeleton, pose).forEach(({ position, rotation }, i) => {
      const geom = this.skeleton.geoms[i];
      const part = geom.name.split("_")[0];
      const colour = part === "shin" ? shin : part === "thigh" ? mix(tint, shin, 0.25) : tint;
      things.push({
        mesh: this.renderer.capsule, model: matrix(rotation, position), size: [0, 0, geom.half], radius: geom.radius,
        kind: 0, colour,
      });
    });
    for (const [x, y, halfX, halfY] of panel.walls) {
      const half = panel.wall_height / 2;
      things.push({
        mesh: this.renderer.box, model: matrix(IDENTITY, [x, y, half]), size: [halfX, halfY, half], radius: 0,
        kind: 1, colour: rgb(look.wall),
      });
    }
    if (panel.goal) this.flag(things, panel.goal);
    const size = 400;
    things.push({
      mesh: this.floor ??= this.renderer.mesh({
        normals: [0, 0, 1, 0, 0, 1, 0, 0, 1, 0, 0, 1],
        offsets: [-size, -size, 0, size, -size, 0, size, size, 0, -size, size, 0], index: [0, 1, 2, 0, 2, 3],
      }),
      model: matrix(IDENTITY, [pose[0], pose[1], 0]), size: [0, 0, 0], radius: 0, flat: true, kind: 2, colour: [1, 1, 1],
    });
    const here = { model: matrix(IDENTITY, [0, 0, 0]), size: [0, 0, 0], radius: 0, flat: true, kind: 3, colour: [1, 1, 1] };
    for (const way of ways) if (way.count) things.push({ ...here, ...way });
    return { things, ...this.cameraOf(panel, pose), uniforms: this.uniforms(panel, pose, look) };
  }

  flag(things, [x, y]) {
    const colour = rgb(GOAL), place = { mesh: this.renderer.capsule, kind: 0, colour };
    things.push({ ...place, model: matrix(IDENTITY, [x, y, 1.2]), size: [0, 0, 1.2], radius: 0.035 });
    things.push({ ...place, model: matrix(IDENTITY, [x, y, 2.5]), size: [0, 0, 0], radius: 0.17 });
  }

  uniforms(panel, pose, look) {
    const { eye, focus } = this.cameraOf(panel, pose);
    const walls = new Float32Array(4 * MAX_WALLS);
    panel.walls.slice(0, MAX_WALLS).forEach((wall, i) => walls.set(wall, 4 * i));
    const goal = panel.goal ? [...panel.goal, panel.goal_radius, 1] : [0, 0, 0, 0];
    return {
      uEye: eye, uFocus: [pose[0], pose[1], 0.5], uBack: rgb(look.back), uLine: rgb(look.line), uDark: look.dark,
      uGoal: goal, uStart: [...panel.start, 0, 1], uGoalColour: rgb(GOAL), uWalls: walls,
      uNumWalls: Math.min(panel.walls.length, MAX_WALLS),
      uFog: Math.max(18, Math.hypot(...minus(eye, focus)) * (this.view.fit ? 1.6 : 1.1)),
    };
  }

  cameraOf(panel, pose) {
    const { box } = panel, aspect = box.w / box.h;
    const { azimuth, elevation } = this.view, flat = Math.cos(elevation);
    let { distance } = this.view;
    let target = [pose[0], pose[1], 0.4];
    if (this.view.fit) {
      const [x, y, halfX, halfY] = panel.extent;
      target = [x, y, 0];
      const tall = this.camera === "above" ? halfY : halfY * 0.86 + 1;
      // The card would hide the upper left corner: the arena stands right of it, a little smaller where there is no room.
      const wide = halfX / aspect, fill = Math.max(tall, wide), beside = box.w > 2 * CARD ? wide / (1 - CARD / box.w) : 0;
      const size = Math.max(fill, Math.min(beside, 1.2 * fill));
      distance *= (1.04 * size) / Math.tan(FOV / 2) / 10.5 + (this.camera === "above" ? 0.2 : 0);
      const aside = Math.min(CARD / box.w, 0.8 * (1 - wide / size)) * distance * Math.tan(FOV / 2) * aspect;
      target = minus(target, [-Math.sin(azimuth) * aside, Math.cos(azimuth) * aside, 0]);
    }
    target = plus(target, this.view.shift);
    const eye = plus(target, times([Math.cos(azimuth) * flat, Math.sin(azimuth) * flat, Math.sin(elevation)], distance));
    const top = [-Math.cos(azimuth) * Math.sin(elevation), -Math.sin(azimuth) * Math.sin(elevation), flat];
    const back = unit(minus(eye, target)), axes = { right: cross(top, back), top, back };
    const view = multiply(perspective(FOV, aspect, 0.1, 900), lookAt(eye, target, top));
    return { view, eye, axes, focus: [pose[0], pose[1], 0.4] };
  }

  wipe() {
    if (this.renderer) this.renderer.wipe(rgb(THEMES[this.theme].back), this.canvas.width, this.canvas.height);
  }

  // One panel: the ant in its colour, and the ways walked, [{ mesh, count }] (without WebGL: `pieces`, from above).
  drawPanel(panel, pose, tint, ways, pieces) {
    const scale = pixels(), { x, y, w, h } = panel.box;
    panel.lastPose = pose;
    if (!this.renderer) return this.drawFlat(panel, pose, tint, pieces(), scale);
    const rectangle = [x, this.canvas.height / scale - y - h, w, h].map((v) => Math.round(v * scale));
    return this.renderer.render(this.scene(panel, pose, tint, ways), rectangle);
  }

  // Without WebGL one looks straight down: the point `at` of the floor (m) is drawn at `origin` (px), `zoom` px per m.
  flatView({ box: { x, y, w, h }, extent }, pose) {
    const { fit, distance, shift } = this.view, half = 0.42 * distance;
    const [cx, cy, halfX, halfY] = fit ? extent : [pose[0], pose[1], half, half];
    const card = fit && w > 2 * CARD ? CARD : 0; // the arena stands right of the card
    const zoom = (Math.min((w - card) / halfX, h / halfY) / 2.1) * (fit ? 10.5 / distance : 1);
    return { at: [cx + shift[0], cy + shift[1]], origin: [x + (w + card) / 2, y + h / 2], zoom };
  }

  // Without WebGL: the same from above, with the pen of the page.
  drawFlat(panel, pose, tint, pieces, scale) {
    const pen = this.pen ??= this.canvas.getContext("2d"), look = THEMES[this.theme], { x, y, w, h } = panel.box;
    pen.save();
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.beginPath();
    pen.rect(x, y, w, h);
    pen.clip();
    pen.fillStyle = look.back;
    pen.fillRect(x, y, w, h);
    const { at, origin, zoom } = this.flatView(panel, pose);
    pen.translate(...origin);
    pen.scale(zoom, -zoom);
    pen.translate(-at[0], -at[1]);
    pen.fillStyle = look.wall;
    for (const [wx, wy, hx, hy] of panel.walls) pen.fillRect(wx - hx, wy - hy, 2 * hx, 2 * hy);
    if (panel.goal) {
      pen.fillStyle = GOAL;
      pen.beginPath();
      pen.arc(...panel.goal, panel.goal_radius, 0, 7);
      pen.fill();
    }
    const line = (ax, ay, bx, by, width, colour) => {
      pen.lineWidth = width;
      pen.lineCap = "round";
      pen.strokeStyle = `rgb(${colour.map((v) => Math.round(255 * v))})`;
      pen.beginPath();
      pen.moveTo(ax, ay);
      pen.lineTo(bx, by);
      pen.stroke();
    };
    for (const [ax, ay, bx, by, colour] of pieces) line(ax, ay, bx, by, 0.1, colour);
    geomPoses(this.skeleton, pose).forEach(({ position, rotation }, i) => {
      const geom = this.skeleton.geoms[i], along = times([rotation[2], rotation[5], rotation[8]], geom.half);
      const colour = geom.name.startsWith("shin") ? rgb(look.shin) : tint;
      const [a, b] = [minus(position, along), plus(position, along)];
      line(a[0], a[1], b[0], b[1], 2 * geom.radius, colour);
    });
    pen.restore();
  }

  // Where OpenGL runs in software: coarser pictures rather than jerky ones.
  spare(elapsed) {
    this.slow = elapsed > 0.06 ? (this.slow || 0) + 1 : Math.max(0, (this.slow || 0) - 0.25);
    if (this.slow < 6 || fineness <= 0.5) return;
    this.slow = 0;
    fineness = Math.max(0.5, fineness * 0.7);
    this.layout();
  }
}
