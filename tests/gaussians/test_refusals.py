"""Settings that cannot work are refused where they are made, with their bound."""

import dataclasses
import math

import jax
import numpy as np
import pytest

from gaussians_jax.core import splats, static_rows, time_knots
from gaussians_jax.core.splats import Params
from gaussians_jax.init import points as initialization
from gaussians_jax.init.points import InitSpec, StartSpec
from gaussians_jax.losses import acceleration, spectral
from gaussians_jax.losses.acceleration import AccelerationSpec
from gaussians_jax.losses.depth import DepthSpec
from gaussians_jax.losses.flow import FlowSpec
from gaussians_jax.losses.neighbors import NeighborSpec
from gaussians_jax.losses.spectral import FourierSpec, SpectralSpec, WaveletSpec
from gaussians_jax.motion import growth as motion_growth
from gaussians_jax.motion import kan as kan_motion
from gaussians_jax.motion.anchors import AnchorMotionSpec, RateSpec
from gaussians_jax.motion.basis import BasisMotionSpec
from gaussians_jax.motion.carried import CarriedSpec
from gaussians_jax.motion.embedding import EmbeddingMotionSpec
from gaussians_jax.motion.growth import MotionGrowthSpec
from gaussians_jax.motion.kan import KanMotionSpec
from gaussians_jax.motion.mlp import MotionSpec, SmoothingSpec
from gaussians_jax.motion.polynomial import PolynomialMotionSpec
from gaussians_jax.motion.splines import SplineMotionSpec
from gaussians_jax.motion.temporal_opacity import TemporalOpacitySpec
from gaussians_jax.optim import optimizer, phases
from gaussians_jax.optim.densification import DefaultStrategySpec
from gaussians_jax.optim.learning_rates import LearningRateSpec
from gaussians_jax.optim.mcmc import MCMCStrategySpec
from gaussians_jax.optim.phases import AlternationSpec, AnnealingSpec
from gaussians_jax.scene import spec
from gaussians_jax.scene.spec import SplatScene
from gaussians_jax.splatting import harmonics, raster, rendering
from gaussians_jax.splatting.projection import Footprints
from gaussians_jax.splatting.raster_spec import GSPLAT, RasterSpec
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.training import schedules
from tests import scenes
from tests.gaussians.shared import put, rows_of, some_gaussians

