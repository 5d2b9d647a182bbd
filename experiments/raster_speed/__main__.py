"""How fast the rasterizer is, against this machine's limit and simpler forms.

    python -m experiments.raster_speed
    python -m experiments.raster_speed --cases 10000@256x256 --baselines
    python -m experiments.raster_speed --yardstick PATH/run.py --cameras 4 --cores 1 4

Times are medians of process CPU time in one process that sees one core
(`PJRT_NPROC=1`), because the machine may be shared. `--yardstick` names a script that
times another rasterizer on a scene it writes: it is called as
`PYTHON SCRIPT --gaussians N --size WxH --scene FILE --json`, and its answer
`forward_ms`, `forward_backward_ms` is printed beside ours for the same scene.
"""

import dataclasses
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

import jax
import jax.numpy as jnp
import numpy as np

from experiments import cli, markdown
from experiments.raster_speed import baselines as raster_baselines
from gaussians_jax import raster
from gaussians_jax.projection import Footprints
from gaussians_jax.raster_spec import GSPLAT
from nerfies_jax import children, console
from nerfies_jax.capture.json_files import write_json
from nerfies_jax.measure import clock

ALL_CASES = tuple(
    f"{count}@{size}"
    for size in ("256x256", "480x270", "800x800")
    for count in (1_000, 10_000, 50_000, 200_000)
)
SPEC = dataclasses.replace(GSPLAT, alpha_max=0.999)  # the yardstick's clamp


@dataclasses.dataclass(frozen=True)
class Settings:
    """What to time."""

    cases: tuple[str, ...] = ALL_CASES  # GAUSSIANS@WIDTHxHEIGHT
    repeats: int = 7
    baselines: bool = False  # dense and lockstep, on every case of at most 10k
    yardstick: pathlib.Path | None = None
    cameras: int = 0  # also this many cameras under vmap, against as many singles
    cores: tuple[int, ...] = ()  # also in fresh processes that see so many cores
    out: pathlib.Path | None = None  # JSON of all cases

    def __post_init__(self):
        cli.check_out_file(self.out)
        for case in self.cases:
            parsed(case)
        if self.repeats < 1:
            raise ValueError(f"--repeats {self.repeats}: time at least once")


def parsed(case: str) -> tuple[int, int, int]:
    """Gaussians, width and height of a case; ValueError where it is none."""
    try:
        count, size = case.split("@")
        width, height = size.split("x")
        return int(count), int(width), int(height)
    except ValueError:
        raise ValueError(
            f"a case is GAUSSIANS@WIDTHxHEIGHT, as 10000@256x256; got {case!r}"
        ) from None


class Case:
    """One scene and the compiled programs that draw it."""

    def __init__(self, text: str, scene: dict | None):
        self.count, self.width, self.height = parsed(text)
        self.text = text
        self.size = (self.width, self.height)
        scene = scene or make_scene(self.count, self.width, self.height)
        self.footprints = footprints_of(scene)
        self.values = jnp.asarray(scene["colors"], jnp.float32)

    def arguments(self):
        return (*self.footprints[:3], self.values, self.footprints)

    def forward(self, drawing=raster.rasterize, **sizes):
        """The compiled drawing; takes footprints and values."""

        def draw(footprints, values):
            return drawing(footprints, values, self.size, SPEC, **sizes)

        return jax.jit(draw).lower(self.footprints, self.values).compile()

    def gradient(self, drawing=raster.rasterize, cameras=None, **sizes):
        """The compiled slopes of the summed picture by all that is drawn."""

        def loss(mean_px, whitening, opacity, values, footprints):
            moved = footprints._replace(
                mean_px=mean_px, whitening=whitening, opacity=opacity
            )
            image, left = drawing(moved, values, self.size, SPEC, **sizes)
            return jnp.sum(image) + jnp.sum(left)

        slopes = jax.grad(loss, argnums=(0, 1, 2, 3))
        arguments = self.arguments()
        if cameras is not None:
            slopes = jax.vmap(slopes, in_axes=(0, None, None, None, None))
            arguments = (cameras, *arguments[1:])
        return jax.jit(slopes).lower(*arguments).compile()


def make_scene(count: int, width: int, height: int) -> dict:
    """Half uniform, half in four clusters; three sigma about 6.5 px."""
    rng = np.random.default_rng(0)
    size = np.array([width, height])
    center = rng.random((4, 2))[rng.integers(0, 4, count)] * size
    clustered = center + rng.normal(size=(count, 2)) * size * 0.06
    spread = rng.random((count, 2)) * size
    one, two = np.exp(rng.normal(0.3, 0.5, (2, count))) ** 2
    angle = rng.random(count) * np.pi
    cos, sin = np.cos(angle), np.sin(angle)
    covariance = [
        cos**2 * one + sin**2 * two + 0.3,
        cos * sin * (one - two),
        sin**2 * one + cos**2 * two + 0.3,
    ]
    return dict(
        means2d=np.where(rng.random((count, 1)) < 0.5, spread, clustered),
        covs=np.stack(covariance, 1),
        depths=1 + 9 * rng.random(count),
        opacities=1 / (1 + np.exp(-2 * rng.normal(size=count))),
        colors=rng.random((count, 3)),
    )


