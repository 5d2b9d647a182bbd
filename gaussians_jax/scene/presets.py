"""Presets with the numbers of the papers; those for a CPU are in `small_presets`.

Where a preset leaves its paper, that is said beside it. None of the full sizes was ever
trained to its end: they want a GPU.
"""

import dataclasses

from gaussians_jax.init.points import InitSpec, StartSpec
from gaussians_jax.losses.acceleration import AccelerationSpec
from gaussians_jax.losses.depth import DepthSpec
from gaussians_jax.losses.flow import FlowSpec
from gaussians_jax.losses.neighbors import NeighborSpec
from gaussians_jax.losses.spectral import SpectralSpec
from gaussians_jax.motion.anchors import AnchorMotionSpec, RateSpec
from gaussians_jax.motion.basis import BasisMotionSpec
from gaussians_jax.motion.carried import CarriedSpec
from gaussians_jax.motion.embedding import EmbeddingMotionSpec
from gaussians_jax.motion.growth import MotionGrowthSpec
from gaussians_jax.motion.kan import KanMotionSpec
from gaussians_jax.motion.mlp import MotionSpec
from gaussians_jax.motion.nodes import MaskSpec, NodeMotionSpec
from gaussians_jax.motion.planes import PlaneMotionSpec
from gaussians_jax.motion.polynomial import PolynomialMotionSpec
from gaussians_jax.motion.se3_bases import SE3BasesSpec
from gaussians_jax.motion.splines import SplineMotionSpec
from gaussians_jax.motion.temporal_opacity import TemporalOpacitySpec
from gaussians_jax.motion.time_basis import TimeBasisSpec
from gaussians_jax.optim.densification import DefaultStrategySpec
from gaussians_jax.optim.learning_rates import LearningRateSpec
from gaussians_jax.optim.mcmc import MCMCStrategySpec
from gaussians_jax.optim.phases import AlternationSpec, AnnealingSpec
from gaussians_jax.scene.small_presets import (
    SMALL_ADC_GS,
    SMALL_D_MISO,
    SMALL_DEFORMABLE,
    SMALL_DYNMF,
    SMALL_E_D3DGS,
    SMALL_EDGS,
    SMALL_FOUR_D,
    SMALL_MCMC,
    SMALL_MOBA,
    SMALL_MOTION_GS,
    SMALL_SC_GS,
    SMALL_SONATA,
    SMALL_SPACETIME,
    SMALL_SPLINE,
    SMALL_STATIC,
    SMALL_TRACKED,
)
from gaussians_jax.scene.spec import SplatScene
from nerfies_jax.training import step_counts

# Kerbl et al. 2023, arXiv:2308.04079: every other number is a default of its spec.
STATIC = SplatScene(steps=30_000)

# Kheradmand et al. 2024, arXiv:2404.09591: its first opacity and scale, its noise and
# its regularizers. The paper counts 1 to 6 million Gaussians, one number for each of
# its scenes; here it is a million. Its noise and rates are the code's; rows that moved
# or are new start with zero moments and their own count, where the code keeps the
# moments of those that moved and has one count for all.
MCMC = SplatScene(
    steps=30_000,
    init=InitSpec(opacity=0.5, scale=0.1),
    strategy=MCMCStrategySpec(),
)

# Yang et al. 2023, arXiv:2309.13101, for real captures: the network, the warm-up and
# the smoothing are defaults of `MotionSpec`. Rates of means fall until the end, there
# to step 30,000.
DEFORMABLE = SplatScene(
    steps=40_000,
    learning_rates=LearningRateSpec(log_scale=1e-3),
    motion=MotionSpec(),
)

# Zhu et al. 2024, arXiv:2410.07707, and its code's numbers: Deformable 3DGS with flow
# that is not the camera's. Its flow and masks come from networks, these from
# `evidence`; frames come in any order, where its come one after the other; and its
# cameras stay those of the capture, as there by default (`poses=PoseRefinementSpec`
# refines them). Rates of means fall over 30,000 steps there, so that after 20,000 they
# are this.
MOTION_GS = SplatScene(
    steps=20_000,
    learning_rates=LearningRateSpec(mean_end=7.4e-6, log_scale=1e-3),
    motion=MotionSpec(),
    flow=FlowSpec(),
)

# Rigid motions fitted to tracks before training, in the manner of Shape of Motion. Its
# tracks and depths come from networks, these from optical flow (`evidence`).
TRACKED = SplatScene(
    steps=30_000,
    init=InitSpec(points=50_000, extra_random=None),
    motion=SE3BasesSpec(bases=20, knots=44),
    temporal_opacity=TemporalOpacitySpec(),
    start=StartSpec(motion="tracks", moving_points=20_000),
)

