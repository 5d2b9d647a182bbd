"""Named radiance fields with the papers' settings, and variants for a CPU.

Samples, networks, rates and weights are those of the paper or code cited at each.
Numbers without a comment are defaults of their specs, which cite their own source.
Deviations from the paper are stated at each preset. All presets deviate as follows:

- Densities use a softplus instead of a ReLU, fine samples are stratified instead of
  independent, and encodings include the identity and have no factor of pi.
- `nerf` and presets derived from it train without the crop of the first 500 steps and
  without noise on densities, in Euclidean space only: all effects convert points of the
  field to scene units by one scale, which normalized device coordinates do not have.
  For forward-facing cameras in a plane, `sampling.spacing=disparity` places samples
  that are even in these coordinates, and feature grids contract what is far.
- None of the full sizes has been trained to its end, because they need a GPU.
"""

import dataclasses

from nerfies_jax.fields.effects.ambient import AmbientSpec
from nerfies_jax.fields.effects.appearance import AppearanceSpec
from nerfies_jax.fields.effects.background import BackgroundSpec
from nerfies_jax.fields.effects.elastic import ElasticSpec
from nerfies_jax.fields.effects.moving_mask import MovingMaskSpec
from nerfies_jax.fields.effects.ray_distortion import DistortionSpec
from nerfies_jax.fields.effects.scene_flow import SceneFlowSpec
from nerfies_jax.fields.effects.smoothness import SmoothnessSpec
from nerfies_jax.fields.effects.surface import SurfaceSpec
from nerfies_jax.fields.effects.time_condition import TimeSpec
from nerfies_jax.fields.effects.time_warp import TimeWarpSpec
from nerfies_jax.fields.effects.transient import TransientSpec
from nerfies_jax.fields.effects.warp import WarpSpec
from nerfies_jax.fields.occupancy import OccupancySpec
from nerfies_jax.fields.spec import RadianceScene, SamplingSpec
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.grids import HashGridSpec
from nerfies_jax.nn.planes import PlanesSpec
from nerfies_jax.nn.voxels import VoxelGridSpec
from nerfies_jax.training import step_counts

# Mildenhall et al. 2020, arXiv:2003.08934. With the ReLU of the paper, a ray that
# starts without any density has no gradient.
NERF = RadianceScene(
    steps=200_000,  # "100-300k iterations"
    rays=4096,  # section 5.3
    micro_batches=4,  # 6.4 GiB instead of 25.5
    sampling=SamplingSpec(64, 128),  # section 5.3
    template=TemplateSpec(EncodingSpec(10), EncodingSpec(4)),  # section 5.1
    learning_rate=5e-4,  # section 5.3, and its end
    learning_rate_end=5e-5,
)

# Martin-Brualla et al. 2021, arXiv:2008.02268, with the sizes of its public
# reimplementation. beta_min is that of the paper, and is added outside the rendered
# sum. The trunk is that of NeRF. Its skip connection is one layer earlier in the
# reimplementation. The transient medium ends at the far plane. In the reimplementation
# its last sample represents everything behind it.
NERF_W = dataclasses.replace(
    NERF,
    appearance=AppearanceSpec(width=48),
    transient=TransientSpec(
        code_width=16, depth=4, width=128, beta_min=0.03, density_weight=0.01
    ),
)

# Pumarola et al. 2020, arXiv:2011.13961, and its code: one network for both levels,
# 500 rays, 800k steps with a rate that decays by ten every 500k, and a curriculum that
# adds the frames one by one over the first 10k steps. Not implemented are the crop of
# the center and the total variation over time. The rays of a step are from all frames.
# In the published code they are from one.
D_NERF = dataclasses.replace(
    NERF,
    steps=800_000,
    rays=500,
    curriculum_steps=10_000,
    sampling=SamplingSpec(64, 128, shared=True),
    learning_rate_end=5e-4 * 10 ** (-8 / 5),
    warp=WarpSpec(
        kind="translation",
        condition="time",
        position=EncodingSpec(10),
        time=EncodingSpec(10),
        depth=8,
        width=256,
        skips=(5,),  # as NeRF's trunk
    ),
)

# The baseline of the same paper: a NeRF that reads the time, without a warp.
T_NERF = dataclasses.replace(D_NERF, warp=None, time=TimeSpec())

