"use strict";
// The Gaussians of a player as arrays, and their depth order. This file depends on
// neither the page nor WebGL, because it also runs as the sorting worker.

const TYPES = {
  uint8: Uint8Array, int8: Int8Array, uint16: Uint16Array, int16: Int16Array,
  uint32: Uint32Array, float32: Float32Array,
};
const FIELDS = { mean: 3, quaternion: 4, log_scale: 3, opacity: 1 };

// Return the stored numbers of one array.
function stored(entry, buffer) {
  const length = entry.shape.reduce((product, size) => product * size, 1);
  return new TYPES[entry.type](buffer, entry.offset, length);
}

// Return the values of one array.
function decoded(entry, buffer) {
  return Float32Array.from(
    stored(entry, buffer), (number) => entry.shift + entry.scale * number);
}

// A field: its static values, and the changes of the moving rows.
function fieldOf(name, header, buffer) {
  const entries = header.arrays;
  return {
    width: FIELDS[name],
    values: decoded(entries[name], buffer),
    rows: stored(entries[name + ".rows"], buffer),
    step: stored(entries[name + ".step"], buffer),
    change: stored(entries[name + ".change"], buffer),
  };
}

// Return the two stored times around a time in [0, 1], and the position between them.
function between(time, keyframes) {
  const place = Math.min(Math.max(time, 0), 1) * (keyframes - 1);
  const before = Math.min(Math.floor(place), keyframes - 2);
  return { before, share: place - before };
}

// Write the values of a field at a time into `now`, which already has the static ones.
// Interpolation between stored times is linear.
function pose(field, time, keyframes, now) {
  const { width, values, rows, step, change } = field;
  const { before, share } = between(time, keyframes);
  const size = rows.length * width;
  for (let row = 0, at = before * size; row < rows.length; row++) {
    for (let k = 0; k < width; k++, at++) {
      const i = rows[row] * width + k;
      now[i] = values[i]
        + step[row] * (change[at] + share * (change[at + size] - change[at]));
    }
  }
}

// Return a function of a camera's position, forward axis (world coordinates) and time
// that returns the rows of the Gaussians beyond the near plane, farthest first.
function sorterOf(header, buffer) {
  const field = fieldOf("mean", header, buffer), { near, far } = header.raster;
  const now = field.values.slice(), count = now.length / 3;
  const depths = new Float32Array(count), kept = new Uint32Array(count);
  return ({ position, forward, time }) => {
    pose(field, time, header.keyframes, now);
    const [x, y, z] = forward;
    const start = x * position[0] + y * position[1] + z * position[2];
    let seen = 0;
    for (let i = 0, at = 0; i < count; i++, at += 3) {
      const depth = x * now[at] + y * now[at + 1] + z * now[at + 2] - start;
      if (!(depth >= near && depth <= far)) continue;
      depths[seen] = depth;
      kept[seen++] = i;
    }
    const rows = order(depths.subarray(0, seen));
    const sorted = new Uint32Array(seen);
    for (let i = 0; i < seen; i++) sorted[seen - 1 - i] = kept[rows[i]];
    return sorted;
  };
}

// Sort rows by depth, with ties in their order. Positive floats have the order of their
// bits, so two counting sorts by 16 bits each are exact.
function order(depths) {
  const bits = new Uint32Array(depths.buffer, depths.byteOffset, depths.length);
  let rows = new Uint32Array(depths.length), next = new Uint32Array(depths.length);
  for (let i = 0; i < rows.length; i++) rows[i] = i;
  for (const shift of [0, 16]) {
    const starts = new Uint32Array(65537);
    for (let i = 0; i < bits.length; i++) starts[((bits[i] >>> shift) & 65535) + 1]++;
    for (let i = 0; i < 65536; i++) starts[i + 1] += starts[i];
    for (let i = 0; i < rows.length; i++) {
      next[starts[(bits[rows[i]] >>> shift) & 65535]++] = rows[i];
    }
    [rows, next] = [next, rows];
  }
  return rows;
}

// As a worker: the first message contains the scene, all others are requests.
if (typeof WorkerGlobalScope !== "undefined") {
  let sort = null;
  onmessage = ({ data }) => {
    if (!sort) {
      sort = sorterOf(data.header, data.buffer);
      return;
    }
    const rows = sort(data);
    postMessage(rows, [rows.buffer]);
  };
}
