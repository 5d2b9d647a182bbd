"""Settings that trade accuracy for time, axis by axis; no JAX.

Every axis changes one thing in a base, so that its line says what that thing is worth.
"""

from typing import NamedTuple

from experiments.ablate.arms import Arm, Suite

SPLATS, FIELD, SONATA, MOBA = (
    "splats-deformable-small",
    "nerfies-small",
    "sonata-small",
    "moba-small",
)


class Axis(NamedTuple):
    """One thing that can be set, and a few values of it."""

    question: str
    base: str  # the setting that the others are held against
    settings: dict[str, Arm]  # by name, the base among them


def _axis(question: str, preset: str, **changes: str) -> Axis:
    """The base is the preset as it is; `changes` name what is set in the others.

    Names of settings are those of the changes, so that a preset as it is is trained
    once for all of its axes.
    """
    settings = {preset: Arm(preset)}
    for name, assignments in changes.items():
        settings[name] = Arm(preset, tuple(assignments.split()))
    return Axis(question, preset, settings)


def _precisions(preset: str, stem: str) -> dict[str, Arm]:
    """The preset under each of JAX's own switches of precision.

    XLA for CPUs takes the one for products as a hint: it sums float32 as before, in
    another order, and saves nothing.
    """
    return {
        preset: Arm(preset),
        f"{stem}-products-bfloat16": Arm(
            preset, environment=("JAX_DEFAULT_MATMUL_PRECISION=BF16_BF16_F32",)
        ),
        f"{stem}-float64": Arm(preset, environment=("JAX_ENABLE_X64=1",)),
    }


_PRESETS = (
    "splats-static-small",
    SPLATS,
    SONATA,
    MOBA,
    "nerf-small",
    "t-nerf-small",
    "d-nerf-small",
    FIELD,
    "hypernerf-small",
    "nsff-small",
)

AXES = {
    "preset": Axis(
        "which representation and method",
        SPLATS,
        {name: Arm(name) for name in _PRESETS},
    ),
    "gaussians": _axis(
        "how many Gaussians, and whether they grow",
        SPLATS,
        **{
            "most-4000": "init.points=1500 init.random=2000 init.extra_random=500 "
            "densification.cap_max=4000",
            "most-20000": "densification.cap_max=20000",
            "no-growth": "densification=none",
        },
    ),
    "harmonics": _axis(
        "which degree of spherical harmonics",
        SPLATS,
        **{"sh-0": "sh_degree=0", "sh-2": "sh_degree=2", "sh-3": "sh_degree=3"},
    ),
    "dssim": _axis(
        "how much D-SSIM in the loss",
        SPLATS,
        **{"dssim-0": "dssim_weight=0", "dssim-0.5": "dssim_weight=0.5"},
    ),
    "raster": _axis(
        "which tiles and cut-offs in the rasteriser",
        SPLATS,
        **{
            "tile-16": "raster.tile=16",
            "cut-0.01": "raster.alpha_threshold=0.01",
            "cut-0.001": "raster.alpha_threshold=0.001",
            "stop-1e-2": "raster.transmittance_threshold=0.01",
            "antialiased": "raster.antialiased=true",
        },
    ),
    "motion-network": _axis(
        "how large a motion network",
        SPLATS,
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
    "basis": _axis(
        "how many bases of motion",
        MOBA,
        **{
            "k-2": "motion.count=2",
            "k-4": "motion.count=4",
            "k-16": "motion.count=16",
            "no-basis": "motion.count=none",
        },
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
        **{"rays-256": "rays=256", "rays-1024": "rays=1024"},
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
    "precision": Axis(
        "in which precision a field is trained", FIELD, _precisions(FIELD, "field")
    ),
    "splat-precision": Axis(
        "in which precision Gaussians are trained",
        SPLATS,
        _precisions(SPLATS, "splats"),
    ),
    "bands": _axis(
        "how many bands encode the position",
        FIELD,
        **{
            "bands-5": "template.position.bands=5",
            "bands-10": "template.position.bands=10",
            "warp-bands-2": "warp.position.bands=2",
            "warp-bands-6": "warp.position.bands=6",
        },
    ),
}

SETTINGS = Suite(
    arms={name: arm for axis in AXES.values() for name, arm in axis.settings.items()},
    claims=(),
    seeds=1,
    pictured=(),
    context="",
)
