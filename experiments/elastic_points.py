"""What drawing a few samples of each ray does to the elastic penalty.

    python -m experiments.elastic_points
    python -m experiments.elastic_points --points 1 2 4 --draws 400 --out table.json

On rays through synthetic surfaces in thin fog and a bent SE(3) warp 6x128: bias of the
value, deviation of the gradient of the warp's weights, and processor time of both, for
1, 4 and 8 systematic draws and for all samples. "uniform 4" are as many samples drawn
evenly, each standing for its own weight: what drawing by weight saves.
"""

import dataclasses
import pathlib

from experiments import cli, markdown
from nerfies_jax import console
from nerfies_jax.runs import platform


@dataclasses.dataclass(frozen=True)
class ElasticPoints:
    """Tabulate bias, deviation and time of the elastic penalty's estimators."""

    points: tuple[int, ...] = (1, 4, 8)
    """Samples drawn of each ray; all of them are always there to compare with."""
    rays: int = 256
    """In a batch."""
    samples: int = 64
    """Of each ray."""
    draws: int = 100
    """Batches drawn for bias and deviation."""
    repeats: int = 5
    """Rounds of timing."""
    out: pathlib.Path | None = None
    """Also write the figures here, as JSON."""
    device: str = "auto"
    """cpu, gpu, or whatever JAX finds."""

    def __post_init__(self):
        cli.check_out_file(self.out)
        for name in ("rays", "samples", "draws", "repeats"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} {getattr(self, name)} must be at least 1")
        wrong = [k for k in self.points if not 0 < k < self.samples]
        if wrong:
            raise ValueError(
                f"--points {wrong[0]} must be in 1 .. {self.samples - 1}: a ray has "
                f"{self.samples} samples"
            )


@cli.command(ElasticPoints)
def main(args):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with cli.user_errors():
        platform.start_jax(args.device, "all")
    figures = estimator_table(args)
    console.say(table(figures))
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.measure import clock

    record = {"machine": clock.machine(), "rows": figures}
    if args.out is not None:
        write_json(args.out, record)
    return record


def estimator_table(args: ElasticPoints) -> dict[str, dict[str, float]]:
    """By estimator, relative to all samples: `bias` and its standard `error`,
    `deviation` (RMS) of the value and of the gradient, and `cpu_seconds`.
    """
    import jax
    import jax.flatten_util
    import jax.numpy as jnp

    from nerfies_jax.measure import clock

    params, batch = warp_and_rays(args.rays, args.samples)
    rows = {"uniform 4": None, **{str(k): k for k in args.points}, "all": "all"}
    rows = rows if args.samples > 4 else {k: v for k, v in rows.items() if v}
    figures, calls, exact = {}, {}, None
    for name, points in reversed(rows.items()):
        both = jax.jit(
            jax.value_and_grad(
                lambda params, key, points=points: penalty(params, key, batch, points)
            )
        )

        def one(key, both=both):
            value, slope = both(params, key)
            return value, jax.flatten_util.ravel_pytree(slope)[0]

        if points == "all":
            exact = one(jax.random.key(0))
        keys = jax.random.split(jax.random.key(1), 1 if points == "all" else args.draws)
        drawn = [one(key) for key in keys]
        values = jnp.stack([value for value, _ in drawn]) / exact[0] - 1
        off = [jnp.linalg.norm(slope - exact[1]) for _, slope in drawn]
        slope_deviation = jnp.sqrt(jnp.mean(jnp.square(jnp.stack(off))))
        deviation = jnp.sqrt(jnp.mean(values**2))
        figures[name] = {
            "bias": float(jnp.mean(values)),
            "error": float(jnp.std(values)) / len(drawn) ** 0.5,
            "value_deviation": float(deviation),
            "gradient_deviation": float(slope_deviation / jnp.linalg.norm(exact[1])),
        }
        calls[name] = lambda both=both: both(params, jax.random.key(2))
    for name, timing in clock.compare(calls, repeats=args.repeats).items():
        figures[name]["cpu_seconds"] = timing.median_cpu
    return {name: figures[name] for name in rows}


