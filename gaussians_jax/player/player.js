"use strict";
// The page of a player: its controls and the drawing of footprints by WebGL 2.

const VERTEX = `#version 300 es
uniform vec2 size;
layout(location = 0) in vec2 corner;
layout(location = 1) in vec2 mean;
layout(location = 2) in vec4 shape; // p, k, r, opacity
layout(location = 3) in vec2 box;
layout(location = 4) in vec3 colour;
out vec2 offset;
flat out vec4 footprint;
flat out vec3 tint;
void main() {
  offset = corner * box;
  footprint = shape;
  tint = colour;
  vec2 place = (mean + offset) / size * 2.0 - 1.0;
  gl_Position = vec4(place.x, -place.y, 0.0, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform float least, most;
in vec2 offset;
flat in vec4 footprint;
flat in vec3 tint;
out vec4 drawn;
void main() {
  float u = footprint.x * offset.x;
  float v = footprint.z * (offset.y - footprint.y * offset.x);
  float alpha = min(most, footprint.w * exp(-u * u - v * v));
  if (alpha < least) discard;
  drawn = vec4(tint * alpha, alpha);
}`;
const WHOLE = `#version 300 es
layout(location = 0) in vec2 corner;
void main() { gl_Position = vec4(corner, 0.0, 1.0); }`;
const BEHIND = `#version 300 es
precision highp float;
uniform sampler2D picture;
uniform vec3 background;
out vec4 drawn;
void main() {
  vec4 front = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
  drawn = vec4(front.rgb + (1.0 - front.a) * background, 1.0);
}`;
const RADIANS = 0.006; // that the view turns for a pixel
// Of a footprint, in the order of the shader's inputs 1 to 4.
const PARTS = [2, 4, 2, 3];

function program(gl, vertex, fragment) {
  const linked = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(linked, shader);
  }
  gl.linkProgram(linked);
  if (!gl.getProgramParameter(linked, gl.LINK_STATUS)) {
    throw new Error(gl.getProgramInfoLog(linked));
  }
  return linked;
}