# What is made, the setting that cannot work, and words of the message.
SETTINGS = [
    (AccelerationSpec, dict(weight=-1.0), "weight=-1.0 must be finite and not neg"),
    (AccelerationSpec, dict(drift=math.nan), "drift=nan"),
    (AccelerationSpec, dict(decay=0.0), "decay=0.0 must be finite and positive"),
    (AccelerationSpec, dict(interval=math.inf), "interval=inf"),
    (AccelerationSpec, dict(samples=0), "samples=0"),
    (AccelerationSpec, dict(start=-1), "start at least 0"),
    (AlternationSpec, dict(start=10, stop=9), "0 <= start <= stop, got start=10 and"),
    (AlternationSpec, dict(start=-1, stop=10), "start=-1"),
    (AlternationSpec, dict(start=1, stop=10, nets=0), "at least one step, got nets=0"),
    (AlternationSpec, dict(start=1, stop=10, rows=0), "rows=0"),
    (AnnealingSpec, dict(after=-1), "after=-1"),
    (AnnealingSpec, dict(after=1, decay=-1.0), "decay=-1.0"),
    (AnnealingSpec, dict(after=1, decay=math.nan), "decay=nan"),
    (AnnealingSpec, dict(after=1, freeze_share=1.0), r"lie in \[0, 1\)"),
    (BasisMotionSpec, dict(count=0), "at least one direction"),
    (BasisMotionSpec, dict(basis_form="square"), "unknown basis_form 'square'"),
    (BasisMotionSpec, dict(base_depth=0), "hidden layer each"),
    (BasisMotionSpec, dict(depth=0, skips=()), "hidden layer each"),
    (BasisMotionSpec, dict(block=0), "block=0"),
    (BasisMotionSpec, dict(warm_up=-1), "warm_up=-1"),
    (BasisMotionSpec, dict(learning_rate=1e-8), "both must be positive"),
    (BasisMotionSpec, dict(activation="cubic"), "unknown activation 'cubic'"),
    (BasisMotionSpec, dict(skips=(9,)), "layer 9 is not in"),
    (DefaultStrategySpec, dict(prune_opa=0.02), "0 < prune < reset < 1"),
    (DefaultStrategySpec, dict(refine_every=0), "refine_every must be at least 1"),
    (DefaultStrategySpec, dict(shrink=1.0), "shrink must be larger than 1"),
    (DepthSpec, dict(kind="ordinal"), "kind must be one of"),
    (DepthSpec, dict(space="log"), "space one of"),
    (DepthSpec, dict(weight=-1.0), "not negative"),
    (DepthSpec, dict(opaque=0.0), "0 < opaque < 1"),
    (FourierSpec, dict(dc_weight=-1.0), "dc_weight=-1.0"),
    (FourierSpec, dict(most=math.nan), "most=nan"),
    (InitSpec, dict(points=0), "at least one initial Gaussian"),
    (InitSpec, dict(opacity=2.0), "opacity=2.0"),
    (InitSpec, dict(scale=-1.0), "scale=-1.0"),
    (InitSpec, dict(max_scale=math.nan), "max_scale=nan"),
    (InitSpec, dict(source="sfm"), "unknown source 'sfm'; choose from"),
    (KanMotionSpec, dict(embedding=0), "embedding=0"),
    (FlowSpec, dict(weight=-1.0), "weight=-1.0"),
    (FlowSpec, dict(start=-1), "start=-1"),
    (FlowSpec, dict(opaque=1.0), "opaque=1.0"),
    (EmbeddingMotionSpec, dict(embedding=0), "embedding=0"),
    (KanMotionSpec, dict(coarser=0), "coarser=0"),
    (KanMotionSpec, dict(opacity=-1.0), "opacity=-1"),
    (EmbeddingMotionSpec, dict(coarser=0), "coarser=0"),
    (EmbeddingMotionSpec, dict(opacity=-1.0), "opacity=-1.0"),
    (EmbeddingMotionSpec, dict(grow_until=-1), "grow_until=-1"),
    (KanMotionSpec, dict(time_code=0), "time_code=0"),
    (KanMotionSpec, dict(hidden=()), r"hidden=\(\)"),
    (KanMotionSpec, dict(block=0), "block=0"),
    (KanMotionSpec, dict(warm_up=-1), "warm_up=-1"),
    (KanMotionSpec, dict(network="cnn"), "unknown network 'cnn'"),
    (KanMotionSpec, dict(mlp_width=8), "network='mlp' only"),
    (KanMotionSpec, dict(position=False, scale=False, rotation=False), "all off"),
    (KanMotionSpec, dict(spread=0.0), "equal codes stay equal"),
    (KanMotionSpec, dict(learning_rate=1e-5, learning_rate_end=1e-4), "the rate falls"),
    (KanMotionSpec, dict(embedding_rate=0.0), "embedding_rate=0.0"),
    (KanMotionSpec, dict(kernels=1), "two centers"),
    (LearningRateSpec, dict(mean_end=0.0), "mean_end"),
    (MCMCStrategySpec, dict(growth=0.9), "growth=0.9"),
    (MCMCStrategySpec, dict(min_opacity=0.0), "min_opacity=0.0"),
    (MCMCStrategySpec, dict(refine_every=0), "refine_every=0"),
    (MCMCStrategySpec, dict(noise_lr=-1.0), "noise_lr=-1.0"),
    (MotionGrowthSpec, dict(form="firm"), "unknown form 'firm'; choose from"),
    (MotionGrowthSpec, dict(start=-1), "start=-1"),
    (MotionGrowthSpec, dict(motion=0.0), "disable this component"),
    (MotionGrowthSpec, dict(motion=math.inf), "motion=inf"),
    (MotionGrowthSpec, dict(beta=1.0), 'use form="hard"'),
    (MotionGrowthSpec, dict(beta=math.inf), "beta=inf"),
    (MotionSpec, dict(scale_rule="cubic"), "unknown scale_rule 'cubic'"),
    (MotionSpec, dict(block=0), "block=0"),
    (MotionSpec, dict(learning_rate_end=0.0), "both must be positive"),
    (NeighborSpec, dict(count=0), "count=0"),
    (NeighborSpec, dict(start=-1), "start at least 0"),
    (NeighborSpec, dict(gamma=-1.0), "not negative"),
    (NeighborSpec, dict(weight=math.nan), "not negative"),
    (NeighborSpec, dict(scale="meters"), "unknown scale 'meters'"),
    (RasterSpec, dict(alpha_max=1.0), "alpha_threshold < alpha_max < 1"),
    (RasterSpec, dict(near=0.0), "0 < near < far"),
    (RasterSpec, dict(tile=12), "tile must be one of"),
    (RasterSpec, dict(capacity=0), "capacity must be at least 1"),
    (RasterSpec, dict(eps2d=0.0), "eps2d must be positive"),
    (RasterSpec, dict(eps2d=math.nan), "eps2d must be positive"),
    (RasterSpec, dict(tangent_margin=math.nan), "tangent_margin must be"),
    (RasterSpec, dict(transmittance_threshold=1.0), "0 <= transmittance_threshold < 1"),
    (SmoothingSpec, dict(steps=0), "steps >= 1"),
    (SpectralSpec, dict(wavelet=None, fourier=None), "both None"),
    (SpectralSpec, dict(gate="open"), "unknown gate 'open'"),
    (SpectralSpec, dict(opening=1.0), "opening=1.0"),
    (SpectralSpec, dict(gate="floor", floor=0.5), "floor=0.5"),
    (SpectralSpec, dict(learning_rate=0.0), "learning_rate=0.0"),
    (SpectralSpec, dict(after=-1), "after=-1"),
    (SplatScene, dict(steps=0), "steps=0 must be at least 1"),
    (SplatScene, dict(steps=10, sh_degree=4), "0, 1, 2 or 3"),
    (SplatScene, dict(steps=10, sh_every=0), "sh_every=0"),
    (SplatScene, dict(steps=10, dssim_weight=1.5), r"\[0, 1\]"),
    (WaveletSpec, dict(levels=0), "levels=0"),
    (WaveletSpec, dict(most=0.0), "most=0.0"),
    (WaveletSpec, dict(level_factor=-1.0), "level_factor=-1.0"),
    (optimizer.scale_by_row_radam, dict(b2=0.6), "follows from b2=0.6"),
    (optimizer.scale_by_row_radam, dict(threshold=3.0),
     r"threshold=3.0 must lie in \[4, 1999\)"),
    (optimizer.scale_by_row_radam, dict(b1=1.0), "strictly between 0 and 1"),
    (optimizer.scale_by_row_radam, dict(b2=1.0), "strictly between 0 and 1"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "setting", "words"), SETTINGS)
