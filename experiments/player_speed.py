"""Frame times of the browser player next to gsplat.js, on the same Gaussians.

    python -m experiments.player_speed PLAYER.html --gsplat INDEX.es.js

Each page that a run of splats left (`player.html`) is opened in Chromium. Its Gaussians
at one time are handed to [gsplat.js](https://github.com/huggingface/gsplat.js) in the
same tab, and both draw the same views on square canvases in turn, `--frames` at a time
for `--rounds` rounds. A frame ends when a pixel of it has been read back, so it is
finished. Both sort in a worker meanwhile. Without `--gsplat` only our own player is
measured.

Rendering is by SwiftShader, on the processor, so that any machine can repeat it. It
measures the fill rate above all: how many pixels the quads cover, and what blending one
costs. *CPU* are the processor seconds of Chromium's rendering process, all threads
together, which a busy machine disturbs less than the time that passes. Ratios are taken
within each round, and the table has their median and range. gsplat.js cuts every
Gaussian at exp(-4) and blends in 8 bits. Ours draws each to the alpha threshold that it
was trained with, which takes more pixels where a Gaussian is opaque and fewer where it
is not, and blends in floats. *Alike* is the PSNR between the two images.

The second table counts the work of one frame at 1920x1080, on the first view. *Shaded*
are fragments inside the quads, *blended* those above the threshold, both counted by the
GPU program itself. *GB* are read and written while they blend, 16 bytes for each in
half floats, and when the background is put behind. *Sort* is what the worker takes for
one order. The last columns divide these bytes and the shaded fragments by the nominal
memory bandwidth and fill rate of a laptop's integrated GPU (Intel Iris Xe, 96 units: 68
GB/s, 24 pixels a clock at 1.3 GHz, half as many in half floats), with no help from a
cache. A GPU does both at once. The player draws fewer pixels in motion where frames
take longer than 40 ms.
"""

import contextlib
import dataclasses
import os
import pathlib
import shutil
import statistics

from experiments import cli, markdown
from nerfies_jax.runtime import console

ARGUMENTS = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    "--disable-dev-shm-usage",
)
ADDRESS = "http://player.test/"  # of which the browser asks us, and not the network
FULL_HD = (1920, 1080)
BYTES_BLENDED = 16  # four half floats read, and four written
BYTES_BEHIND = 12  # half floats read and eight bits written, with the background behind
# Intel Iris Xe with 96 units and LPDDR4x-4266 on two channels, as Intel states them.
BANDWIDTH, FILL_RATE = 68.3e9, 24 * 1.3e9 / 2  # bytes and half-float pixels a second
LARGE_SORT = 1_000_000