def warp_and_rays(rays: int, samples: int):
    """A warp with strains around a tenth, and rays through one or two surfaces."""
    import jax
    import jax.numpy as jnp

    from nerfies_jax.effects import warp
    from nerfies_jax.effects.warp import WarpSpec
    from nerfies_jax.radiance import compositing
    from nerfies_jax.training.effects import FrameCondition

    keys = jax.random.split(jax.random.key(0), 6)
    params = warp.init(WarpSpec(), keys[0])
    # Heads two thousand times as large as at the start: displacements around 0.1.
    params = params._replace(heads=jax.tree.map(lambda x: 2e3 * x, params.heads))
    start = jax.random.uniform(keys[1], (rays, 2), minval=-0.5, maxval=0.5)
    start = jnp.concatenate([start, jnp.full((rays, 1), -1.0)], axis=1)
    distance = jnp.linspace(0.0, 2.0, samples)
    point = start[:, None] + distance[:, None] * jnp.array([0.0, 0.0, 1.0])
    surface = jax.random.uniform(keys[2], (rays, 2, 1), minval=0.4, maxval=1.6)
    strength = jax.random.uniform(keys[3], (rays, 2, 1), minval=0.0, maxval=60.0)
    bumps = strength * jnp.exp(-(((distance - surface) / 0.04) ** 2))
    density = jnp.sum(bumps, axis=1) + 0.05
    spacing = compositing.intervals(distance, 2.0 / samples)
    weight = jax.vmap(compositing.weights)(density * spacing)
    codes = 0.05 * jax.random.normal(keys[4], (rays, 8))
    conditions = FrameCondition(
        jnp.zeros(rays), {"motion": codes}, jnp.zeros(rays, jnp.int32)
    )
    return params, (point, weight, conditions)


def penalty(params, key, batch, points):
    """The elastic energy by `points` draws, "all", or None: four drawn evenly."""
    import jax
    import jax.numpy as jnp

    from nerfies_jax.effects import elastic, warp
    from nerfies_jax.effects.effect import RayOutput
    from nerfies_jax.effects.elastic import ElasticSpec
    from nerfies_jax.effects.warp import WarpSpec
    from nerfies_jax.training.effects import PenaltyContext

    point, weight, conditions = batch
    if points is None:
        samples = weight.shape[1]
        even = jnp.ones_like(weight)
        start = jax.random.uniform(key, weight.shape[:1])
        chosen, _ = jax.vmap(elastic.systematic, (0, 0, None))(even, start, 4)
        point = jnp.take_along_axis(point, chosen[..., None], axis=1)
        weight = jnp.take_along_axis(weight, chosen, axis=1) * (samples / 4)
    nothing = dict.fromkeys(RayOutput._fields)
    level = RayOutput(**nothing | {"point": point, "static_weight": weight})
    context = PenaltyContext(
        **dict.fromkeys(PenaltyContext._fields)
        | {
            "displace": lambda x, condition: warp.displace(
                WarpSpec(), params, x, condition
            ),
            "condition": conditions,
            "levels": (level,),
            "key": key,
        }
    )
    spec = ElasticSpec(points=points if isinstance(points, int) else None)
    return elastic.energy(spec, context)[0]


def table(figures: dict[str, dict[str, float]]) -> str:
    """The rows as text."""
    whole = figures["all"]["cpu_seconds"]
    lines = [
        f"{'samples':10s} {'bias':>8s} {'+-':>7s} {'value RMS':>10s} "
        f"{'gradient RMS':>13s} {'CPU s':>7s} {'of all':>7s}"
    ]
    for name, row in figures.items():
        lines.append(
            f"{name:10s} {row['bias']:8.4f} {row['error']:7.4f} "
            f"{row['value_deviation']:10.3f} {row['gradient_deviation']:13.3f} "
            f"{row['cpu_seconds']:7.3f} {row['cpu_seconds'] / whole:7.2f}"
        )
    return "\n".join(lines)


def page(stored) -> str:
    """The page in docs/results below the docstring, from what `--out` wrote."""
    heads = ("samples", "bias", "± s.e.", "deviation", "of the gradient", "CPU ms")
    keys = ("bias", "error", "value_deviation", "gradient_deviation")
    rows = [
        [
            name,
            *(markdown.number(row[key], 4) for key in keys),
            markdown.number(1e3 * row["cpu_seconds"], 1),
        ]
        for name, row in stored["rows"].items()
    ]
    return markdown.table(heads, rows) + (
        "\n\nBias and deviations are shares of the penalty, and of its gradient, over "
        "all samples."
    )


if __name__ == "__main__":
    main()
