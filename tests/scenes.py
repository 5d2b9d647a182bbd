"""Small scenes and specs that several tests share, made once per process."""

import dataclasses
import functools

import jax

from gaussians_jax.losses.acceleration import AccelerationSpec
from gaussians_jax.losses.depth import DepthSpec
from gaussians_jax.losses.neighbors import NeighborSpec
from gaussians_jax.losses.spectral import SpectralSpec
from gaussians_jax.motion.basis import BasisMotionSpec
from gaussians_jax.motion.growth import MotionGrowthSpec
from gaussians_jax.motion.kan import KanMotionSpec
from gaussians_jax.motion.mlp import MotionSpec, SmoothingSpec
from gaussians_jax.optim.densification import DefaultStrategySpec
from gaussians_jax.optim.phases import AlternationSpec, AnnealingSpec
from gaussians_jax.scene.spec import SplatScene
from nerfies_jax import evaluation
from nerfies_jax.capture import synthetic
from nerfies_jax.evaluation import protocol
from nerfies_jax.fields.effects.appearance import AppearanceSpec
from nerfies_jax.fields.effects.warp import WarpSpec
from nerfies_jax.fields.spec import RadianceScene, SamplingSpec
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.scene import scene as nerf_scene

TINY_SCENE = dataclasses.replace(
    synthetic.DEFAULT, size=(40, 30), frames=6, supersampling=1, points=200, tracks=8
)
TINY_MOTION = MotionSpec(
    position=EncodingSpec(2),
    time=EncodingSpec(2),
    depth=2,
    width=8,
    skips=(),
    warm_up=3,
    smoothing=SmoothingSpec(steps=10),
)
TINY_SPLATS = SplatScene(
    steps=30,
    sh_degree=1,
    sh_every=10,
    strategy=DefaultStrategySpec(
        refine_every=10,
        refine_start_iter=10,
        refine_stop_iter=25,
        cap_max=600,
        reset_every=20,
    ),
)
TINY_DEFORMABLE = dataclasses.replace(TINY_SPLATS, motion=TINY_MOTION)
TINY_SONATA = dataclasses.replace(
    TINY_SPLATS,
    optimizer="radam",
    motion=KanMotionSpec(
        embedding=4, time_code=3, hidden=(6,), kernels=3, warm_up=3, learning_rate=1e-2
    ),
    neighbors=NeighborSpec(count=4, start=3),
    spectral=SpectralSpec(),
    depth=DepthSpec(),
)
TINY_MOBA = dataclasses.replace(
    TINY_SPLATS,
    motion=BasisMotionSpec(
        position=EncodingSpec(2),
        base_time=EncodingSpec(1),
        time=EncodingSpec(2),
        base_depth=1,
        base_width=8,
        count=4,
        basis_width=8,
        depth=2,
        width=8,
        skips=(),
        warm_up=3,
    ),
    alternation=AlternationSpec(12, 18),
    annealing=AnnealingSpec(18),
    motion_growth=MotionGrowthSpec(start=5),
    acceleration=AccelerationSpec(start=3, samples=64),
)
TINY_FIELD = RadianceScene(
    steps=10,
    template=TemplateSpec(
        EncodingSpec(2), EncodingSpec(1), depth=1, width=8, skips=(), color_width=8
    ),
    sampling=SamplingSpec(4, 0),
    appearance=AppearanceSpec(width=3),
    warp=WarpSpec(position=EncodingSpec(2), depth=1, width=8, skips=()),
)


@functools.cache
def tiny_scene():
    """`tiny_capture`, and what only the scene knows."""
    return synthetic.make(TINY_SCENE)


def tiny_capture():
    """Six frames of 40x30 of the default scene, two of them held out."""
    return tiny_scene()[0]


@functools.cache
def tiny_field():
    """Metadata of `TINY_FIELD`, parameters whose warp and codes show, and a view."""
    capture = tiny_capture()
    metadata = nerf_scene.metadata_of(capture, TINY_FIELD)
    field = nerf_scene.field(TINY_FIELD, metadata)

    @jax.jit  # or each array is a program
    def start(key):
        params = field.init(key)
        params["warp"] = jax.tree.map(lambda leaf: leaf + 0.1, params["warp"])
        params["codes"] = jax.tree.map(lambda leaf: 40 * leaf, params["codes"])
        return params

    params = start(jax.random.key(3))
    return metadata, params, evaluation.view_of(capture, int(capture.heldout[0]))


@functools.cache
def tiny_tracks():
    """A capture of which half is held out, its truth and five tracks through it."""
    spec = dataclasses.replace(TINY_SCENE, heldout_every=2)
    capture, truth = synthetic.make(spec)
    return capture, truth, protocol.ground_truth(capture, truth, 2, 5)
