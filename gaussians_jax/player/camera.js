"use strict";
// The camera of a player. Pure functions of numbers, independent of the page.
//
// A view is { quaternion, target, distance }: the rotation from world to camera axes
// (wxyz; x right, y down, z forward), a point on the viewing axis, and the distance of
// the camera from it. three.js, which all well-maintained camera controls need, would
// add 0.7 MB to every page, and supports neither a rolled camera nor an off-center
// principal point.

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function sum(a, b, factor = 1) {
  return a.map((value, k) => value + factor * b[k]);
}

function product([a, b, c, d], [w, x, y, z]) {
  return [
    a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y,
    a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w,
  ];
}

function unit(vector) {
  const length = Math.hypot(...vector);
  return vector.map((value) => value / length);
}

// Convert a rotation matrix (row by row) to a quaternion, by its largest component.
function quaternionOf(m) {
  const w = 1 + m[0] + m[4] + m[8], x = 1 + m[0] - m[4] - m[8];
  const y = 1 - m[0] + m[4] - m[8], z = 1 - m[0] - m[4] + m[8];
  const most = Math.max(w, x, y, z);
  const a = m[7] - m[5], b = m[2] - m[6], c = m[3] - m[1];
  const d = m[1] + m[3], e = m[2] + m[6], f = m[5] + m[7];
  if (most === w) return unit([w, a, b, c]);
  if (most === x) return unit([a, x, d, e]);
  return unit(most === y ? [b, d, y, f] : [c, e, f, z]);
}

// Convert a quaternion of any length to a rotation matrix, row by row.
function matrixOf([w, x, y, z]) {
  const d = 2 / (w * w + x * x + y * y + z * z);
  return [
    1 - d * (y * y + z * z), d * (x * y - w * z), d * (x * z + w * y),
    d * (x * y + w * z), 1 - d * (x * x + z * z), d * (y * z - w * x),
    d * (x * z - w * y), d * (y * z + w * x), 1 - d * (x * x + y * y),
  ];
}

// Return the view of a camera { rotation, position, target } that looks at its target.
function viewOf({ rotation, position, target }) {
  const distance = Math.hypot(...sum(position, target, -1));
  return { quaternion: quaternionOf(rotation), target, distance };
}

// Return the camera of a view in the largest image that fits into `width` x `height`
// px. `lens` has the focal length, pixel aspect, skew and principal point for its size.
function cameraOf(view, lens, width, height) {
  const rotation = matrixOf(view.quaternion);
  const enlarged = Math.min(width / lens.size[0], height / lens.size[1]);
  return {
    rotation,
    position: sum(view.target, rotation.slice(6), -view.distance),
    focal: lens.focal * enlarged,
    aspect: lens.aspect,
    skew: lens.skew * enlarged,
    center: lens.center.map(
      (place, k) => [width, height][k] / 2 + enlarged * (place - lens.size[k] / 2)),
    size: [width, height],
    enlarged,
  };
}

// Rotate the camera about the target by an angle (rad) about a unit axis of the world.
function turned(view, axis, angle) {
  const half = -angle / 2, s = Math.sin(half);
  const turn = [Math.cos(half), s * axis[0], s * axis[1], s * axis[2]];
  return { ...view, quaternion: unit(product(view.quaternion, turn)) };
}

// Rotate to the right about `up`, and upward about the horizontal axis, in rad.
function orbited(view, up, right, above) {
  const about = turned(view, up, right);
  return turned(about, matrixOf(about.quaternion).slice(0, 3), -above);
}

// Move the view and its target by scene units to the right and down in the image.
function moved(view, right, down) {
  const rotation = matrixOf(view.quaternion);
  const by = [0, 1, 2].map((k) => right * rotation[k] + down * rotation[3 + k]);
  return { ...view, target: sum(view.target, by) };
}

// Multiply the distance from the target by `factor`.
function nearer(view, factor) {
  return { ...view, distance: view.distance * factor };
}

// Interpolate between two views, around the target.
function toward(view, goal, share) {
  if (share >= 1) return goal;
  const { quaternion: from } = view;
  const same = from.reduce((total, value, k) => total + value * goal.quaternion[k], 0);
  const to = goal.quaternion.map((value) => (same < 0 ? -value : value));
  return {
    quaternion: unit(from.map((value, k) => value + share * (to[k] - value))),
    target: sum(view.target, sum(goal.target, view.target, -1), share),
    distance: view.distance * (goal.distance / view.distance) ** share,
  };
}

// Return the difference of two views: the largest of the rotation (rad), the shift of
// the target and the change of the distance, relative to the distance.
function apart(view, goal) {
  const from = unit(view.quaternion), to = unit(goal.quaternion);
  // By the chord, because the arc cosine near one is inaccurate.
  const chord = (sign) => Math.hypot(...sum(from, to, sign));
  return Math.max(
    2 * Math.min(chord(1), chord(-1)),
    Math.hypot(...sum(view.target, goal.target, -1)) / goal.distance,
    Math.abs(Math.log(view.distance / goal.distance)),
  );
}

// Limit a value to a range, which it may exceed by less than `give`.
function kept(value, [low, high], give) {
  const soft = (over) => (give ? give * Math.tanh(over / give) : 0);
  if (value > high) return high + soft(value - high);
  return value < low ? low - soft(low - value) : value;
}

// Limit a view to the ranges in the page, which it may exceed slightly: by `give`, in
// radians or as a share of a distance.
function limited(view, limits, give) {
  const [side, ahead, up] = limits.axes;
  const distance = Math.exp(
    kept(Math.log(view.distance), limits.distance.map(Math.log), give));
  const shift = sum(view.target, limits.target, -1), length = Math.hypot(...shift);
  const reach = kept(length, [0, limits.pan], give * limits.pan);
  const target = reach < length ? sum(limits.target, shift, reach / length) : view.target;
  let within = { ...view, distance, target };
  const away = () => matrixOf(within.quaternion).slice(6).map((value) => -value);
  const turn = (axis, from, range) => {
    const to = kept(from, range, give);
    if (to !== from) within = turned(within, axis, to - from);
  };
  const offset = away(), level = cross(offset, up);
  // The elevation is limited before the vertical, where the azimuth is undefined.
  if (Math.hypot(...level) > 1e-6) {
    const sine = Math.min(1, Math.max(-1, dot(offset, up)));
    turn(unit(level), Math.asin(sine), limits.elevation);
  }
  const around = Math.atan2(dot(away(), ahead), dot(away(), side));
  if (limits.azimuth) turn(up, around, limits.azimuth);
  return within;
}

// Convert a view to text for a link, and back: eight numbers, accurate to far below a
// pixel. The text of a view that was read from a text is the same text.
function textOf(view) {
  const numbers = [...view.quaternion, ...view.target, view.distance];
  return numbers.map((number) => Number(number.toFixed(7))).join(",");
}

function viewFrom(text) {
  const numbers = text.split(",").map(Number);
  const quaternion = numbers.slice(0, 4);
  if (numbers.length !== 8 || !numbers.every(Number.isFinite)) return null;
  if (!(Math.hypot(...quaternion) > 0.5 && numbers[7] > 0)) return null;
  return { quaternion, target: numbers.slice(4, 7), distance: numbers[7] };
}
