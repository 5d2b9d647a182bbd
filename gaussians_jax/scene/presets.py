"""Presets with the numbers of the papers. Presets for a CPU are in `small_presets`.

Each comment says where a preset differs from its paper. None of the full-size presets
was ever trained to its end, because they need a GPU.
"""

import dataclasses

from gaussians_jax.init.points import InitSpec, StartSpec
from gaussians_jax.losses.acceleration import AccelerationSpec
from gaussians_jax.losses.depth import DepthSpec
from gaussians_jax.losses.flow import FlowSpec
from gaussians_jax.losses.neighbors import NeighborSpec
from gaussians_jax.losses.spectral import SpectralSpec
from gaussians_jax.losses.transients import TransientMaskSpec
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
from gaussians_jax.optim.floaters import FloaterSpec
from gaussians_jax.optim.learning_rates import LearningRateSpec
from gaussians_jax.optim.mcmc import MCMCStrategySpec
from gaussians_jax.optim.phases import AlternationSpec, AnnealingSpec
from gaussians_jax.per_frame.appearance import AppearanceSpec
from gaussians_jax.per_frame.sky import SkySpec
from gaussians_jax.scene.small_presets import (
    SMALL_ADC_GS,
    SMALL_COLLECTION,
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

# Kerbl et al. 2023, arXiv:2308.04079: all other numbers are defaults of their specs.
STATIC = SplatScene(steps=30_000)

# Kheradmand et al. 2024, arXiv:2404.09591: its initial opacity and scale, its noise and
# its regularizers. The paper uses 1 to 6 million Gaussians depending on the scene, this
# preset one million. Noise and rates are those of the code. Moved and new Gaussians
# start with zero moments and a step count of their own, where the code keeps the
# moments of moved ones and has one count for all.
MCMC = SplatScene(
    steps=30_000,
    init=InitSpec(opacity=0.5, scale=0.1),
    strategy=MCMCStrategySpec(),
)

# WildGaussians (Kulhanek et al. 2024, arXiv:2407.08447), its code's numbers for
# photographs of monuments: codes of 32, features of four octaves, two layers of 128.
# Differences: a sky of spherical harmonics as in Splatfacto-W in place of Gaussians on
# a sphere, residuals in place of DINO features for transient objects, no network for
# the exposure of an image, and floaters in front of cameras are pruned. Codes learn ten
# times as fast.
COLLECTION = SplatScene(
    steps=200_000,
    learning_rates=LearningRateSpec(mean=1.6e-5, mean_end=1.6e-7, log_scale=5e-4),
    strategy=DefaultStrategySpec(
        refine_every=400,
        refine_start_iter=4000,
        refine_stop_iter=100_000,
        reset_every=15_000,
        floaters=FloaterSpec(),
    ),
    appearance=AppearanceSpec(learning_rate=5e-4, sky=SkySpec(degree=3, width=128)),
    transients=TransientMaskSpec(start=35_000),
)

# Yang et al. 2023, arXiv:2309.13101, for real captures: the network, the warm-up and
# the smoothing are defaults of `MotionSpec`. The rates of the means decay until the
# end, in the paper until step 30,000. Gaussians grow from a mean gradient of 2e-4 on,
# as in the paper and 3DGS. The threshold of the current public code, 7e-4, is for
# absolute values of gradients, summed over pixels, which are larger.
DEFORMABLE = SplatScene(
    steps=40_000,
    learning_rates=LearningRateSpec(log_scale=1e-3),
    motion=MotionSpec(),
)

# Zhu et al. 2024, arXiv:2410.07707, and the numbers of its code: Deformable 3DGS
# supervised by the flow that the camera motion does not explain. Differences: flow and
# masks come from `preprocessing`, not from networks. Frames are visited in random, not
# temporal order. Cameras are not refined, as in the paper's default
# (`poses=PoseRefinementSpec()` refines them). The paper's rates of the means decay over
# 30,000 steps, so `mean_end` is their value after 20,000.
MOTION_GS = SplatScene(
    steps=20_000,
    learning_rates=LearningRateSpec(mean_end=7.4e-6, log_scale=1e-3),
    motion=MotionSpec(),
    flow=FlowSpec(),
)

# Rigid motions fitted to tracks before training, similar to Shape of Motion. Tracks and
# depths come from optical flow (`preprocessing`), not from networks.
TRACKED = SplatScene(
    steps=30_000,
    init=InitSpec(points=50_000, extra_random=None),
    motion=SE3BasesSpec(bases=20, knots=44),
    temporal_opacity=TemporalOpacitySpec(),
    start=StartSpec(motion="tracks", moving_points=20_000),
)

# Sonata. Numbers that the paper does not give are those of E-D3DGS, which it is based
# on (`E_D3DGS`): two views per step, no D-SSIM, 60,000 steps, densification until the
# end, an opacity penalty instead of resets, learning rates, and a table of half as many
# time codes as frames, read by a coarse and a fine network, with a smoothness penalty.
# Rotations are rotation vectors. Depth is used only if a capture has it, with a
# correlation loss, which the paper leaves open. Codes are initialized as waves, not as
# zeros, and Equation 18 has a small weight: see `SMALL_SONATA`.
# `motion.network=bspline` is the KAN of Equation 4.
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
    neighbors=NeighborSpec(weight=0.01, start=3000),
    spectral=SpectralSpec(),
    depth=DepthSpec(),
)

