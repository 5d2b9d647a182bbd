"""A spec becomes a field and a model: rays, codes, levels, the step."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import evaluation
from nerfies_jax.capture import synthetic
from nerfies_jax.capture.capture import PointCloud
from nerfies_jax.capture.scene_metadata import SceneMetadata
from nerfies_jax.capture.synthetic import rendering
from nerfies_jax.fields import compositing, field_ray
from nerfies_jax.fields.effects.ambient import AmbientSpec
from nerfies_jax.fields.effects.appearance import AppearanceSpec
from nerfies_jax.fields.effects.background import BackgroundSpec
from nerfies_jax.fields.effects.moving_mask import MovingMaskSpec
from nerfies_jax.fields.effects.scene_flow import SceneFlowSpec
from nerfies_jax.fields.effects.transient import TransientSpec
from nerfies_jax.fields.effects.warp import WarpSpec
from nerfies_jax.fields.spec import SamplingSpec
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.planes import PlanesSpec
from nerfies_jax.scene import presets, scene
from nerfies_jax.scene import steps as field_steps
from nerfies_jax.scene.scene import RadianceScene
from nerfies_jax.training import loop
from nerfies_jax.training.effects import FrameCondition, weighted_sum
from nerfies_jax.training.model import View
from tests import gradients, random_params, scenes
from tests.oracles import networks

TINY_TEMPLATE = TemplateSpec(
    position=EncodingSpec(3),
    direction=EncodingSpec(1),
    depth=2,
    width=16,
    skips=(),
    color_width=8,
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
METADATA = SceneMetadata(
    near=1.0,
    far=3.0,
    center=(0.5, 0.0, -0.5),
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
    init = jax.jit(lambda key: model.init(capture, key))  # or each array is a program
    return model, init(jax.random.key(3)), frames


@functools.cache
def rendered(spec):
    model, state, _ = started(spec)
    capture = scenes.tiny_capture()
    view = evaluation.view_of(capture, 0)
    return jax.jit(lambda p: model.render(p, view, (13, 7), jnp.int32(0)))(state.params)


def ray_of(dtype):
    return field_ray.Ray(
        jnp.asarray([0.1, -0.2, 0.3], dtype),
        jnp.asarray([0.6, 0.0, 0.8], dtype),
        jnp.asarray(0.5, dtype),
        jnp.asarray(1.5, dtype),
    )


def condition_of(dtype, **codes):
    codes = {name: jnp.asarray(code, dtype) for name, code in codes.items()}
    return FrameCondition(jnp.asarray(0.4, dtype), codes, jnp.int32(0))


def test_training_a_static_field_lowers_the_loss():
    model, state, frames = started(STATIC)
    assert set(state.params) == {"template", "codes"}
    assert state.params["codes"] == {}
    assert frames.points is None
    assert frames.depths is None
    assert model.required_data == frozenset()
    step, trace = jax.jit(model.step), []
    for _ in range(40):
        state, metrics = step(state, frames)
        trace.append(float(metrics["mse"]))
    assert set(metrics) == {"loss", "mse", "coarse", "fine"}
    assert np.mean(trace[-8:]) < 0.8 * np.mean(trace[:8]), trace


@pytest.mark.parametrize(
    ("union", "behind", "samples"),
    [(True, (1.0, 1.0, 1.0), 16), (False, (0.0, 1.0, 0.5), 8), (False, None, 9)],
)
def test_a_static_level_is_the_plain_nerf(union, behind, samples, dtype):
    plan = dataclasses.replace(STATIC.sampling, union=union)
    metadata = dataclasses.replace(METADATA, background=behind)
    field = scene.field(dataclasses.replace(STATIC, sampling=plan), metadata)
    ray = ray_of(dtype)
    params = random_params.like(field.init, dtype)
    levels = jax.jit(field.render_ray)(params, ray, condition_of(dtype))
    coarse, fine = jax.tree.map(np.asarray, levels)
    assert fine.color.dtype == dtype
    even = np.linspace(0.5, 1.5, 8)
    expected = plain_nerf(params["template"]["coarse"], ray, even, behind)
    tolerance = {"float32": 3e-6, "float64": 1e-12}[dtype]
    np.testing.assert_allclose(coarse.color, expected, atol=tolerance)
    expected = plain_nerf(params["template"]["fine"], ray, fine.distances, behind)
    np.testing.assert_allclose(fine.color, expected, atol=tolerance)
    assert len(fine.distances) == samples
    if behind is None:
        assert fine.distances[-1] == ray.far
        assert fine.spacing[-1] == compositing.AT_INFINITY
        assert fine.background is None
    else:
        whole = float(ray.far) - fine.distances[0]
        np.testing.assert_allclose(fine.spacing.sum(), whole, rtol=1e-6)
        np.testing.assert_array_equal(fine.background, np.asarray(behind, dtype))
    assert np.all(np.diff(fine.distances) >= 0)


def test_a_transient_medium_ends_at_the_far_plane(dtype):
    """A density of 1e-5 would be opaque over the interval behind it."""
    thin = TransientSpec(code_width=2, depth=1, width=8, density_bias=-12.0)
    spec = dataclasses.replace(STATIC, transient=thin)
    field = scene.field(spec, dataclasses.replace(METADATA, background=None))
    params = random_params.like(field.init, dtype)
    ray, condition = ray_of(dtype), condition_of(dtype, transient=np.zeros(2))
    output = jax.jit(field.render_ray)(params, ray, condition)[-1]
    share = np.asarray(output.media_weight["transient"], float)
    ends = np.append(output.distances[1:], ray.far)
    depth = output.media["transient"].density * (ends - output.distances)
    assert 0 < share.sum() <= 1.01 * depth.sum() < 1e-2
    # The static field is still opaque there.
    np.testing.assert_allclose(np.sum(output.static_weight), 1, atol=1e-2)


def plain_nerf(net, ray, distances, behind):
    """One ray of the two-layer field in NumPy, in float64; `behind` it a color."""
    origin, direction, _, far = networks.exact(tuple(ray))
    color, passing = np.zeros(3), 1.0
    view = networks.waves(TINY_TEMPLATE.direction, direction)
    ends = np.append(distances[1:], 1e10 if behind is None else far)
    for distance, end in zip(distances, ends, strict=True):
        point = origin + distance * direction
        heads = networks.heads(net.trunk, networks.waves(TINY_TEMPLATE.position, point))
        beside = np.concatenate([heads["bottleneck"], view])
        shade = 1 / (1 + np.exp(-networks.heads(net.color, beside)["color"]))
        alpha = 1 - np.exp(-np.logaddexp(0, heads["density"][0]) * (end - distance))
        color = color + passing * alpha * shade
        passing = passing * (1 - alpha)
    return color if behind is None else color + passing * np.asarray(behind)


@pytest.mark.full
def test_blocks_of_rays_do_not_show_in_an_image():
    # 91 pixels in blocks of 97 and 10
    plan = dataclasses.replace(STATIC.sampling, block=10)
    whole, other = (
        rendered(STATIC),
        rendered(dataclasses.replace(STATIC, sampling=plan)),
    )
    # Another tiling of the matrix products moves last bits
    np.testing.assert_allclose(whole.color, other.color, atol=1e-6)
    np.testing.assert_allclose(whole.depth, other.depth, rtol=1e-5)


def test_the_estimate_of_memory_counts_each_sample_of_each_network():
    """A medium at three times, and no sample of a single level twice."""
    capture = scenes.tiny_capture()

    def floats(**changes):
        spec = dataclasses.replace(STATIC, **changes)
        rest = scene.estimate_memory_bytes(dataclasses.replace(spec, rays=1), capture)
        more = scene.estimate_memory_bytes(dataclasses.replace(spec, rays=2), capture)
        return (more - rest) // 12  # three of four bytes

    one, two, three = (SamplingSpec(8, fine) for fine in (0, 8, 5))
    net = 2 * 16 + 8
    assert floats(sampling=one) == 8 * net
    assert floats(sampling=two) == (8 + 16) * net
    apart = dataclasses.replace(three, union=False)
    assert floats(sampling=apart) == (8 + 5) * net
    bent = {"warp": TINY_WARP, "ambient": AmbientSpec(depth=3, width=4, skips=())}
    bent["mask"] = MovingMaskSpec(depth=1, width=5, skips=())
    assert floats(sampling=one, **bent) == 8 * (net + 2 * 8 + 3 * 4 + 5)
    transient = TransientSpec(depth=1, width=8)
    assert floats(transient=transient) == (8 + 16) * net + 16 * 8
    flow = SceneFlowSpec(TINY_TEMPLATE, flow_trunk=True)
    assert floats(sampling=one, scene_flow=flow) == 8 * net + 3 * 8 * (net + 2 * 16)
    planes = PlanesSpec(multiples=(1, 2), timestamps=3, features=4)
    flow = SceneFlowSpec(dataclasses.replace(TINY_TEMPLATE, position=planes))
    corners = 2 * 6 * 4 * 4
    assert floats(sampling=one, scene_flow=flow) == 8 * net + 24 * (net + corners)


@pytest.mark.slow
def test_a_step_takes_no_more_memory_than_the_estimate():
    """And not much less. Measured: 0.76 of it; of small presets 0.57 to 1.02."""
    capture, spec = scenes.tiny_capture(), presets.PRESETS["nsff-grid-small"]
    spec = dataclasses.replace(spec, micro_batches=1, rays=256)
    model = scene.build(spec, scene.metadata_of(capture, spec))
    frames = evaluation.frames_of(capture, model.required_data)
    state = jax.eval_shape(lambda key: model.example(capture, key), jax.random.key(0))
    program = jax.jit(model.step).lower(state, frames).compile()
    temporary = program.memory_analysis().temp_size_in_bytes
    assert 0.5 < temporary / scene.estimate_memory_bytes(spec, capture) < 1.1


@pytest.mark.slow
def test_memory_of_a_render_does_not_grow_with_the_image():
    model, state, _ = started(STATIC)
    view = evaluation.view_of(scenes.tiny_capture(), 0)

    def temporaries(size):
        draw = jax.jit(lambda p: model.render(p, view, size, jnp.int32(0)))
        return draw.lower(state.params).compile().memory_analysis().temp_size_in_bytes

    small, large = temporaries((40, 40)), temporaries((160, 160))
    pixels = 160 * 160 - 40 * 40
    # Positions in and color, alpha and depth out, each at most copied once
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
    image = jax.jit(lambda p: model.render(p, view, (9, 7), jnp.int32(0)))(params)
    np.testing.assert_allclose(image.depth, metadata.near, rtol=1e-4)
    np.testing.assert_allclose(image.alpha, 1, atol=1e-6)


def codes_by(field, dtype):
    """Tables, and codes at times and for exposures, in one program a field."""
    params = random_params.like(field.init, dtype)
    at = jax.jit(
        jax.vmap(lambda p, *seen: field.codes_at(p, View(None, *seen)), (None, 0, 0))
    )
    return jax.tree.map(np.asarray, params["codes"]), lambda times, exposures: at(
        params, np.asarray(times, dtype), np.asarray(exposures, np.int32)
    )


def test_a_code_is_its_row_at_its_own_time_and_between_rows_elsewhere(dtype):
    spec = dataclasses.replace(STATIC, warp=TINY_WARP)
    tables, at = codes_by(scene.field(spec, METADATA), dtype)
    table = tables["motion"]
    assert table.shape == (3, TINY_WARP.code_width)
    codes = np.asarray(at([*METADATA.times, -1.0, 7.0, 0.4], [0] * 6)["motion"])
    np.testing.assert_array_equal(codes[:5], table[[0, 1, 2, 0, 2]])
    between = 0.8 * table[1] + 0.2 * table[2]
    np.testing.assert_allclose(codes[5], between, rtol=1e-6)


def test_an_exposure_that_was_not_learned_lies_between_its_neighbors(float64):
    spec = dataclasses.replace(STATIC, appearance=AppearanceSpec(width=2))
    tables, at = codes_by(scene.field(spec, METADATA), "float64")
    table = tables["appearance"]
    assert table.shape == (2, 2)  # only what is learned from has a row
    (code,) = at([0.0], [2])["appearance"]
    np.testing.assert_allclose(code, 0.75 * table[0] + 0.25 * table[1], atol=1e-7)


def test_facts_place_held_out_exposures_by_time():
    capture = scenes.tiny_capture()
    metadata = scene.metadata_of(capture, STATIC)
    learned = set(capture.appearance_ids[capture.train].tolist())
    rows = [metadata.exposures[one] for one in sorted(learned)]
    assert sorted(left for left, right, _ in rows) == list(range(len(learned)))
    assert all(left == right for left, right, _ in rows)
    assert max(max(left, right) for left, right, _ in metadata.exposures) < len(learned)
    assert metadata.times == tuple(sorted(set(capture.times[capture.train].tolist())))


def test_the_observed_volume_fills_the_box():
    capture = scenes.tiny_capture()
    metadata = scene.metadata_of(capture, STATIC)
    inside = (capture.points.position - np.asarray(metadata.center)) * metadata.scale
    # Outliers of structure from motion may lie outside
    assert np.mean(np.abs(inside) <= 1) > 0.9
    assert np.abs(inside).max() > 0.5
    own = scene.metadata_of(capture, dataclasses.replace(STATIC, extent=None))
    assert own.scale == 1
    assert own.center == (0, 0, 0)


def test_the_subject_of_scattered_photographs_fills_the_box():
    capture = scenes.tiny_capture()
    photographs = dataclasses.replace(
        synthetic.PRESETS["collection"],
        size=capture.size,
        frames=len(capture.train),
        heldout_every=len(capture.train) // len(capture.heldout),
    )
    views = rendering.schedule(photographs, seed=0).cameras
    views = cameras.take(views, np.arange(len(capture.ids)))
    capture = dataclasses.replace(capture, cameras=views)
    rng = np.random.default_rng(0)
    subject = rng.uniform(-0.05, 0.05, (400, 3)).astype(np.float32)
    around = rng.uniform(-2, 2, (400, 3)).astype(np.float32)
    position = np.concatenate([subject, around])
    points = PointCloud(position, np.zeros((800, 3), np.uint8))
    capture = dataclasses.replace(capture, points=points)
    spec = dataclasses.replace(STATIC, volume="subject")
    metadata = scene.metadata_of(capture, spec)
    inside = (subject - np.asarray(metadata.center)) * metadata.scale
    assert 0.3 < np.abs(inside).max() < 1
    assert scene.metadata_of(capture, STATIC).scale < metadata.scale / 3
    # Samples of the first level are dense there, and those of a video are even.
    view = jax.tree.map(jnp.asarray, cameras.take(views, 0))
    whole = dataclasses.replace(metadata, near=0.3, far=4.0)
    field_ray_, _ = field_ray.field_ray_through(whole, view, jnp.float32([20, 15]))
    centered = dataclasses.replace(
        spec, sampling=dataclasses.replace(spec.sampling, coarse=32, spacing="center")
    )
    distance = field_ray.first_distances(centered, field_ray_, None, None)
    point = field_ray_.origin + distance[:, None] * field_ray_.direction
    assert np.mean(np.abs(point).max(axis=1) < 1.5) > 0.4


@pytest.mark.slow
def test_gradient_of_a_whole_step(float64):
    # One level and no elastic term: where fine samples lie and how elastic samples are
    # weighed depends on the parameters, and by design no gradient says so.
    spec = dataclasses.replace(
        STATIC,
        sampling=SamplingSpec(8, 0),
        warp=TINY_WARP,
        appearance=AppearanceSpec(width=2),
        background=BackgroundSpec(points=16),
        ambient=AmbientSpec(depth=1, width=4, skips=(), closed_steps=1, anneal_steps=4),
    )
    model, _, frames = started(spec)
    field = scene.field(spec, model.spec[1])
    frames = jax.tree.map(
        lambda x: x.astype(float64) if x.dtype == jnp.float32 else x, frames
    )
    batch = field_steps.draw_batch(frames, 6, jax.random.key(1))

    def loss(params):
        terms = field_steps.loss_terms(
            field, params, frames, batch, jnp.int32(4), jax.random.key(2)
        )
        return weighted_sum(terms)

    # Not the first state: zero displacements would leave terms without slope.
    params = random_params.like(field.init, "float64", 0.05)
    assert gradients.directional_error(loss, params) < 1e-5


def test_a_curriculum_adds_the_frames_in_the_order_of_time(rng):
    """As many as in the loop of the published code, and rays of all of these."""
    _, state, frames = started(STATIC)
    times = rng.permutation(12).astype(np.float32) / 11
    some = rng.integers(0, len(frames.times), 12)
    many = frames._replace(
        times=times,
        images=np.asarray(frames.images)[some],
        cameras=jax.tree.map(lambda leaf: np.asarray(leaf)[some], frames.cameras),
    )
    spec = dataclasses.replace(STATIC, curriculum_steps=100)
    radiance = scene.field(spec, METADATA)

    @jax.jit
    def rows(step, many):
        now = state._replace(step=step)
        keys = jax.random.split(jax.random.key(5), 4)
        rays = [field_steps.micro_batch(radiance, now, many, key)[0] for key in keys]
        return jnp.concatenate([one.row for one in rays])

    for step in (0, 24, 26, 50, 90, 99, 100, 1000):
        number = 12 if step >= 100 else max(int(step / 100 * 12), 3)
        drawn_from = np.unique(rows(jnp.int32(step), many))
        np.testing.assert_array_equal(drawn_from, np.sort(np.argsort(times)[:number]))


def test_more_rays_are_of_moving_objects_at_first():
    """Where masks have them: a third, in addition to their share of the pixels."""
    flow = SceneFlowSpec(
        network=TINY_TEMPLATE, time=EncodingSpec(2), moving_rays=1 / 3, decay_steps=10
    )
    spec = dataclasses.replace(STATIC, rays=3000, scene_flow=flow)
    _, state, frames = started(STATIC)
    radiance = scene.field(spec, METADATA)
    shape = frames.images.shape[:3]
    masks = np.zeros(shape, bool)
    masks[1:, : shape[1] // 2, : shape[2] // 3] = True

    @jax.jit
    def rays(step, masks):
        now, seen = state._replace(step=step), frames._replace(moving=masks)
        batch, _ = field_steps.micro_batch(radiance, now, seen, jax.random.key(1))
        column, line = jnp.floor(batch.pixel).astype(jnp.int32).T
        return batch.row, line, column, batch.color

    for step, share in ((0, 1 / 3), (9, 1 / 3), (10, 0.0)):
        row, line, column, color = map(np.asarray, rays(jnp.int32(step), masks))
        moves = masks[row, line, column]
        expected = share + (1 - share) * masks.mean()
        assert abs(moves.mean() - expected) < 0.04
        # A ray misses them with a probability of up to 0.88^32 = 0.02.
        assert share == 0 or moves[: round(share * 3000)].mean() > 0.96
        assert len(np.unique(row[moves])) == shape[0] - 1
        images = np.asarray(frames.images)
        np.testing.assert_allclose(color, images[row, line, column] / 255, atol=1e-6)
    # Nothing moves: the rays are as without it.
    row, *_ = rays(jnp.int32(0), np.zeros(shape, bool))
    draw = jax.jit(field_steps.draw_batch, static_argnums=1)
    uniform = draw(frames, 3000, jax.random.key(1))
    np.testing.assert_array_equal(row, uniform.row)


@pytest.mark.parametrize("levels", [1, 2])
def test_shared_and_single_levels(levels):
    plan = SamplingSpec(8, 8 if levels == 2 else 0, shared=levels == 2)
    field = scene.field(dataclasses.replace(STATIC, sampling=plan), METADATA)
    params = jax.eval_shape(field.init, jax.random.key(0))
    assert set(params["template"]) == {"fine"}
    inputs = ray_of("float32"), condition_of("float32")
    assert len(jax.eval_shape(field.render_ray, params, *inputs)) == levels


@pytest.mark.full
def test_an_unobserved_pixel_teaches_nothing():
    model, state, frames = started(STATIC)
    nothing = frames._replace(valid=np.zeros(frames.images.shape[:3], bool))
    _, metrics = jax.jit(model.step)(state, nothing)
    assert float(metrics["loss"]) == 0


@pytest.mark.parametrize(("logit", "without"), [(-60.0, ("scene_flow",)), (60.0, ())])
def test_a_medium_has_the_share_that_it_is_given(logit, without):
    """All to what is static is the static field; all to the medium hides that."""
    spec = dataclasses.replace(
        STATIC, scene_flow=SceneFlowSpec(network=TINY_TEMPLATE, time=EncodingSpec(2))
    )
    metadata = scene.metadata_of(scenes.tiny_capture(), spec)
    field = scene.field(spec, metadata)
    ray = field_ray.field_ray(
        metadata, *(jnp.asarray(x) for x in ([0.0, 0, 0], [0.0, 0, 1])), jnp.float32(1)
    )
    condition = FrameCondition(jnp.float32(0.3), {}, jnp.int32(0))

    @jax.jit
    def both(key):
        params = field.init(key)
        flow = params["scene_flow"]
        blend = flow.blend._replace(bias=jnp.full_like(flow.blend.bias, logit))
        params["scene_flow"] = flow._replace(blend=blend)
        other = scene.field(spec, metadata, without)
        moved = jax.tree.map(lambda leaf: leaf + 1, params["template"])
        changed = params if without else params | {"template": moved}
        return (
            field.render_ray(params, ray, condition)[-1].color,
            other.render_ray(changed, ray, condition)[-1].color,
        )

    # Samples go where the changed coarse level sends them.
    np.testing.assert_allclose(*both(jax.random.key(0)), atol=1e-3)


@pytest.mark.full
def test_micro_batches_go_down_the_mean_of_all_rays():
    _, state, frames = started(STATIC)
    field = scene.field(STATIC, METADATA)

    def mean_slope(parts):
        spec = dataclasses.replace(STATIC, micro_batches=parts)
        model = scene.build(spec, METADATA)
        after, metrics = jax.jit(model.step)(state, frames)
        return after.optimizer.mu, metrics["loss"]

    def part(index):
        key = jax.random.fold_in(loop.step_key(state), index)
        batch_key, field_key = jax.random.split(key)
        batch = field_steps.draw_batch(frames, STATIC.rays // 2, batch_key)

        def loss(params):
            return weighted_sum(
                field_steps.loss_terms(
                    field, params, frames, batch, state.step, field_key
                )
            )

        return jax.jit(jax.value_and_grad(loss))(state.params)

    moment, loss = mean_slope(2)
    (one, first), (other, second) = part(0), part(1)
    np.testing.assert_allclose(loss, (one + other) / 2, rtol=1e-5)
    for actual, a, b in zip(
        *map(jax.tree.leaves, (moment, first, second)), strict=True
    ):
        # Adam's first moment after one step is a tenth of the slope.
        np.testing.assert_allclose(actual, 0.05 * (a + b), rtol=1e-4, atol=1e-7)
