"""Small scenes and specs that several tests share, made once per process."""

import dataclasses
import functools

from gaussians_jax.density import DensitySpec
from gaussians_jax.effects.mlp_motion import MotionSpec, SmoothingSpec
from gaussians_jax.spec import SplatScene
from nerfies_jax.capture import synthetic
from nerfies_jax.nets.encoding import EncodingSpec

TINY_FILM = dataclasses.replace(
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
    density=DensitySpec(interval=10, start=10, stop=25, most=600, reset_interval=20),
)
TINY_DEFORMABLE = dataclasses.replace(TINY_SPLATS, motion=TINY_MOTION)


@functools.cache
def tiny_capture():
    """Six frames of 40x30 of the default scene, two of them held out."""
    return synthetic.make(TINY_FILM)[0]