# Prepares both players; `window.frames.ours` and `.gsplat` draw frame number k.
SET_UP = """async ([source, size, time]) => {
  const header = JSON.parse(document.getElementById("header").textContent);
  const buffer = bytesOf(document.getElementById("data").textContent);
  const count = header.arrays.color.shape[0];
  const first = viewOf(header.view);
  const viewAt = (k) => orbited(first, header.up, 0.1 * Math.sin(k), 0);
  const cameraAt = (k) => cameraOf(viewAt(k), header.view, size, size);
  const finish = (gl) => {
    const pixels = new Uint8Array(4);
    gl.readPixels(size >> 1, size >> 1, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  };
  const { painter } = player, black = [0, 0, 0];
  const scale = Math.max(1, cameraAt(0).enlarged) ** 2;
  const raster = { ...header.raster, eps2d: header.raster.eps2d * scale };
  const text = document.getElementById("splats").textContent;
  const ask = sorterFor(header, buffer, text, (rows) => painter.sort(rows));
  window.frames = { ours(k) {
    const camera = cameraAt(k);
    ask({ position: camera.position, forward: camera.rotation.slice(6), time });
    painter.draw(camera, raster, time, black);
    finish(painter.gl);
  } };
  frames.ours(0);
  const result = { gaussians: count, moving: painter.scene.movers };
  if (!source) return result;

  const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
  const { Scene, Camera, WebGLRenderer, Splat, SplatData, Vector3, Quaternion } =
    await import(url);
  const now = {};
  for (const name of Object.keys(FIELDS)) {
    const field = fieldOf(name, header, buffer);
    now[name] = field.values.slice();
    pose(field, time, header.instants, now[name]);
  }
  const color = decoded(header.arrays.color, buffer);
  const colors = new Uint8Array(4 * count);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < 3; k++) {
      colors[4 * i + k] = Math.round(255 * Math.min(1, color[3 * i + k]));
    }
    colors[4 * i + 3] = Math.round(255 * now.opacity[i]);
    const q = unit(Array.from(now.quaternion.subarray(4 * i, 4 * i + 4)));
    now.quaternion.set(q, 4 * i);
  }
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = size;
  const renderer = new WebGLRenderer(canvas, []); // no fading in
  renderer.setSize(size, size);
  const scene = new Scene(), camera = new Camera();
  scene.addObject(new Splat(new SplatData(
    count, now.mean, now.quaternion, now.log_scale.map(Math.exp), colors)));
  frames.gsplat = (k) => {
    const [w, x, y, z] = viewAt(k).quaternion, { position, focal } = cameraAt(k);
    camera.data.fx = camera.data.fy = focal;
    camera.position = new Vector3(...position);
    camera.rotation = new Quaternion(-x, -y, -z, w);
    renderer.render(scene, camera);
    finish(renderer.gl);
  };
  const rest = () => new Promise((done) => setTimeout(done, 50));
  for (let i = 0; renderer.renderProgram.depthIndex.length < count; i++) {
    if (i > 600) throw new Error("gsplat.js has not sorted after half a minute");
    frames.gsplat(0);
    await rest();
  }
  for (let i = 0; i < 5; i++) { // until the orders are those of the view
    for (const draw of Object.values(frames)) draw(0);
    await rest();
  }
  const pixels = [painter.gl, renderer.gl].map((gl, i) => {
    Object.values(frames)[i](0);
    const read = new Uint8Array(4 * size * size);
    gl.readPixels(0, 0, size, size, gl.RGBA, gl.UNSIGNED_BYTE, read);
    return read;
  });
  let error = 0;
  for (let i = 0; i < pixels[0].length; i++) {
    if (i % 4 < 3) error += (pixels[0][i] - pixels[1][i]) ** 2;
  }
  result.alike_db = 10 * Math.log10(255 ** 2 / (error / (3 * size * size)));
  return result;
}"""

# Milliseconds of each frame, drawn one after the other.
DRAW = """async ([name, start, count]) => {
  const times = [];
  for (let k = start; k < start + count; k++) {
    const began = performance.now();
    frames[name](k);
    times.push(performance.now() - began);
    await new Promise((done) => setTimeout(done)); // orders arrive between frames
  }
  return times;
}"""

# Counts fragments by adding a one for each, and times the order.
WORK = """([width, height, time]) => {
  const header = JSON.parse(document.getElementById("header").textContent);
  const buffer = bytesOf(document.getElementById("data").textContent);
  const { painter } = player, { gl } = painter;
  const camera = cameraOf(viewOf(header.view), header.view, width, height);
  const raster = { ...header.raster };
  raster.eps2d *= Math.max(1, camera.enlarged) ** 2;
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.activeTexture(gl.TEXTURE0 + 9);
  const texture = newTexture(gl);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, width, height);
  gl.framebufferTexture2D(
    gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  gl.viewport(0, 0, width, height);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE);
  const one = FRAGMENT.replace(/if \\(left < 0.0\\) discard;/, "")
    .replace(/drawn = .*;/, "drawn = vec4(1.0, left < 0.0 ? 0.0 : 1.0, 0.0, 0.0);");
  const counter = programOf(gl, VERTEX, one);
  const sort = sorterOf(header, buffer), forward = camera.rotation.slice(6);
  const rows = sort({ position: camera.position, forward, time });
  painter.sort(rows);
  painter.project(camera, raster, time);
  gl.clear(gl.COLOR_BUFFER_BIT);
  gl.useProgram(counter);
  uniformsOf(gl, counter)("size", "2f", width, height);
  uniformsOf(gl, counter)("least", "1f", raster.alpha_threshold);
  painter.drawQuads();
  const read = new Float32Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, read);
  let shaded = 0, blended = 0;
  for (let i = 0; i < read.length; i += 4) {
    shaded += read[i];
    blended += read[i + 1];
  }
  const median = (run) => {
    const times = Array.from({ length: 21 }, () => {
      const began = performance.now();
      run();
      return performance.now() - began;
    });
    return times.sort((a, b) => a - b)[10];
  };
  const depths = Float32Array.from({ length: LARGE }, () => 1 + Math.random());
  return {
    drawn: rows.length, shaded, blended,
    sort_ms: median(() => sort({ position: camera.position, forward, time })),
    large_sort_ms: median(() => order(depths)),
  };
}""".replace("LARGE", str(LARGE_SORT))


