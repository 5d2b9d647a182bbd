"""Whole steps of every preset of Gaussians, from starts that nobody would choose."""

import dataclasses
import functools
import re
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax import density, scene, splats
from gaussians_jax.rates import RateSpec
from gaussians_jax.scene import Extra
from gaussians_jax.spec import effects_of
from gaussians_jax.start import StartSpec
from nerfies_jax.capture.capture import PointCloud
from nerfies_jax.training.model import Frames, Model, TrainState, View
from tests import scenes
from tests.hard_cases import hostile

pytestmark = pytest.mark.hard_cases

STEPS = 200
TINY = {
    "splats-static": scenes.TINY_SPLATS,
    "splats-deformable": scenes.TINY_DEFORMABLE,
    "sonata": scenes.TINY_SONATA,
    "moba": scenes.TINY_MOBA,
}
# What moves takes longer to compile.
PRESETS = [
    pytest.param(name, marks=() if name == "splats-static" else pytest.mark.slow)
    for name in TINY
]
# Pruned at the first event, being too large or too faint: a scene without Gaussians.
DIE = ("huge", "needles", "transparent")
# |dL/dq| is 1e30 times that of a unit quaternion; its square is beyond float32.
STOPS = {"quaternions of nearly nothing": "optimiser.second.rows.splats.quaternion"}
# The last frame's error over that of the start; 0.15 to 0.63 where Adam trains. RAdam's
# steps are 0.03 to 0.15 of Adam's in so few updates, too short to make good what the
# reset of the opacities at half time took: 1.12 to 1.24, as filmed, too.
FALLS = {"sonata": 1.5}


def hostile_spec(name):
    """A tiny preset that grows, prunes and resets within one bucket of rows.

    One capacity is one program for all starts; 200 points leave room for 56.
    """
    plan = dataclasses.replace(
        scenes.TINY_SPLATS.density,
        interval=50,
        start=50,
        stop=STEPS,
        reset_interval=100,
        most=splats.BUCKET,
        gradient=1e-5,
        # Of an extent of 0.04 scene units: the paper's 0.1 prunes all of this scene.
        prune_scale=50.0,
    )
    return dataclasses.replace(TINY[name], steps=STEPS, density=plan)


class Ready(NamedTuple):
    """A model, where it would start, its frames and its picture."""

    model: Model
    start: TrainState
    frames: Frames
    effects: tuple
    render: object  # (state, view) -> Rendering


def ready_for(spec, capture) -> Ready:
    facts = scene.facts_of(capture)
    model = scene.build(spec, facts)

    @jax.jit
    def render(state, view):
        return model.render(state.params, view, capture.size, state.step)

    return Ready(
        model,
        model.init(capture, jax.random.key(3)),
        hostile.frames_of(capture, model.wants),
        effects_of(spec, facts),
        render,
    )


@functools.cache
def ready(name) -> Ready:
    return ready_for(hostile_spec(name), scenes.tiny_capture())


def started_with(made: Ready, rows):
    """The first state with these rows, and what is made of the rows made anew."""
    params = made.start.params
    params = params._replace(rows=params.rows | {"splats": rows})
    extra = Extra(density.empty_stats(rows), scene.carried_by(made.effects, params))
    return made.start._replace(params=params, extra=extra)


def one_point(rows):
    return rows._replace(mean=jnp.zeros_like(rows.mean) + rows.mean[:1])


def one_colour(rows):
    return rows._replace(sh_dc=jnp.zeros_like(rows.sh_dc))


def alone(rows):
    return splats.bury(rows, jnp.arange(len(rows.mean)) > 0)


def living(rows, logit):
    """Every living row with that opacity; dead ones stay dead."""
    logits = jnp.where(splats.alive(rows), logit, rows.opacity_logit)
    return rows._replace(opacity_logit=logits)


def about_the_cameras(rows):
    """The cloud moved onto the cameras: some at z = 0, some behind."""
    capture = scenes.tiny_capture()
    positions = capture.cameras.position[capture.train]
    # A quarter exactly at the first camera, where z, x and y are all 0.
    spread = 0.05 * np.random.default_rng(0).normal(size=rows.mean.shape)
    spread[::4] = 0.0
    mean = positions[np.arange(len(spread)) % len(positions)] + spread
    mean[::4] = positions[0]
    return rows._replace(mean=jnp.asarray(mean, rows.mean.dtype))


def scaled(value):
    return lambda rows: rows._replace(log_scale=jnp.full_like(rows.log_scale, value))


ROWS = {
    "in one point": one_point,
    "zero-size": scaled(-100.0),
    "huge": scaled(100.0),
    "needles": lambda rows: rows._replace(
        log_scale=jnp.zeros_like(rows.log_scale) + jnp.array([-30.0, -30.0, 3.0])
    ),
    "opaque": lambda rows: living(rows, 100.0),
    "transparent": lambda rows: living(rows, -100.0),
    "of one colour": one_colour,
    "about the cameras": about_the_cameras,
    "alone": alone,
    "far away": lambda rows: rows._replace(mean=rows.mean * 1e6),
    "quaternions of nearly nothing": lambda rows: rows._replace(
        quaternion=rows.quaternion * 1e-30
    ),
}


