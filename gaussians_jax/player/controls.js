"use strict";
// Pointers, wheel and keys rotate, move and zoom the camera.

const RADIANS = 0.006; // rotation of the view per pixel
const ARROW = Math.PI / 36; // 5 degrees, or a share of the distance with Shift
const SETTLING = 0.08; // seconds in which the camera covers most of its way
const GIVE = 0.12; // largest excess over the limits in a drag: radians, or shares of a distance
const ARRIVED = 2e-5; // in the same units: far below a pixel

// The controlled camera. It follows its goal, and calls `wake` when they differ.
// `still` (reduced motion) makes it jump.
function cameraman(header, wake, still) {
  const { up, limits } = header;
  // Without motion a view is what its link stores, so a link gives the same image.
  const rounded = (any) => viewFrom(textOf(any));
  const first = rounded(viewOf(header.view));
  let view = first, goal = first, held = false;

  function steer(next) {
    goal = limited(next, limits, held && !still() ? GIVE : 0);
    wake();
  }

  return {
    get view() { return view; },
    get moving() { return view !== goal; },
    orbit: (right, above) => steer(orbited(goal, up, right, above)),
    pan: (right, down) => steer(moved(goal, right, down)),
    zoom: (factor) => steer(nearer(goal, factor)),
    // A drag holds the camera. Afterwards it returns within the limits.
    hold(yes) {
      held = yes;
      if (!yes) steer(goal);
    },
    reset() {
      goal = first;
      wake();
    },
    jump(next) {
      view = goal = next;
      wake();
    },
    // Advance by a time in seconds.
    advance(seconds) {
      if (view === goal) return;
      view = toward(view, goal, still() ? 1 : 1 - Math.exp(-seconds / SETTLING));
      if (apart(view, goal) < ARRIVED) view = goal = rounded(goal);
    },
  };
}

// Pointers and the wheel on the canvas. `unit` is the width of a pixel in the plane of
// the target, in scene units.
function steerByHand(canvas, camera, unit) {
  const pointers = new Map();
  const each = () => [...pointers.values()];
  const spread = ([a, b]) => Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
    camera.hold(true);
    canvas.classList.add("held");
  });
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
    canvas.addEventListener(name, (event) => {
      if (!pointers.delete(event.pointerId) || pointers.size) return;
      camera.hold(false);
      canvas.classList.remove("held");
    });
  }
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const before = each().slice(0, 2);
    pointers.set(event.pointerId, event);
    const dx = event.clientX - last.clientX, dy = event.clientY - last.clientY;
    if (pointers.size > 1) {
      if (!before.includes(last)) return; // a third finger
      camera.pan(-dx / 2 * unit(), -dy / 2 * unit());
      camera.zoom(spread(before) / Math.max(spread(each()), 1));
    } else if (event.shiftKey || event.buttons & 6) { // right or middle button
      camera.pan(-dx * unit(), -dy * unit());
    } else {
      camera.orbit(-dx * RADIANS, dy * RADIANS);
    }
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode ? 30 : 1; // px, or lines of about 30 px
    const rate = event.ctrlKey ? 0.01 : 0.001; // a pinch on a touchpad comes in small steps
    camera.zoom(Math.exp(event.deltaY * lines * rate));
  }, { passive: false });
}

// Apply a key to the camera. Returns false for unused keys.
function steerByKey(event, camera, distance) {
  const step = event.shiftKey ? 0 : ARROW, pan = event.shiftKey ? ARROW * distance : 0;
  const toward = {
    ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1],
  }[event.key];
  if (toward) {
    if (pan) camera.pan(toward[0] * pan, toward[1] * pan);
    else camera.orbit(toward[0] * step, -toward[1] * step);
  } else if (event.key === "+" || event.key === "=") {
    camera.zoom(1 / 1.1);
  } else if (event.key === "-" || event.key === "_") {
    camera.zoom(1.1);
  } else {
    return false;
  }
  return true;
}
