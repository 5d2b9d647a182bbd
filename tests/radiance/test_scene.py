"""A spec becomes a field and a model: rays, codes, levels, the step."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import evaluation, render_ray, scene
from nerfies_jax.effects.ambient import AmbientSpec
from nerfies_jax.effects.appearance import AppearanceSpec
from nerfies_jax.effects.background import BackgroundSpec
from nerfies_jax.effects.elastic import ElasticSpec
from nerfies_jax.effects.time_condition import TimeSpec
from nerfies_jax.effects.warp import WarpSpec
from nerfies_jax.nets import codes
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.radiance.template import TemplateSpec
from nerfies_jax.scene import RadianceScene
from nerfies_jax.scene_metadata import SceneMetadata
from nerfies_jax.spec import SamplingSpec
from nerfies_jax.training.effects import FrameCondition, weighted_sum
from nerfies_jax.training.model import TrainState, View
from tests import gradients, scenes

TINY_TEMPLATE = TemplateSpec(
    position=EncodingSpec(3),
    direction=EncodingSpec(1),
    depth=2,
    width=16,
    skips=(),
    colour_width=8,
)
STATIC = RadianceScene(
    steps=40,
    template=TINY_TEMPLATE,
    sampling=SamplingSpec(8, 8, block=97),
    rays=64,
    learning_rate=5e-3,
    learning_rate_end=1e-3,
)
TINY_WARP = WarpSpec(
    position=EncodingSpec(2), depth=2, width=8, skips=(), anneal_steps=10
)
NERFIES = dataclasses.replace(
    STATIC,
    warp=TINY_WARP,
    appearance=AppearanceSpec(width=2),
    elastic=ElasticSpec(points=2),
    background=BackgroundSpec(points=16),
)
METADATA = SceneMetadata(
    near=1.0,
    far=3.0,
    centre=(0.5, 0.0, -0.5),
    scale=0.5,
    background=(1.0, 1.0, 1.0),
    times=(0.0, 0.25, 1.0),
    exposures=((0, 0, 0.0), (1, 1, 0.0), (0, 1, 0.25)),
)


@functools.cache
def started(spec):
    capture = scenes.tiny_capture()
    model = scene.build(spec, scene.metadata_of(capture, spec))
    frames = evaluation.frames_of(capture, model.required_data)
    return model, model.init(capture, jax.random.key(3)), frames


@functools.cache
def stepped(spec, count):
    model, state, frames = started(spec)
    step = jax.jit(model.step)
    trace = []
    for _ in range(count):
        state, metrics = step(state, frames)
        trace.append({name: float(value) for name, value in metrics.items()})
    return state, trace


@functools.cache
def rendered(spec):
    model, state, _ = started(spec)
    capture = scenes.tiny_capture()
    view = evaluation.view_of(capture, 0)
    return jax.jit(lambda p: model.render(p, view, (13, 7), jnp.int32(0)))(state.params)


def ray_of(dtype):
    return render_ray.Ray(
        jnp.asarray([0.1, -0.2, 0.3], dtype),
        jnp.asarray([0.6, 0.0, 0.8], dtype),
        jnp.asarray(0.5, dtype),
        jnp.asarray(1.5, dtype),
    )


def condition_of(dtype, **found):
    found = {name: jnp.asarray(code, dtype) for name, code in found.items()}
    return FrameCondition(jnp.asarray(0.4, dtype), found, jnp.int32(0))


@pytest.mark.parametrize(
    "spec",
    [
        pytest.param(STATIC, id="static"),
        pytest.param(NERFIES, id="nerfies", marks=pytest.mark.slow),
    ],
)
def test_training_lowers_the_loss(spec):
    _, trace = stepped(spec, 40)
    first = np.mean([row["mse"] for row in trace[:8]])
    last = np.mean([row["mse"] for row in trace[-8:]])
    assert last < 0.8 * first, (first, last)


def test_a_static_field_has_a_template_and_nothing_else():
    model, state, frames = started(STATIC)
    assert set(state.params) == {"template", "codes"}
    assert state.params["codes"] == {}
    assert frames.points is None
    assert frames.depths is None
    assert model.required_data == frozenset()
    _, trace = stepped(STATIC, 40)
    assert set(trace[0]) == {"loss", "mse", "coarse", "fine"}


def test_a_static_level_is_the_plain_nerf(dtype):
    metadata = METADATA
    field = scene.field(STATIC, metadata)
    params = jax.tree.map(lambda x: x.astype(dtype), field.init(jax.random.key(0)))
    ray = ray_of(dtype)
    coarse, fine = jax.jit(field.render_ray)(params, ray, condition_of(dtype))
    assert fine.colour.dtype == dtype
    expected = plain_nerf(params["template"]["coarse"], ray, np.linspace(0.5, 1.5, 8))
    tolerance = {"float32": 3e-6, "float64": 1e-12}[dtype]
    np.testing.assert_allclose(coarse.colour, expected, atol=tolerance)
    expected = plain_nerf(params["template"]["fine"], ray, np.asarray(fine.distances))
    np.testing.assert_allclose(fine.colour, expected, atol=tolerance)
    assert len(fine.distances) == 16
    assert np.all(np.diff(fine.distances) >= 0)


def plain_nerf(net, ray, distances):
    """One ray of the two-layer field in NumPy, white behind, in float64."""
    net = jax.tree.map(lambda x: np.asarray(x, np.float64), net)
    origin, direction, _, far = (np.asarray(x, np.float64) for x in ray)
    colour, passing = np.zeros(3), 1.0
    ends = np.append(distances[1:], far)
    for distance, end in zip(distances, ends, strict=True):
        hidden = waves(origin + distance * direction, 3)
        for layer in net.trunk.hidden:
            hidden = np.maximum(hidden @ layer.weight + layer.bias, 0)
        heads = {
            name: hidden @ head.weight + head.bias
            for name, head in net.trunk.heads.items()
        }
        beside = np.concatenate([heads["bottleneck"], waves(direction, 1)])
        branch = beside @ net.colour.hidden[0].weight + net.colour.hidden[0].bias
        head = net.colour.heads["colour"]
        shade = 1 / (1 + np.exp(-(np.maximum(branch, 0) @ head.weight + head.bias)))
        density = np.logaddexp(0, heads["density"][0])
        alpha = 1 - np.exp(-density * (end - distance))
        colour = colour + passing * alpha * shade
        passing = passing * (1 - alpha)
    return colour + passing


def waves(x, bands):
    parts = [x]
    for band in range(bands):
        parts += [np.sin(2**band * x), np.cos(2**band * x)]
    return np.concatenate(parts)


@pytest.mark.full
def test_blocks_of_rays_do_not_show_in_a_picture():
    # 91 pixels in blocks of 97, 10 and 1024
    whole = rendered(STATIC)
    for block in (10, 1024):
        plan = dataclasses.replace(STATIC.sampling, block=block)
        other = rendered(dataclasses.replace(STATIC, sampling=plan))
        # Another tiling of the matrix products moves last bits
        np.testing.assert_allclose(whole.colour, other.colour, atol=1e-6)
        np.testing.assert_allclose(whole.depth, other.depth, rtol=1e-5)


@pytest.mark.slow
def test_memory_of_a_render_does_not_grow_with_the_picture():
    model, state, _ = started(STATIC)
    view = evaluation.view_of(scenes.tiny_capture(), 0)

    def temporaries(size):
        draw = jax.jit(lambda p: model.render(p, view, size, jnp.int32(0)))
        return draw.lower(state.params).compile().memory_analysis().temp_size_in_bytes

    small, large = temporaries((40, 40)), temporaries((160, 160))
    pixels = 160 * 160 - 40 * 40
    # Positions in and colour, alpha and depth out, each at most copied once
    assert large - small <= pixels * 4 * (2 + 5) * 3, (small, large)


def test_depth_is_along_the_viewing_axis_in_scene_units():
    capture = scenes.tiny_capture()
    model, state, _ = started(STATIC)
    metadata = model.spec[1]
    # An opaque field stops every ray at its first sample: the near plane.
    params = jax.tree.map(lambda x: x, state.params)
    for net in params["template"].values():
        head = net.trunk.heads["density"]
        net.trunk.heads["density"] = head._replace(bias=head.bias + 1e6)
    view = evaluation.view_of(capture, 0)
    picture = jax.jit(lambda p: model.render(p, view, (9, 7), jnp.int32(0)))(params)
    np.testing.assert_allclose(picture.depth, metadata.near, rtol=1e-4)
    np.testing.assert_allclose(picture.alpha, 1, atol=1e-6)


def test_a_code_is_its_row_at_its_own_time_and_between_rows_elsewhere(dtype):
    spec = dataclasses.replace(STATIC, warp=TINY_WARP)
    field = scene.field(spec, METADATA)
    params = jax.tree.map(lambda x: x.astype(dtype), field.init(jax.random.key(0)))
    table = params["codes"]["motion"]
    assert table.shape == (3, TINY_WARP.code_width)

    def at(time):
        view = View(None, jnp.asarray(time, dtype), jnp.int32(0))
        return field.codes_at(params, view)["motion"]

    for row, time in enumerate(METADATA.times):
        np.testing.assert_array_equal(at(time), table[row])
    np.testing.assert_allclose(at(0.4), 0.8 * table[1] + 0.2 * table[2], atol=1e-7)
    np.testing.assert_array_equal(at(-1.0), table[0])
    np.testing.assert_array_equal(at(7.0), table[2])


def test_an_exposure_that_was_not_learnt_lies_between_its_neighbours(float64):
    spec = dataclasses.replace(STATIC, appearance=AppearanceSpec(width=2))
    field = scene.field(spec, METADATA)
    params = field.init(jax.random.key(0))
    table = params["codes"]["appearance"]
    assert table.shape == (2, 2)  # only what is learnt from has a row
    view = View(None, jnp.asarray(0.0), jnp.int32(2))
    found = field.codes_at(params, view)["appearance"]
    np.testing.assert_allclose(found, 0.75 * table[0] + 0.25 * table[1], atol=1e-7)


def test_facts_place_held_out_exposures_by_time():
    capture = scenes.tiny_capture()
    metadata = scene.metadata_of(capture, STATIC)
    learnt = set(capture.appearance_ids[capture.train].tolist())
    rows = [metadata.exposures[one] for one in sorted(learnt)]
    assert sorted(left for left, right, _ in rows) == list(range(len(learnt)))
    assert all(left == right for left, right, _ in rows)
    assert max(max(left, right) for left, right, _ in metadata.exposures) < len(learnt)
    assert metadata.times == tuple(sorted(set(capture.times[capture.train].tolist())))


def test_the_filmed_volume_fills_the_box():
    capture = scenes.tiny_capture()
    metadata = scene.metadata_of(capture, STATIC)
    inside = (capture.points.position - np.asarray(metadata.centre)) * metadata.scale
    # Outliers of structure from motion may lie outside
    assert np.mean(np.abs(inside) <= 1) > 0.9
    assert np.abs(inside).max() > 0.5
    own = scene.metadata_of(capture, dataclasses.replace(STATIC, extent=None))
    assert own.scale == 1
    assert own.centre == (0, 0, 0)


@pytest.mark.full
def test_without_its_warp_a_field_shows_the_canonical_scene():
    spec = dataclasses.replace(STATIC, warp=TINY_WARP)
    field, canonical = (
        scene.field(spec, METADATA, without) for without in ((), ("warp",))
    )
    params = field.init(jax.random.key(0))
    code = np.ones(TINY_WARP.code_width)
    condition = condition_of("float32", motion=code)
    warp = params["warp"]
    grown = {
        name: head._replace(weight=head.weight * 1e3)
        for name, head in warp.heads.items()
    }
    params = params | {"warp": warp._replace(heads=grown)}
    bent = jax.jit(field.render_ray)(params, ray_of("float32"), condition)[-1]
    straight = jax.jit(canonical.render_ray)(params, ray_of("float32"), condition)[-1]
    assert np.abs(bent.warped - bent.point).max() > 1e-3
    np.testing.assert_array_equal(straight.warped, straight.point)
    static = scene.field(STATIC, METADATA)
    plain = jax.jit(static.render_ray)(params, ray_of("float32"), condition)[-1]
    np.testing.assert_array_equal(straight.colour, plain.colour)


def test_what_cannot_be_left_out_is_refused():
    spec = dataclasses.replace(
        STATIC, warp=TINY_WARP, time=TimeSpec(), appearance=AppearanceSpec()
    )
    with pytest.raises(ValueError, match=r"no effect 'elastic'.*warp"):
        scene.field(spec, METADATA, without=("elastic",))
    for name in ("time", "appearance"):
        with pytest.raises(ValueError, match="feeds the template"):
            scene.field(spec, METADATA, without=(name,))


def test_wrong_specs_are_refused_early():
    with pytest.raises(ValueError, match="there is none"):
        dataclasses.replace(STATIC, elastic=ElasticSpec())
    with pytest.raises(ValueError, match="coarse=1"):
        SamplingSpec(coarse=1)
    with pytest.raises(ValueError, match="spacing='log'"):
        SamplingSpec(spacing="log")
    with pytest.raises(ValueError, match="rays=0"):
        dataclasses.replace(STATIC, rays=0)
    with pytest.raises(ValueError, match="learning_rate_end"):
        dataclasses.replace(STATIC, learning_rate=1e-4, learning_rate_end=1e-3)
    spec = dataclasses.replace(STATIC, warp=TINY_WARP, background=BackgroundSpec())
    with pytest.raises(ValueError, match="background=none"):
        scene.build(spec, METADATA)


@pytest.mark.slow
def test_gradient_of_a_whole_step(float64):
    # One level and no elastic term: where fine samples lie and how elastic samples are
    # weighed depends on the parameters, and by design no gradient says so.
    spec = dataclasses.replace(
        NERFIES,
        sampling=SamplingSpec(8, 0),
        elastic=None,
        ambient=AmbientSpec(depth=1, width=4, skips=(), closed_steps=1, anneal_steps=4),
    )
    model, state, frames = started(spec)
    metadata = model.spec[1]
    made = scene.field(spec, metadata)
    as_float64 = functools.partial(
        jax.tree.map,
        lambda x: x.astype(float64) if x.dtype == jnp.float32 else x,
    )
    frames = as_float64(frames)
    batch = scene.draw_batch(frames, 6, jax.random.key(1))
    # Not the first state: zero displacements would leave terms without slope.
    params = jax.tree.map(
        lambda x: (
            x + 0.05 * jnp.sin(jnp.arange(x.size, dtype=float64)).reshape(x.shape)
        ),
        as_float64(state.params),
    )

    def loss(params):
        terms = scene.loss_terms(
            made, params, frames, batch, jnp.int32(4), jax.random.key(2)
        )
        return weighted_sum(terms)

    assert gradients.directional_error(loss, params) < 1e-5


@pytest.mark.parametrize("levels", [1, 2])
def test_shared_and_single_levels(levels):
    plan = SamplingSpec(8, 8 if levels == 2 else 0, shared=levels == 2)
    spec = dataclasses.replace(STATIC, sampling=plan)
    field = scene.field(spec, METADATA)
    params = field.init(jax.random.key(0))
    assert set(params["template"]) == {"fine"}
    found = jax.jit(field.render_ray)(
        params, ray_of("float32"), condition_of("float32")
    )
    assert len(found) == levels


@pytest.mark.full
def test_a_step_repeats_itself_and_counts():
    model, state, frames = started(NERFIES)
    step = jax.jit(model.step)
    one, _ = step(state, frames)
    other, _ = step(state, frames)
    assert isinstance(one, TrainState)
    assert int(one.step) == 1
    for a, b in zip(
        jax.tree.leaves(one.params), jax.tree.leaves(other.params), strict=True
    ):
        np.testing.assert_array_equal(a, b)


@pytest.mark.full
def test_an_unfilmed_pixel_teaches_nothing():
    _, state, frames = started(STATIC)
    model = started(STATIC)[0]
    nothing = frames._replace(valid=jnp.zeros(frames.images.shape[:3], bool))
    _, metrics = jax.jit(model.step)(state, nothing)
    assert float(metrics["loss"]) == 0


def test_codes_of_one_table_must_agree():
    wide = dataclasses.replace(TINY_WARP, code_width=5)
    spec = dataclasses.replace(STATIC, warp=wide, time=TimeSpec(condition="code"))
    with pytest.raises(ValueError, match="code_width"):
        scene.field(spec, METADATA)


def test_blend_of_codes_is_what_look_up_uses():
    table = jnp.arange(6.0).reshape(3, 2)
    np.testing.assert_allclose(
        codes.blend(table, jnp.int32(0), jnp.int32(2), jnp.float32(0.5)), [2, 3]
    )
