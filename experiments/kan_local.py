"""What it costs and saves to sum only the nearest kernels of a KAN: dense or local.

    python -m experiments.kan_local
    python -m experiments.kan_local --kernels 8 64 --nearest 4 8 --points 20000

One layer over evenly spread points: all kernels, as `nets.kan` sums them, or the few
nearest to each input, whose weights are gathered for every point and input. Tabulates
the largest error of the local sum, relative to the largest value, and processor time of
value and slopes, both forms in turn.
"""

import dataclasses
import pathlib

from experiments import cli, markdown
from nerfies_jax import console
from nerfies_jax.runs import platform


@dataclasses.dataclass(frozen=True)
class KanLocal:
    """Hold local sums of kernels against dense ones."""

    kernels: tuple[int, ...] = (8, 16, 32)
    """Of each function of one input, on an even grid."""
    nearest: tuple[int, ...] = (4, 6, 8)
    """Kernels that are summed for each input."""
    points: int = 10000
    """At which the layer is evaluated: Gaussians."""
    width: int = 32
    """Inputs, and outputs, of the layer."""
    repeats: int = 5
    """Rounds of timing."""
    out: pathlib.Path | None = None
    """Also write the figures here, as JSON."""
    device: str = "auto"
    """cpu, gpu, or whatever JAX finds."""

    def __post_init__(self):
        cli.check_out_file(self.out)
        for name in ("points", "width", "repeats"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} {getattr(self, name)} must be at least 1")
        if not self.kernels or min(self.kernels) < 2:
            raise ValueError(f"--kernels {self.kernels}: a grid has at least two")
        if not self.nearest or min(self.nearest) < 1:
            raise ValueError(f"--nearest {self.nearest}: sum at least one")


@cli.command(KanLocal)
def main(args):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with cli.user_errors():
        platform.start_jax(args.device, "one")
    figures = measured(args)
    console.say(table(figures))
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.measure import clock

    record = {"machine": clock.machine(), "rows": figures}
    if args.out is not None:
        write_json(args.out, record)
    return record


def measured(args: KanLocal) -> list[dict]:
    """One row for each number of kernels and each way to sum them."""
    rows = []
    for kernels in args.kernels:
        rows += _rows(args, kernels)
    return rows


def _rows(args, kernels):
    import jax
    import jax.numpy as jnp
    import numpy as np

    from nerfies_jax.measure import clock
    from nerfies_jax.nets import kan
    from nerfies_jax.nets.mlp import HeadSpec

    heads = (("y", HeadSpec(args.width)),)
    spec = kan.KANSpec(args.width, heads=heads, kernels=kernels, base=False)
    params = kan.init(jax.random.key(0), spec)
    shape = args.points, args.width
    places = jax.random.uniform(jax.random.key(1), shape, jnp.float32, -1, 1)

    def dense(params, x):
        return kan.apply_heads(spec, params, x)["y"]

    def nearest_alone(nearest):
        return lambda params, x: local(spec, params.heads["y"], x, nearest)

    ways = {"all": dense} | {
        nearest: nearest_alone(nearest) for nearest in args.nearest if nearest < kernels
    }
    values = {name: np.asarray(jax.jit(f)(params, places)) for name, f in ways.items()}
    programs = {name: jax.jit(_with_slopes(f)) for name, f in ways.items()}
    times = clock.compare(
        {n: lambda program=f: program(params, places) for n, f in programs.items()},
        repeats=args.repeats,
        warm_up=1,
    )
    largest = np.abs(values["all"]).max()
    return [
        {
            "kernels": kernels,
            "nearest": name,
            "error": float(np.abs(value - values["all"]).max() / largest),
            "seconds": times[name].median_cpu,
            "over_dense": times[name].median_cpu / times["all"].median_cpu,
        }
        for name, value in values.items()
    ]


def _with_slopes(function):
    import jax
    import jax.numpy as jnp

    return jax.grad(lambda params, x: jnp.sum(jnp.sin(function(params, x))), (0, 1))


def local(spec, layer, inputs, nearest: int):
    """One layer without base: only the `nearest` kernels around each input.

    inputs: [points, in] on the grid; returns [points, out].
    """
    import jax
    import jax.numpy as jnp

    from nerfies_jax.nets import kan

    low, _ = spec.grid_of(0)
    step = kan.spacing(spec, 0)
    first = jnp.floor((inputs - low) / step - (nearest - 2) / 2).astype(jnp.int32)
    first = jnp.clip(first, 0, spec.kernels - nearest)
    every = jnp.arange(inputs.shape[1])

    # Kernel by kernel, as the dense sum goes: [points, in, out] gathered at a time.
    def add(total, k):
        which = first + k
        center = low + step * which.astype(inputs.dtype)
        gaussian = jnp.exp(-(((inputs - center) / kan.width(spec, 0)) ** 2))
        weight = layer.kernel[which, every]
        return total + jnp.einsum("ni,nio->no", gaussian, weight), None

    nothing = jnp.zeros((inputs.shape[0], layer.bias.shape[0]), inputs.dtype)
    total, _ = jax.lax.scan(
        jax.checkpoint(add), nothing, jnp.arange(nearest, dtype=jnp.int32)
    )
    return total + layer.bias


def table(figures: list[dict]) -> str:
    """Lines for a person."""
    lines = [f"{'kernels':>8}{'summed':>8}{'error':>10}{'CPU ms':>9}{'of dense':>10}"]
    lines += [
        f"{row['kernels']:>8}{row['nearest']:>8}{row['error']:>10.1e}"
        f"{1e3 * row['seconds']:>9.1f}{row['over_dense']:>10.2f}"
        for row in figures
    ]
    return "\n".join(lines)


def page(stored) -> str:
    """The page in docs/results below the docstring, from what `--out` wrote."""
    heads = ("kernels", "summed", "error", "CPU ms", "time over all")
    rows = [
        [
            str(row["kernels"]),
            str(row["nearest"]),
            markdown.short(row["error"]),
            markdown.number(1e3 * row["seconds"], 1),
            markdown.number(row["over_dense"], 2),
        ]
        for row in stored["rows"]
    ]
    text = markdown.table(heads, rows)
    ratios = [r["over_dense"] for r in stored["rows"] if r["nearest"] != "all"]
    if not ratios:
        return text
    return (
        f"{text}\n\nA local sum takes {min(ratios):.1f} to {max(ratios):.1f} times as "
        "long as the sum of all kernels."
    )


if __name__ == "__main__":
    main()
