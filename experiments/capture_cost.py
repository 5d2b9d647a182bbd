"""Reading captures: memory of the frames, and the cost of decoding in a child.

    python -m experiments.capture_cost --out capture_cost.json

Memory: a capture is read and handed to training in a fresh process, whose peak is
compared with the bytes of the images and with the estimate that is printed before a
run. Decoding: the same files are decoded by turns in this process and, as readers do
it, in a child process with limits. Times are processor seconds of both processes.
"""

import dataclasses
import functools
import json
import os
import pathlib
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from experiments import cli, markdown
from nerfies_jax.runtime import console

SIZE = (1280, 720)
FILES = 24  # of EXR, and frames of the video


@dataclasses.dataclass(frozen=True)
class CaptureCost:
    """Measure the memory of frames and the processor time of decoders."""

    frames: int = 300
    """Frames of the capture whose memory is measured."""
    pairs: int = 5
    """Turns of each decoder, in this process and in the child."""
    out: pathlib.Path = pathlib.Path("capture_cost.json")
    """File of the numbers."""

    def __post_init__(self):
        cli.check_out_file(self.out, "--out")
        if self.frames < 4 or self.pairs < 1:
            raise ValueError(
                f"--frames {self.frames} --pairs {self.pairs}: at least 4 and 1"
            )


class Case(NamedTuple):
    """One kind of file, decoded in both ways."""

    name: str
    here: Callable[[], object]
    in_child: Callable[[], object]


@cli.command(CaptureCost)
def main(args):
    """Measure and store."""
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.metrics import clock
    from nerfies_jax.training.provenance import revision

    with tempfile.TemporaryDirectory() as scratch:
        folder = pathlib.Path(scratch)
        memory = _memory(folder / "frames", args.frames)
        console.say(_sentence(memory))
        rows = []
        for case in _cases(folder):
            case.here(), case.in_child()  # imports, and the cache of the files
            pairs = [
                (_seconds(case.here), _seconds(case.in_child))
                for _ in range(args.pairs)
            ]
            rows.append({"decoder": case.name, "pairs": pairs})
            console.say(f"{case.name}: {_medians(pairs)} s here and in a child")
    stored = {
        "machine": clock.machine(),
        "revision": revision(),
        "memory": memory,
        "decoders": rows,
    }
    write_json(args.out, stored)
    console.say(f"kept in {args.out}")
    return stored


def _seconds(run):
    """Processor seconds of this process and of children that end meanwhile."""
    before = _spent()
    run()
    return _spent() - before


def _spent():
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    usages = [resource.getrusage(kind) for kind in kinds]
    return sum(one.ru_utime + one.ru_stime for one in usages)


def _medians(pairs):
    return [round(statistics.median(column), 2) for column in zip(*pairs, strict=True)]


_MEASURE = """
import json, sys
import jax
from nerfies_jax import capture, evaluation
from nerfies_jax.capture import frame_memory

def status(key):
    with open("/proc/self/status") as file:
        (line,) = (line for line in file if line.startswith(key))
    return 1024 * int(line.split()[1])

small, large = sys.argv[1:]
evaluation.frames_of(capture.load(small))  # loads libraries
with open("/proc/self/clear_refs", "w") as file:
    file.write("5")  # forget the peak
before = status("VmRSS")
loaded = capture.load(large)
jax.block_until_ready(evaluation.frames_of(loaded))
print(json.dumps({
    "frames": len(loaded.ids),
    "size": loaded.size,
    "bytes": loaded.images.nbytes,
    "peak": status("VmHWM") - before,
    "estimate": frame_memory.frame_bytes(loaded),
}))
"""


