"""Frame times of the browser player next to gsplat.js, on the same Gaussians.

    nerfies study speed player PLAYER.html --gsplat INDEX.es.js

Each page that a run of splats wrote (`player.html`) is opened in Chromium. Its
Gaussians at one time are passed to
[gsplat.js](https://github.com/huggingface/gsplat.js) in the same tab, and both render
the same views on square canvases in turn, `--frames` at a time for `--rounds` rounds.
A frame ends when one of its pixels has been read back. Both sort in a worker. Without
`--gsplat` only this project's player is measured.

Rendering is by SwiftShader, on the processor, so that any machine can repeat it. It
measures mostly the fill rate: how many pixels the quads cover, and the cost of blending
one. *CPU* are the processor seconds of Chromium's rendering process over all threads,
which a busy machine disturbs less than the wall clock. Ratios are taken within each
round, and the table has their median and range. gsplat.js cuts every Gaussian at
exp(-4) and blends in 8 bits. This player renders each to the alpha threshold that it
was trained with, which takes more pixels if a Gaussian is opaque and fewer if it is
not, and blends in floats. *Alike* is the PSNR between the two images.

The second table counts the work of one frame at 1920x1080, on the first view. *Shaded*
are fragments inside the quads, *blended* those above the threshold, both counted by the
GPU program itself. *GB* are read and written for blending, 16 bytes for each in half
floats, and for adding the background. *Sort* is the time of one sort in the worker. The
last columns divide these bytes and the shaded fragments by the nominal memory bandwidth
and fill rate of a laptop's integrated GPU (Intel Iris Xe, 96 units: 68 GB/s, 24 pixels
a clock at 1.3 GHz, half as many in half floats), without a cache. A GPU does both at
once. The player renders fewer pixels in motion if frames take longer than 40 ms.
"""

import contextlib
import os
import pathlib
import shutil
import statistics
from typing import Any

from experiments import markdown
from nerfies_jax.metrics import clock
from nerfies_jax.runtime import console

ARGUMENTS = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    "--disable-dev-shm-usage",
)
ADDRESS = "http://player.test/"  # served here, not by the network
FULL_HD = (1920, 1080)
BYTES_BLENDED = 16  # four half floats read, and four written
BYTES_BEHIND = 12  # half floats read and eight bits written, for the background
# Intel Iris Xe with 96 units and LPDDR4x-4266 on two channels, as Intel states them.
BANDWIDTH, FILL_RATE = 68.3e9, 24 * 1.3e9 / 2  # bytes and half-float pixels a second
LARGE_SORT = 1_000_000
PROGRAMS = pathlib.Path(__file__).with_name("player.js").read_text()


def measure(args: Any) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Measure every page.

    Args:
      args: Options.

    Returns:
      One row for each page, and the machine.

    Raises:
      ValueError: If the browser or playwright is missing.
    """
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise ValueError("this needs Chromium or Chrome on the path")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise ValueError("this needs playwright: pip install playwright") from None
    rows = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=chromium, args=list(ARGUMENTS)
        )
        for path in args.pages:
            rows.append(measure_page(browser, path, args))
            console.say("  ".join(f"{k} {v}" for k, v in rows[-1].items()))
        machine = clock.machine() | {"browser": f"Chromium {browser.version}"}
        machine["load"] = os.getloadavg()[1] if hasattr(os, "getloadavg") else None
        browser.close()
    return rows, machine


def _run(tab, name, arguments):
    """Run a program of player.js in the page."""
    return tab.evaluate(f"(words) => ({PROGRAMS}).{name}(words)", arguments)


def measure_page(browser: Any, path: pathlib.Path, args: Any) -> dict[str, Any]:
    """Time both players on the Gaussians of one page, and count the work of a frame.

    Args:
      browser: The browser.
      path: The page.
      args: Options.

    Returns:
      Measurements by name.
    """
    tab = browser.new_page(
        viewport={"width": args.size, "height": args.size + 200}, bypass_csp=True
    )
    # Workers that are modules, as those of gsplat.js, do not start from a file.
    tab.route(f"{ADDRESS}*", lambda route: route.fulfill(path=path))
    tab.goto(f"{ADDRESS}#t={args.time:g}")
    tab.wait_for_function("() => player.ready")
    work = _run(tab, "work", [*FULL_HD, args.time, LARGE_SORT])
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
    row |= _run(tab, "setUp", [source, args.size, args.time])
    names = ["ours", "gsplat"] if source else ["ours"]
    for name in names:
        row |= {f"{name}_ms": [], f"{name}_cpu_ms": []}
    renderer = _renderer()
    for turn in range(args.rounds):
        for name in names if turn % 2 else names[::-1]:
            before = _processor_ms(renderer)
            drawn = _run(tab, "draw", [name, turn * args.frames, args.frames])
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
    """Format the tables below the docstring.

    Args:
      stored: The stored results.

    Returns:
      Markdown.
    """
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