def test_settings_that_cannot_work_are_refused(make, setting, words):
    with pytest.raises(ValueError, match=words):
        make(**setting)


def test_settings_that_can_work_are_taken():
    assert SpectralSpec(opening=0.03).floor == 0.05  # which no learned gate reads
    hard = MotionGrowthSpec(form="hard", start=3)
    moba(motion_growth=hard, start=StartSpec("tracks"))  # moves from the first step


def some_rows(count=7):
    return Params({"splats": rows_of(some_gaussians(count, "float32"))}, {})


def footprints(size):
    """Nothing to draw on an image of this size, by one device or by several."""
    two = Footprints(*(np.zeros((2, *shape)) for shape in [(2,), (3,), (), (), (2,)]))
    return put(two, "float32"), put(np.ones((2, 3)), "float32"), size, GSPLAT


def capture_with(points):
    """The small capture with some of its own points, or with none."""
    capture = scenes.tiny_capture()
    cloud = capture.points
    subset = None if points is None else type(cloud)(*(leaf[:points] for leaf in cloud))
    return dataclasses.replace(capture, points=subset)


def knots(count, interpolation="linear", fade=0.0):
    """A table of seven Gaussians that grow, and are seen less and less."""
    first = some_gaussians(7, "float32")

    def grown(time):
        return first._replace(
            mean=first.mean * (1 + time), opacity=first.opacity * (1 - fade * time)
        )

    return time_knots.at(time_knots.bake(grown, count), put(0.5), interpolation)


def still(params, time):
    return splats.activate(params.rows["splats"])


def through_a_lens():
    camera = cameras.take(scenes.tiny_capture().cameras, 0)
    camera = camera._replace(radial=np.float32([0.1, 0, 0]))
    gaussians = some_gaussians(3, "float32")
    return rendering.render(gaussians, put(np.ones((3, 3))), camera, (8, 6))


def moba(**changes):
    spec.refuse_what_cannot_train(dataclasses.replace(scenes.TINY_MOBA, **changes))


def late(**changes):
    still = dataclasses.replace(scenes.TINY_SPLATS, steps=500, **changes)
    spec.refuse_what_cannot_train(still)


