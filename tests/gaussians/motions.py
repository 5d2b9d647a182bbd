"""The three networks that move Gaussians, small, under one face for the tests."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from gaussians_jax.core import splats
from gaussians_jax.core.splats import Params
from gaussians_jax.motion import basis as motion_basis
from gaussians_jax.motion import kan as kan_motion
from gaussians_jax.motion import mlp as mlp_motion
from gaussians_jax.motion.basis import BasisMotionSpec
from gaussians_jax.motion.kan import KanMotionSpec
from gaussians_jax.motion.mlp import MotionSpec, SmoothingSpec
from nerfies_jax.nn.encoding import EncodingSpec
from tests import scenes
from tests.gaussians.shared import jitted, put, rows_of, some_gaussians

FRAMES = 9
MLP = MotionSpec(
    position=EncodingSpec(3),
    time=EncodingSpec(2),
    depth=3,
    width=16,
    skips=(2,),
    block=8,
    smoothing=SmoothingSpec(0.5, 50),
)
KAN = KanMotionSpec(embedding=6, time_code=4, hidden=(5,), kernels=3, block=8)
BASIS = BasisMotionSpec(
    position=EncodingSpec(3),
    base_time=EncodingSpec(1),
    time=EncodingSpec(2),
    base_depth=2,
    base_width=8,
    count=4,
    basis_width=8,
    depth=3,
    width=16,
    skips=(2,),
    block=8,
    smoothing=SmoothingSpec(0.5, 50),
)


class Motion(NamedTuple):
    """One of the networks."""

    module: Any
    spec: Any
    init: Callable  # spec -> parameters
    deform: Callable  # parameters, spec, what it reads, time, active -> offsets
    apply: Callable  # Gaussians, offsets -> Gaussians


def _prepared(module):
    def together(params, spec, reads, time, active=None):
        """As in a training step: prepared and used in one program."""
        ready = module.prepare(params, spec, reads, active)
        rows = () if module is kan_motion else (reads,)
        return module.deform(params, spec, *rows, time, ready, active)

    return together


MOTIONS = {
    "mlp": Motion(
        mlp_motion,
        MLP,
        lambda spec: mlp_motion.init(jax.random.key(0), spec),
        mlp_motion.deform,
        functools.partial(mlp_motion.apply, scale_rule="log"),
    ),
    "kan": Motion(
        kan_motion,
        KAN,
        lambda spec: kan_motion.init(jax.random.key(0), spec, FRAMES),
        _prepared(kan_motion),
        kan_motion.apply,
    ),
    "basis": Motion(
        motion_basis,
        BASIS,
        lambda spec: motion_basis.init(jax.random.key(0), spec),
        _prepared(motion_basis),
        motion_basis.apply,
    ),
}
deformed = {
    name: jitted(motion.deform, static_argnums=1) for name, motion in MOTIONS.items()
}


def strong(name, spec=None, dtype="float64"):
    """Parameters that move things by about their own size; every bias is drawn too."""
    motion = MOTIONS[name]
    shapes = jax.eval_shape(lambda: motion.init(spec or motion.spec))
    rng = np.random.default_rng(0)
    size = 0.5 if name == "kan" else 0.3
    return put(
        jax.tree.map(lambda leaf: size * rng.normal(size=leaf.shape), shapes), dtype
    )


def read_by(name, count, dtype="float64"):
    """What the network reads of each Gaussian: its place, or a code of its own."""
    if name == "kan":
        embedding = np.random.default_rng(1).normal(size=(count, KAN.embedding))
        return put(embedding, dtype)
    return some_gaussians(count, dtype).mean


def scene_of(name, spec=None, dtype="float64", count=9):
    """A scene whose Gaussians this network moves."""
    rows = {"splats": rows_of(some_gaussians(count, dtype))}
    if name == "kan":
        rows[kan_motion.NAME] = read_by(name, count, dtype)
    return Params(rows, {MOTIONS[name].module.NAME: strong(name, spec, dtype)})


def moving_scene(noise=0.1):
    """Parameters of `scenes.TINY_DEFORMABLE`: its capture's points, which all move."""
    cloud, rng = scenes.tiny_capture().points, np.random.default_rng(0)
    rows = splats.from_points(cloud.position, cloud.color / 255, degree=1)
    init = jitted(mlp_motion.init, static_argnums=1)
    nets = init(jax.random.key(0), scenes.TINY_MOTION)
    nets = jax.tree.map(lambda leaf: leaf + noise * rng.normal(size=leaf.shape), nets)
    params = put(Params({"splats": rows}, {mlp_motion.NAME: nets}), "float32")
    return jax.jit(splats.pad_rows, static_argnums=1)(params, 256)
