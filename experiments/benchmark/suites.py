"""Suites of methods, and claims about them, without JAX.

The methods of a suite differ in one part.
"""

import shlex
from collections.abc import Mapping
from typing import NamedTuple

from nerfies_jax.runs.representations import PRESETS


class Claim(NamedTuple):
    """A statement that one method is better than another, by some metrics."""

    statement: str
    better: str
    worse: str
    metrics: tuple[str, ...]


class Suite(NamedTuple):
    """Methods and claims that belong together."""

    methods: dict[str, str]  # preset and changes, as for --preset and --set
    claims: tuple[Claim, ...] = ()
    context: str = ""  # published numbers
    # Own number of steps of each method, at which it is also evaluated during training
    # (`evaluated_at`). Empty for the presets' own.
    steps: Mapping[str, int] = {}


def parse_settings(settings: str) -> tuple[str | None, tuple[str, ...]]:
    """Split the settings of a method.

    Args:
      settings: Preset and changes, such as "sonata-small depth=none".

    Returns:
      The preset, None if there is none, and the changes.
    """
    words = shlex.split(settings)
    if words and "=" not in words[0]:
        return words[0], tuple(words[1:])
    return None, tuple(words)


def evaluated_at(steps: int) -> tuple[int, ...]:
    """Return the steps at which to evaluate a method of a suite with own steps.

    Each is half of the next one, for an axis of time that is logarithmic.

    Args:
      steps: Number of steps of the method.

    Returns:
      The steps.
    """
    return tuple(steps // 2**k for k in (4, 3, 2, 1, 0) if steps // 2**k)


MOVING = ("heldout.psnr", "heldout.moving_psnr", "heldout.moving_ssim")
TRACKED = (*MOVING, "tracks.epe")
PRECISE = ("tracks.epe", "heldout.moving_psnr", "tracks.strain")
DEEP = ("heldout.moving_psnr", "heldout.moving_ssim", "heldout.moving_depth_median")

TRACKS, UNTRACKED = "start.motion=tracks", "start.motion=none"
FIELD = "nerfies-grid-small"
FIELDS = Suite(
    {
        "nerfies": f"{FIELD} {TRACKS}",
        "no-elastic": f"{FIELD} {TRACKS} elastic=none",
        "no-background": f"{FIELD} {TRACKS} background=none",
        "translation": f"{FIELD} {TRACKS} warp.kind=translation",
        "nerfies-mlp": f"nerfies-small {TRACKS}",
        # Neither of these two has a grid.
        "t-nerf": "t-nerf-small",
        "static": f"{FIELD} {UNTRACKED} elastic=none background=none warp=none",
        # Tracks leave nothing to find for bands that open one by one.
        "untracked": f"{FIELD} {UNTRACKED}",
        "coarse-to-fine": f"{FIELD} {UNTRACKED} warp.anneal_steps=300",
    },
    (
        Claim("A warped field represents deformation", "nerfies", "static", DEEP),
        Claim(
            "A template under a warp is better than a field that reads the time (not a "
            "claim of the paper)",
            *("nerfies-mlp", "t-nerf", DEEP),
        ),
        Claim("SE(3) is better than translation", "nerfies", "translation", PRECISE),
        Claim(
            "Elastic regularization finds a more rigid and better solution",
            *("nerfies", "no-elastic", PRECISE),
        ),
        Claim(
            "Background regularization keeps the background static",
            *("nerfies", "no-background"),
            ("tracks.drift", "tracks.epe", "heldout.moving_psnr"),
        ),
        Claim(
            "Coarse-to-fine avoids poor local minima (without tracks)",
            *("coarse-to-fine", "untracked", ("tracks.epe", "heldout.moving_psnr")),
        ),
        Claim(
            "Tracks find motion that gradient descent on images does not",
            *("nerfies", "untracked", ("tracks.epe", "heldout.moving_psnr")),
        ),
    ),
)

TRACKED_PARTS = Suite(
    {
        "full": "splats-tracked-small",
        "no-temporal-opacity": "splats-tracked-small temporal_opacity=none",
        "no-inpainting": "splats-tracked-small start.fill_hidden=False",
        "one-spline": "splats-tracked-small motion.coarse_knots=0 motion.fine_rate=1.0",
        "k4": "splats-tracked-small motion.bases=4",
        "k20": "splats-tracked-small motion.bases=20",
        "slow": "splats-tracked-small motion.learning_rate=1e-4",
        "flow": "splats-tracked-small flow.start=0",
    },
    (
        Claim("Temporal opacity helps", "full", "no-temporal-opacity", TRACKED),
        Claim("Inpainting occluded background helps", "full", "no-inpainting", TRACKED),
        Claim("A second spline with few knots helps", "full", "one-spline", TRACKED),
        Claim("Eight bases are better than four", "full", "k4", TRACKED),
        Claim("Eight bases are better than twenty", "full", "k20", TRACKED),
        Claim("A higher learning rate of the motion helps", "full", "slow", TRACKED),
        Claim("An optical flow loss helps after tracks", "flow", "full", TRACKED),
    ),
)

REFINED = "poses=PoseRefinementSpec"
POSES = Suite(
    {
        "captured": "splats-tracked-small",
        "refined": f"splats-tracked-small {REFINED}",
        "refined-slowly": f"splats-tracked-small {REFINED} poses.learning_rate=3e-5 "
        "poses.learning_rate_end=3e-6",
        "motion-gs": "motion-gs-small",  # its flow gives gradients to cameras, too
        "motion-gs-refined": f"motion-gs-small {REFINED}",
    },
    (
        Claim("Pose refinement helps", "refined", "captured", TRACKED),
        Claim("Slow pose refinement helps", "refined-slowly", "captured", TRACKED),
        Claim(
            "Pose refinement helps with a flow loss",
            *("motion-gs-refined", "motion-gs", TRACKED),
        ),
    ),
)

CONTEXT = (
    "The two papers report means of the same baselines that differ by 0.35 to 1.9 dB, "
    "more than\nmost of the effects that they report: these numbers are context, not a "
    "target."
)
SONATA = Suite(
    {
        "full": f"sonata-small {TRACKS}",
        "no-position": f"sonata-small motion.position=false {TRACKS}",
        "no-scale": f"sonata-small motion.scale=false {TRACKS}",
        "no-rotation": f"sonata-small motion.rotation=false {TRACKS}",
        "mlp": f"sonata-small motion.network=mlp {TRACKS}",
        "bspline": f"sonata-small motion.network=bspline {TRACKS}",
        "no-frequency": f"sonata-small spectral=none {TRACKS}",
        "no-depth": f"sonata-small depth=none {TRACKS}",
        "no-neighbors": f"sonata-small neighbors=none {TRACKS}",
        "deformable": f"splats-deformable-small {TRACKS}",
        "static": "splats-static-small",
    },
    (
        Claim("Deforming Gaussians represent motion", "full", "static", MOVING),
        Claim(
            "Without position residuals, motion drifts and blurs: the worst ablation",
            *("full", "no-position", TRACKED),
        ),
        Claim(
            "Scale residuals adapt to geometry of many sizes",
            *("full", "no-scale", MOVING),
        ),
        Claim("Rotation residuals help", "full", "no-rotation", MOVING),
        Claim(
            "An RBF-KAN captures detail that an MLP misses (same inputs, as many "
            "parameters)",
            *("full", "mlp", TRACKED),
        ),
        Claim(
            "Gaussians are cheaper than B-splines in a KAN and at least as good "
            "(equations 5 and 4)",
            *("full", "bspline", (*TRACKED, "train.seconds")),
        ),
        Claim(
            "An RBF-KAN on embeddings is better than deformable 3DGS (the paper's 'w/ "
            "MLP' also has other inputs, losses and optimizer)",
            *("full", "deformable", TRACKED),
        ),
        Claim(
            "Frequency losses keep edges sharp",
            *("full", "no-frequency", (*MOVING, "heldout.ssim")),
        ),
        Claim(
            "Depth supervision gives better geometry",
            *("full", "no-depth"),
            ("heldout.psnr", "heldout.depth_median", "heldout.moving_depth_median"),
        ),
        Claim(
            "Similar embeddings of neighbors make motion coherent (not ablated in the "
            "paper)",
            *("full", "no-neighbors", TRACKED),
        ),
    ),
    "Published means of NeRF-DS, PSNR/SSIM: full 24.42/.856, no-position 22.93/.804,\n"
    "no-scale 24.16/.848, no-rotation 23.99/.840, 'w/ MLP' 22.87/.802, no-frequency\n"
    f"23.89/.839, no-depth 24.29/.852.\n{CONTEXT}",
)

# With tracks, the cap of the small preset is reached before motion may guide growth,
# and its threshold guides nothing (`MotionGrowthSpec`).
SPACIOUS = f"moba-small strategy.cap_max=14000 motion.warm_up=0 {TRACKS}"
GUIDED = f"{SPACIOUS} motion_growth.start=1 motion_growth.motion=0.04"
MOBA = Suite(
    {
        "full": f"moba-small {TRACKS}",
        "no-basis": f"moba-small motion.count=none {TRACKS}",
        "no-annealing": f"moba-small annealing=none {TRACKS}",
        "guided-growth": GUIDED,
        "no-motion-growth": f"{SPACIOUS} motion_growth=none",
        "hard-growth": f"{GUIDED} motion_growth.form=hard",
        "no-alternation": f"moba-small alternation=none {TRACKS}",
        "no-acceleration": f"moba-small acceleration=none {TRACKS}",
        "k2": f"moba-small motion.count=2 {TRACKS}",
        "k4": f"moba-small motion.count=4 {TRACKS}",
        "k16": f"moba-small motion.count=16 {TRACKS}",
        "k32": f"moba-small motion.count=32 {TRACKS}",
        "deformable": f"splats-deformable-small {TRACKS}",
        "static": "splats-static-small",
    },
    (
        Claim("Deforming Gaussians represent motion", "full", "static", MOVING),
        Claim(
            "Spatially varying bases are better than deformable 3DGS (whole methods: "
            "all parts differ)",
            *("full", "deformable", TRACKED),
        ),
        Claim(
            "Bases are better than a plain residual network: the worst ablation",
            *("full", "no-basis", TRACKED),
        ),
        Claim("Positional annealing refines", "full", "no-annealing", TRACKED),
        Claim(
            "Densification guided by motion spends Gaussians on moving objects",
            *("guided-growth", "no-motion-growth", MOVING),
        ),
        Claim(
            "A soft guide is better than the printed conjunction (not in the paper, "
            "which prints the hard form)",
            *("guided-growth", "hard-growth", MOVING),
        ),
        Claim(
            "Alternating updates of networks and Gaussians are more stable",
            *("full", "no-alternation", TRACKED),
        ),
        Claim(
            "The acceleration penalty smooths motion (not ablated in the paper)",
            *("full", "no-acceleration", TRACKED),
        ),
        *(
            Claim(f"Eight bases are better than {number}", "full", method, TRACKED)
            for number, method in (
                ("two", "k2"),
                ("four", "k4"),
                (16, "k16"),
                (32, "k32"),
            )
        ),
    ),
    "Published means of NeRF-DS, PSNR/SSIM: full (K = 8) 24.14/.857, no-annealing\n"
    "23.87/.850, no-motion-growth 23.83/.849, no-basis 23.48/.841, K = 2 23.54/.840,\n"
    f"K = 4 23.62/.847, K = 16 23.54/.845, K = 32 23.44/.841.\n{CONTEXT}",
)

# About as many steps as take 75 processor seconds on one core of an idle machine, or
# half as much again if another run competes for its memory. They are multiples of 160,
# so that evaluations are after whole scans of ten steps.
CURVES = Suite(
    {
        "tracked": "splats-tracked-small",
        "space-time": "spacetime-small",
        "static": "splats-static-small",
        "deformable": f"splats-deformable-small {TRACKS}",
        "sonata": f"sonata-small {TRACKS}",
        "moba": f"moba-small {TRACKS}",
        "d-nerf-grid": "d-nerf-grid-small",
        "nerf-grid": "nerf-grid-small",
    },
    context="All methods with a motion start from the same tracks. The processor "
    "seconds include neither\ntracking nor compilation. Learning rates decay to the "
    "end of each run, so an earlier point\nof a curve is below what a run of that "
    "length would reach.",
    steps={
        "tracked": 1920,
        "space-time": 2080,
        "static": 3360,
        "deformable": 1600,
        "sonata": 1440,
        "moba": 1280,
        "d-nerf-grid": 640,
        "nerf-grid": 2080,
    },
)

# Weights that the papers do not print, from none to the largest.
_SWEPT = {
    "sonata": (
        "Sonata's Equation 18",
        f"sonata-small {TRACKS} neighbors.weight",
        ("0", "0.01", "0.1", "1"),
    ),
    "moba": (
        "MoBa's acceleration penalty",
        f"moba-small {TRACKS} acceleration.weight",
        ("0", "0.001", "0.01", "0.1"),
    ),
    "e-d3dgs": (
        "E-D3DGS' local smoothness",
        "e-d3dgs-small neighbors.weight",
        ("0", "0.01", "0.1", "1"),
    ),
    "dynmf": (
        "DynMF's sparsity",
        "dynmf-small motion.sparsity",
        ("none", "1e-4", "1e-3", "1e-2"),
    ),
}
WEIGHTS = Suite(
    {
        f"{name}-{value}": f"{settings}={value}"
        for name, (_, settings, values) in _SWEPT.items()
        for value in values
    },
    tuple(
        Claim(
            f"{part} helps with a weight of {value}",
            *(f"{name}-{value}", f"{name}-{values[0]}", TRACKED),
        )
        for name, (part, _, values) in _SWEPT.items()
        for value in values[1:]
    ),
)

SUITES = {
    "curves": CURVES,
    "fields": FIELDS,
    "tracked": TRACKED_PARTS,
    "poses": POSES,
    "sonata": SONATA,
    "moba": MOBA,
    "weights": WEIGHTS,
    "presets": Suite({name: name for name in PRESETS if name.endswith("-small")}),
}