# Park et al. 2021, arXiv:2011.12948, in the published configuration for quarter
# resolution. Those for the validation rig and for full HD are not included. Weights and
# scaling of the losses are those of the code, but the elastic loss uses 4 samples per
# ray instead of all 128, and a fold has a cost of 1.0 instead of 0 (see `ElasticSpec`).
# There are no camera codes, and codes between two frames are interpolated linearly
# instead of by a cubic spline. The warp has eight bands. `warp.position.bands=6` is
# that of HyperNeRF, and `background.width=none` the background loss without ρ.
NERFIES = RadianceScene(
    steps=250_000,
    rays=6144,
    micro_batches=8,  # 9.7 GiB instead of 77.6
    sampling=SamplingSpec(128, 128),
    template=TemplateSpec(EncodingSpec(8), EncodingSpec(4), skips=(4,)),
    extent=0.3,  # a box of diagonal one
    learning_rate=1e-3,
    learning_rate_end=1e-4,
    appearance=AppearanceSpec(width=8),
    warp=WarpSpec(anneal_steps=80_000),
    elastic=ElasticSpec(
        weight=1e-2, hold_steps=50_000, decay_steps=100_000, scaling="official"
    ),
    background=BackgroundSpec(),
)

# Park et al. 2021, arXiv:2106.13228: six bands in the warp, a bent slicing surface, no
# elastic loss. Color reads an appearance code per frame, as in Nerfies. In the
# published configuration for the validation rig it reads one per camera.
HYPERNERF = dataclasses.replace(
    NERFIES,
    warp=WarpSpec(position=EncodingSpec(6), anneal_steps=80_000),
    ambient=AmbientSpec(),
    elastic=None,
)

# Yan, Li and Lee 2023, arXiv:2303.14435, and its code's `nerf_ds.gin`: HyperNeRF with
# four bands in the warp, ambient coordinates that are open from the start, 64 and 64
# samples, 512 rays, and neither appearance codes nor background regularization. The
# encodings of the code have no identity. Its loss on displacements (1e-3) and the
# increasing sharpness of its mask weights are not implemented.
NERF_DS = dataclasses.replace(
    HYPERNERF,
    rays=512,
    micro_batches=1,
    sampling=SamplingSpec(64, 64),
    learning_rate=1e-3,
    learning_rate_end=1e-5,
    appearance=None,
    background=None,
    warp=WarpSpec(position=EncodingSpec(4), anneal_steps=50_000),
    ambient=AmbientSpec(closed_steps=0, anneal_steps=1),
    mask=MovingMaskSpec(table="mask"),
    surface=SurfaceSpec(),
)

# Li et al. 2021, arXiv:2011.13084, and its code: one level of 128 samples, 1024 rays.
# Normalized device coordinates, which only fit forward-facing captures, are not used,
# so the bound on the flow is one unit of the field. The kinetic term is added once. The
# rays on moving objects are a third of the 1024, and count in the loss of the blended
# image, where the public code adds 512 that do not. Masks, flow and depth are used if a
# capture has them. Otherwise it trains on colors only.
NSFF = dataclasses.replace(
    NERF,
    steps=360_000,
    rays=1024,
    sampling=SamplingSpec(128, 0),
    scene_flow=SceneFlowSpec(moving_rays=1 / 3, chain_steps=100_000),
)

# Fang et al. 2022, arXiv:2205.15285, the larger published model for captures of
# HyperNeRF. The published grid grows at four steps. Here the strides open one after the
# other over the first 6000 steps, coarse to fine, so that the shapes of the program and
# of checkpoints do not change. Until the finest opens, only every fourth, then every
# second vertex is trained. The published code marches through the box in steps of half
# a cell and skips empty space. Here samples are drawn by the weights of a coarse level.
# Densities are exponential instead of a shifted softplus and start with the same
# opacity (1e-3 per cell). The motion has the common learning rate instead of 7e-4. The
# gradient of the smoothness loss is that of the code, 1e-5 / 4096 rays / 6 * 160 / 128,
# for the whole grid also from step 10 000 on, when the code limits it to the features
# that a step uses. Losses on the colors of samples and on the last transmittance,
# static points and camera codes are not implemented.
TINEUVOX = RadianceScene(
    steps=20_000,
    rays=4096,
    micro_batches=4,
    sampling=SamplingSpec(64, 128, shared=True),
    template=TemplateSpec(
        VoxelGridSpec(),
        EncodingSpec(4),
        depth=1,
        skips=(),
        density="exp",
        density_bias=-2.5,
        anneal_steps=6000,
    ),
    learning_rate=1e-3,
    learning_rate_end=1e-4,
    table_rate=100.0,
    warp=TimeWarpSpec(),
    smoothness=SmoothnessSpec(weight=0.02, until=None),
)

