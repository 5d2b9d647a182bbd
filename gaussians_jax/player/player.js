"use strict";
// The page of a player: time, rendering and buttons.

const SLOW = 1 / 25, FAST = 1 / 50; // seconds per frame above and below which the size changes
const COARSEST = 0.3; // smallest resolution, as a share of the screen's along an edge
const LINKED_AFTER = 300; // ms without motion after which the address bar shows the view

// Return a function that requests the depth order of the Gaussians, from a worker if
// possible. `take` gets the rows, and whether a worker sorted them. One request is
// active at a time, and only the last one of those made meanwhile follows.
function sorterFor(header, buffer, source, take) {
  let worker = null, current = null, next = null, here = null;

  function onThisThread(request) {
    here ??= sorterOf(header, buffer);
    take(here(request), request, false);
  }

  function give(request) {
    current = request;
    next = null;
    worker.postMessage(request);
  }

  function withoutWorker() { // for browsers that do not allow workers here
    worker = null;
    if (next ?? current) onThisThread(next ?? current);
  }

  try {
    worker = new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
    worker.onerror = withoutWorker;
    worker.onmessage = ({ data }) => {
      const answered = current;
      current = null;
      if (next) give(next);
      take(data, answered, true);
    };
    worker.postMessage({ header, buffer });
  } catch {
    withoutWorker();
  }
  return (request) => {
    if (!worker) onThisThread(request);
    else if (current) next = request;
    else give(request);
  };
}

