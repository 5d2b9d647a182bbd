"""A frame behind its occupancy is the frame of the full quadrature."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import evaluation
from nerfies_jax.fields import occupancy, skipping
from nerfies_jax.fields.effects.ambient import AmbientSpec
from nerfies_jax.fields.effects.appearance import AppearanceSpec
from nerfies_jax.fields.effects.records import FieldRecord
from nerfies_jax.fields.effects.transient import TransientSpec
from nerfies_jax.fields.effects.warp import WarpSpec
from nerfies_jax.fields.field_ray import field_ray_through
from nerfies_jax.fields.occupancy import OccupancySpec
from nerfies_jax.fields.render_ray import Bound
from nerfies_jax.fields.spec import SamplingSpec
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.geometry import rays
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.grids import HashGridSpec
from nerfies_jax.scene import scene, variants
from nerfies_jax.scene.scene import RadianceScene
from nerfies_jax.training.effects import FrameCondition
from tests import scenes

SIZE = (23, 17)
STEP = jnp.int32(30)
GRID = TemplateSpec(
    HashGridSpec(levels=1, coarsest=8, finest=8),
    EncodingSpec(1),
    depth=1,
    width=8,
    skips=(),
    color_width=8,
    density="exp",
    density_bias=-12.0,
)
TWO_LEVELS = RadianceScene(
    steps=30, template=GRID, sampling=SamplingSpec(10, 7), learning_rate=5e-3
)
MOVING = dataclasses.replace(
    TWO_LEVELS,
    sampling=SamplingSpec(8, 12, shared=True, union=False),
    appearance=AppearanceSpec(2),
    warp=WarpSpec(position=EncodingSpec(2), depth=1, width=8, skips=()),
    ambient=AmbientSpec(depth=1, width=8, skips=(), closed_steps=1, anneal_steps=9),
)
# The fine level takes over what the warp and the slices said of the coarse samples.
TAKEN_OVER = dataclasses.replace(MOVING, sampling=SamplingSpec(8, 9))
ONE_LEVEL = dataclasses.replace(TWO_LEVELS, sampling=SamplingSpec(24, 0))
# Of warps alone: read on a grid of the frame, and space surveyed where they lead.
WARPED_TWO_LEVELS = dataclasses.replace(TWO_LEVELS, warp=MOVING.warp)
GUIDED = dataclasses.replace(
    TWO_LEVELS, sampling=SamplingSpec(24, 0, occupancy=OccupancySpec())
)


def with_holes(templates):
    """The same networks with things and gaps, as large as a cell of the grid."""
    return {
        name: net._replace(tables=jax.tree.map(lambda x: 4e5 * x, net.tables))
        for name, net in templates.items()
    }


@functools.cache
def full_of_holes(spec, background):
    """A model and parameters of things and gaps, as large as a cell of the grid."""
    capture = scenes.tiny_capture()
    metadata = dataclasses.replace(
        scene.metadata_of(capture, spec), background=background
    )
    field = scene.field(spec, metadata)
    params = jax.jit(field.init)(jax.random.key(7))
    if spec.warp is not None:  # motions of a fifth of the half-side, not of 1e-4
        heads = jax.tree.map(lambda x: 600 * x, params["warp"].heads)
        params["warp"] = params["warp"]._replace(heads=heads)
        params["codes"] = jax.tree.map(lambda x: 20 * x, params["codes"])
    params["template"] = with_holes(params["template"])
    return scene.build(spec, metadata), params


ORANGE = (1.0, 0.5, 0.0)
occupied_at = jax.jit(occupancy.at, static_argnums=2)


@pytest.mark.parametrize(
    ("spec", "background", "row"),
    [
        # Each field compiles three programs; a static one is the quickest.
        pytest.param(GUIDED, ORANGE, 3, marks=pytest.mark.full),
        pytest.param(WARPED_TWO_LEVELS, ORANGE, 3, marks=pytest.mark.full),
        (ONE_LEVEL, ORANGE, 3),
        *(pytest.param(MOVING, ORANGE, n, marks=pytest.mark.full) for n in range(3)),
    ],
    ids=[
        "guided",
        "warped, two levels",
        "one level",
        "moving",
        "moving then",
        "moving at last",
    ],
)
def test_skipping_changes_a_frame_by_no_more_than_it_may(spec, background, row):
    model, params = full_of_holes(spec, background)
    view = evaluation.view_of(scenes.tiny_capture(), row)
    if spec.warp is not None:  # in another place at every time, and between two
        view = view._replace(time=view.time + jnp.float32(0.03))
    occupied = jax.jit(model.surveyed.survey)(params, STEP)
    assert all(0.02 < cells.mean() < 0.8 for cells in occupied.values())
    frame_by_frame = spec.ambient is not None
    assert (occupied == {}) == frame_by_frame
    draw = jax.jit(model.surveyed.draw, static_argnums=3)
    skipped = draw(params, occupied, view, SIZE, STEP)
    whole = jax.jit(model.render, static_argnums=2)(params, view, SIZE, STEP)
    assert 0.1 < whole.alpha.mean() < 0.98
    most = skipping.SKIPPED_DEPTH + np.exp(-skipping.OPAQUE_DEPTH)
    for name in ("color", "alpha"):
        error = np.abs(getattr(skipped, name) - getattr(whole, name))
        assert np.sqrt(np.mean(error**2)) < most, name  # 39 dB
        if not spec.sampling.fine:  # else samples move where coarse weights change
            assert error.max() < most, name
    span = model.spec[1].far - model.spec[1].near
    seen = whole.alpha > 0.5
    assert np.abs(skipped.depth - whole.depth)[seen].mean() < most * span
    if frame_by_frame:
        return
    # Were nothing occupied, samples would be skipped that the image is made of.
    nothing = jax.tree.map(jnp.zeros_like, occupied)
    bare = draw(params, nothing, view, SIZE, STEP)
    assert np.abs(bare.color - whole.color).max() > 10 * most


def test_space_is_surveyed_of_a_warp_that_colors_what_it_moves():
    """The survey asks the template where the warp leads, and still gives it all."""

    def displace(_, point, condition):
        return jnp.full(3, 0.3, point.dtype)

    def look(_, condition):
        return jnp.ones(2)

    own = FieldRecord(
        "own", condition=look, condition_width=2, displace=displace, shortest_wave=9.0
    )
    metadata = scene.metadata_of(scenes.tiny_capture(), ONE_LEVEL)
    field = scene.field(ONE_LEVEL, metadata, effects=(own,))
    params = jax.eval_shape(field.init, jax.random.key(0))
    (cells,) = jax.eval_shape(field.survey, params, STEP).values()
    assert cells.shape == (skipping.STILL_CELLS,) * 3


@pytest.mark.full
def test_where_nothing_is_skipped_a_frame_is_the_full_quadrature(monkeypatch):
    """Samples that the fine level takes over are where they were asked before."""
    monkeypatch.setattr(skipping, "SKIPPED_DEPTH", -1.0)
    monkeypatch.setattr(skipping, "OPAQUE_DEPTH", np.inf)
    model, params = full_of_holes(TAKEN_OVER, ORANGE)
    view = evaluation.view_of(scenes.tiny_capture(), 1)
    rendering = jax.jit(model.surveyed.draw, static_argnums=3)(
        params, {}, view, SIZE, STEP
    )
    whole = jax.jit(model.render, static_argnums=2)(params, view, SIZE, STEP)
    assert 0.1 < whole.alpha.mean() < 0.98
    np.testing.assert_allclose(rendering.color, whole.color, atol=1e-5)
    np.testing.assert_allclose(rendering.depth, whole.depth, atol=1e-4)


@pytest.mark.full
@pytest.mark.parametrize("pixels", [SIZE, (40, 30)])
def test_a_frame_does_not_depend_on_how_it_is_cut(pixels, monkeypatch):
    """Blocks, stages and batches are of memory alone."""
    model, params = full_of_holes(TAKEN_OVER, ORANGE)
    view = evaluation.view_of(scenes.tiny_capture(), 3)
    occupied = jax.jit(model.surveyed.survey)(params, STEP)
    images = []
    for block, batch, stages in ((16384, 2048, 4), (100, 37, 1)):
        for name, value in (("BLOCK", block), ("BATCH", batch), ("STAGES", stages)):
            monkeypatch.setattr(skipping, name, value)
        draw = jax.jit(functools.partial(model.surveyed.draw), static_argnums=3)
        images.append(draw(params, occupied, view, pixels, STEP))
    limit = np.exp(-skipping.OPAQUE_DEPTH)
    np.testing.assert_allclose(images[0].color, images[1].color, atol=limit)


def test_a_survey_finds_a_small_thing_whichever_cell_it_is_in():
    """Points of a cell lie in it, and what touches it is occupied as well."""
    cells = 12
    index = np.arange(cells**3, dtype=np.int32)
    draw = jax.jit(occupancy.random_points, static_argnums=(2, 3, 4))
    dilated = jax.jit(occupancy.dilate)
    for number in range(3):
        point = draw(jax.random.key(number), index, cells, 0.3, jnp.float32)
        assert np.abs(point).max() > 0.5  # up to twice the half-side
        for one in (0, 777, cells**3 - 1):
            only = index == one
            grid = only.reshape((cells,) * 3)
            np.testing.assert_array_equal(occupied_at(grid, point, 0.3), only)
            around = np.asarray(dilated(grid))
            near = np.abs(
                np.stack(np.unravel_index(index, (cells,) * 3))
                - np.stack(np.unravel_index(one, (cells,) * 3))[:, None]
            )
            np.testing.assert_array_equal(around.ravel(), near.max(axis=0) <= 1)
    far = np.float32([[0.61, 0.0, 0.0], [0.0, -9.0, 0.1]])
    assert occupied_at(np.zeros((cells,) * 3, bool), far, 0.3).all()


@pytest.mark.full
@pytest.mark.parametrize("bend", [0.0, -0.2])
def test_a_survey_of_what_is_shown_is_that_of_everything_there(bend):
    capture = scenes.tiny_capture()
    model, params = full_of_holes(MOVING, ORANGE)
    spec, metadata = model.spec[:2]
    field = scene.field(spec, metadata)
    camera = jax.tree.map(lambda x: x[2], capture.cameras)
    camera = jax.device_put(camera._replace(radial=np.float32([bend, 0, 0])))
    bound = Bound(spec, metadata, field.effects, params)
    shown = jax.jit(lambda camera: skipping.shown_cells(bound, camera, capture.size))(
        camera
    )
    assert 0.02 < shown.mean() < 0.4
    # Every sample of every ray is in a cell that is shown.
    through = jax.jit(
        jax.vmap(lambda pixel: field_ray_through(metadata, camera, pixel))
    )
    ray, _ = jax.tree.map(
        np.asarray, through(rays.pixel_centers(capture.size).reshape(-1, 2))
    )
    share = np.linspace(0, 1, 41, dtype=np.float32)[:, None]
    distance = ray.near + share * (ray.far - ray.near)
    point = ray.origin + distance[..., None] * ray.direction
    assert occupied_at(shown, point, spec.extent).mean() > 0.999

    time = jnp.float32(0.4)
    codes = field.codes_at(params, evaluation.view_of(capture, 2))
    condition = FrameCondition(time, codes, STEP)
    whole, part = (
        jax.jit(lambda which: skipping.survey(bound, condition, which))(which)
        for which in (None, shown)
    )
    around = np.asarray(jax.jit(occupancy.dilate)(shown))
    shown = np.asarray(shown)
    for name, cells in whole.items():
        actual = np.asarray(part[name])
        np.testing.assert_array_equal(actual & shown, np.asarray(cells) & shown)
        assert actual[~around].all()


@pytest.mark.parametrize(
    "change",
    [{"transient": TransientSpec(depth=1, width=8)}, {"extent": None}],
    ids=["transient", "no extent"],
)
def test_without_a_survey_a_frame_is_the_full_quadrature(change):
    spec = dataclasses.replace(TWO_LEVELS, **change)
    metadata = scene.metadata_of(scenes.tiny_capture(), spec)
    assert scene.build(spec, metadata).surveyed is None
    if spec.transient is not None:  # what is left can be surveyed
        static = variants.without_effects(spec, metadata, ("transient",), False)
        assert static.surveyed is not None