# Sonata. What it leaves open is as in E-D3DGS, which it descends from (`E_D3DGS`): two
# views a step, no D-SSIM, 60,000 steps, growth to the end, a price on opacity for its
# resets, rates, a table of half as many moments as frames, which bends little and which
# a coarse and a fine network read. Turns are rotation vectors. Depth counts only where
# a capture has it, and by correlation, which the paper leaves open. Codes start as
# waves, not as zeros: see `SMALL_SONATA`. The KAN of the paper's equation 4 is
# `motion.network=bspline`.
SONATA = SplatScene(
    steps=60_000,
    batch_size=2,
    dssim_weight=0.0,
    optimizer="radam",
    strategy=DefaultStrategySpec(refine_stop_iter=60_000, reset_every=6_000_000),
    motion=KanMotionSpec(
        waves=2.0,
        spread=0.5,
        coarser=5,
        smoothness=1e-4,
        opacity=1e-4,
        warm_up=3000,
    ),
    neighbors=NeighborSpec(start=3000),
    spectral=SpectralSpec(),
    depth=DepthSpec(),
)

# E-D3DGS (Bae et al. 2024, arXiv:2404.03613), its code's numbers for HyperNeRF's
# chicken: two views a step, no D-SSIM, growth to the end, no opacity reset but a price
# on opacity. The two views are any two, where its are neighbors, and the rates of its
# networks do not grow with the scene, but all do with the root of the views, which
# there they do not. Codes and heads start otherwise (`EmbeddingMotionSpec`).
E_D3DGS = SplatScene(
    steps=60_000,
    batch_size=2,
    dssim_weight=0.0,
    strategy=DefaultStrategySpec(refine_stop_iter=60_000, reset_every=6_000_000),
    motion=EmbeddingMotionSpec(),
    neighbors=NeighborSpec(),
)

# MoBa-GS: growth up to half of the run, then alternating updates, and from three
# quarters on annealed positions. It starts from random points. Activations of the base,
# bounds of the directions (by 1) and turns as rotation vectors are our choice where the
# paper is silent; growth is guided by a soft factor where it prints a hard rule
# (`MotionGrowthSpec(form="hard")`).
MOBA = SplatScene(
    steps=20_000,
    init=InitSpec(source="random", random=100_000),
    strategy=DefaultStrategySpec(refine_stop_iter=10_000),
    motion=BasisMotionSpec(),
    alternation=AlternationSpec(10_000, 15_000),
    annealing=AnnealingSpec(15_000),
    motion_growth=MotionGrowthSpec(),
    acceleration=AccelerationSpec(start=3000),
)

# DynMF: ten trajectories, sparse coefficients that are alike among neighbors. What the
# paper leaves open is as in 3D-GS and Deformable 3DGS.
DYNMF = SplatScene(
    steps=30_000, motion=TimeBasisSpec(), neighbors=NeighborSpec(start=3000)
)

# Spacetime Gaussians: cubic motion, opacity over time. Not here: features and a small
# network for colors (this is its "lite" model), sampling guided by errors.
SPACETIME = SplatScene(steps=30_000, motion=PolynomialMotionSpec())

# The motion of SplineGS, from tracks as it starts there; its tracks and depths come
# from networks, these from optical flow. It also finds the cameras, which here a
# capture has, and takes control points away, which here stay.
SPLINE = SplatScene(
    steps=20_000,
    init=InitSpec(points=50_000, extra_random=None),
    motion=SplineMotionSpec(),
    start=StartSpec(motion="tracks", moving_points=20_000),
)

# 4DGS (Wu et al. 2024, arXiv:2310.08528), its numbers for HyperNeRF's captures: 3000
# steps without motion and 14,000 with it, growth up to 10,000 of those, 360,000
# Gaussians at most, no opacity reset, no D-SSIM, two views a step (with all rates times
# the root of that, which there they are not). 150 moments are for films of any length.
# There, what is faint goes only where there are more than 200,000 Gaussians, and the
# second stage begins with fresh moments and rates of its own.
FOUR_D = SplatScene(
    steps=17_000,
    batch_size=2,
    dssim_weight=0.0,
    strategy=DefaultStrategySpec(
        refine_stop_iter=13_000, reset_every=1_000_000, cap_max=360_000
    ),
    motion=PlaneMotionSpec(),
)

# SC-GS: 512 nodes, 80,000 steps, growth up to step 50,000, and the rates of its code.
# Its first 10,000 steps, which train the nodes as Gaussians, are replaced by a start
# from tracks. Rates fall until the end; there those of positions do to step 30,000, and
# of nodes to step 40,000.
SC_GS = SplatScene(
    steps=80_000,
    init=InitSpec(points=50_000, extra_random=None),
    learning_rates=LearningRateSpec(log_scale=1e-3),
    strategy=DefaultStrategySpec(refine_stop_iter=50_000),
    motion=NodeMotionSpec(),
    start=StartSpec(motion="tracks", moving_points=20_000),
)