# For a CPU: a small coarse level, a small network, few rays.
SMALL_NERF = RadianceScene(
    steps=3000,
    rays=512,
    micro_batches=2,  # one per core
    sampling=SamplingSpec(16, 16),
    template=TemplateSpec(
        EncodingSpec(8), EncodingSpec(2), depth=4, width=96, skips=(), color_width=48
    ),
    coarse=TemplateSpec(
        EncodingSpec(6), None, depth=2, width=48, skips=(), color_width=32
    ),
    learning_rate=5e-3,
    learning_rate_end=2e-4,
)
# All bands are open from the start. If they open one by one over a tenth or a third of
# such a short run, with both regularizers, the warp stays at the identity (built-in
# scene after 700 steps: 16.5 dB in moving regions, and 18.0 with all bands open).
SMALL_WARP = WarpSpec(position=EncodingSpec(4), depth=4, width=64, skips=())
SMALL_NERF_W = dataclasses.replace(
    SMALL_NERF,
    appearance=AppearanceSpec(width=4),
    transient=TransientSpec(code_width=8, depth=2, width=48, beta_power=1.0),
)
SMALL_D_NERF = dataclasses.replace(
    SMALL_NERF,
    warp=dataclasses.replace(
        SMALL_WARP, kind="translation", condition="time", time=EncodingSpec(4)
    ),
)
SMALL_T_NERF = dataclasses.replace(SMALL_NERF, time=TimeSpec(EncodingSpec(4)))
SMALL_NERFIES = dataclasses.replace(
    SMALL_NERF,
    warp=SMALL_WARP,
    # With the scaling of ρ of the paper, 33 times larger, such a short run stays at the
    # identity. docs/results/ablate_lazy.md shows the effect of evaluating it every five
    # steps.
    elastic=ElasticSpec(weight=1e-3, every=5, scaling="official"),
    background=BackgroundSpec(points=512),
)
SMALL_HYPERNERF = dataclasses.replace(
    SMALL_NERFIES,
    ambient=AmbientSpec(
        depth=3, width=32, skips=(), closed_steps=100, anneal_steps=900
    ),
    elastic=None,
)
SMALL_NERF_DS = dataclasses.replace(
    SMALL_NERF,
    warp=SMALL_WARP,
    ambient=AmbientSpec(depth=3, width=32, skips=(), closed_steps=0, anneal_steps=1),
    mask=MovingMaskSpec(depth=3, width=32, skips=()),
    surface=SurfaceSpec(
        EncodingSpec(2), EncodingSpec(2), closed_steps=300, anneal_steps=600, slope=0.1
    ),
)
SMALL_SCENE_FLOW = SceneFlowSpec(
    network=TemplateSpec(EncodingSpec(8), EncodingSpec(2), depth=4, width=96, skips=()),
    time=EncodingSpec(4),
    # After 600 steps of 192 rays, compared with a bound of 1 and a sixth of the decay
    # steps: 19.49 instead of 19.34 dB, a flow error of 0.54 instead of 0.95 px (both
    # directions), and a depth error of 9 instead of 12 %.
    flow_bound=0.2,
    decay_steps=3000,
)
SMALL_NSFF = dataclasses.replace(
    SMALL_NERF,
    micro_batches=4,  # 233 ms per step on two cores, and 265 with two
    sampling=SamplingSpec(48, 0),
    scene_flow=SMALL_SCENE_FLOW,
)


