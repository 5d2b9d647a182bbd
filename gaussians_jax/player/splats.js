"use strict";
// The scene of a player: unpacked, posed at a time, projected, put in order. Pure
// functions of arrays; nothing here knows the page. The formulas are those of
// gaussians_jax/projection.py; axes are x right, y down, z forward, pixel centres at
// +0.5, quaternions wxyz, matrices row by row.

const TYPES = {
  uint8: Uint8Array, int8: Int8Array, uint16: Uint16Array, int16: Int16Array,
  uint32: Uint32Array, float32: Float32Array,
};
const FIELDS = { mean: 3, quaternion: 4, log_scale: 3, opacity: 1 };
const FLOATS = 11; // of a footprint: mean 2, p k r, opacity, half box 2, colour 3

// Numbers of one array as they are stored.
function stored(entry, buffer) {
  const length = entry.shape.reduce((product, size) => product * size, 1);
  return new TYPES[entry.type](buffer, entry.offset, length);
}

// The scene at rest, what moves of it, and room for it at one time.
function unpack(header, buffer) {
  const entries = header.arrays;
  const scene = { instants: header.instants, count: entries.colour.shape[0], fields: {} };
  scene.colour = Float32Array.from(
    stored(entries.colour, buffer), (number) => entries.colour.scale * number);
  for (const [name, width] of Object.entries(FIELDS)) {
    const entry = entries[name];
    const rest = Float32Array.from(
      stored(entry, buffer), (number) => entry.shift + entry.scale * number);
    scene.fields[name] = {
      width, rest,
      now: rest.slice(),
      rows: stored(entries[name + ".rows"], buffer),
      step: stored(entries[name + ".step"], buffer),
      change: stored(entries[name + ".change"], buffer),
    };
  }
  scene.scale = scene.fields.log_scale.rest.map(Math.exp);
  scene.room = { // for every frame the same: to make it anew takes a fifth of one
    footprints: new Float32Array(scene.count * FLOATS),
    depths: new Float32Array(scene.count),
  };
  return scene;
}

// Brings every field's `now` to a time from 0 to 1, on the straight line between the
// two instants beside it.
function pose(scene, time) {
  const place = Math.min(Math.max(time, 0), 1) * (scene.instants - 1);
  const before = Math.min(Math.floor(place), scene.instants - 2);
  const share = place - before;
  for (const { width, rest, now, rows, step, change } of Object.values(scene.fields)) {
    const size = rows.length * width;
    for (let row = 0, at = before * size; row < rows.length; row++) {
      for (let k = 0; k < width; k++, at++) {
        const i = rows[row] * width + k;
        const between = change[at] + share * (change[at + size] - change[at]);
        now[i] = rest[i] + step[row] * between;
      }
    }
  }
  const { now, rows } = scene.fields.log_scale;
  for (const row of rows) {
    for (let i = 3 * row; i < 3 * row + 3; i++) scene.scale[i] = Math.exp(now[i]);
  }
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}

// Footprints of what a camera sees, farthest first; FLOATS numbers each. `camera` has
// rotation, position, focal, aspect, skew, centre and size of the picture in px.
function project(scene, camera, raster) {
  const { rotation: w, position: at, size, centre, skew } = camera;
  const mean = scene.fields.mean.now, quaternion = scene.fields.quaternion.now;
  const opacities = scene.fields.opacity.now, scale = scene.scale;
  const fx = camera.focal, fy = camera.focal * camera.aspect;
  const marginX = raster.tangent_margin * 0.5 * size[0];
  const marginY = raster.tangent_margin * 0.5 * size[1];
  const { footprints, depths } = scene.room;
  const first = [0, 0, 0], second = [0, 0, 0], axes = new Float64Array(9);
  let seen = 0;
  for (let i = 0; i < scene.count; i++) {
    const dx = mean[3 * i] - at[0], dy = mean[3 * i + 1] - at[1];
    const dz = mean[3 * i + 2] - at[2];
    const z = w[6] * dx + w[7] * dy + w[8] * dz;
    if (!(z >= raster.near && z <= raster.far)) continue;
    let opacity = opacities[i];
    if (!(opacity >= raster.alpha_threshold)) continue;
    let tanX = (w[0] * dx + w[1] * dy + w[2] * dz) / z;
    let tanY = (w[3] * dx + w[4] * dy + w[5] * dz) / z;
    const x = fx * tanX + skew * tanY + centre[0], y = fy * tanY + centre[1];

    // Rows of T = J W R diag(scale), tangents clamped in J alone.
    tanX = clamp(tanX, -(centre[0] + marginX) / fx, (size[0] - centre[0] + marginX) / fx);
    tanY = clamp(tanY, -(centre[1] + marginY) / fy, (size[1] - centre[1] + marginY) / fy);
    columns(quaternion, 4 * i, axes);
    for (let k = 0; k < 3; k++) {
      const a = axes[3 * k], b = axes[3 * k + 1], c = axes[3 * k + 2];
      const right = w[0] * a + w[1] * b + w[2] * c;
      const down = w[3] * a + w[4] * b + w[5] * c;
      const ahead = w[6] * a + w[7] * b + w[8] * c;
      const length = scale[3 * i + k] / z;
      first[k] = (fx * (right - tanX * ahead) + skew * (down - tanY * ahead)) * length;
      second[k] = fy * (down - tanY * ahead) * length;
    }

    // The whitening: u = p dx, v = r (dy - k dx), alpha = opacity exp(-u^2 - v^2).
    const a = dot(first, first) + raster.eps2d;
    const nx = first[1] * second[2] - first[2] * second[1];
    const ny = first[2] * second[0] - first[0] * second[2];
    const nz = first[0] * second[1] - first[1] * second[0];
    const sharp = (nx * nx + ny * ny + nz * nz) / a;
    const blurred = sharp + raster.eps2d * (1 + dot(second, second) / a);
    const p = Math.sqrt(0.5 / a), k = dot(first, second) / a;
    const r = Math.sqrt(0.5 / blurred);
    if (raster.antialiased) opacity *= Math.max(Math.sqrt(sharp / blurred), 0.005);
    const reach = Math.sqrt(Math.log(opacity / raster.alpha_threshold));
    const across = reach / p, along = Math.hypot(reach / r, k * across);
    const inside = x + across > 0 && x - across < size[0]
      && y + along > 0 && y - along < size[1];
    if (!inside) continue; // also where a number is NaN

    depths[seen] = z;
    let to = FLOATS * seen++;
    for (const part of [x, y, p, k, r, opacity, across, along]) footprints[to++] = part;
    for (let c = 0; c < 3; c++) footprints[to++] = scene.colour[3 * i + c];
  }
  return farthestFirst(footprints, depths.subarray(0, seen));
}