def _memory(folder, count):
    """Peak of a process that reads a capture, in bytes beyond its libraries."""
    _write_frames(folder / "small", 4, (64, 48))
    _write_frames(folder / "large", count, SIZE)
    command = [sys.executable, "-c", _MEASURE, folder / "small", folder / "large"]
    done = subprocess.run(command, capture_output=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def _write_frames(folder, count, size):
    """A capture of transforms.json: poses around the origin, one image many times."""
    from nerfies_jax.capture.images import write_png
    from nerfies_jax.capture.json_files import write_json

    (folder / "images").mkdir(parents=True)
    y, x = np.mgrid[: size[1], : size[0]]
    write_png(folder / "images/0.png", np.stack([x, y, x + y], -1).astype(np.uint8))
    entries = []
    for row in range(count):
        if row:
            os.link(folder / "images/0.png", folder / f"images/{row}.png")
        c, s = float(np.cos(0.01 * row)), float(np.sin(0.01 * row))
        pose = [[c, 0, s, 4 * s], [0, 1, 0, 0], [-s, 0, c, 4 * c], [0, 0, 0, 1]]
        name = f"images/{row}.png"
        entries.append({"file_path": name, "transform_matrix": pose})
        entries[-1]["time"] = row / (count - 1)
    write_json(folder / "transforms.json", {"camera_angle_x": 0.9, "frames": entries})


def _cases(folder):
    """Files of each kind, and both ways to decode them."""
    from nerfies_jax.capture import (
        colmap_models,
        colmap_tables,
        decoder,
        exr,
        exr_decoding,
        video,
        video_decoding,
    )

    rng = np.random.default_rng(0)
    pixels = rng.random((SIZE[1], SIZE[0], 3), np.float32)
    paths = [folder / f"{row}.exr" for row in range(FILES)]
    exr.write_exr(paths[0], pixels, half=True)
    for path in paths[1:]:
        os.link(paths[0], path)
    film = folder / "a.mp4"
    shown = rng.integers(0, 256, (SIZE[1] // 8, SIZE[0] // 8, 3), np.uint8)
    shown = shown.repeat(8, 0).repeat(8, 1)
    video.write_video(film, (np.roll(shown, 9 * row, 1) for row in range(FILES)))
    model = folder / "model"
    _write_model(model)

    def session(read):
        def run():
            with decoder.session():
                read()

        return run

    frames = functools.partial(video_decoding.frames, str(film), 1, 2**31, None, False)
    return (
        Case(
            f"{FILES} EXR of {SIZE[0]}x{SIZE[1]}, half floats",
            lambda: [exr_decoding.read(str(path), False) for path in paths],
            session(lambda: [exr.read_exr(path) for path in paths]),
        ),
        Case(
            f"{FILES} video frames of {SIZE[0]}x{SIZE[1]}",
            lambda: [*frames("refuse")],
            session(lambda: [*video.read_video(film)]),
        ),
        Case(
            "COLMAP text model of 60 images and 20,000 points",
            lambda: colmap_tables.read(str(model)),
            session(lambda: colmap_models.tables(model)),
        ),
    )


def _write_model(folder, images=60, points=20_000):
    """A COLMAP model as text: each point is seen by six images."""
    folder.mkdir()
    (folder / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    seen: list[list[int]] = [[] for _ in range(images)]
    lines = []
    for point in range(points):
        track = []
        for step in range(6):
            image = (point + step) % images
            track += [str(image + 1), str(len(seen[image]))]
            seen[image].append(point + 1)
        place = f"{point % 100} {point % 77} {10 + point % 13}"
        lines.append(f"{point + 1} {place} 9 9 9 0.5 {' '.join(track)}")
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")
    rows = []
    for image in range(images):
        rows.append(f"{image + 1} 1 0 0 0 {-image} 0 0 1 {image:03d}.png")
        rows.append(" ".join(f"1 1 {point}" for point in seen[image]))
    (folder / "images.txt").write_text("\n".join(rows) + "\n")


def _sentence(memory):
    raw, peak, estimate = (memory[key] for key in ("bytes", "peak", "estimate"))
    width, height = memory["size"]
    return (
        f"{memory['frames']} frames of {width}x{height} hold {raw / 1e6:,.0f} MB; "
        f"reading them and handing them to training peaks at {peak / 1e6:,.0f} MB, "
        f"{peak / raw:.2f} times that, and the estimate is {estimate / peak:.2f} of "
        "the peak."
    )


def page(stored: dict) -> str:
    """State the memory, and list the processor time of each decoder in both ways."""
    rows = []
    for row in stored["decoders"]:
        here, child = (list(column) for column in zip(*row["pairs"], strict=True))
        ratio = statistics.median(c / h for h, c in row["pairs"])
        rows.append(
            [
                row["decoder"],
                markdown.number(statistics.median(here)),
                markdown.number(statistics.median(child)),
                markdown.number(ratio),
            ]
        )
    heads = ("decoder", "in one process, CPU s", "in a child, CPU s", "times")
    return "\n\n".join(
        [
            f"{_sentence(stored['memory'])} (Revision {str(stored['revision'])[:12]}.)",
            f"Medians of {len(stored['decoders'][0]['pairs'])} pairs. The child's time "
            "includes its start, which imports the decoder's library.",
            markdown.table(heads, rows),
        ]
    )


if __name__ == "__main__":
    main()