BROKEN = np.where(np.arange(18).reshape(6, 3) == 13, np.nan, 1.0)
FROM_POINTS = InitSpec(source="points")
CALLS = [
    (lambda: acceleration.Bound(AccelerationSpec(), 1.0, 1), "at least two frames"),
    (lambda: harmonics.degree_of(5), "1, 4, 9 or 16 coefficients, got 5"),
    (lambda: initialization.uses_capture_points(FROM_POINTS, capture_with(None)),
     'it has none; choose source="random"'),
    (lambda: initialization.initial_count(FROM_POINTS, capture_with(0)),
     'it has none; choose source="random"'),
    (lambda: kan_motion.init(jax.random.key(0), KanMotionSpec(), 0), "frames=0"),
    (
        lambda: motion_growth.MotionGuided(
            DefaultStrategySpec(), MotionGrowthSpec(), 0.0
        ),
        "extent=0.0",
    ),
    (lambda: moba(motion=None), "without a motion"),
    (lambda: moba(motion=scenes.TINY_MOTION, neighbors=NeighborSpec()),
     "neighbors=none"),
    (lambda: spec.effects_of(
        dataclasses.replace(scenes.TINY_DEFORMABLE, neighbors=NeighborSpec()),
        spec.SceneMetadata(1.0, (0.0, 0.0, 0.0), 3)),
     "neighbors=none"),
    (lambda: moba(motion=PolynomialMotionSpec(), alternation=None,
                  carried=CarriedSpec()),
     "motion.fading=none"),
    (lambda: moba(strategy=None), "motion_growth=none"),
    (lambda: moba(strategy=MCMCStrategySpec()), "threshold of Default"),
    (lambda: moba(flow=FlowSpec(), carried=CarriedSpec()), "flow=none"),
    (lambda: moba(motion=AnchorMotionSpec(moves=False), start=StartSpec("tracks")),
     "motion.moves=false"),
    (lambda: moba(temporal_opacity=TemporalOpacitySpec(), carried=CarriedSpec()),
     "temporal_opacity=none"),
    (lambda: moba(motion_growth=MotionGrowthSpec(form="hard", start=3)),
     "nothing would"),
    (lambda: moba(motion=None, motion_growth=None, acceleration=None),
     "alternation without"),
    (lambda: moba(motion=SplineMotionSpec()), "alternation=none"),
    (lambda: moba(annealing=AnnealingSpec(10**6)), "comes too late"),
    (lambda: moba(acceleration=AccelerationSpec(start=10**6)), "never begin"),
    (lambda: late(motion=MotionSpec(warm_up=500)), "motion.warm_up=500 of 500"),
    (lambda: late(motion=MotionSpec(depth=4, warm_up=0)), "skips="),
    (lambda: late(motion=AnchorMotionSpec(warm_up=0, rate=RateSpec(start=500))),
     "motion.rate.start=500"),
    (lambda: moba(motion=PolynomialMotionSpec()), "alternation=none"),
    (lambda: phases.annealed(schedules.log_linear(1e-2, 1e-4, 1000),
                             AnnealingSpec(951), 1000), "3/4 of the run"),
    (lambda: moba(motion=PolynomialMotionSpec(warm_up=5), alternation=None),
     "motion.warm_up=5 with motion.fading"),
    (lambda: raster.rasterize(*footprints((5, 0))), "at least one pixel"),
    (lambda: through_a_lens(), "lens distortion, radial=.*, which these"),
    (lambda: spectral.Bound(SpectralSpec(after=10), 10), "after=10"),
    (lambda: splats.pad_rows(some_rows(), 6),
     "7 Gaussians cannot be padded to a capacity of 6"),
    (lambda: splats.capacity_for(3101, most=3100),
     "3101 Gaussians do not fit under the cap"),
    (lambda: splats.from_points(BROKEN, 0 * BROKEN), "point 4 is not finite"),
    (lambda: splats.from_points(BROKEN[:0], BROKEN[:0]), "points is empty"),
    (lambda: splats.from_points(np.ones((4, 3)), np.ones((4, 4))), r"\[n, 3\]"),
    (lambda: static_rows.split(some_rows(), still, np.linspace(0, 1, 3), -1e-3),
     "static_threshold=-0.001 .*scene units"),
    (lambda: static_rows.split(some_rows(), still, np.linspace(0, 1, 3), math.nan),
     "static_threshold=nan .*scene units"),
    (lambda: static_rows.split(some_rows(), still, np.zeros(0), 0.1),
     "times is empty"),
    (lambda: knots(1), "at least 2"),
    (lambda: knots(3, "cubic"), "reads 4 knots at once, got 3"),
    (lambda: knots(8, "quintic"), "choose from linear, cubic"),
    (lambda: knots(5, fade=0.5), r"opacities at time 0 .* at 0\.5"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "words"), CALLS)
def test_what_cannot_be_done_is_refused(call, words):
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize(("near", "far"), [(0.0, 1.0), (2.0, 1.0), (1.0, math.inf)])
def test_impossible_depth_ranges_are_refused(near, far, rng):
    cameras = scenes.tiny_capture().cameras
    with pytest.raises(ValueError, match="0 < near < far"):
        splats.random_in_views(rng, cameras, (4, 4), near, far, 10)