# E-D3DGS (Bae et al. 2024, arXiv:2404.03613), its code's numbers for HyperNeRF's
# chicken: two views per step, no D-SSIM, densification until the end, and an opacity
# penalty instead of resets. Differences: the two views are random, not adjacent. The
# rates of the networks do not scale with the scene, and all rates scale with the square
# root of the number of views. Codes and heads are initialized differently
# (`EmbeddingMotionSpec`).
E_D3DGS = SplatScene(
    steps=60_000,
    batch_size=2,
    dssim_weight=0.0,
    strategy=DefaultStrategySpec(refine_stop_iter=60_000, reset_every=6_000_000),
    motion=EmbeddingMotionSpec(),
    neighbors=NeighborSpec(),
)

# MoBa-GS: densification during the first half of the run, then alternating updates, and
# annealed positions from three quarters on. Gaussians are initialized at random points.
# Choices where the paper gives none: activations of the base network, direction bounds
# of 1, rotation vectors. Densification is guided by a soft factor, where the paper
# prints a hard rule (`MotionGrowthSpec(form="hard")`).
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

# DynMF: ten trajectories with sparse coefficients that are similar among neighbors.
# Numbers that the paper does not give are those of 3DGS and Deformable 3DGS.
DYNMF = SplatScene(
    steps=30_000, motion=TimeBasisSpec(), neighbors=NeighborSpec(start=3000)
)

# Spacetime Gaussians: cubic motion and temporal opacity. This is the "lite" model of
# the paper, without features and a small network for colors. Error-guided sampling is
# missing as well.
SPACETIME = SplatScene(steps=30_000, motion=PolynomialMotionSpec())

# The motion of SplineGS, initialized from tracks as in the paper. Differences: tracks
# and depths come from optical flow, not from networks. Cameras come from the capture
# and are not estimated. Control points are not pruned.
SPLINE = SplatScene(
    steps=20_000,
    init=InitSpec(points=50_000, extra_random=None),
    motion=SplineMotionSpec(),
    start=StartSpec(motion="tracks", moving_points=20_000),
)

# 4DGS (Wu et al. 2024, arXiv:2310.08528), its numbers for HyperNeRF's captures: 3000
# steps without motion and 14,000 with it, densification during the first 10,000 of
# those, at most 360,000 Gaussians, no opacity resets, no D-SSIM, two views per step.
# Differences: all rates scale with the square root of the number of views. 150 knots in
# time are used for videos of any length. The paper prunes transparent Gaussians only if
# there are more than 200,000, and begins its second stage with fresh moments and other
# rates.
FOUR_D = SplatScene(
    steps=17_000,
    batch_size=2,
    dssim_weight=0.0,
    strategy=DefaultStrategySpec(
        refine_stop_iter=13_000, reset_every=1_000_000, cap_max=360_000
    ),
    motion=PlaneMotionSpec(),
)

# SC-GS: 512 nodes, 80,000 steps, densification until step 50,000, and the rates of its
# code. Differences: an initialization from tracks replaces the first 10,000 steps,
# which train the nodes as Gaussians. Rates decay until the end, where the paper's
# decay until step 30,000 (positions) and 40,000 (nodes).
SC_GS = SplatScene(
    steps=80_000,
    init=InitSpec(points=50_000, extra_random=None),
    learning_rates=LearningRateSpec(log_scale=1e-3),
    strategy=DefaultStrategySpec(refine_stop_iter=50_000),
    motion=NodeMotionSpec(),
    start=StartSpec(motion="tracks", moving_points=20_000),
)

# The motion of EDGS: anchors with a mask of the moving ones, without a rigidity loss.
# The paper's anchors are the occupied cells of a grid and also produce the colors of
# their Gaussians. Here they are spread over the points and only move Gaussians. Their
# number and the number of steps are our choice.
EDGS = SplatScene(
    steps=40_000,
    init=InitSpec(points=50_000, extra_random=None),
    motion=NodeMotionSpec(nodes=2048, rigidity=None, mask=MaskSpec()),
    start=StartSpec(motion="tracks", moving_points=20_000),
)

# D-MiSo: 80,000 steps, four views per step, core Gaussians that are densified for 5000
# steps (to about 3000 in the paper, at most `cap_max` here), each with 25 children.
# Differences: the paper renders only the cores during those steps, here the children
# are rendered from the start (`motion.carried`). The paper's network reads all three
# corners of a core's triangle, this one the first. All rates are multiplied by two, the
# square root of the number of views. In the paper's code the times of real captures are
# noisy, and the network that rotates the children has a rate of 0.1.
D_MISO = SplatScene(
    steps=80_000,
    batch_size=4,
    init=InitSpec(points=4000),
    strategy=DefaultStrategySpec(refine_stop_iter=5000, cap_max=10_000),
    motion=MotionSpec(warm_up=2000, smoothing=None),
    carried=CarriedSpec(),
)

# ADC-GS, its code's numbers for HyperNeRF's chicken (other videos are densified from a
# gradient of 0.0035 or 0.005): ten Gaussians per anchor, two views per step, a weight
# of 0.1 for 1 - SSIM, colors independent of the view direction, densification from step
# 9000 to 50,000, no resets. Differences: the paper quantizes from step 10,000 and adds
# the rate loss at 15,000, here both begin together. Its penalty on feature differences
# between neighbors (0.01), the coding of anchor positions and separate learning rates
# for the outputs of an anchor are missing. All rates scale with the square root of the
# number of views.
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
    "splats-collection": COLLECTION,
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
    "splats-collection-small": SMALL_COLLECTION,
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
    """Change the number of training steps, and scale all schedules in proportion.

    Args:
      spec: Settings.
      steps: Number of steps.

    Returns:
      The changed settings.

    Raises:
      ValueError: If `steps` is less than one.
    """
    if steps < 1:
        raise ValueError(f"steps={steps} must be at least 1")
    in_proportion = step_counts.scale_steps(spec, steps / spec.steps)
    return dataclasses.replace(in_proportion, steps=steps)
