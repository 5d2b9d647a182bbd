"""Settings that trade accuracy for time, axis by axis; no JAX.

Every axis changes one thing in a base, so that its line says what that thing is worth.
What moves is fitted to tracks first in all bases: from rest no setting finds it.
"""

import dataclasses
from typing import NamedTuple

from experiments.ablate.arms import Arm, Suite
from nerfies_jax.training.track_start import FROM_REST, FROM_TRACKS

SPLATS, FIELD = "splats-tracked-small", "nerfies-grid-small"
# Presets that start from rest, from tracks, named as in the league.
NETWORK, SONATA = "splats-deformable-small+tracks", "sonata-small+tracks"


class Axis(NamedTuple):
    """One thing that can be set, and a few values of it."""

    question: str
    base: str  # the setting that the others are held against
    settings: dict[str, Arm]  # by name, the base among them


def _base(name: str) -> Arm:
    preset, _, tracks = name.partition("+")
    return Arm(preset, (FROM_TRACKS,) if tracks else ())


def _axis(question: str, base: str, **changes: str) -> Axis:
    """`changes` name what is set in the others, beside what the base has set.

    Names of settings are those of the changes, so that a base is trained once for all
    of its axes.
    """
    arm = _base(base)
    settings = {base: arm}
    for name, assignments in changes.items():
        settings[name] = dataclasses.replace(
            arm, changes=(*arm.changes, *assignments.split())
        )
    return Axis(question, base, settings)


def _lengths(question: str, base: str, **shares: float) -> Axis:
    """The base over other numbers of steps, its schedules in proportion."""
    arm = _base(base)
    others = {
        name: dataclasses.replace(arm, share=share) for name, share in shares.items()
    }
    return Axis(question, base, {base: arm, **others})


def _precisions(base: str, stem: str) -> dict[str, Arm]:
    """The base under each of JAX's own switches of precision.

    XLA for CPUs takes the one for products as a hint: it sums float32 as before, in
    another order, and saves nothing.
    """
    arm = _base(base)
    switches = {
        f"{stem}-products-bfloat16": "JAX_DEFAULT_MATMUL_PRECISION=BF16_BF16_F32",
        f"{stem}-float64": "JAX_ENABLE_X64=1",
    }
    others = {
        name: dataclasses.replace(arm, environment=(s,)) for name, s in switches.items()
    }
    return {base: arm, **others}


_PRESETS = (
    "splats-static-small",
    "splats-deformable-small",
    SPLATS,
    "spline-small",
    "sc-gs-small",
    "d-miso-small",
    "sonata-small",
    "moba-small",
    "nerf-grid-small",
    "d-nerf-grid-small",
    FIELD,
    "hypernerf-grid-small",
    "nerf-small",
    "nerfies-small",
)

AXES = {
    "preset": Axis(
        "which representation and method",
        SPLATS,
        {name: Arm(name) for name in _PRESETS},
    ),
    "steps": _lengths(
        "how long Gaussians train",
        SPLATS,
        **{"steps-0.25": 0.25, "steps-0.5": 0.5, "steps-2": 2.0},
    ),
    "gaussians": _axis(
        "how many Gaussians, and whether they grow",
        SPLATS,
        **{
            "most-4000": "init.points=1500 init.random=2000 start.moving_points=1200 "
            "densification.cap_max=4000",
            "most-20000": "densification.cap_max=20000",
            "no-growth": "densification=none",
        },
    ),
    "views": _axis(
        "how many views in a step (rates go with the root of their number)",
        SPLATS,
        **{"views-1": "batch_size=1", "views-4": "batch_size=4"},
    ),
    "harmonics": _axis(
        "which degree of spherical harmonics",
        SPLATS,
        # Opened early enough: in the presets' own rhythm a third degree never is.
        **{
            "sh-0": "sh_degree=0",
            "sh-2": "sh_degree=2 sh_every=500",
            "sh-3": "sh_degree=3 sh_every=350",
        },
    ),
    "dssim": _axis(
        "how much D-SSIM in the loss",
        SPLATS,
        **{"dssim-0": "dssim_weight=0", "dssim-0.5": "dssim_weight=0.5"},
    ),
    "raster": _axis(
        "which tiles and cut-offs in the rasterizer",
        SPLATS,
        **{
            "tile-16": "raster.tile=16",
            "cut-0.01": "raster.alpha_threshold=0.01",
            "cut-0.001": "raster.alpha_threshold=0.001",
            "stop-1e-2": "raster.transmittance_threshold=0.01",
            "antialiased": "raster.antialiased=true",
        },
    ),
    "motion": _axis(
        "how fine the motion is, and what finds it",
        SPLATS,
        **{
            "bases-2": "motion.bases=2",
            "bases-16": "motion.bases=16",
            "knots-40": "motion.knots=40 motion.coarse_knots=20",
            "no-fading": "temporal_opacity=none",
            "from-rest": FROM_REST,
            "no-motion": f"{FROM_REST} motion=none temporal_opacity=none",
        },
    ),
    "motion-network": _axis(
        "how large a motion network",
        NETWORK,
        **{
            "motion-2x48": "motion.depth=2 motion.width=48 motion.skips=",
            "motion-8x256": "motion.depth=8 motion.width=256 motion.skips=5",
            "time-bands-2": "motion.time.bands=2",
            "time-bands-10": "motion.time.bands=10",
        },
    ),
    "kan": _axis(
        "how fine a grid in the KAN, or an MLP instead",
        SONATA,
        **{
            "kernels-4": "motion.kernels=4",
            "kernels-16": "motion.kernels=16",
            "kan-mlp": "motion.network=mlp",
        },
    ),
    "splat-precision": Axis(
        "in which precision Gaussians are trained",
        SPLATS,
        _precisions(SPLATS, "splats"),
    ),
    "field-steps": _lengths(
        "how long a field trains",
        FIELD,
        **{"field-steps-0.25": 0.25, "field-steps-0.5": 0.5, "field-steps-2": 2.0},
    ),
    "samples": _axis(
        "how many samples per ray",
        FIELD,
        **{
            "samples-8+8": "sampling.coarse=8 sampling.fine=8",
            "samples-32+32": "sampling.coarse=32 sampling.fine=32",
            "samples-32+0": "sampling.coarse=32 sampling.fine=0",
        },
    ),
    "rays": _axis(
        "how many rays in a step",
        FIELD,
        **{"rays-512": "rays=512", "rays-2048": "rays=2048"},
    ),
    "elastic": _axis(
        "on how many samples of a ray to keep the warp elastic, in which form",
        FIELD,
        **{
            "elastic-off": "elastic=none",
            "elastic-1": "elastic.points=1",
            "elastic-8": "elastic.points=8",
            "elastic-all": "elastic.points=none",
            "elastic-plain": "elastic.robust_width=none",
        },
    ),
    "warp": _axis(
        "rotation and translation, or translation alone",
        FIELD,
        **{"warp-translation": "warp.kind=translation"},
    ),
    "tables": _axis(
        "how large the tables of the grid",
        FIELD,
        **{
            "levels-4": "template.position.levels=4",
            "finest-96": "template.position.finest=96",
            "rows-2**15": "template.position.rows=32768",
        },
    ),
    "precision": Axis(
        "in which precision a field is trained", FIELD, _precisions(FIELD, "field")
    ),
}

SETTINGS = Suite(
    arms={name: arm for axis in AXES.values() for name, arm in axis.settings.items()},
    claims=(),
    seeds=1,
    pictured=(),
    context="",
)