function farthestFirst(footprints, depths) {
  const sorted = new Float32Array(depths.length * FLOATS);
  let to = sorted.length;
  for (const row of order(depths)) {
    to -= FLOATS;
    for (let i = 0; i < FLOATS; i++) sorted[to + i] = footprints[FLOATS * row + i];
  }
  return sorted;
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// The axes that a quaternion of any length turns x, y and z to, one behind the other.
function columns(quaternion, at, axes) {
  const w = quaternion[at], x = quaternion[at + 1];
  const y = quaternion[at + 2], z = quaternion[at + 3];
  const double = 2 / (w * w + x * x + y * y + z * z);
  axes[0] = 1 - double * (y * y + z * z);
  axes[1] = double * (x * y + w * z);
  axes[2] = double * (x * z - w * y);
  axes[3] = double * (x * y - w * z);
  axes[4] = 1 - double * (x * x + z * z);
  axes[5] = double * (y * z + w * x);
  axes[6] = double * (x * z + w * y);
  axes[7] = double * (y * z - w * x);
  axes[8] = 1 - double * (x * x + y * y);
}

// Rows from the nearest to the farthest, equal ones as they came. Positive floats are
// in the order of their bits, so two counting sorts by 16 bits each are exact.
function order(depths) {
  const bits = new Uint32Array(depths.buffer, depths.byteOffset, depths.length);
  let rows = Uint32Array.from(depths.keys()), next = new Uint32Array(depths.length);
  for (const shift of [0, 16]) {
    const starts = new Uint32Array(65537);
    for (const value of bits) starts[((value >>> shift) & 65535) + 1]++;
    for (let i = 0; i < 65536; i++) starts[i + 1] += starts[i];
    for (const row of rows) next[starts[(bits[row] >>> shift) & 65535]++] = row;
    [rows, next] = [next, rows];
  }
  return rows;
}

// The camera of a view as large as it fits into `width` x `height` px, and what was
// drawn there is larger by, in px.
function fitted(view, width, height) {
  const enlarged = Math.min(width / view.size[0], height / view.size[1]);
  const centre = view.centre.map(
    (place, k) => [width, height][k] / 2 + enlarged * (place - view.size[k] / 2));
  const focal = view.focal * enlarged, skew = view.skew * enlarged;
  return { ...view, focal, skew, centre, size: [width, height], enlarged };
}

// The view turned about its target by an angle (rad) about a unit axis of the world.
function turned(view, axis, angle) {
  const [x, y, z] = axis, c = Math.cos(angle), s = Math.sin(angle), d = 1 - c;
  const turn = [
    c + x * x * d, x * y * d - z * s, x * z * d + y * s,
    y * x * d + z * s, c + y * y * d, y * z * d - x * s,
    z * x * d - y * s, z * y * d + x * s, c + z * z * d,
  ];
  const apply = (v) => [0, 3, 6].map((i) => dot(turn.slice(i, i + 3), v));
  const rotation = [0, 3, 6].flatMap((i) => apply(view.rotation.slice(i, i + 3)));
  const offset = apply(view.position.map((value, k) => value - view.target[k]));
  return { ...view, rotation, position: view.target.map((value, k) => value + offset[k]) };
}

// The view and its target moved by scene units to the right and down in the picture.
function moved(view, right, down) {
  const by = [0, 1, 2].map((k) => right * view.rotation[k] + down * view.rotation[3 + k]);
  const add = (place) => place.map((value, k) => value + by[k]);
  return { ...view, position: add(view.position), target: add(view.target) };
}

// The view at another distance from its target, `factor` times this one.
function nearer(view, factor) {
  const position = view.target.map(
    (value, k) => value + factor * (view.position[k] - value));
  return { ...view, position };
}
