"""Whole steps of Gaussians, still and moving, from starts that nobody would choose."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax import representation
from gaussians_jax.core import splats
from gaussians_jax.core.protocols import Strategy
from gaussians_jax.init.points import InitSpec
from gaussians_jax.scene import growth, scene
from gaussians_jax.scene.growth import AuxState
from gaussians_jax.scene.spec import effects_of, strategy_of
from nerfies_jax.capture.capture import PointCloud
from nerfies_jax.training.model import Frames, Model, TrainState, View
from tests import bare_scenes, scenes
from tests.hard_cases import hostile

pytestmark = pytest.mark.full

STEPS = 200
# What is to stay finite has by then grown, lost its opacities, been pruned for its size
# (which begins after that, at 150) and gone on.
ENOUGH = 160
TINY = {
    "splats-static": scenes.TINY_SPLATS,
    "sonata": scenes.TINY_SONATA,
}
# What moves takes longer to compile.
PRESETS = [
    pytest.param(name, marks=() if name == "splats-static" else pytest.mark.slow)
    for name in TINY
]
# What those have not: bases, planes, embeddings, nodes that are held rigid, polynomials
# that fade. The time basis and the splines share the code of the polynomials, masked
# nodes that of the rigid ones. Anchors, carried Gaussians and flow have hard cases and
# a step of a whole scene in their own tests.
SYSTEMS = ("moba", "4dgs", "e-d3dgs", "sc-gs", "spacetime")
# Pruned at the first event, being too large or too faint: a scene without Gaussians.
DIE = ("huge", "needles", "transparent")
# |dL/dq| is 1e30 times that of a unit quaternion; its square is beyond float32.
STOPS = {"quaternions of nearly nothing": "optimizer.second.rows.splats.quaternion"}
# Captures that change nothing a preset reads: they would be "as recorded" once more. Of
# these, "unobserved depth not a number" is half of "unobserved frames".
NO_DEPTHS = ("no depth known", "constant depth", "unobserved depth not a number")
UNREAD = {"splats-static": (*NO_DEPTHS, "one instant")}
# Starts that only a motion, its network or its growth could spoil: the static preset
# shows what becomes of the others.
ROWS_OF = {
    "sonata": ("in one point", "needles", "about the cameras", "alone", "far away")
}
CAPTURES_OF = {
    "sonata": (
        *("as recorded", "one instant", "two views", "no depth known"),
        "unobserved depth not a number",
    ),
}
SILENT = {"kan_motion", "motion_growth"}  # add nothing to the loss
# The last frame's error over that of the start; 0.15 to 0.63 where Adam trains. RAdam's
# steps are 0.03 to 0.15 of Adam's in so few updates, too short to make good what the
# reset of the opacities at half time took: 1.12 to 1.24, as recorded, too.
FALLS = {"sonata": 1.5}


def hostile_spec(name):
    """A tiny preset that grows, prunes and resets within one bucket of rows.

    One capacity is one program for all starts; 200 points leave room for 56.
    """
    spec = TINY[name] if name in TINY else bare_scenes.tiny_splats(name)
    plan = bare_scenes.shrunk(
        spec.strategy,
        refine_every=50,
        refine_start_iter=50,
        refine_stop_iter=STEPS,
        reset_every=100,
        cap_max=splats.BUCKET,
        grow_grad2d=1e-5,
        # Of an extent of 0.04 scene units: the paper's 0.1 prunes all of this scene.
        prune_scale3d=50.0,
    )
    return dataclasses.replace(spec, steps=STEPS, strategy=plan)


class Ready(NamedTuple):
    """A model, where it would start, its frames and its image."""

    model: Model
    start: TrainState
    frames: Frames
    effects: tuple
    strategy: Strategy | None
    render: object  # (params, view, step) -> Rendering


@functools.cache
def ready(name) -> Ready:
    spec, capture = hostile_spec(name), scenes.tiny_capture()
    metadata = scene.metadata_of(capture)
    model = scene.build(spec, metadata)

    @jax.jit
    def render(params, view, step):
        return model.render(params, view, capture.size, step)

    return Ready(
        model,
        model.init(capture, jax.random.key(3)),
        hostile.frames_of(capture, model.required_data),
        effects_of(spec, metadata),
        strategy_of(spec, metadata),
        render,
    )


def started_with(prepared: Ready, rows):
    """The first state with these rows, and what is made of the rows made anew."""
    params, rows = prepared.start.params, jax.device_put(rows)
    params = params._replace(rows=params.rows | {"splats": rows})
    aux_state = AuxState(
        prepared.strategy.init(rows), growth.states_of(prepared.effects, params)
    )
    return prepared.start._replace(params=params, aux_state=aux_state)


def one_point(rows):
    return rows._replace(mean=np.zeros_like(rows.mean) + rows.mean[:1])


def alone(rows):
    return splats.deactivate(jax.device_put(rows), jnp.arange(len(rows.mean)) > 0)


def with_logit(rows, logit):
    """Every active row with that opacity; inactive ones stay inactive."""
    logits = np.where(
        splats.active_mask(jax.device_put(rows)), np.float32(logit), rows.opacity_logit
    )
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
    return rows._replace(mean=mean.astype(rows.mean.dtype))


def scaled(value):
    return lambda rows: rows._replace(log_scale=np.full_like(rows.log_scale, value))


ROWS = {
    "in one point": one_point,
    "zero-size": scaled(-100.0),
    "huge": scaled(100.0),
    "needles": lambda rows: rows._replace(
        log_scale=np.zeros_like(rows.log_scale) + np.float32([-30.0, -30.0, 3.0])
    ),
    "opaque": lambda rows: with_logit(rows, 100.0),
    "transparent": lambda rows: with_logit(rows, -100.0),
    "about the cameras": about_the_cameras,
    "alone": alone,
    "far away": lambda rows: rows._replace(mean=rows.mean * np.float32(1e6)),
    "quaternions of nearly nothing": lambda rows: rows._replace(
        quaternion=rows.quaternion * np.float32(1e-30),
        # Not round: of round ones the slopes are rounding alone, times 1e30.
        log_scale=rows.log_scale + np.float32([0.0, 0.5, -0.5]),
    ),
}


def of_every_kind(rows):
    """A seventh of the rows each: as they were, and as six of the starts above."""
    kinds = "in one point", "needles", "huge", "opaque", "transparent"
    kinds = rows, *(ROWS[kind](rows) for kind in (*kinds, "about the cameras"))
    kind = np.arange(len(rows.mean)) % len(kinds)

    def own(*leaves):
        return np.stack(leaves)[kind, np.arange(len(kind))]

    return jax.tree.map(own, *kinds)


def run(prepared, start, frames, folder=None, steps=STEPS):
    """Train, hold the run to its promises and look at its image."""
    trained = hostile.train(prepared.model, start, frames, folder, steps=steps)
    image = rendered_frame(prepared, trained.result.state, frames, 0)
    for name, leaf in image._asdict().items():
        assert np.isfinite(np.asarray(leaf)).all(), name
    return trained


def rendered_frame(prepared, state, frames, row):
    """The view of that frame."""
    camera = jax.tree.map(lambda leaf: leaf[row], frames.cameras)
    view = View(camera, frames.times[row], frames.appearance[row])
    return prepared.render(*hostile.on_device((state.params, view, state.step)))


def falls(prepared, frames, trained):
    """The last frame's mean squared error after training, over that before it."""
    truth = np.float32(frames.images[-1]) / 255
    before, after = (
        np.mean(
            (np.asarray(rendered_frame(prepared, state, frames, -1).color) - truth) ** 2
        )
        for state in (prepared.start, trained.result.state)
    )
    return after / before


