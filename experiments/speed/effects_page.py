"""The page of `experiments.speed effects` in docs/results."""

import textwrap
from collections.abc import Mapping

from experiments import markdown
from nerfies_jax.metrics.clock import Metric

OFF = """\
A disabled effect is `None` in the settings of a scene and costs nothing. This page
lists the cost of enabled ones. [inspect.md](../inspect.md) describes how effects are
recommended for a capture.

## Disabled effects cost nothing

A step reads no flags. An effect that is `None` has no parameters, no state and no
operations:

- `tests/test_effect_leaves.py` lists, at the presets' full sizes, each array that a
  scene should have, effect by effect, and finds those and no others.
- `tests/test_effect_cost.py` compares every preset without its effects with a static
  scene written by hand: equal flops, bytes and memory of the compiled step, and bitwise
  equal states after it. A preset without one effect lowers to the same text, from the
  same initial state, as one assembled from the others, while every function of the
  modules of the missing effect raises. The same holds for parts of motions that are
  `None`, and for penalties of weight zero.

So `nerfies reconstruct --preset nerfies-small --set background=none` is
Nerfies without background points, and not Nerfies with a term of weight zero.

## How to read the tables

One training step of each preset on the built-in scene, at {at:.0%} of its steps,
after every warm-up. *bare* is the preset without its effects, *only X* has one, *X + Y*
has one and an effect that it requires, *all* is the preset, and *without X* is the
preset without one effect (and those that require it) or without a part of one.
`splats-static-small` has no effects: its rows are effects that no preset has.{apart}

- *Mflop* and *MB* are the compiler's counts, in which the body of a loop counts once:
  blending of Gaussians, and networks that move them in blocks, are undercounted.
  *matmul Mflop* counts the matrix products with all iterations of loops (if their
  number is known), and compares across presets. Work that only some steps do
  (`elastic.every`) counts in full. *temporary MB* is memory in addition to inputs and
  outputs.
- *compile s* is paid once per run and shape, and not at all with the compilation
  cache.
- *step ms* is processor time of one core, a tenth of a call of ten steps, the median of
  {repeats} calls or more, with all scenes of a preset in turn. Ratios hold on other
  machines better than milliseconds.
- *over bare* is the time of a step divided by that of the bare scene. Costs do not add
  up exactly, because the compiler fuses neighboring operations. The ratio of a cheap
  effect may be a little below 1.

`--check {stored}` compares a new measurement with these
numbers: counts must repeat to half a percent under the same XLA, ratios within a
quarter, and seconds within a factor of two."""

SUMMARY = """\
Appearance codes are almost free ({appearance:.2f}), and so are background points
({background:.2f} with a warp, {warp:.2f} without them) and the depth loss
({depth:.2f}). A warp makes a step of a field {warp:.2f} times as long, and with an
elastic penalty on 4 samples of a ray at one step of five {elastic:.2f} times. A step of
splats with motion takes {mlp:.2f} (MLP), {kan:.2f} (KAN) or {basis:.2f} (basis) times
as long as a static one, and {acceleration:.2f} times with the acceleration penalty.
NSFF is the most expensive field ({flow:.2f}): it also traces each ray at the times of
its neighbors. Annealing, alternation and motion-guided growth have no measurable cost
per step."""
QUOTED = {
    "appearance": "nerf-w-small.only_appearance",
    "background": "nerfies-small.warp_and_background",
    "warp": "nerfies-small.only_warp",
    "elastic": "nerfies-small.warp_and_elastic",
    "depth": "sonata-small.only_depth",
    "mlp": "splats-deformable-small.only_motion",
    "kan": "sonata-small.only_motion",
    "basis": "moba-small.only_motion",
    "acceleration": "moba-small.motion_and_acceleration",
    "flow": "nsff-small.only_scene_flow",
}
STORED = "nerfies_jax/runs/effect_cost.json"  # from which costs are quoted
HEADS = (
    *("scene", "parameters", "Mflop", "matmul Mflop", "MB", "temporary MB"),
    *("compile s", "step ms", "over bare"),
)
MILLIONS = ("flops", "matrix_flops", "bytes_accessed", "temporary_bytes")


def page(results) -> str:
    """Format the page below the docstring.

    Args:
      results: The stored results.

    Returns:
      Markdown.
    """
    about, rows = results["about"], results["metrics"]
    ratios = {
        name: rows[f"{key}.step.over_bare"]["value"] for name, key in QUOTED.items()
    }
    metrics = {
        key: Metric(key, **row) for key, row in rows.items() if row["value"] is not None
    }
    return "\n\n".join(
        [
            OFF.format(
                at=about["at"],
                repeats=about["repeats"],
                stored=STORED,
                apart=_apart(about),
            ),
            SUMMARY.format(**ratios),
            "\n".join(tables(metrics)),
        ]
    )


def tables(metrics: Mapping[str, Metric]) -> list[str]:
    """Format one table of training steps for each preset.

    Args:
      metrics: Metrics by key.

    Returns:
      Lines of Markdown.
    """
    scenes: dict[str, list[str]] = {}
    for key in metrics:
        preset, scene, *parts = key.split(".")
        if parts == ["parameters"]:
            scenes.setdefault(preset, []).append(scene)
    lines = []
    for preset, names in scenes.items():
        rows = [_row(metrics, preset, name) for name in names]
        table = markdown.table(HEADS, rows)
        lines += [f"### `{preset}`", "", *table.splitlines(), ""]
    return lines[:-1]


def _row(metrics, preset, scene):
    def value(key):
        return metrics[f"{preset}.{scene}.{key}"].value

    return [
        _title(scene),
        f"{int(value('parameters')):,}",
        *(_number(value(f"step.{name}") / 1e6) for name in MILLIONS),
        f"{value('step.compile_seconds'):.0f}",
        _number(1e3 * value("step.seconds")),
        f"{value('step.over_bare'):.2f}",
    ]


def _number(value):
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _title(scene):
    """Convert a key of the metrics to the name in the table."""
    for word in ("only", "without"):
        if scene.startswith(f"{word}_"):
            return f"{word} {scene.removeprefix(f'{word}_')}"
    return scene.replace("_and_", " + ")


def _apart(about):
    """Name the presets that were measured on another processor."""
    apart = about.get("apart", {})
    if not apart:
        return ""
    cpus = " and ".join(sorted(set(apart.values())))
    preset_names = ", ".join(f"`{name}`" for name in apart)
    line = f"Measured apart, on {cpus}: {preset_names}."
    return "\n" + textwrap.fill(line, 88, break_on_hyphens=False)