@dataclasses.dataclass(frozen=True)
class PlayerSpeed:
    """Time frames of the browser player, next to gsplat.js if it is there."""

    pages: cli.Positional[tuple[pathlib.Path, ...]]
    """Pages that runs of splats have written (player.html)."""
    gsplat: pathlib.Path | None = None
    """Its module, node_modules/gsplat/dist/index.es.js after `npm install gsplat`."""
    size: int = 600
    """Width and height of the canvases, in pixels."""
    time: float = 0.5
    """Time of the scene to render, from 0 to 1."""
    frames: int = 4
    """Frames in a row of one player."""
    rounds: int = 9
    """Rounds of measurements, in which the players take turns."""
    out: pathlib.Path = pathlib.Path("player_speed.json")
    """Keeps the numbers."""

    def __post_init__(self):
        cli.check_out_file(self.out)
        if min(self.size, self.frames, self.rounds) < 1 or not 0 <= self.time <= 1:
            raise ValueError(
                "--size, --frames and --rounds are at least 1, --time is from 0 to 1"
            )


@cli.command(PlayerSpeed)
def main(args):
    """Measure every page. Wrong input ends with exit code 2."""
    with cli.user_errors():
        for path in filter(None, (*args.pages, args.gsplat)):
            if not path.is_file():
                raise ValueError(f"{path}: no such file")
        chromium = shutil.which("chromium") or shutil.which("google-chrome")
        if chromium is None:
            raise ValueError("this needs Chromium or Chrome on the path")
        try:
            from playwright.sync_api import sync_playwright
        except ImportError:
            raise ValueError("this needs playwright: pip install playwright") from None
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.metrics import clock

    rows = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=chromium, args=list(ARGUMENTS)
        )
        for path in args.pages:
            rows.append(measured(browser, path, args))
            console.say("  ".join(f"{k} {v}" for k, v in rows[-1].items()))
        machine = clock.machine() | {"browser": f"Chromium {browser.version}"}
        machine["load"] = os.getloadavg()[1] if hasattr(os, "getloadavg") else None
        browser.close()
    stored = {"machine": machine, "rows": rows}
    write_json(args.out, stored)
    return stored


def measured(browser, path: pathlib.Path, args: PlayerSpeed) -> dict:
    """Time both players on the Gaussians of one page, and count the work of a frame."""
    tab = browser.new_page(
        viewport={"width": args.size, "height": args.size + 200}, bypass_csp=True
    )
    # Workers that are modules, as those of gsplat.js, do not start from a file.
    tab.route(f"{ADDRESS}*", lambda route: route.fulfill(path=path))
    tab.goto(f"{ADDRESS}#t={args.time:g}")
    tab.wait_for_function("() => player.ready")
    work = tab.evaluate(WORK, [*FULL_HD, args.time])
    tab.reload()
    tab.add_style_tag(
        content="#stage { flex: none !important; "
        f"width: {args.size}px; height: {args.size}px }}"
    )
    tab.wait_for_function(
        "(size) => player.ready && document.getElementById('scene').width === size",
        arg=args.size,
    )
    source = args.gsplat.read_text(encoding="utf-8") if args.gsplat else None
    row = {"page": tab.title(), "size": args.size}
    row |= tab.evaluate(SET_UP, [source, args.size, args.time])
    names = ["ours", "gsplat"] if source else ["ours"]
    for name in names:
        row |= {f"{name}_ms": [], f"{name}_cpu_ms": []}
    renderer = _renderer()
    for turn in range(args.rounds):
        for name in names if turn % 2 else names[::-1]:
            before = _processor_ms(renderer)
            drawn = tab.evaluate(DRAW, [name, turn * args.frames, args.frames])
            spent = (_processor_ms(renderer) - before) / args.frames
            row[f"{name}_ms"].append(statistics.median(drawn))
            row[f"{name}_cpu_ms"].append(spent)
    tab.close()
    return row | {"work": work}


