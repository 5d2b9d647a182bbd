"""Whole steps of every radiance field, from starts that nobody would choose."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.fields.effects import scene_flow_losses as flow_losses
from nerfies_jax.scene import scene
from tests import scenes
from tests.hard_cases import field_starts, hostile, linear_warps, tiny_fields
from tests.hard_cases.field_starts import Start
from tests.hard_cases.linear_warps import DISPLACEMENTS

STARTS = field_starts.OF_FRAMES | field_starts.OF_CAPTURES | field_starts.OF_PARAMETERS
# A field compiles in 15 to 45 s.
QUICK = ("nerf-w",)


def marked(name, *others):
    """A full case, or a slow one."""
    mark = pytest.mark.full if name in QUICK else pytest.mark.slow
    return pytest.param(name, *others, marks=mark)


FIELDS = [marked(name) for name in tiny_fields.PAPERS]
# Starts of the other fields: those that reach what they have and NeRF-W has not.
FEW_STARTS = ("as recorded", "one instant", "nothing observed", "cameras inside")
FEW_STARTS += ("opaque by far", "shattered warp", "all a hundredfold")


def is_tried(name, start):
    """Whether a field is trained from that start."""
    spec, needs = tiny_fields.tiny(name), STARTS[start].needs
    if needs:
        return any(getattr(spec, effect) for effect in needs)
    return name in QUICK or start in FEW_STARTS


RUNS = [
    marked(name, start)
    for name in tiny_fields.PAPERS
    for start in STARTS
    if is_tried(name, start)
]
RUNS += [marked(name, start) for name in tiny_fields.SYSTEMS for start in FEW_STARTS]


# --- whole runs ----------------------------------------------------------------------


def trained(name, start, folder=None):
    """A run that ended as every run must, and what it would show then."""
    run = tiny_fields.started(name)
    capture = start.capture(run.capture)
    place = tiny_fields.place_of(scene.metadata_of(capture, run.spec), start.speed)
    if capture.points is None:  # they are told the field's planes alone
        capture = dataclasses.replace(capture, points=run.capture.points)
    frames = start.frames(tiny_fields.frames_of(capture, run.model.required_data))
    params = start.params(jax.tree.map(np.asarray, run.state.params))
    state = run.state._replace(params=params, aux_state=place)
    ended = hostile.train(run.model, state, frames, folder, steps=tiny_fields.STEPS)
    return ended, image_of(run, ended.result.state, frames, 0)


def image_of(run, state, frames, row):
    """The view of that frame."""
    view = jax.tree.map(lambda leaf: leaf[row], (frames.cameras, frames.times))
    return run.image(*hostile.on_device((state, *view)))


@pytest.mark.parametrize(("name", "start"), RUNS)
def test_a_field_stays_finite_from(name, start, tmp_path):
    folder = tmp_path if start == "as recorded" else None
    ended, image = trained(name, STARTS[start], folder)
    # The loop may stop with a word; none of these starts gives it a reason.
    assert ended.result.stopped_by == "steps", ended.result.message
    assert not hostile.not_finite(image)
    assert np.all((image.color > -1e-5) & (image.color < 2 + 1e-5))
    assert np.all((image.alpha > -1e-5) & (image.alpha < 1 + 1e-5))
    assert np.all(image.depth >= 0)
    if start == "as recorded":
        assert ended.last["mse"] < 0.9 * ended.first["mse"]


# One size a field of these widths does not survive: products of five layers pass 3e38.
OVERFLOWING = Start(params=field_starts.times(1e12))


@pytest.mark.parametrize("name", [marked(name) for name in QUICK])
def test_a_field_that_overflows_stops_where_it_started_and_says_so(name, tmp_path):
    ended, _ = trained(name, OVERFLOWING, tmp_path)
    assert ended.result.stopped_by == "non-finite"
    assert "step 1 is not finite: metric " in ended.result.message
    assert ended.result.steps == 0
    start = OVERFLOWING.params(
        jax.tree.map(np.asarray, tiny_fields.started(name).state.params)
    )
    for after, inputs in zip(
        jax.tree.leaves(ended.result.state.params),
        jax.tree.leaves(start),
        strict=True,
    ):
        np.testing.assert_array_equal(after, inputs)


@pytest.mark.parametrize("name", FIELDS)
def test_a_step_is_the_same_in_any_unit(name):
    # Without learning, which would make more and more of the rounding.
    usual, _ = trained(name, Start(speed=0.0))
    for unit in ("box of 1e-5 units", "box of 1e5 units"):
        other, _ = trained(name, STARTS[unit]._replace(speed=0.0))
        # Positions are rounded before they are scaled: by 1e-7 of the box
        for metric, value in usual.first.items():
            if metric not in ("step", "seconds", "cpu_seconds"):
                np.testing.assert_allclose(
                    other.first[metric], value, rtol=1e-3, atol=1e-6
                )


@pytest.mark.slow  # shares the program of nerfies
@pytest.mark.parametrize("name", ["nerfies"])
@pytest.mark.parametrize("displacement", DISPLACEMENTS)
def test_a_step_with_the_elastic_penalty_is_finite_from(displacement, name):
    strain = DISPLACEMENTS[displacement]

    def bent(params):
        return params | {"warp": linear_warps.linear_warp(params["warp"], strain)}

    # Its gradients are taken and not followed: every step has the same strain.
    ended, image = trained(name, Start(params=bent, speed=0.0))
    assert ended.result.stopped_by == "steps", ended.result.message
    assert not hostile.not_finite(image)
    expected = linear_warps.cost(tiny_fields.tiny(name).elastic, strain)
    measured = ended.first["elastic/elastic"]
    if displacement == "huge":
        # Asked 1e4 units out, the template leaves some rays empty in some steps.
        assert 0 < measured < (1 + 1e-4) * expected
    else:  # every ray ends somewhere, for behind it is an interval of 1e10
        np.testing.assert_allclose(measured, expected, rtol=1e-4, atol=1e-12)
    folded = np.linalg.det(np.eye(3) + strain) < 0
    empty = 0.2 if displacement == "huge" else 1e-6
    np.testing.assert_allclose(ended.first["elastic/folded"], folded, atol=empty)


# --- what the field knows of a hostile capture ---------------------------------------


# Captures hold depths from 1e-6 to 1e6 scene units.
@pytest.mark.parametrize("factor", [1e-5, 1e5])
def test_units_of_a_capture_do_not_reach_the_field(factor):
    spec = tiny_fields.tiny("nerf")
    capture = scenes.tiny_capture()
    usual = scene.metadata_of(capture, spec)
    other = scene.metadata_of(field_starts.scaled(factor)(capture), spec)
    # To the rounding of float32 points and cameras
    np.testing.assert_allclose(other.scale * factor, usual.scale, rtol=1e-6)
    np.testing.assert_allclose(other.near / factor, usual.near, rtol=1e-6)
    np.testing.assert_allclose(other.far / factor, usual.far, rtol=1e-6)
    center = np.asarray(other.center) / factor
    np.testing.assert_allclose(center, usual.center, atol=1e-6)


def test_points_behind_the_far_plane_do_not_push_the_near_one_past_it():
    spec = tiny_fields.tiny("nerf")
    capture = scenes.tiny_capture()
    ahead = 50 * capture.cameras.camera_from_world[0, 2]
    points = capture.points._replace(position=capture.points.position + ahead)
    metadata = scene.metadata_of(dataclasses.replace(capture, points=points), spec)
    assert metadata.near == capture.near
    assert metadata.far == capture.far


# --- means of what is hardly there ---------------------------------------------------


@jax.jit
def mean_and_slopes(values, logs, scale):
    def mean(values, logs):
        # as `visible` is made: the weight's own slope is the weight
        return flow_losses.weighted_mean(values, scale * jnp.exp(logs))

    return jax.value_and_grad(mean, (0, 1))(values, logs)


@pytest.mark.parametrize("scale", [1.0, 1e-12, 1e-18, 1e-22, 2e-30, 1e18])
def test_a_weighted_mean_keeps_its_slopes_however_small_the_weights(scale, rng, dtype):
    values = rng.normal(size=(5, 4, 3))
    share = rng.uniform(0.1, 1.0, (5, 4))
    inputs = (np.asarray(x, dtype) for x in (values, np.log(share), scale))
    value, slopes = mean_and_slopes(*inputs)
    of_axes = values.mean(-1)
    exact = (share * of_axes).sum() / share.sum()
    by_log = share * (of_axes - exact) / share.sum()
    tolerance = {"float32": 2e-6, "float64": 1e-14}[dtype]
    np.testing.assert_allclose(value, exact, atol=tolerance)
    np.testing.assert_allclose(slopes[1], by_log, atol=tolerance)
    by_value = np.broadcast_to((share / share.sum() / 3)[..., None], values.shape)
    np.testing.assert_allclose(slopes[0], by_value, atol=tolerance)


@pytest.mark.parametrize("scale", [0.0, 1e-31, 1e-37])
def test_weights_that_are_next_to_nothing_are_none(scale, dtype):
    ones, zeros = np.ones((5, 4, 3), dtype), np.zeros((5, 4), dtype)
    value, slopes = mean_and_slopes(ones, zeros, np.asarray(scale, dtype))
    assert value == 0
    assert not any(np.any(slope) for slope in slopes)