# The motion of EDGS: anchors, and a mask of those that move; nothing asks for rigidity.
# Its anchors are the cells of a grid that hold points and make the looks of their
# Gaussians; here they are spread over the points and carry alone. Their number and the
# steps are our choice.
EDGS = SplatScene(
    steps=40_000,
    init=InitSpec(points=50_000, extra_random=None),
    motion=NodeMotionSpec(nodes=2048, rigidity=None, mask=MaskSpec()),
    start=StartSpec(motion="tracks", moving_points=20_000),
)

# D-MiSo: 80,000 steps, four views in each, cores that grow for 5000 steps (to some 3000
# there; at most so many here) and carry 25 Gaussians each. Where the paper draws cores
# alone for those steps, what they carry is here from the start (`effects.carried`); its
# network reads all three corners of a core's triangle, this one the first; and all
# rates are times two, the root of the views. In its code the times of real captures are
# noisy, and the network that turns what is carried learns with a rate of 0.1.
D_MISO = SplatScene(
    steps=80_000,
    batch_size=4,
    init=InitSpec(points=4000),
    strategy=DefaultStrategySpec(refine_stop_iter=5000, cap_max=10_000),
    motion=MotionSpec(warm_up=2000, smoothing=None),
    carried=CarriedSpec(),
)

# ADC-GS, its code's numbers for HyperNeRF's chicken (other films grow from 0.0035 or
# 0.005 on): ten Gaussians of an anchor, two views a step, a fifth of the loss half of
# 1 - SSIM, one color from everywhere, growth from step 9000 to 50,000, no resets. It
# rounds from step 10,000 on, where bits cost from 15,000; here both begin together. Its
# price on features that differ between neighbors (0.01), a codec for the places of
# anchors and a rate for each part of what an anchor makes are not here. All rates are
# times the root of the views, which there they are not.
ADC_GS = SplatScene(
    steps=60_000,
    batch_size=2,
    dssim_weight=1 / 9,  # 0.8 L1 + 0.1 (1 - SSIM), times 10 / 9
    init=InitSpec(points=2000, random=2000),
    sh_degree=0,
    learning_rates=LearningRateSpec(mean=4e-3, log_scale=7e-3, quaternion=2e-3),
    strategy=DefaultStrategySpec(
        refine_start_iter=9100,
        refine_stop_iter=50_000,
        grow_grad2d=2e-3,
        prune_opa=0.003,
        reset_every=6_000_000,
        cap_max=100_000,
    ),
    motion=AnchorMotionSpec(rate=RateSpec(start=15_000), learning_rate_end=1.6e-6),
)

PRESETS = {
    "splats-static": STATIC,
    "splats-mcmc": MCMC,
    "splats-tracked": TRACKED,
    "splats-deformable": DEFORMABLE,
    "sonata": SONATA,
    "moba": MOBA,
    "dynmf": DYNMF,
    "spacetime": SPACETIME,
    "spline": SPLINE,
    "4dgs": FOUR_D,
    "e-d3dgs": E_D3DGS,
    "sc-gs": SC_GS,
    "edgs": EDGS,
    "d-miso": D_MISO,
    "adc-gs": ADC_GS,
    "motion-gs": MOTION_GS,
    "splats-static-small": SMALL_STATIC,
    "splats-tracked-small": SMALL_TRACKED,
    "splats-mcmc-small": SMALL_MCMC,
    "splats-deformable-small": SMALL_DEFORMABLE,
    "sonata-small": SMALL_SONATA,
    "moba-small": SMALL_MOBA,
    "dynmf-small": SMALL_DYNMF,
    "spacetime-small": SMALL_SPACETIME,
    "spline-small": SMALL_SPLINE,
    "4dgs-small": SMALL_FOUR_D,
    "e-d3dgs-small": SMALL_E_D3DGS,
    "sc-gs-small": SMALL_SC_GS,
    "edgs-small": SMALL_EDGS,
    "d-miso-small": SMALL_D_MISO,
    "adc-gs-small": SMALL_ADC_GS,
    "motion-gs-small": SMALL_MOTION_GS,
}


def with_steps(spec: SplatScene, steps: int) -> SplatScene:
    """Change the number of training steps, and stretch all schedules in proportion.

    Args:
      spec: Settings.
      steps: Number of steps.

    Returns:
      The changed settings.

    Raises:
      ValueError: If `steps` is less than one.
    """
    if steps < 1:
        raise ValueError(f"steps={steps}: train for at least one step")
    in_proportion = step_counts.stretched(spec, steps / spec.steps)
    return dataclasses.replace(in_proportion, steps=steps)