def footprints_of(scene: dict) -> Footprints:
    """Footprints of a scene given by image covariances (px^2)."""
    a, b, c = scene["covs"].astype(np.float64).T
    opacity = scene["opacities"].astype(np.float64)
    whitening = [np.sqrt(0.5 / a), b / a, np.sqrt(0.5 / (c - b * b / a))]
    reach = 2 * np.log(np.maximum(opacity / SPEC.alpha_threshold, 1))
    extent = np.sqrt(reach[:, None] * np.stack([a, c], 1))
    fields = (
        scene["means2d"],
        np.stack(whitening, 1),
        opacity,
        scene["depths"],
        extent,
    )
    return Footprints(*(jnp.asarray(field, jnp.float32) for field in fields))


def median_ms(call, *arguments, repeats: int, clock=time.process_time) -> float:
    """Milliseconds of a call, the median of `repeats` after one that warms up."""
    jax.block_until_ready(call(*arguments))
    times = []
    for _ in range(repeats):
        start = clock()
        jax.block_until_ready(call(*arguments))
        times.append(1e3 * (clock() - start))
    return float(np.median(times))


def exponential_limit_ns(repeats: int) -> float:
    """One exp and one multiply per element in cache: the floor of an evaluation."""
    start, steps = jnp.linspace(0.1, 0.9, 8192, dtype=jnp.float32), 2000

    @jax.jit
    def loop(x):
        return jax.lax.fori_loop(0, steps, lambda _, x: 0.9 * jnp.exp(-x), x)

    return median_ms(loop, start, repeats=repeats) * 1e6 / (steps * start.size)