@pytest.mark.parametrize(
    ("name", "case"),
    [
        pytest.param(*preset.values, case, marks=preset.marks)
        for preset in PRESETS
        for case in ROWS_OF.get(*preset.values, ROWS)
        # A run that stops has programs of its own; one preset shows how it ends.
        if case not in STOPS or preset.values == ("splats-static",)
    ],
)
def test_splats_train_from_hostile_rows(name, case, tmp_path):
    prepared = ready(name)
    rows = jax.tree.map(np.asarray, prepared.start.params.rows["splats"])
    start = started_with(prepared, ROWS[case](rows))
    stops = case in STOPS
    folder = tmp_path if stops else None
    trained = run(prepared, start, prepared.frames, folder, ENOUGH)
    if stops:
        assert trained.result.stopped_by == "non-finite"
        assert STOPS[case] in trained.result.message
        return
    assert trained.result.stopped_by == "steps", trained.result.message
    rows = trained.result.state.params.rows["splats"]
    assert bool(splats.active_mask(rows).any()) == (case not in DIE), case
    if case in DIE:  # a run of nothing ends with a word
        about = prepared.model.spec
        saved = representation.save(tmp_path, *about, trained.result.state)
        assert saved.notes[0].startswith("No Gaussian is left")
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "case"),
    [
        pytest.param(*preset.values, case, marks=preset.marks)
        for preset in PRESETS
        for case in CAPTURES_OF.get(*preset.values, hostile.CAPTURES)
        if case not in UNREAD.get(*preset.values, ())
    ],
)
def test_splats_train_on_hostile_captures(name, case, tmp_path):
    prepared = ready(name)
    frames = hostile.CAPTURES[case](prepared.frames)
    folder = tmp_path if case == "as recorded" else None
    trained = run(prepared, prepared.start, frames, folder)
    assert trained.result.stopped_by == "steps", trained.result.message
    assert falls(prepared, frames, trained) < FALLS.get(name, 0.95)
    if case == "as recorded":
        check_every_part(prepared, trained.result)