# A feature grid instead of a positional encoding, with a smaller network. Training PSNR
# and seconds on one core, Blender lego, 200 of 2000 steps:
#   2048 rays, 64 wide, softplus, rate 1e-2             21.3 dB in 56 s
#   exponential densities                               22.2       58
#   and rate 3e-2 (6e-2: 21.4)                          22.7       54
#   and 32 wide                                         22.7       37
#   and 1024 rays (300 steps)                           22.8       29
GRID_TEMPLATE = TemplateSpec(
    HashGridSpec(),
    EncodingSpec(2),
    depth=1,
    width=32,
    skips=(),
    color_width=32,
    density="exp",
)
COARSE_GRID_TEMPLATE = TemplateSpec(
    HashGridSpec(levels=3, coarsest=16, finest=48, rows=2**17),
    None,
    depth=1,
    width=16,
    skips=(),
    color_width=16,
    density="exp",
)
SMALL_NERF_GRID = dataclasses.replace(
    SMALL_NERF,
    rays=1024,
    template=GRID_TEMPLATE,
    coarse=COARSE_GRID_TEMPLATE,
    template_rate=6.0,
)

# Not contracted, with few features per cell. Held-out PSNR and that of moving regions,
# built-in scene `default` after 90 seconds (750 steps) on one core from tracks: 96
# cells of four features 23.20 / 19.21 dB contracted, 24.45 / 20.64 not contracted. Two
# features 25.93 / 22.03 (128 cells: 25.54 / 21.89). All strides are open from the first
# step.
SMALL_TINEUVOX = dataclasses.replace(
    SMALL_NERF_GRID,
    template=dataclasses.replace(
        GRID_TEMPLATE, position=VoxelGridSpec(cells=96, features=2, bands=1)
    ),
    warp=TimeWarpSpec(
        position=EncodingSpec(4), time=EncodingSpec(4), embedding=8, width=64
    ),
    smoothness=SmoothnessSpec(weight=1.0, until=1500),
    # Only tables have a large rate, as published (8e-2 compared with 6e-4). With the
    # same rate for networks, a dark video of a hand in front of books became an opaque
    # black wall in front of the cameras within ten steps, and did not recover.
    template_rate=1.0,
    table_rate=6.0,
)


def _on_grid(preset: RadianceScene) -> RadianceScene:
    """Return a small preset with a grid template and motion initialized from tracks."""
    names = ("rays", "micro_batches", "template", "coarse", "template_rate")
    grid = {name: getattr(SMALL_NERF_GRID, name) for name in names}
    # A grid fits the static scene within seconds, and a warp without motion by then
    # stays static. The presets with MLPs keep the schedules of the papers.
    moves = preset.warp is not None or preset.scene_flow is not None
    start = dataclasses.replace(preset.start, motion="tracks" if moves else "none")
    return dataclasses.replace(preset, start=start, **grid)


# The dynamic medium on planes of space and time as in HexPlane. It is evaluated three
# times per sample. Built-in scene `default` after 90 seconds on one core (steps,
# held-out PSNR, PSNR of moving regions, and gain of the motion there):
#   waves, 4 of 96 wide, 1024 rays           54    18.8  15.1
#   and 256 rays                            220    21.29 16.60   0.0 dB
#   waves, 3 of 64 wide                     410    21.97 16.82   0.0
#   a hash grid of space and the time       820    22.16 16.96   0.1
#   planes, exponential, template's rate    690    23.57 18.26   1.2
PLANES_MEDIUM = dataclasses.replace(
    GRID_TEMPLATE,
    position=PlanesSpec(vertices=64, multiples=(1, 2), timestamps=30, features=8),
    width=48,
)

# Without motion. The field starts nearly empty, and unused space stays empty. (With a
# warp the bias has no benefit within a minute.) The number of samples in occupied space
# matters most: the first samples are in occupied cells, and the fine level also
# evaluates them. PSNR of 25 held-out frames of Blender lego and 15 of the built-in
# scene `static`, with seconds on a busy core:
#   24 + 24 of 1024 rays, along the whole ray    24.33 dB in 56 s    29.51 dB in 60 s
#   and fine level with both (32 + 24)           25.67       103
#   in occupied cells, each level its own        24.61        59
#   in occupied cells, fine level with both      26.29        97
#   and 512 rays, twice the steps                26.52        89     30.56       76
#   48 in occupied cells, no coarse level        26.62        99     29.34       61
# The last number of the other scene has 512 rays. Networks of width 64 gain nothing
# (24.33 in 90 s). A finer grid of 512 cells gains 0.3 dB on lego and loses 2 on the
# other.
EMPTIER = -3.0  # added to the density
STILL_NERF_GRID = dataclasses.replace(
    SMALL_NERF_GRID,
    steps=8000,
    rays=512,
    # Occupancy selects rays that meet occupied cells. Blender lego, eight held-out
    # frames, seconds on a busy core, without and with it: 24.68 dB in 66 s and 25.26 in
    # 73 after 1200 steps, 25.38 in 137 and 25.91 in 136 after 2400 (1024 rays, samples
    # along the whole ray).
    sampling=SamplingSpec(24, 24, occupancy=OccupancySpec()),
    template=dataclasses.replace(GRID_TEMPLATE, density_bias=EMPTIER),
    coarse=dataclasses.replace(COARSE_GRID_TEMPLATE, density_bias=EMPTIER),
)

