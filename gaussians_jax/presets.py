"""Named scenes: a paper's numbers, and variants that train on a CPU in minutes."""

import dataclasses

from gaussians_jax.density import DensitySpec
from gaussians_jax.effects.mlp_motion import MotionSpec
from gaussians_jax.rates import RateSpec
from gaussians_jax.scene import SplatScene
from gaussians_jax.start import StartSpec
from nerfies_jax.nets.encoding import EncodingSpec

# Kerbl et al. 2023, arXiv:2308.04079: every other number is a default of its spec.
STATIC = SplatScene(steps=30_000)

# Yang et al. 2023, arXiv:2309.13101, for real captures: the network, the warm-up and
# the smoothing are defaults of `MotionSpec`.
DEFORMABLE = SplatScene(steps=40_000, motion=MotionSpec())

# For a CPU: the same parts with fewer Gaussians, a smaller network, a shorter run.
# Measured on the built-in scene at 2000 steps (held-out PSNR and SSIM, one seed):
#   motion from 10 % of the run on, network rate 2e-3   18.20 / 0.466, worse than static
#   motion from 35 % on, rate 8e-4                      20.36 / 0.740
#   and random points beside the static ones            21.61 / 0.802
#   and 96 wide, 6 bands of time, no smoothing          21.89 / 0.807
# A field that may move everything before the static part stands bends the background to
# follow the camera; without points of its own, what moves is painted onto the walls.
SMALL_STATIC = SplatScene(
    steps=3000,
    start=StartSpec(points=4000, random=5000, beside=2000),
    sh_degree=1,
    sh_every=1000,
    density=DensitySpec(
        interval=200, start=300, stop=2000, reset_interval=100_000, most=10_000
    ),
    rates=RateSpec(mean_end=3.2e-6),
)
SMALL_DEFORMABLE = dataclasses.replace(
    SMALL_STATIC,
    motion=MotionSpec(
        position=EncodingSpec(5),
        time=EncodingSpec(6),
        depth=4,
        width=96,
        skips=(2,),
        warm_up=600,
        smoothing=None,
        rate=5e-4,
        rate_end=5e-6,
    ),
)

PRESETS = {
    "splats-static": STATIC,
    "splats-deformable": DEFORMABLE,
    "splats-static-small": SMALL_STATIC,
    "splats-deformable-small": SMALL_DEFORMABLE,
}


def with_steps(spec: SplatScene, steps: int) -> SplatScene:
    """The same scene over another number of steps, its schedules in proportion."""
    if steps < 1:
        raise ValueError(f"steps={steps}: train for at least one step")
    share = steps / spec.steps

    def scaled(count):
        return max(1, round(count * share))

    density, motion = spec.density, spec.motion
    if density is not None:
        density = dataclasses.replace(
            density,
            start=scaled(density.start),
            stop=scaled(density.stop),
            reset_interval=scaled(density.reset_interval),
        )
    if motion is not None:
        smoothing = motion.smoothing
        if smoothing is not None:
            smoothing = dataclasses.replace(smoothing, steps=scaled(smoothing.steps))
        motion = dataclasses.replace(
            motion, warm_up=scaled(motion.warm_up), smoothing=smoothing
        )
    return dataclasses.replace(
        spec,
        steps=steps,
        sh_every=scaled(spec.sh_every),
        density=density,
        motion=motion,
    )