def check_every_part(prepared, result):
    """Every part with a loss is in the log, and what parts keep has all rows."""
    logged = {key.partition("/")[0] for key in result.history.rows[-1]}
    assert {effect.name for effect in prepared.effects} - SILENT <= logged
    capacity = len(result.state.params.rows["splats"].mean)
    statistics = jax.tree.leaves(result.state.aux_state)
    assert {len(leaf) for leaf in statistics} == {capacity}


@pytest.mark.slow
def test_sonata_learns_where_its_opacities_are_not_reset():
    prepared = ready("sonata")
    model = prepared.model._replace(events=())
    trained = hostile.train(model, prepared.start, prepared.frames, steps=500)
    assert falls(prepared, prepared.frames, trained) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_every_system_trains_from_rows_of_every_kind_at_one_instant(name):
    prepared = ready(name)
    rows = jax.tree.map(np.asarray, prepared.start.params.rows["splats"])
    start = started_with(prepared, of_every_kind(rows))
    frames = hostile.CAPTURES["one instant"](prepared.frames)
    trained = run(prepared, start, frames)
    assert trained.result.stopped_by == "steps", trained.result.message
    assert falls(prepared, frames, trained) < 0.95


def points_at(position):
    """The capture with other points, all of them gray."""
    position = np.asarray(position, np.float32)
    color = np.full(position.shape, 128, np.uint8)
    return dataclasses.replace(
        scenes.tiny_capture(), points=PointCloud(position, color)
    )


# Of where the cameras are, what the first one sees a unit ahead, and the far plane.
CLOUDS = {
    "one point": lambda place, ahead, far: place[:1] + ahead,
    "all in one place": lambda place, ahead, far: np.tile(place[:1] + ahead, (150, 1)),
    "in the cameras": lambda place, ahead, far: np.tile(place, (40, 1)),
    "behind the cameras": lambda place, ahead, far: np.tile(place - 3 * ahead, (40, 1)),
    "beyond the far plane": lambda place, ahead, far: np.tile(
        place + 100 * far * ahead, (40, 1)
    ),
    "a hair apart": lambda place, ahead, far: (
        place[:1] + ahead + 1e-7 * np.arange(150)[:, None]
    ),
    "light-years away": lambda place, ahead, far: np.tile(
        place + 1e15 * ahead, (40, 1)
    ),
}


@pytest.mark.parametrize(("source", "extra"), [("points", 0), ("auto", 50)])
@pytest.mark.parametrize("cloud", CLOUDS)
def test_every_cloud_of_points_is_a_finite_start(cloud, extra, source):
    capture = scenes.tiny_capture()
    place = capture.cameras.position[capture.train]
    ahead = capture.cameras.camera_from_world[capture.train[0], 2]
    capture = points_at(CLOUDS[cloud](place, ahead, capture.far))
    plan = InitSpec(random=120, extra_random=extra, source=source)
    spec = dataclasses.replace(scenes.TINY_SPLATS, init=plan)
    state = scene.build(spec, scene.metadata_of(capture)).init(
        capture, jax.random.key(0)
    )
    assert not hostile.not_finite(state)
    assert splats.active_mask(state.params.rows["splats"]).any()
