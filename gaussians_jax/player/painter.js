"use strict";
// Rendering of Gaussians in WebGL 2, with the formulas of splatting/projection.py.

const WIDTH = 2048; // texels per row, supported by all devices

// The footprint of one Gaussian at the time and camera of the uniforms.
const PROJECTION = `
precision highp float;
precision highp int;
precision highp isampler2D;
uniform highp sampler2D gaussians, steps;
uniform isampler2D meanChange, quaternionChange, scaleChange;
uniform int movers, before;
uniform float share;
uniform mat3 rotation; // from world to camera
uniform vec3 position;
uniform vec2 focal, center, size, margin;
uniform float skew, near, far, eps2d, least;
uniform bool antialiased;

struct Footprint {
  vec2 mean; // px
  vec3 whitening; // p, k, r: u = p dx, v = r (dy - k dx)
  float opacity;
  vec3 color;
  bool seen;
};

vec4 texel(int index, int part) {
  return texelFetch(gaussians, ivec2((index & 511) * 4 + part, index >> 9), 0);
}

vec4 change(isampler2D changes, int row) {
  int i = before * movers + row, j = i + movers;
  vec4 one = vec4(texelFetch(changes, ivec2(i & 2047, i >> 11), 0));
  vec4 other = vec4(texelFetch(changes, ivec2(j & 2047, j >> 11), 0));
  return mix(one, other, share);
}

Footprint footprintOf(int index) {
  Footprint shown;
  shown.seen = false;
  vec4 place = texel(index, 0), q = texel(index, 1), lengths = texel(index, 2);
  int row = int(lengths.w);
  if (row >= 0) {
    vec4 unit = texelFetch(steps, ivec2(row & 2047, row >> 11), 0);
    place += unit.xxxw * change(meanChange, row);
    q += unit.y * change(quaternionChange, row);
    lengths += unit.z * change(scaleChange, row);
  }
  shown.color = texel(index, 3).rgb;
  shown.opacity = place.w;
  vec3 scale = exp(lengths.xyz);
  vec3 view = rotation * (place.xyz - position);
  float z = view.z;
  if (!(z >= near && z <= far && shown.opacity >= least)) return shown;
  vec2 tangent = view.xy / z;
  shown.mean = focal * tangent + vec2(skew * tangent.y, 0.0) + center;

  // Rows of T = J W R diag(scale), with clamped tangents in J only.
  tangent = clamp(tangent, -(center + margin) / focal, (size - center + margin) / focal);
  float twice = 2.0 / dot(q, q);
  float w = q.x, x = q.y, y = q.z, s = q.w;
  mat3 axes = rotation * mat3(
    1.0 - twice * (y * y + s * s), twice * (x * y + w * s), twice * (x * s - w * y),
    twice * (x * y - w * s), 1.0 - twice * (x * x + s * s), twice * (y * s + w * x),
    twice * (x * s + w * y), twice * (y * s - w * x), 1.0 - twice * (x * x + y * y));
  mat3 across = transpose(axes); // columns: right, down and forward components of the axes
  vec3 right = across[0] - tangent.x * across[2], down = across[1] - tangent.y * across[2];
  vec3 first = (focal.x * right + skew * down) * scale / z;
  vec3 second = focal.y * down * scale / z;

  float a = dot(first, first) + eps2d, inverse = inversesqrt(a);
  vec3 n = first * inverse, area = cross(n, second);
  float sharp = dot(area, area);
  float blurred = sharp + eps2d * (1.0 + dot(second, second) / a);
  shown.whitening = vec3(
    sqrt(0.5) * inverse, dot(n, second) * inverse, sqrt(0.5) * inversesqrt(blurred));
  if (antialiased) shown.opacity *= max(sqrt(sharp / blurred), 0.005);
  shown.seen = shown.opacity >= least;
  return shown;
}`;

// Write the footprints in depth order, once per Gaussian and not per corner, which
// would take a third of a frame on a CPU. `reach` is the squared radius at which alpha
// falls to the threshold, as an exponent of two, which hardware evaluates.
const PROJECT = `#version 300 es
${PROJECTION}
layout(location = 0) in uint index;
out vec4 place; // mean in px, k, reach
out vec2 spread; // px along x and y per unit of that reach
out vec3 color;
void main() {
  Footprint shown = footprintOf(int(index));
  place = vec4(0.0, 0.0, 0.0, -1.0);
  spread = vec2(0.0);
  color = vec3(0.0);
  if (!shown.seen) return;
  place = vec4(shown.mean, shown.whitening.y, log2(shown.opacity / least));
  spread = sqrt(log(2.0)) / shown.whitening.xz;
  color = shown.color;
}`;
const NOTHING = `#version 300 es
void main() {}`;
const PARTS = { place: 4, spread: 2, color: 3 }; // floats per footprint