function start(header, buffer, source) {
  const one = (id) => document.getElementById(id);
  const canvas = one("scene"), slider = one("time"), lens = header.view;
  const calm = matchMedia("(prefers-reduced-motion: reduce)");
  const camera = cameraman(header, wake, () => calm.matches);
  let painter = painterOf(canvas, header, buffer), lost = false;
  let time = 0, playing = false, resolution = 1, byWorker = null;
  let awake = false, before = 0, lasted = 0, drawn = "", asked = "", sorted = "", linking = 0;
  const ask = sorterFor(header, buffer, source, (rows, request, worker) => {
    byWorker = worker;
    sorted = request.key;
    if (!lost) painter.sort(rows);
    wake();
  });

  // Inputs of the order, and further inputs of the image.
  const orderKey = () => [time, textOf(camera.view)].join();
  const imageKey = () => [
    orderKey(), sorted, one("background").value, canvas.width, canvas.height].join();

  function resize() {
    const dense = Math.min(window.devicePixelRatio || 1, 2);
    const share = dense * (playing || camera.moving ? resolution : 1);
    const width = Math.max(1, Math.round(canvas.clientWidth * share));
    const height = Math.max(1, Math.round(canvas.clientHeight * share));
    // Setting the size clears the canvas, even if it does not change.
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
  }

  function draw() {
    const shown = cameraOf(camera.view, lens, canvas.width, canvas.height);
    // The dilation of footprints is in pixels of training. In a larger image it is
    // scaled, or thin Gaussians would separate.
    const wider = Math.max(1, shown.enlarged);
    const raster = { ...header.raster, eps2d: header.raster.eps2d * wider * wider };
    const hex = parseInt(one("background").value.slice(1), 16);
    const background = [hex >> 16, (hex >> 8) & 255, hex & 255].map((x) => x / 255);
    painter.draw(shown, raster, time, background);
    one("poster").hidden = true;
  }

  function wake() {
    if (awake) return;
    awake = true;
    before = 0;
    requestAnimationFrame(tick);
  }

  function tick(now) {
    const since = before ? (now - before) / 1000 : 1 / 60;
    const passed = Math.min(since, 0.25);
    if (playing) setTime((time + Number(one("speed").value) * since / header.seconds) % 1);
    camera.advance(passed);
    const busy = playing || camera.moving;
    if (busy && before && since < 1) adapt(since); // longer if the page was hidden
    before = now;
    resize();
    const key = orderKey();
    if (key !== asked) {
      asked = key;
      const { rotation, position } = cameraOf(camera.view, lens, 1, 1);
      ask({ key, time, position, forward: rotation.slice(6) });
    }
    if (!lost && sorted && imageKey() !== drawn) {
      draw();
      drawn = imageKey();
    }
    awake = busy;
    if (busy) requestAnimationFrame(tick);
    else scheduleLink();
  }

  // Fewer pixels if frames take long, more if they take little time.
  function adapt(seconds) {
    lasted = lasted ? 0.7 * lasted + 0.3 * seconds : seconds;
    if (lasted > SLOW && resolution > COARSEST) resolution = Math.max(COARSEST, resolution * 0.8);
    else if (lasted < FAST && resolution < 1) resolution = Math.min(1, resolution * 1.1);
    else return;
    lasted = 0;
  }

  function setTime(next) {
    time = Math.round(next * 1e6) / 1e6; // as in a link
    slider.value = time;
    const seconds = (share) => `${(share * header.seconds).toFixed(2)} s`;
    one("clock").textContent = `${seconds(time)} / ${seconds(1)}`;
    slider.setAttribute("aria-valuetext", `${seconds(time)} of ${seconds(1)}`);
    wake();
  }

  function play(yes) {
    playing = yes;
    one("play").setAttribute("aria-label", yes ? "Pause" : "Play");
    one("play").classList.toggle("playing", yes);
    wake();
  }

  function step(by) {
    play(false);
    const last = header.keyframes - 1;
    setTime(Math.min(Math.max(Math.round(time * last) + by, 0), last) / last);
  }

  // The address contains the time and the view when nothing moves.
  function scheduleLink() {
    clearTimeout(linking);
    linking = setTimeout(() => {
      if (playing || camera.moving) return;
      const parts = `#t=${time}&view=${textOf(camera.view)}`;
      history.replaceState(null, "", parts);
    }, LINKED_AFTER);
  }

  function follow() {
    const parts = new URLSearchParams(location.hash.slice(1));
    const when = parseFloat(parts.get("t")), view = viewFrom(parts.get("view") ?? "");
    if (view) camera.jump(view);
    if (when >= 0 && when <= 1) setTime(when);
    return view || when >= 0;
  }

  function fullscreen() {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen();
  }

  function help() {
    if (one("help").open) one("help").close();
    else one("help").showModal();
  }

  function press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.closest?.("select, input[type=color]")) return;
    const keys = {
      " ": () => play(!playing), ",": () => step(-1), ".": () => step(1),
      home: () => camera.reset(), f: fullscreen, "?": help,
    };
    const key = event.key.toLowerCase();
    // Space presses a button, and arrows move the slider.
    if (event.target.closest?.("button, summary") && event.key === " ") return;
    if (one("help").open && event.key !== "?") return;
    if (event.target === slider && ["ArrowLeft", "ArrowRight"].includes(event.key)) {
      step(event.key === "ArrowLeft" ? -1 : 1);
    } else if (keys[key]) {
      keys[key]();
    } else if (event.target === slider || !steerByKey(event, camera, camera.view.distance)) {
      return;
    }
    event.preventDefault();
  }

  // Phones may take the WebGL context of hidden pages, and may restore it.
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault(); // required for the context to be restored
    lost = true;
    one("poster").hidden = false;
    one("trouble").textContent =
      "The browser took the drawing away: load the page again if it does not return.";
  });
  canvas.addEventListener("webglcontextrestored", () => {
    painter = painterOf(canvas, header, buffer);
    lost = false;
    sorted = asked = drawn = "";
    one("trouble").textContent = "";
    wake();
  });
  steerByHand(canvas, camera, () => camera.view.distance
    / cameraOf(camera.view, lens, canvas.clientWidth, canvas.clientHeight).focal);
  const clicks = {
    play: () => play(!playing), previous: () => step(-1), next: () => step(1),
    first: () => camera.reset(), fullscreen, keys: help,
  };
  for (const [id, act] of Object.entries(clicks)) one(id).addEventListener("click", act);
  one("fullscreen").hidden = !document.fullscreenEnabled;
  slider.addEventListener("input", () => {
    play(false);
    setTime(Number(slider.value));
  });
  one("background").addEventListener("input", wake);
  window.addEventListener("hashchange", () => follow() && play(false));
  new ResizeObserver(wake).observe(canvas); // also when the caption is opened
  window.addEventListener("keydown", press);
  setTime(0);
  play(!follow() && !calm.matches);
  return {
    get time() { return time; },
    get playing() { return playing; },
    get view() { return { ...camera.view, ...cameraOf(camera.view, lens, ...lens.size) }; },
    get resolution() { return canvas.width / canvas.clientWidth; },
    get byWorker() { return byWorker; },
    // Nothing moves, and the image is up to date.
    get ready() { return !awake && sorted === orderKey() && drawn === imageKey(); },
    painter,
  };
}

function bytesOf(text) {
  const packed = atob(text.trim()), bytes = new Uint8Array(packed.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = packed.charCodeAt(i);
  return bytes.buffer;
}

let player = null; // for tests, and for pages that embed this one in a frame
try {
  const text = (id) => document.getElementById(id).textContent;
  player = start(JSON.parse(text("header")), bytesOf(text("data")), text("splats"));
} catch (error) {
  document.getElementById("trouble").textContent = `Nothing can be drawn: ${error.message}`;
}