def _renderer():
    """Find the process of Chromium that renders for all tabs."""
    import psutil

    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            if "--type=gpu-process" in process.cmdline():
                return process
    raise RuntimeError("Chromium runs without a GPU process")


def _processor_ms(process):
    used = process.cpu_times()
    return 1e3 * (used.user + used.system)


def page(stored) -> str:
    """Render the tables of the page in docs/results below the docstring."""
    heads = (
        *("scene", "Gaussians", "moving", "ours, ms", "gsplat.js, ms"),
        *("times as fast", "ours, CPU ms", "gsplat.js, CPU ms", "times as fast"),
        "alike, dB",
    )
    rows, work = [], []
    for row in stored["rows"]:
        rows.append(
            [
                f"{row['page']}, {row['size']} px",
                f"{row['gaussians']:,}",
                f"{row['moving']:,}",
                *_compared(row, "ms"),
                *_compared(row, "cpu_ms"),
                markdown.number(row.get("alike_db"), 1),
            ]
        )
        work.append(_work_row(row))
    machine = stored["machine"]
    heads_of_work = (
        *("scene", "vertices", "shaded, M", "blended, M", "GB", "sort, ms"),
        *("sort of 1 M, ms", "bandwidth, ms", "fill, ms"),
    )
    return "\n".join(
        [
            markdown.table(heads, rows),
            "",
            "Medians over the rounds, on "
            f"{machine['cpu']} with {machine['cores']} cores, {machine['browser']}"
            f"{_load(machine)}.",
            "",
            "## Work of a frame at 1920x1080",
            "",
            markdown.table(heads_of_work, work),
            "",
            "50 frames per second leave 20 ms.",
        ]
    )


def _load(machine):
    """Words for how busy the machine was, where it told."""
    load = machine.get("load")
    return "" if load is None else f", at a load average of {load:.0f}"


def _compared(row, unit):
    """Cells of both medians, and of the median ratio with its range over the rounds."""
    ours, theirs = row[f"ours_{unit}"], row.get(f"gsplat_{unit}")
    if theirs is None:
        return [markdown.number(statistics.median(ours), 0), "", ""]
    ratios = [b / a for a, b in zip(ours, theirs, strict=True)]
    middle, least, most = statistics.median(ratios), min(ratios), max(ratios)
    return [
        *(markdown.number(statistics.median(times), 0) for times in (ours, theirs)),
        f"{middle:.2f} ({least:.2f} to {most:.2f})",
    ]


def _work_row(row):
    work = row["work"]
    moved = BYTES_BLENDED * work["blended"] + BYTES_BEHIND * FULL_HD[0] * FULL_HD[1]
    return [
        row["page"],
        f"{4 * work['drawn']:,}",
        markdown.number(work["shaded"] / 1e6, 1),
        markdown.number(work["blended"] / 1e6, 1),
        markdown.number(moved / 1e9),
        markdown.number(work["sort_ms"], 1),
        markdown.number(work["large_sort_ms"], 0),
        markdown.number(1e3 * moved / BANDWIDTH, 1),
        markdown.number(1e3 * work["shaded"] / FILL_RATE, 1),
    ]


if __name__ == "__main__":
    main()