// A function of sorted footprints that draws them on the canvas.
function painter(canvas, raster) {
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false });
  if (!gl) throw new Error("this browser has no WebGL 2");
  const splats = program(gl, VERTEX, FRAGMENT), whole = program(gl, WHOLE, BEHIND);
  const corners = gl.createBuffer(), instances = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, corners);
  gl.bufferData(
    gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  gl.bindBuffer(gl.ARRAY_BUFFER, instances);
  let at = 0;
  PARTS.forEach((width, i) => {
    gl.enableVertexAttribArray(i + 1);
    gl.vertexAttribPointer(i + 1, width, gl.FLOAT, false, 4 * FLOATS, 4 * at);
    gl.vertexAttribDivisor(i + 1, 1);
    at += width;
  });
  // Eight bits would round a hundred thin layers to bands.
  const fine = gl.getExtension("EXT_color_buffer_float")
    || gl.getExtension("EXT_color_buffer_half_float");
  const texture = gl.createTexture(), target = gl.createFramebuffer();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  let size = [0, 0];

  function resize() {
    if (size[0] === canvas.width && size[1] === canvas.height) return;
    size = [canvas.width, canvas.height];
    const kind = fine ? gl.HALF_FLOAT : gl.UNSIGNED_BYTE;
    gl.texImage2D(
      gl.TEXTURE_2D, 0, fine ? gl.RGBA16F : gl.RGBA8, ...size, 0, gl.RGBA, kind, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.framebufferTexture2D(
      gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  }

  return (footprints, background) => {
    resize();
    gl.viewport(0, 0, ...size);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(splats);
    gl.uniform2f(gl.getUniformLocation(splats, "size"), ...size);
    gl.uniform1f(gl.getUniformLocation(splats, "least"), raster.alpha_threshold);
    gl.uniform1f(gl.getUniformLocation(splats, "most"), raster.alpha_max);
    gl.bufferData(gl.ARRAY_BUFFER, footprints, gl.STREAM_DRAW);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, footprints.length / FLOATS);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(whole);
    gl.uniform3f(gl.getUniformLocation(whole, "background"), ...background);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  };
}

function start(header, buffer) {
  const one = (id) => document.getElementById(id);
  const canvas = one("scene"), slider = one("time"), button = one("play");
  const scene = unpack(header, buffer);
  let paint = painter(canvas, header.raster), lost = false;
  let view = header.view, playing = !location.hash, stale = true, before = 0;
  slider.value = parseFloat(location.hash.slice(1)) || 0; // player.html#0.5: that time

  function draw() {
    const dense = Math.min(window.devicePixelRatio || 1, 2);
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * dense));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * dense));
    const camera = fitted(view, canvas.width, canvas.height);
    // The footprints' least width counts pixels as trained: in a larger picture it
    // grows along, or thin Gaussians would part.
    const wider = Math.max(1, camera.enlarged);
    const raster = { ...header.raster, eps2d: header.raster.eps2d * wider * wider };
    pose(scene, Number(slider.value));
    const hex = parseInt(one("background").value.slice(1), 16);
    const background = [hex >> 16, (hex >> 8) & 255, hex & 255].map((x) => x / 255);
    paint(project(scene, camera, raster), background);
    one("poster").hidden = true;
  }

  function tick(now) {
    if (playing) {
      const time = Number(slider.value) + (now - before) / 1000 / header.seconds;
      slider.value = time % 1;
    }
    before = now;
    if (!lost && (playing || stale)) {
      draw();
      stale = false;
    }
    requestAnimationFrame(tick);
  }

  function change(next) {
    view = next;
    stale = true;
  }

  function play(yes) {
    playing = yes;
    button.textContent = yes ? "Pause" : "Play";
  }

  // Phones take the drawing of pages that are out of sight, and may give it back.
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault(); // or it is never given back
    lost = true;
    one("poster").hidden = false;
    one("trouble").textContent = "The browser took the drawing: load the page again if it stays away.";
  });
  canvas.addEventListener("webglcontextrestored", () => {
    paint = painter(canvas, header.raster);
    lost = false;
    stale = true;
    one("trouble").textContent = "";
  });
  steer(canvas, header.up, () => view, change);
  button.addEventListener("click", () => play(!playing));
  one("first").addEventListener("click", () => change(header.view));
  for (const id of ["time", "background"]) {
    one(id).addEventListener("input", () => { stale = true; });
  }
  slider.addEventListener("pointerdown", () => play(false));
  window.addEventListener("resize", () => { stale = true; });
  window.addEventListener("keydown", (event) => {
    // Which Space presses or opens; on the slider it plays.
    if (event.key !== " " || event.target.closest?.("button, [type=color]")) return;
    event.preventDefault();
    play(!playing);
  });
  play(playing);
  requestAnimationFrame((now) => { before = now; tick(now); });
  return {
    get view() { return view; },
    get time() { return Number(slider.value); },
    get playing() { return playing; },
    get ready() { return !stale; },
  };
}

// Pointers and wheel on the canvas change the view: `get` has it, `change` takes it.
function steer(canvas, up, get, change) {
  const held = new Map();

  function drag(dx, dy, sideways) {
    const view = get();
    const away = Math.hypot(...view.position.map((x, k) => x - view.target[k]));
    const unit = away / fitted(view, canvas.clientWidth, canvas.clientHeight).focal;
    if (sideways) return change(moved(view, -dx * unit, -dy * unit));
    const about = turned(view, up, -dx * RADIANS);
    change(turned(about, about.rotation.slice(0, 3), -dy * RADIANS));
  }

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, event);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => held.delete(event.pointerId));
  }
  canvas.addEventListener("pointermove", (event) => {
    const last = held.get(event.pointerId);
    if (!last) return;
    held.set(event.pointerId, event);
    const dx = event.clientX - last.clientX, dy = event.clientY - last.clientY;
    if (held.size === 1) return drag(dx, dy, event.shiftKey || event.buttons === 2);
    const other = [...held.values()].find((each) => each.pointerId !== event.pointerId);
    const apart = (a) => Math.hypot(a.clientX - other.clientX, a.clientY - other.clientY);
    drag(dx / 2, dy / 2, true);
    change(nearer(get(), apart(last) / Math.max(apart(event), 1)));
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode ? 30 : 1; // px, or lines of about 30
    change(nearer(get(), Math.exp(event.deltaY * lines * 0.001)));
  }, { passive: false });
}

function bytesOf(text) {
  const packed = atob(text.trim()), bytes = new Uint8Array(packed.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = packed.charCodeAt(i);
  return bytes.buffer;
}

let player = null; // for tests and for pages that embed this one
try {
  const text = (id) => document.getElementById(id).textContent;
  player = start(JSON.parse(text("header")), bytesOf(text("data")));
} catch (error) {
  document.getElementById("trouble").textContent = `Nothing can be drawn: ${error.message}`;
}