// The quad around a footprint is the square around the circle u^2 + v^2 = reach, the
// smallest parallelogram that contains the ellipse.
const VERTEX = `#version 300 es
uniform vec2 size;
layout(location = 0) in vec4 place;
layout(location = 1) in vec2 spread;
layout(location = 2) in vec3 color;
out vec2 offset;
flat out vec4 tint;
void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  if (place.w < 0.0) return;
  tint = vec4(color, place.w);
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  offset = corner * sqrt(place.w);
  float dx = offset.x * spread.x;
  vec2 at = place.xy + vec2(dx, offset.y * spread.y + place.z * dx);
  at = at / size * 2.0 - 1.0;
  gl_Position = vec4(at.x, -at.y, 0.0, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform float least, most;
in vec2 offset;
flat in vec4 tint;
out vec4 drawn;
void main() {
  float left = tint.a - dot(offset, offset);
  if (left < 0.0) discard;
  float alpha = min(most, least * exp2(left));
  drawn = vec4(tint.rgb * alpha, alpha);
}`;
const WHOLE = `#version 300 es
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  gl_Position = vec4(corner, 0.0, 1.0);
}`;
const BEHIND = `#version 300 es
precision highp float;
uniform sampler2D image;
uniform vec3 background;
out vec4 drawn;
void main() {
  vec4 front = texelFetch(image, ivec2(gl_FragCoord.xy), 0);
  drawn = vec4(front.rgb + (1.0 - front.a) * background, 1.0);
}`;

function programOf(gl, vertex, fragment, varyings = null) {
  const linked = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(linked, shader);
  }
  if (varyings) gl.transformFeedbackVaryings(linked, varyings, gl.INTERLEAVED_ATTRIBS);
  gl.linkProgram(linked);
  if (!gl.getProgramParameter(linked, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error(gl.getProgramInfoLog(linked));
  }
  return linked;
}

// Return a function that sets a uniform by its name.
function uniformsOf(gl, program) {
  const places = {};
  return (name, kind, ...values) => {
    places[name] ??= gl.getUniformLocation(program, name);
    gl["uniform" + kind](places[name], ...values);
  };
}

// Store a scene in textures, at the units 0 to 4 in the order of SAMPLERS.
const SAMPLERS = ["gaussians", "steps", "meanChange", "quaternionChange", "scaleChange"];

function sceneTextures(gl, header, buffer) {
  const count = header.arrays.color.shape[0], { keyframes } = header;
  const fields = Object.keys(FIELDS).map((name) => fieldOf(name, header, buffer));
  const rowOf = new Int32Array(count).fill(-1);
  let movers = 0;
  for (const { rows } of fields) {
    for (const row of rows) if (rowOf[row] < 0) rowOf[row] = movers++;
  }
  const all = (kind, texels) => new kind(4 * WIDTH * Math.max(1, Math.ceil(texels / WIDTH)));
  const gaussians = all(Float32Array, 4 * count), steps = all(Float32Array, movers);
  const changes = [Int16Array, Int8Array, Int8Array].map(
    (kind) => all(kind, keyframes * movers));
  const color = decoded(header.arrays.color, buffer);
  for (let i = 0; i < count; i++) {
    gaussians[16 * i + 11] = rowOf[i];
    for (let k = 0; k < 3; k++) gaussians[16 * i + 12 + k] = color[3 * i + k];
  }
  // Of mean, quaternion, scale and opacity, which is stored with the mean.
  [[0, 0, 0], [4, 1, 0], [8, 2, 0], [3, 0, 3]].forEach(([at, texture, first], f) => {
    const { width, values, rows, step, change } = fields[f];
    for (let i = 0; i < count; i++) {
      for (let k = 0; k < width; k++) gaussians[16 * i + at + k] = values[width * i + k];
    }
    rows.forEach((row, r) => {
      steps[4 * rowOf[row] + f] = step[r];
      for (let t = 0; t < keyframes; t++) {
        const from = (t * rows.length + r) * width;
        const to = 4 * (t * movers + rowOf[row]) + first;
        for (let k = 0; k < width; k++) changes[texture][to + k] = change[from + k];
      }
    });
  });
  const kinds = [
    [gl.RGBA32F, gl.RGBA, gl.FLOAT], [gl.RGBA32F, gl.RGBA, gl.FLOAT],
    [gl.RGBA16I, gl.RGBA_INTEGER, gl.SHORT],
    [gl.RGBA8I, gl.RGBA_INTEGER, gl.BYTE], [gl.RGBA8I, gl.RGBA_INTEGER, gl.BYTE],
  ];
  [gaussians, steps, ...changes].forEach((content, unit) => {
    const [inside, format, type] = kinds[unit];
    gl.activeTexture(gl.TEXTURE0 + unit);
    newTexture(gl);
    gl.texImage2D(
      gl.TEXTURE_2D, 0, inside, WIDTH, content.length / 4 / WIDTH, 0, format, type, content);
  });
  return { movers, keyframes };
}

function newTexture(gl) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return texture;
}