def run(made, start, frames, folder):
    """Train, hold the run to its promises and look at its picture."""
    steps = made.model.spec[0].steps
    trained = hostile.train(made.model, start, frames, folder, steps=steps)
    picture = made.render(trained.result.state, view_of(frames, 0))
    for name, leaf in picture._asdict().items():
        assert np.isfinite(np.asarray(leaf)).all(), name
    return trained


def from_rows(name, case, folder):
    made = ready(name)
    rows = ROWS[case](made.start.params.rows["splats"])
    return run(made, started_with(made, rows), made.frames, folder)


def view_of(frames, row):
    camera = jax.tree.map(lambda leaf: leaf[row], frames.cameras)
    return View(camera, frames.times[row], frames.warp[row], frames.appearance[row])


def falls(made, frames, trained):
    """The last frame's mean squared error after training, over that before it."""
    truth = frames.images[-1].astype(jnp.float32) / 255
    drawn = [
        made.render(state, view_of(frames, -1)).colour
        for state in (made.start, trained.result.state)
    ]
    before, after = (float(jnp.mean((colour - truth) ** 2)) for colour in drawn)
    return after / before


@pytest.mark.parametrize("case", ROWS)
@pytest.mark.parametrize("name", PRESETS)
def test_splats_train_from_hostile_rows(name, case, tmp_path):
    trained = from_rows(name, case, tmp_path)
    if case in STOPS and name != "sonata":  # whose RAdam starts with the plain slope
        assert trained.result.stopped_by == "non-finite"
        assert STOPS[case] in trained.result.message
        return
    assert trained.result.stopped_by == "steps", trained.result.message
    living = trained.result.state.params.rows["splats"]
    assert bool(splats.alive(living).any()) == (case not in DIE), case


@pytest.mark.parametrize("case", hostile.CAPTURES)
@pytest.mark.parametrize("name", PRESETS)
def test_splats_train_on_hostile_captures(name, case, tmp_path):
    made = ready(name)
    frames = hostile.CAPTURES[case](made.frames)
    trained = run(made, made.start, frames, tmp_path)
    assert trained.result.stopped_by == "steps", trained.result.message
    assert falls(made, frames, trained) < FALLS.get(name, 0.95)


def faster(spec, factor):
    """The spec with every learning rate in it so many times as high."""
    changed = {}
    for field in dataclasses.fields(spec):
        value = getattr(spec, field.name)
        if dataclasses.is_dataclass(value):
            changed[field.name] = faster(value, factor)
        elif isinstance(spec, RateSpec) or re.search("rate(_end)?$", field.name):
            changed[field.name] = value * factor
    return dataclasses.replace(spec, **changed)


@pytest.mark.slow
@pytest.mark.parametrize("name", TINY)
def test_splats_train_on_two_frames_at_ten_times_the_rates(name, tmp_path):
    spec = faster(hostile_spec(name), 10.0)
    assert spec.rates.mean == 1.6e-3
    capture = scenes.tiny_capture()
    capture = dataclasses.replace(capture, train=capture.train[:2])
    made = ready_for(spec, capture)
    assert made.frames.times.shape == (2,)
    trained = run(made, made.start, made.frames, tmp_path)
    assert trained.result.stopped_by == "steps", trained.result.message
    assert falls(made, made.frames, trained) < FALLS.get(name, 0.95)


def points_at(position):
    """The capture with other points, all of them grey."""
    position = np.asarray(position, np.float32)
    colour = np.full(position.shape, 128, np.uint8)
    return dataclasses.replace(
        scenes.tiny_capture(), points=PointCloud(position, colour)
    )


def hostile_clouds():
    capture = scenes.tiny_capture()
    place = capture.cameras.position[capture.train]
    ahead = capture.cameras.camera_from_world[capture.train[0], 2]
    return {
        "one point": place[:1] + ahead,
        "all in one place": np.tile(place[:1] + ahead, (150, 1)),
        "in the cameras": np.tile(place, (40, 1)),
        "behind the cameras": np.tile(place - 3 * ahead, (40, 1)),
        "beyond the far plane": np.tile(place + 100 * capture.far * ahead, (40, 1)),
        "a hair apart": place[:1] + ahead + 1e-7 * np.arange(150)[:, None],
        "light-years away": np.tile(place + 1e15 * ahead, (40, 1)),
    }


@pytest.mark.parametrize("source", ["auto", "points"])
@pytest.mark.parametrize("beside", [0, 50])
@pytest.mark.parametrize("cloud", hostile_clouds())
def test_every_cloud_of_points_is_a_finite_start(cloud, beside, source):
    capture = points_at(hostile_clouds()[cloud])
    plan = StartSpec(random=120, beside=beside, source=source)
    spec = dataclasses.replace(scenes.TINY_SPLATS, start=plan)
    state = scene.build(spec, scene.facts_of(capture)).init(capture, jax.random.key(0))
    assert not hostile.not_finite(state)
    assert splats.alive(state.params.rows["splats"]).any()
