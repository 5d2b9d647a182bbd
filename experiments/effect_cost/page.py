"""The page of `experiments.effect_cost` in docs/results."""

import textwrap

from experiments.effect_cost import report
from nerfies_jax.metrics.clock import Metric

OFF = """\
A disabled effect is `None` in the settings of a scene and costs nothing. This page
lists the cost of enabled ones. [inspect.md](../inspect.md) describes how effects are
recommended for a capture.

## Disabled effects cost nothing

A step reads no flags. An effect that is `None` has no parameters, no state and no
operations:

- `tests/test_effect_leaves.py` counts out, at the presets' full sizes, each array
  that a scene should have, effect by effect, and finds those and no others.
- `tests/test_effect_cost.py` compares every preset that lost all its effects with a
  static scene written without the machinery: equal flops, bytes and memory of the
  compiled step, and bitwise equal states after it. Every effect is removed from a
  preset, which then lowers to the same text, from the same first state, as one that was
  put together by hand from the others, while every function of the missing effects'
  modules refuses to be called. Parts of motions that are `None`, and their penalties
  of weight zero, are held likewise: their functions refuse to be called, and the first
  state is that of the whole without their arrays.

So `python -m experiments.reconstruct --preset nerfies-small --set background=none` is
Nerfies without background points, and not Nerfies with a term of weight zero.

## How to read the tables

One training step of each preset on the built-in scene, at {at:.0%} of its steps,
where every warm-up is over. *bare* is the preset without its effects, *only X* has
one, *X + Y* one and what it cannot be without, *all* is the preset, *without X* the
preset that lost one (and what needs it) or a part of one. `splats-static-small` has
none of its own; it stands for what no preset has.{apart}

- *Mflop* and *MB* are the compiler's count, in which the body of a loop counts once,
  however often it runs: what blends Gaussians, and networks that move them in blocks,
  are undercounted. *matmul Mflop* has the matrix products alone, with all rounds of
  loops (where their number is known), and compares across presets; what some steps
  skip (`elastic.every`) counts as if none did. *temporary MB* is
  what a step needs beside its inputs and outputs.
- *compile s* is paid once per run and shape, and not at all from the compilation
  cache.
- *step ms* is processor time of one core, a tenth of a call of ten steps, medians of
  {repeats} calls or more, all scenes of a preset in turn. Ratios hold on other machines
  better than milliseconds.
- *over bare* is a step's time over that of the bare scene. Prices do not add up
  exactly: the compiler joins what it finds side by side. An effect that does next to
  nothing may stand a little below 1.

`--check {kept}` holds a new run against these numbers: counts must repeat to half a
percent under the same XLA, ratios within a quarter, seconds within a factor of two,
which on another machine says little."""

WORTH = """\
Worth knowing: appearance codes are all but free ({appearance:.2f}), and so are
background points ({background:.2f} with a warp, {warp:.2f} without them) and the
depth loss ({depth:.2f}). A warp makes a step of a field {warp:.2f} times as long;
with an elastic penalty on 4 samples of a ray, asked at one step of five, it is
{elastic:.2f}. Motion takes a step of splats to {mlp:.2f} (MLP), {kan:.2f} (KAN) or
{basis:.2f} (basis) of a still one, the acceleration penalty to {acceleration:.2f}. NSFF
is the dearest of fields ({flow:.2f}): it traces each ray at its neighbors' times, too.
Annealing, alternation and motion-guided growth cost a step nothing that can be
measured: they change what is learned and when."""
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
KEPT = "nerfies_jax/runs/effect_cost.json"  # what prices are quoted from


def page(stored) -> str:
    """Everything below the docstring, from an effect_cost.json."""
    about, rows = stored["about"], stored["metrics"]
    quoted = {
        name: rows[f"{key}.step.over_bare"]["value"] for name, key in QUOTED.items()
    }
    metrics = {
        key: Metric(key, **row) for key, row in rows.items() if row["value"] is not None
    }
    return "\n\n".join(
        [
            OFF.format(
                at=about["at"], repeats=about["repeats"], kept=KEPT, apart=_apart(about)
            ),
            WORTH.format(**quoted),
            "\n".join(report.page(metrics)),
        ]
    )


def _apart(about):
    """Name the presets that were measured on another processor."""
    apart = about.get("apart", {})
    if not apart:
        return ""
    cpus = " and ".join(sorted(set(apart.values())))
    named = ", ".join(f"`{name}`" for name in apart)
    line = f"Measured apart, on {cpus}: {named}."
    return "\n" + textwrap.fill(line, 88, break_on_hyphens=False)