// Set all uniforms of PROJECTION.
function setCamera(set, scene, camera, raster, time) {
  const { before, share } = between(time, scene.keyframes);
  SAMPLERS.forEach((name, unit) => set(name, "1i", unit));
  set("movers", "1i", scene.movers);
  set("before", "1i", before);
  set("share", "1f", share);
  set("rotation", "Matrix3fv", true, camera.rotation);
  set("position", "3fv", camera.position);
  set("focal", "2f", camera.focal, camera.focal * camera.aspect);
  set("center", "2fv", camera.center);
  set("size", "2fv", camera.size);
  set("margin", "2fv", camera.size.map((pixels) => raster.tangent_margin * 0.5 * pixels));
  set("skew", "1f", camera.skew);
  for (const name of ["near", "far", "eps2d"]) set(name, "1f", raster[name]);
  set("least", "1f", raster.alpha_threshold);
  set("antialiased", "1i", Number(raster.antialiased));
}

// Half floats prevent the banding that eight bits would show in a hundred thin layers.
// A software renderer blends full floats in half the time.
function formatOf(gl) {
  const float = gl.getExtension("EXT_color_buffer_float");
  const named = gl.getExtension("WEBGL_debug_renderer_info");
  const name = named ? gl.getParameter(named.UNMASKED_RENDERER_WEBGL) : "";
  if (float && /SwiftShader/.test(name) && gl.getExtension("EXT_float_blend")) {
    return [gl.RGBA32F, gl.FLOAT];
  }
  const half = float || gl.getExtension("EXT_color_buffer_half_float");
  return half ? [gl.RGBA16F, gl.HALF_FLOAT] : [gl.RGBA8, gl.UNSIGNED_BYTE];
}

// Buffers for a number of footprints, which `quads` renders one by one.
function footprintBuffer(gl, quads, count) {
  const widths = Object.values(PARTS), bytes = 4 * widths.reduce((a, b) => a + b);
  const footprints = gl.createBuffer();
  gl.bindVertexArray(quads);
  gl.bindBuffer(gl.ARRAY_BUFFER, footprints);
  gl.bufferData(gl.ARRAY_BUFFER, bytes * count, gl.DYNAMIC_COPY);
  let at = 0;
  widths.forEach((width, i) => {
    gl.enableVertexAttribArray(i);
    gl.vertexAttribPointer(i, width, gl.FLOAT, false, bytes, at);
    gl.vertexAttribDivisor(i, 1);
    at += 4 * width;
  });
  return footprints;
}

// Return the renderer of a scene: `sort` sets the rows to render, farthest first.
function painterOf(canvas, header, buffer) {
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false });
  if (!gl) throw new Error("this browser has no WebGL 2");
  const projector = programOf(gl, PROJECT, NOTHING, Object.keys(PARTS));
  const splats = programOf(gl, VERTEX, FRAGMENT), whole = programOf(gl, WHOLE, BEHIND);
  const [setProjector, set, setWhole] = [projector, splats, whole].map(
    (program) => uniformsOf(gl, program));
  const scene = sceneTextures(gl, header, buffer), unit = SAMPLERS.length;
  const target = gl.createFramebuffer(), rows = gl.createBuffer();
  const order = gl.createVertexArray(), quads = gl.createVertexArray();
  gl.bindVertexArray(order);
  gl.bindBuffer(gl.ARRAY_BUFFER, rows);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
  const footprints = footprintBuffer(gl, quads, header.arrays.color.shape[0]);
  const [format, type] = formatOf(gl);
  gl.activeTexture(gl.TEXTURE0 + unit);
  const texture = newTexture(gl);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  let size = [0, 0], count = 0;

  function resize() {
    if (size[0] === canvas.width && size[1] === canvas.height) return;
    size = [canvas.width, canvas.height];
    gl.texImage2D(gl.TEXTURE_2D, 0, format, ...size, 0, gl.RGBA, type, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.framebufferTexture2D(
      gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    gl.viewport(0, 0, ...size);
  }

  function sort(sorted) {
    count = sorted.length;
    gl.bindBuffer(gl.ARRAY_BUFFER, rows);
    gl.bufferData(gl.ARRAY_BUFFER, sorted, gl.STREAM_DRAW);
  }

  // Compute the footprints of all sorted rows.
  function project(camera, raster, time) {
    gl.useProgram(projector);
    setCamera(setProjector, scene, camera, raster, time);
    gl.bindVertexArray(order);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, footprints);
    gl.enable(gl.RASTERIZER_DISCARD);
    gl.beginTransformFeedback(gl.POINTS);
    gl.drawArrays(gl.POINTS, 0, count);
    gl.endTransformFeedback();
    gl.disable(gl.RASTERIZER_DISCARD);
    // A buffer cannot be written and rendered from at the same time.
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
  }

  // Render a quad for each footprint with the current program.
  function drawQuads() {
    gl.bindVertexArray(quads);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
  }

  function draw(camera, raster, time, background) {
    resize();
    project(camera, raster, time);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.useProgram(splats);
    set("size", "2fv", camera.size);
    set("least", "1f", raster.alpha_threshold);
    set("most", "1f", raster.alpha_max);
    drawQuads();
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(whole);
    setWhole("image", "1i", unit);
    setWhole("background", "3fv", background);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, 1);
  }

  return { gl, scene, sort, project, drawQuads, draw };
}