# For photo collections. Codes need a much larger rate than in a video: the grid learns
# within 100 steps, and what codes do not explain by then it explains by fog in front of
# each camera, which stays. Built-in scene `collection`, one seed, PSNR with codes
# fitted to the left half of a held-out photograph and evaluated on the right half, and
# median error of the depth:
#   codes at the common rate, transients from the start   600 steps    20.8 dB    56 %
#   rate of codes x 10, no transients                    1600          26.5        9
#   x 30                                                 1600          27.3        8
#   x 30                                                 3200          26.8        8
#   x 30, transients late and thin, also at infinity     2400          27.6        5
#   ending at the far plane, price 0.1                   2400          27.8        4
#   price 0.01, as in the paper                          2400          27.9        3
#   price 0.01                                           1600          27.6        5
#   and a distortion loss of weight 0.03                 1600          27.7        3
#   of weight 0.1                                        1600          27.7        1.7
#   and price 0.03                                       1600          27.7        1.7
#   of weight 1                                          1600          19.5       73
# All but the first have the box and the samples around the subject. The medium explains
# 20 % of the images if it reaches infinity, and in the last six rows 2.5, 2.5, 3.4,
# 6.2, 3.9 and 4.1 %. Boards cover about 3 %.
SMALL_NERF_W_GRID = _on_grid(
    dataclasses.replace(
        SMALL_NERF_W,
        volume="subject",
        sampling=SamplingSpec(16, 16, spacing="center"),
        code_rate=30.0,
        transient=TransientSpec(
            code_width=8,
            depth=2,
            width=48,
            density_weight=0.03,
            beta_power=1.0,
            density_bias=-3.0,
            hold_steps=750,
        ),
        distortion=DistortionSpec(0.1),
    )
)

PRESETS = {
    "nerf": NERF,
    "nerf-w": NERF_W,
    "d-nerf": D_NERF,
    "t-nerf": T_NERF,
    "nerfies": NERFIES,
    "hypernerf": HYPERNERF,
    "nsff": NSFF,
    "tineuvox": TINEUVOX,
    "nerf-ds": NERF_DS,
    "nerf-small": SMALL_NERF,
    "nerf-w-small": SMALL_NERF_W,
    "d-nerf-small": SMALL_D_NERF,
    "t-nerf-small": SMALL_T_NERF,
    "nerfies-small": SMALL_NERFIES,
    "hypernerf-small": SMALL_HYPERNERF,
    "nsff-small": SMALL_NSFF,
    "tineuvox-small": SMALL_TINEUVOX,
    "nerf-ds-small": SMALL_NERF_DS,
    "nerf-grid-small": STILL_NERF_GRID,
    "nerf-w-grid-small": SMALL_NERF_W_GRID,
    "d-nerf-grid-small": _on_grid(SMALL_D_NERF),
    "nerfies-grid-small": _on_grid(SMALL_NERFIES),
    "hypernerf-grid-small": _on_grid(SMALL_HYPERNERF),
    "nsff-grid-small": dataclasses.replace(
        _on_grid(SMALL_NSFF),
        rays=256,
        scene_flow=dataclasses.replace(
            SMALL_SCENE_FLOW, network=PLANES_MEDIUM, flow_trunk=True
        ),
    ),
}


def with_steps(spec: RadianceScene, steps: int) -> RadianceScene:
    """Change the number of steps of a radiance field.

    Args:
      spec: The scene.
      steps: Number of steps.

    Returns:
      The scene with its schedules scaled in proportion.

    Raises:
      ValueError: If `steps` is below 1.
    """
    if steps < 1:
        raise ValueError(f"steps={steps}: train for at least one step")
    in_proportion = step_counts.scale_steps(spec, steps / spec.steps)
    return dataclasses.replace(in_proportion, steps=steps)
