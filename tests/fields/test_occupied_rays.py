"""Which rays a step learns from, once it is known where something is."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import evaluation
from nerfies_jax.fields import occupied_rays, skipping
from nerfies_jax.fields.effects.transient import TransientSpec
from nerfies_jax.fields.effects.warp import WarpSpec
from nerfies_jax.fields.field_ray import Ray
from nerfies_jax.fields.occupancy import OccupancySpec
from nerfies_jax.fields.spec import SamplingSpec
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.grids import HashGridSpec
from nerfies_jax.scene import scene
from nerfies_jax.scene import steps as field_steps
from nerfies_jax.training import loop
from tests import scenes
from tests.fields.test_skipping import GRID, TWO_LEVELS, with_holes

SPEC = dataclasses.replace(
    TWO_LEVELS,
    rays=40,
    template=dataclasses.replace(
        GRID, position=HashGridSpec(levels=1, coarsest=4, finest=4)
    ),
    sampling=SamplingSpec(
        8, 8, occupancy=OccupancySpec(start=10, every=10, candidates=4, anywhere=0.2)
    ),
    learning_rate=5e-4,
)
CELLS = 16
meets = jax.jit(occupied_rays.meets, static_argnums=2)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("anywhere", [0, 7])
def test_rays_that_meet_something_come_first_and_others_fill_up(rng, share, anywhere):
    meeting = rng.random(60) < share
    actual = np.asarray(occupied_rays.choose(jnp.asarray(meeting), 20, anywhere))
    rest = range(anywhere, 60)
    wanted = [*(n for n in rest if meeting[n]), *(n for n in rest if not meeting[n])]
    assert actual.tolist() == [*range(anywhere), *wanted][:20]


def test_a_ray_meets_what_it_goes_through(rng, dtype):
    """Against the distance of the ray from the middle of one block of eight cells."""
    blocks, half_side = 0, 0.5
    for _ in range(200):
        corner = rng.integers(4, CELLS - 6, 3)
        occupied = np.zeros((CELLS,) * 3, bool)
        occupied[tuple(slice(c, c + 2) for c in corner)] = True
        # Within the observed volume contraction changes nothing.
        size = half_side * 3 / CELLS
        middle = ((corner + 1) / CELLS - 0.5) * half_side * 3
        if np.abs(middle).max() + size > half_side:
            continue
        blocks += 1
        origin, toward = rng.uniform(-0.4, 0.4, (2, 3))
        direction = (toward - origin) / np.linalg.norm(toward - origin)
        ray = Ray(*(jnp.asarray(x, dtype) for x in (origin, direction, 0.0, 0.5)))
        met = bool(meets(jnp.asarray(occupied), ray, half_side))
        along = np.linspace(0, 0.5, 20_001)[:, None] * direction + origin
        gap = np.abs(along - middle).max(axis=1).min()  # to the middle, by the cube
        if abs(gap - size) > 0.02 * size:  # but for a corner that is only just cut
            assert met == (gap < size)
    assert blocks > 50


def test_a_ray_that_leaves_the_cells_may_meet_anything(dtype):
    nothing = jnp.zeros((CELLS,) * 3, bool)
    origin, direction = jnp.zeros(3, dtype), jnp.asarray([0, 0, 1], dtype)
    for far, met in ((0.99, False), (1.01, True), (1e30, True)):
        ray = Ray(origin, direction, jnp.zeros((), dtype), jnp.asarray(far, dtype))
        assert bool(meets(nothing, ray, 0.5)) is met


@pytest.mark.full
def test_a_run_surveys_and_learns_from_what_is_left():
    capture = scenes.tiny_capture()
    model = scene.build(SPEC, scene.metadata_of(capture, SPEC))
    frames = evaluation.frames_of(capture, model.required_data)
    state = model.init(capture, jax.random.key(0))
    assert state.aux_state.all()
    assert [event.steps for event in model.events] == [(10, 20)]
    state.params["template"] = with_holes(state.params["template"])
    # No survey brings back what was found empty: here, where x is large.
    half = jnp.arange(len(state.aux_state)) < len(state.aux_state) // 2
    state = state._replace(aux_state=state.aux_state & half[:, None, None])
    left = np.asarray(state.aux_state)
    ended = loop.fit(model, state, frames, steps=30).state
    assert 0 < ended.aux_state.sum() < left.sum()
    assert not (ended.aux_state & ~left).any()
    field = scene.field(SPEC, scene.metadata_of(capture, SPEC))
    seen = jax.jit(field.survey)(ended.params, ended.step)[skipping.GUIDE]
    assert (seen & ~left).any()  # by itself it would


def test_valid_rays_that_meet_something_are_learned_from():
    capture = scenes.tiny_capture()
    metadata = scene.metadata_of(capture, SPEC)
    field = scene.field(SPEC, metadata)
    frames = evaluation.frames_of(capture, frozenset())
    draw = jax.jit(field_steps.draw_batch, static_argnums=1)
    every = jax.tree.map(np.asarray, draw(frames, 160, jax.random.key(1)))
    every = every._replace(valid=every.valid & (np.arange(160) % 3 > 0))
    cells = np.zeros((CELLS,) * 3, bool)
    cells[:, : CELLS // 2] = True
    choose = jax.jit(lambda *inputs: occupied_rays.learned_from(field, *inputs))
    batch = choose(cells, every)
    assert len(batch.row) == SPEC.rays
    by_itself = [
        bool(every.valid[n]) and bool(meets(cells, ray_of(metadata, every, n), 1.0))
        for n in range(160)
    ]
    assert 20 < sum(by_itself[8:]) < 140
    rows = [*range(8), *(8 + np.flatnonzero(by_itself[8:]))][:40]
    np.testing.assert_array_equal(batch.pixel[: len(rows)], every.pixel[np.array(rows)])


def ray_of(metadata, batch, number):
    """The ray of one candidate in the field, in NumPy."""
    origin, direction = (np.asarray(x)[number] for x in (batch.origin, batch.direction))
    span = metadata.scale / np.asarray(batch.cosine)[number]
    return Ray(
        jnp.asarray((origin - np.asarray(metadata.center)) * metadata.scale, "float32"),
        jnp.asarray(direction),
        jnp.asarray(metadata.near * span, "float32"),
        jnp.asarray(metadata.far * span, "float32"),
    )


@pytest.mark.parametrize(
    "change",
    [
        {"transient": TransientSpec(depth=1, width=8)},
        {"extent": None},
        {"warp": WarpSpec(position=EncodingSpec(2), depth=1, width=8, skips=())},
    ],
    ids=["transient", "no extent", "moving"],
)
def test_what_cannot_be_surveyed_is_refused(change):
    spec = dataclasses.replace(SPEC, **change)
    with pytest.raises(ValueError, match="occupancy=none"):
        scene.build(spec, scene.metadata_of(scenes.tiny_capture(), spec))


@pytest.mark.parametrize(
    "change",
    [{"start": 0}, {"every": 0}, {"candidates": 1}, {"anywhere": 1.0}],
    ids=str,
)
def test_settings_that_choose_nothing_are_refused(change):
    ((name, value),) = change.items()
    with pytest.raises(ValueError, match=f"{name}={value}"):
        OccupancySpec(**change)