def yardstick_times(script: pathlib.Path, text: str, scene_file: str) -> dict:
    """What the other rasterizer took for the scene; `text` is "COUNT@SIZE"."""
    count, size = text.split("@")
    command = [sys.executable, str(script), "--gaussians", count, "--size", size]
    command += ["--scene", scene_file, "--json"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    if answer.returncode:
        raise ValueError(f"{script} failed on {text}: {answer.stderr.strip()[-300:]}")
    return json.loads(answer.stdout.strip().splitlines()[-1])


def time_case(text: str, settings: Settings, limit_ns: float) -> dict:
    """Everything measured for one case, by name."""
    row = dict(case=text)
    scene = None
    if settings.yardstick:
        with tempfile.TemporaryDirectory() as folder:
            file = str(pathlib.Path(folder) / "scene.npz")
            row["yardstick_before"] = yardstick_times(settings.yardstick, text, file)
            with np.load(file) as stored:
                scene = {name: stored[name] for name in stored.files}
    case = Case(text, scene)
    forward, gradient = case.forward(), case.gradient()
    pairs = jax.jit(lambda f: raster.blended_pairs(f, case.size, SPEC))(case.footprints)
    evaluations = float(pairs) * SPEC.tile**2
    repeats = settings.repeats
    row["forward_ms"] = median_ms(
        forward, case.footprints, case.values, repeats=repeats
    )
    row["forward_backward_ms"] = median_ms(gradient, *case.arguments(), repeats=repeats)
    row["wall_ms"] = median_ms(
        gradient, *case.arguments(), repeats=repeats, clock=time.perf_counter
    )
    row["evaluations_millions"] = evaluations / 1e6
    row["forward_ns"] = row["forward_ms"] * 1e6 / max(evaluations, 1)
    row["forward_backward_ns"] = row["forward_backward_ms"] * 1e6 / max(evaluations, 1)
    row["share_of_limit"] = limit_ns / row["forward_ns"] if evaluations else 0.0
    row["temporaries_mb"] = gradient.memory_analysis().temp_size_in_bytes / 1e6
    if settings.yardstick:
        with tempfile.TemporaryDirectory() as folder:
            file = str(pathlib.Path(folder) / "scene.npz")
            after = yardstick_times(settings.yardstick, text, file)
        for name in ("forward_ms", "forward_backward_ms"):
            theirs = (row["yardstick_before"][name] + after[name]) / 2
            row[f"yardstick_{name}"] = theirs
        del row["yardstick_before"]
        row["ratio"] = row["forward_backward_ms"] / row["yardstick_forward_backward_ms"]
    if settings.cameras:
        row["cameras_ratio"] = cameras_ratio(case, settings, gradient)
    if settings.baselines and case.count <= 10_000:
        row |= baseline_times(case, settings)
    return row


def cameras_ratio(case, settings, single) -> float:
    """CPU time of a vmap over cameras, over that of as many single renders."""
    shift = jnp.arange(settings.cameras, dtype=jnp.float32)[:, None, None]
    cameras = case.footprints.mean_px + shift
    together = case.gradient(cameras=cameras)
    rest = case.arguments()[1:]

    def singles():
        return [single(camera, *rest) for camera in cameras]

    ratios = []
    for _ in range(max(3, settings.repeats // 2)):
        both = median_ms(together, cameras, *rest, repeats=1)
        ratios.append(both / median_ms(singles, repeats=1))
    return float(np.median(ratios))


def baseline_times(case, settings) -> dict:
    """The dense and the lockstep form on the same case, one or two repeats."""
    row = {}
    longest, pairs = longest_tile(case)
    forms = {
        "lockstep": (raster_baselines.lockstep, dict(pairs=pairs, longest=longest)),
        "dense": (raster_baselines.dense, {}),
    }
    for name, (drawing, sizes) in forms.items():
        call = case.gradient(drawing, **sizes)
        repeats = 1 if name == "dense" else max(3, settings.repeats // 2)
        row[f"{name}_ms"] = median_ms(call, *case.arguments(), repeats=repeats)
        row[f"{name}_mb"] = call.memory_analysis().temp_size_in_bytes / 1e6
    return row


def longest_tile(case) -> tuple[int, int]:
    """Most Gaussians whose rectangle meets one tile, and all such pairs (host)."""
    grid = raster.Grid(*case.size, SPEC.tile)
    rects = raster.binning.tile_rects(
        case.footprints.mean_px, case.footprints.extent_px, grid
    )
    left, top, columns, count = (np.asarray(x) for x in rects)
    per_tile = np.zeros((grid.rows + 1, grid.columns + 1), np.int64)
    rows = count // columns
    np.add.at(per_tile, (top, left), count > 0)
    np.add.at(per_tile, (top + rows, left), -(count > 0).astype(np.int64))
    np.add.at(per_tile, (top, left + columns), -(count > 0).astype(np.int64))
    np.add.at(per_tile, (top + rows, left + columns), count > 0)
    return int(per_tile.cumsum(0).cumsum(1).max()), int(count.sum())


def core_times(settings: Settings, cores: int) -> dict[str, dict]:
    """The same cases in a fresh process that sees `cores` cores."""
    command = [sys.executable, "-m", "experiments.raster_speed", "--json", "--cases"]
    environment = dict(children.environment(), PJRT_NPROC=str(cores), NPROC=str(cores))
    answer = subprocess.run(
        [*command, *settings.cases, "--repeats", str(settings.repeats)],
        capture_output=True,
        text=True,
        check=True,
        env=environment,
    )
    return {row["case"]: row for row in json.loads(answer.stdout)["rows"]}


@cli.command(Settings)
def main(settings):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with cli.user_errors():
        if settings.yardstick is not None and not settings.yardstick.is_file():
            raise ValueError(f"--yardstick {settings.yardstick}: no such file")
    os.environ.setdefault("PJRT_NPROC", "1")
    os.environ.setdefault("NPROC", "1")
    jax.config.update("jax_numpy_dtype_promotion", "standard")
    limit = exponential_limit_ns(settings.repeats)
    console.say(f"exp + multiply, in cache: {limit:.2f} ns an element")
    rows = []
    for text in settings.cases:
        rows.append(row := time_case(text, settings, limit))
        console.say("  ".join(show(name, row[name]) for name in row))
    seen = {cores: core_times(settings, cores) for cores in settings.cores}
    for cores, times in seen.items():
        for text, row in times.items():
            console.say(
                f"{text} seeing {cores} cores: forward+backward "
                f"{row['forward_backward_ms']:.1f} ms CPU, {row['wall_ms']:.1f} ms wall"
            )

    record = {"machine": clock.machine(), "limit_ns": limit, "rows": rows}
    record["cores"] = seen
    if settings.out is not None:
        write_json(settings.out, record)
    return record


def page(stored) -> str:
    """The page in docs/results below the docstring, from what `--out` wrote."""
    columns = {
        "forward_ms": ("forward, CPU ms", 1),
        "forward_backward_ms": ("and backward", 1),
        "evaluations_millions": ("million evaluations", 1),
        "forward_ns": ("ns an evaluation", 2),
        "share_of_limit": ("share of the limit", 2),
        "temporaries_mb": ("temporary MB", 0),
        "ratio": ("over the yardstick", 2),
        "cameras_ratio": ("vmap over singles", 2),
        "lockstep_ms": ("lockstep, ms", 0),
        "dense_ms": ("dense, ms", 0),
    }
    rows = [
        [
            row["case"],
            *(markdown.number(row.get(k), n) for k, (_, n) in columns.items()),
        ]
        for row in stored["rows"]
    ]
    heads = ("Gaussians@size", *(head for head, _ in columns.values()))
    parts = [
        f"The limit of this machine: {stored['limit_ns']:.2f} ns for an exponential "
        "and a product, in cache.",
        markdown.table(heads, rows),
    ]
    if stored["cores"]:
        heads = ("Gaussians@size", "cores", "CPU ms", "wall ms")
        rows = [
            [
                text,
                str(cores),
                markdown.number(row["forward_backward_ms"], 1),
                markdown.number(row["wall_ms"], 1),
            ]
            for cores, times in stored["cores"].items()
            for text, row in times.items()
        ]
        parts += ["Forward and backward, by cores:", markdown.table(heads, rows)]
    return "\n\n".join(parts)


def show(name, value) -> str:
    return f"{name} {value:.3g}" if isinstance(value, float) else f"{value:>15}"


if __name__ == "__main__":
    main()
