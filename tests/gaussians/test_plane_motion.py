"""Motion read from planes: against SciPy's interpolation and a network by hand."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Params
from gaussians_jax.init import points as initialization
from gaussians_jax.motion import planes as plane_motion
from gaussians_jax.motion.planes import PlaneMotionSpec
from nerfies_jax.nn.planes import PlanesSpec
from nerfies_jax.training.effects import FrameCondition, PenaltyContext
from tests import scenes
from tests.gaussians import bound
from tests.gaussians.shared import put, rows_of, some_gaussians
from tests.gradients import directional_error
from tests.nn.test_planes import expected

ROWS, EXTENT, NAME = 7, 2.0, plane_motion.NAME
BOX = ((-1.0, -2.0, -0.5), (1.5, 1.0, 2.0))
MOTION = PlaneMotionSpec(
    planes=PlanesSpec(vertices=3, multiples=(1, 2), timestamps=4, features=2),
    width=4,
)


@functools.cache
def effect():
    return bound.record(MOTION, extent=EXTENT, box=BOX)


def penalty(motion, step):
    context = PenaltyContext(None, jnp.int32(step), None, None)
    own = MotionParams(shared=motion)
    return bound.motion(MOTION, extent=EXTENT, box=BOX).loss(own, context)


def params_of(gaussians, dtype, size=0.5):
    shapes = jax.eval_shape(lambda: plane_motion.init(jax.random.key(0), MOTION))
    rng = np.random.default_rng(0)
    nets = jax.tree.map(lambda leaf: size * rng.normal(size=leaf.shape), shapes)
    return Params({"splats": rows_of(gaussians)}, {NAME: put(nets, dtype)})


@jax.jit
def moved(params, gaussians, time):
    ready = effect().prepare(params)
    return effect().deform(params, gaussians, FrameCondition(time), ready)


@pytest.mark.parametrize("time", [0.0, 0.4, 1.0])
def test_gaussians_move_as_the_network_makes_of_the_planes(time, dtype):
    gaussians = some_gaussians(ROWS, dtype)  # some outside the box: clamped
    params = params_of(gaussians, dtype)
    there = moved(params, gaussians, put(time, dtype))
    motion, before = jax.tree.map(
        lambda leaf: np.asarray(leaf).astype(float), (params.nets[NAME], gaussians)
    )
    low, high = np.array(BOX)
    place = (before.mean - low) / (high - low)
    assert (place < 0).any()
    places = np.concatenate([place, np.full((ROWS, 1), time)], axis=1)
    hidden = expected(MOTION.planes, motion.planes, places)
    for layer in motion.network.hidden:
        hidden = np.maximum(hidden @ layer.weight + layer.bias, 0)
    off = {
        name: hidden @ head.weight + head.bias
        for name, head in motion.network.heads.items()
    }
    atol = {"float32": 2e-5, "float64": 1e-13}[dtype]
    mean = before.mean + EXTENT * off["mean"]
    np.testing.assert_allclose(there.mean, mean, rtol=0, atol=atol)
    scale = before.scale * np.exp(off["log_scale"])
    np.testing.assert_allclose(there.scale, scale, rtol=10 * atol)
    w, *xyz = before.quaternion.T
    turned = Rotation.from_rotvec(off["turn"]) * Rotation.from_quat(
        np.stack([*xyz, w], -1)
    )
    x, y, z, w = turned.as_quat().T
    same = np.abs(np.sum(np.stack([w, x, y, z], -1) * there.quaternion, -1))
    np.testing.assert_allclose(same, 1, atol=atol)
    assert {leaf.dtype for leaf in there} == {np.dtype(dtype)}


@pytest.mark.full
def test_slopes_are_those_of_differences(float64):
    gaussians = some_gaussians(ROWS, "float64")
    params = params_of(gaussians, "float64")
    weights = np.random.default_rng(1).normal(size=(ROWS, 10))

    def value(motion, mean, time):
        rows = params.rows["splats"]._replace(mean=mean)
        scene = Params({"splats": rows}, {NAME: motion})
        there = moved(scene, gaussians._replace(mean=mean), time)
        parts = there.mean, there.quaternion, there.scale
        return jnp.sum(weights * jnp.concatenate(parts, -1))

    args = params.nets[NAME], gaussians.mean, put(0.47, "float64")
    assert directional_error(value, *args, step=1e-6) < 1e-6


def test_what_is_kept_smooth_is_what_the_weights_say(float64):
    motion = params_of(some_gaussians(ROWS), "float64").nets[NAME]
    terms = penalty(motion, MOTION.warm_up)
    wanted = {"variation": 2e-4, "bend": 1e-3, "unrest": 1e-4}
    assert {name: term.weight for name, term in terms.items()} == wanted
    for name, levels in (("variation", "space"), ("bend", "time"), ("unrest", "time")):
        # One plane alone made even, straight or one: what it had cost is saved.
        plane = getattr(motion.planes[0], levels)[0]
        rest = motion.planes[0]._replace(
            **{levels: (jnp.ones_like(plane), *getattr(motion.planes[0], levels)[1:])}
        )
        less = penalty(
            motion._replace(planes=(rest, *motion.planes[1:])), MOTION.warm_up
        )
        assert less[name].value < terms[name].value
        off = dataclasses.replace(MOTION, **{name: 0.0})
        rest = plane_motion.smoothness(off, motion.planes)
        assert rest.keys() == terms.keys() - {name}
    # Before it moves anything, nothing else would train it, to planes that are even.
    early = penalty(motion, MOTION.warm_up - 1)
    assert {float(term.weight) for term in early.values()} == {0.0}


def test_the_box_holds_what_was_observed():
    capture = scenes.tiny_capture()
    low, high = np.array(initialization.observed_box(capture))
    inside = (capture.points.position > low) & (capture.points.position < high)
    assert inside.all(axis=1).mean() > 0.8
    spread = np.ptp(capture.points.position, axis=0)
    assert (high - low < 3 * spread).all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"planes": PlanesSpec()}, "need timestamps and a product"),
        (
            {"planes": PlanesSpec(timestamps=3, combination="sum")},
            "combination='sum'",
        ),
        ({"bend": -1.0}, "finite and not negative"),
        ({"warm_up": -1}, "must not be negative"),
        ({"plane_rate": 1e-9}, "the rate falls"),
        ({"width": 0}, "width >= 1"),
    ],
)
def test_no_motion_of_nothing(changes, words):
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(MOTION, **changes)


@pytest.mark.parametrize("box", [None, (BOX[1], BOX[0])])
def test_planes_without_a_box_are_refused(box):
    with pytest.raises(ValueError, match="minimum and maximum corner"):
        bound.motion(MOTION, extent=EXTENT, box=box)
