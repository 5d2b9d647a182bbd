"""All built-in scenes, whose truth is known, and ways to find flow, as one file."""

import pathlib
import time
from typing import Any, NamedTuple

import numpy as np
from skimage import registration

from experiments.evidence import report
from nerfies_jax.capture import synthetic
from nerfies_jax.capture.json_files import write_json
from nerfies_jax.metrics import clock
from nerfies_jax.preprocessing import dense_flow, record, summary, view_set
from nerfies_jax.runs import run_folder
from nerfies_jax.runs.platform import CACHE
from nerfies_jax.runtime import console

FLOW_SCENES = ("default", "fast", "articulated", "exposure")
PAIRS = 5  # of neighbors in each of these, evenly over the film
TIMES = (1, 2)  # how many times larger the pictures are made first


class FlowRow(NamedTuple):
    """One way to find flow, over all pairs."""

    method: str
    enlarged: int
    still_px: float  # median error of pixels at rest
    moving_px: float  # and of those that move by themselves
    far_off: float  # share of all pixels more than 1 px off
    seconds: float  # of the processor, for a pair, one way


def measure(seed: int, out: pathlib.Path | None) -> dict[str, Any]:
    """Write evidence.json with all scenes and all ways to find flow."""
    folder = run_folder.new_run_folder(out, "evidence")
    rows = []
    for name, spec in synthetic.PRESETS.items():
        capture, truth = synthetic.cached(spec, CACHE / "scenes", seed)
        evidence = record.gather(capture)
        views = view_set.in_time_order(record.looked_at(capture, evidence.factor))
        counted = summary.of(views, evidence)
        errors = report.errors_of(capture, truth, evidence)
        both = counted._asdict() | errors._asdict()
        rows.append({"scene": name, **report.as_json(both)})
        console.say(f"{name}: {counted.seconds:.0f} s")
        console.say("\n".join(report.error_lines(errors)))
    flows = [report.as_json(row._asdict()) for row in flow_rows(seed)]
    path = folder / "evidence.json"
    stored = {"machine": clock.machine(), "scenes": rows, "flows": flows}
    write_json(path, stored)
    console.say(f"saved {path}")
    return stored


def flow_rows(seed: int) -> list[FlowRow]:
    """Each way to find flow, on the same pairs of frames."""
    pairs = [pair for name in FLOW_SCENES for pair in _pairs(name, seed)]
    rows = []
    for name, method in METHODS.items():
        for times in TIMES:
            rows.append(_flow_row(name, method, times, pairs))
            console.say(rows[-1])
    return rows


def _pairs(name, seed):
    """Frames [2, height, width], true flow, where it is seen, and what moves."""
    capture, _ = synthetic.cached(synthetic.PRESETS[name], CACHE / "scenes", seed)
    views = view_set.in_time_order(capture)
    pictures = dense_flow.leveled(views, 1)
    chosen = np.linspace(0, len(views.row) - 2, PAIRS).round().astype(int)
    for frame in chosen:
        row = views.row[frame]
        flow = capture.flow
        if flow.next_row[row] != views.row[frame + 1]:
            raise RuntimeError(f"{name}: frames {frame} and after are no neighbors")
        known = flow.forward[row], flow.forward_seen[row], capture.moving[row]
        yield pictures[frame : frame + 2], known


def _flow_row(name, method, times, pairs):
    still, moving, began = [], [], time.process_time()
    for pictures, (true, seen, moves) in pairs:
        one, other = (dense_flow.larger(picture, times) for picture in pictures)
        flow = dense_flow.reduced(method(times)(one, other), times)
        error = np.linalg.norm(flow - true, axis=-1)
        still.append(error[seen & ~moves])
        moving.append(error[seen & moves])
    seconds = (time.process_time() - began) / len(pairs)
    still, moving = np.concatenate(still), np.concatenate(moving)
    return FlowRow(
        name,
        times,
        float(np.median(still)),
        float(np.median(moving)),
        float((np.concatenate([still, moving]) > 1).mean()),
        seconds,
    )


def _of_skimage(method):
    def flow(one, other):
        pictures = one / np.float32(255), other / np.float32(255)
        down, right = method(*pictures, dtype=np.float32)
        return np.stack([right, down], axis=-1)

    return lambda times: flow


_TVL1, _ILK = registration.optical_flow_tvl1, registration.optical_flow_ilk
METHODS = {
    "DIS (OpenCV, medium)": dense_flow.dis,
    "ILK (scikit-image)": _of_skimage(_ILK),
    "TV-L1 (scikit-image)": _of_skimage(_TVL1),
}
