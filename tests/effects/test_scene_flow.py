"""The time-varying medium: a loop over rays in NumPy, a wall that moves, the edges."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.capture.flow import FrameFlow
from nerfies_jax.effects import scene_flow
from nerfies_jax.effects.effect import Batch, Box, Context, Level, Moment, Sample
from nerfies_jax.effects.scene_flow import FlowWeights, SceneFlowSpec
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.radiance.template import TemplateSpec
from nerfies_jax.training.model import Frames
from tests import gradients

TINY = SceneFlowSpec(
    network=TemplateSpec(
        EncodingSpec(2), EncodingSpec(1), depth=2, width=8, skips=(1,), colour_width=6
    ),
    time=EncodingSpec(1),
    flow_bound=0.3,
    decay_steps=100,
)
MOMENTS, RAYS, SAMPLES, FEATURES = 4, 6, 5, 7
SIZE = (8, 6)
ROWS = [0, 3, 1, 2, 2, 1]  # of the rays; rows are moments here
BOX_SCALE, BOX_CENTRE = 0.5, (0.2, -0.1, 2.0)


def frames_and_batch(rng, dtype):
    """Four frames of one camera that moves, with depth and flow, and six rays."""
    width, height = SIZE
    filmed = cameras.stack(
        [
            cameras.look_at([0.1 * k, 0, -2.0], [0, 0, 2.0], [0, 1, 0], 9.0, SIZE)
            for k in range(MOMENTS)
        ]
    )
    shape = (MOMENTS, height, width)
    flow = FrameFlow(
        forward=rng.normal(size=(*shape, 2)).astype(np.float32),
        forward_seen=rng.uniform(size=shape) < 0.8,
        next_row=np.minimum(np.arange(MOMENTS) + 1, MOMENTS - 1).astype(np.int32),
        backward=rng.normal(size=(*shape, 2)).astype(np.float32),
        backward_seen=rng.uniform(size=shape) < 0.8,
        previous_row=np.maximum(np.arange(MOMENTS) - 1, 0).astype(np.int32),
    )
    depths = rng.uniform(2, 5, shape).astype(np.float32)
    frames = Frames(
        images=None,
        cameras=jax.tree.map(lambda leaf: leaf.astype(dtype), filmed),
        # the third is filmed a little late, and the flow stretched to it
        times=np.array([0, 1 / 3, 0.7, 1], dtype),
        warp=np.arange(MOMENTS, dtype=np.int32),
        appearance=np.arange(MOMENTS, dtype=np.int32),
        valid=None,
        depths=np.where(depths < 2.3, 0, depths),
        flow=flow,
    )
    row = np.array(ROWS, np.int32)
    pixel = rng.integers(0, SIZE, (RAYS, 2)) + 0.5
    offset = (pixel - np.array(SIZE) / 2) / 9.0
    inside = np.concatenate([offset, np.ones((RAYS, 1))], 1)
    cosine = 1 / np.linalg.norm(inside, axis=1)
    turn = filmed.camera_from_world[row]
    direction = np.einsum("rki,rk->ri", turn, inside) * cosine[:, None]
    batch = Batch(
        row=row,
        pixel=pixel.astype(dtype),
        origin=filmed.position[row].astype(dtype),
        direction=direction.astype(dtype),
        cosine=cosine.astype(dtype),
        colour=rng.uniform(size=(RAYS, 3)).astype(dtype),
        valid=np.array([True, True, True, False, True, True]),
    )
    return jax.tree.map(jnp.asarray, (frames, batch))


def context_of(spec, params, frames, batch, distance, features, weight, step):
    """The rays as the scene renders them, as far as the penalty reads it."""
    centre = jnp.asarray(BOX_CENTRE, distance.dtype)
    origin = (batch.origin - centre) * BOX_SCALE
    point = origin[:, None] + distance[..., None] * batch.direction[:, None]
    moments = Moment(frames.times[batch.row], {}, jnp.full(RAYS, step))

    def at(point, features, direction, moment):
        return scene_flow.medium(
            spec, params, Sample(point, direction, features), moment
        )

    media = jax.vmap(jax.vmap(at, (0, 0, None, None)))(
        point, features, batch.direction, moments
    )
    none = jnp.zeros(RAYS, distance.dtype)
    level = Level(
        distance=distance,
        point=point,
        warped=point,
        static_weight=jnp.zeros_like(weight),
        media={"scene_flow": media},
        media_weight={"scene_flow": weight},
        colour=batch.colour,
        alpha=none,
        depth=none,
        median_depth=none,
        beta=None,
    )
    return Context(
        displace=None,
        moment_of=None,
        moments=moments,
        batch=batch,
        levels=(level,),
        frames=frames,
        box=Box(centre, jnp.asarray(BOX_SCALE, distance.dtype)),
        step=jnp.asarray(step),
        key=jax.random.key(0),
    )


@functools.cache
def scenario(dtype):
    """Parameters and the rest, with nothing next to zero."""
    rng = np.random.default_rng(4)
    frames, batch = frames_and_batch(rng, dtype)
    params = scene_flow.init(TINY, jax.random.key(1), FEATURES, jnp.dtype(dtype))
    params = jax.tree.map(
        lambda x: x + jnp.asarray(0.4 * rng.normal(size=x.shape), dtype), params
    )
    distance = np.sort(rng.uniform(1.0, 3.0, (RAYS, SAMPLES)), 1)
    features = rng.normal(size=(RAYS, SAMPLES, FEATURES))
    weight = rng.uniform(0, 0.25, (RAYS, SAMPLES))
    arrays = [jnp.asarray(x, dtype) for x in (distance, features, weight)]
    return params, frames, batch, arrays


@functools.partial(jax.jit, static_argnums=0)
def terms_of(spec, params, frames, batch, arrays, step):
    context = context_of(spec, params, frames, batch, *arrays, step)
    gap = scene_flow.interval(MOMENTS)
    return scene_flow.penalty(spec, gap, params, context)


# --- an oracle: NumPy, one ray and one sample at a time


def encode(bands, x):
    waves = [w(2.0**k * x) for k in range(bands) for w in (np.sin, np.cos)]
    return np.concatenate([x, *waves])


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def dynamic(params, point, direction, time):
    """Density, colour, flow [2, 3], disocclusion [2] by the published network."""
    features = np.concatenate([encode(2, point), encode(1, np.array([2 * time - 1]))])
    first, second = params.network.trunk.hidden
    hidden = np.maximum(features @ first.weight + first.bias, 0)
    hidden = np.concatenate([hidden, features])
    hidden = np.maximum(hidden @ second.weight + second.bias, 0)
    heads = params.network.trunk.heads
    raw = (hidden @ heads["density"].weight + heads["density"].bias)[0]
    bottleneck = hidden @ heads["bottleneck"].weight + heads["bottleneck"].bias
    branch = np.concatenate([bottleneck, encode(1, direction)])
    layer, head = params.network.colour.hidden[0], params.network.colour.heads["colour"]
    branch = np.maximum(branch @ layer.weight + layer.bias, 0)
    colour = sigmoid(branch @ head.weight + head.bias)
    flow = 0.3 * np.tanh(hidden @ params.flow.weight + params.flow.bias)
    hidden_share = hidden @ params.disocclusion.weight + params.disocclusion.bias
    return np.log1p(np.exp(raw)), colour, flow.reshape(2, 3), sigmoid(hidden_share)


def composite(density, distance):
    weights, light = [], 1.0
    for s in range(SAMPLES):
        length = distance[s + 1] - distance[s] if s + 1 < SAMPLES else 1e10
        weights.append(light * (1 - np.exp(-density[s] * length)))
        light *= np.exp(-density[s] * length)
    return np.array(weights)


def weighted(pairs):
    """Mean of (value, weight) pairs."""
    total = sum(weight for _, weight in pairs)
    return sum(value * weight for value, weight in pairs) / total


def oracle(params, frames, batch, arrays, step):
    """All terms as sums over rays and samples."""
    params, frames, batch = jax.tree.map(
        lambda x: np.asarray(x, np.float64) if x.dtype.kind == "f" else np.asarray(x),
        (params, frames, batch),
    )
    distances, features, blend_weight = (np.asarray(x, np.float64) for x in arrays)
    sides = ("cycle", "warped", "hidden", "magnitude", "smooth", "flow")
    names = ["dynamic", "kinetic", "entropy", *(f"{n}{k}" for n in sides for k in "01")]
    lists = {name: [] for name in names}
    depths = []
    for r in range(RAYS):
        row, distance = batch.row[r], distances[r]
        time, direction = frames.times[row], batch.direction[r]
        origin = (batch.origin[r] - BOX_CENTRE) * BOX_SCALE
        points = [origin + d * direction for d in distance]
        here = [dynamic(params, x, direction, time) for x in points]
        weight = composite([h[0] for h in here], distance)
        mask = float(batch.valid[r])
        if step >= 100:
            mask *= blend_weight[r].sum()
        colour = sum(w * h[1] for w, h in zip(weight, here, strict=True))
        lists["dynamic"].append((np.mean((colour - batch.colour[r]) ** 2), mask))
        column, line = int(batch.pixel[r, 0]), int(batch.pixel[r, 1])
        for s in range(SAMPLES):
            logit = features[r, s] @ params.blend.weight[:, 0] + params.blend.bias[0]
            share = sigmoid(logit)
            lists["entropy"].append((-share * np.log(share), 1))
        expected = weight @ distance * batch.cosine[r] / BOX_SCALE
        known = frames.depths[row, line, column]
        if known > 0 and batch.valid[r]:
            depths.append((expected, known))
        flows = np.array([h[2] for h in here])  # samples, sides, axes
        for side in (0, 1):
            later = time + (1, -1)[side] / 3
            if not -1 / 6 < later < 1 + 1 / 6:
                continue
            moved = [x + f for x, f in zip(points, flows[:, side], strict=True)]
            there = [dynamic(params, x, direction, later) for x in moved]
            w = composite([t[0] for t in there], distance)
            seen = 1 - np.array([h[3][side] for h in here])
            colour = sum(a * t[1] for a, t in zip(w, there, strict=True))
            error = np.mean((colour - batch.colour[r]) ** 2)
            lists[f"warped{side}"].append((error, mask * (w @ seen)))
            for s in range(SAMPLES):
                around = np.abs(flows[s, side] + there[s][2][1 - side]).mean()
                lists[f"cycle{side}"].append((around, seen[s]))
                lists[f"hidden{side}"].append((1 - seen[s], 1))
            for s in range(SAMPLES - 1):
                change = np.abs(flows[s + 1, side] - flows[s, side]).mean()
                lists[f"smooth{side}"].append((change, 1))
            rendered = np.abs(weight @ flows[:, side]).mean()
            lists[f"magnitude{side}"].append((rendered, 1))
            _flow_pixel(lists, frames, batch, r, side, points, flows, weight)
        if 1 / 6 < time < 1 - 1 / 6:
            for s in range(SAMPLES):
                acceleration = np.mean((flows[s, 0] + flows[s, 1]) ** 2) / 2
                lists["kinetic"].append((acceleration, 1))
    mean = {name: weighted(pairs) for name, pairs in lists.items() if pairs}
    predicted, known = np.array(depths).T
    return {
        "dynamic": mean["dynamic"],
        "warped": mean["warped0"] + mean["warped1"],
        "disocclusion": mean["hidden0"] + mean["hidden1"],
        "cycle": mean["cycle0"] + mean["cycle1"],
        "magnitude": mean["magnitude0"] + mean["magnitude1"],
        "smoothness": mean["smooth0"] + mean["smooth1"],
        "kinetic": mean["kinetic"],
        "entropy": mean["entropy"],
        "depth": np.mean((standard(predicted) - standard(known)) ** 2),
        "flow": mean["flow0"] + mean["flow1"],
    }


def standard(depth):
    median = np.sort(depth)[(len(depth) - 1) // 2]
    return (depth - median) / np.abs(depth - median).mean()


def _flow_pixel(lists, frames, batch, r, side, points, flows, weight):
    row = batch.row[r]
    column, line = int(batch.pixel[r, 0]), int(batch.pixel[r, 1])
    flow = frames.flow
    other = (flow.next_row, flow.previous_row)[side][row]
    shift = (flow.forward, flow.backward)[side][row, line, column]
    seen = (flow.forward_seen, flow.backward_seen)[side][row, line, column]
    if other == row or not seen or not batch.valid[r]:
        return
    stretch = abs(frames.times[other] - frames.times[row]) * 3
    place = sum(
        w * (x + stretch * f)
        for w, x, f in zip(weight, points, flows[:, side], strict=True)
    )
    place = place / BOX_SCALE + np.array(BOX_CENTRE)
    turn, position = (
        frames.cameras.camera_from_world[other],
        frames.cameras.position[other],
    )
    x, y, z = turn @ (place - position)
    pixel = 9.0 * np.array([x, y]) / z + np.array(SIZE) / 2
    lists[f"flow{side}"].append((np.abs(pixel - batch.pixel[r] - shift).mean(), 1))


@pytest.mark.parametrize("step", [0, 250])
def test_terms_are_sums_over_rays_and_samples_one_by_one(dtype, step):
    given = scenario(dtype)
    found = terms_of(TINY, *given, step)
    expected = oracle(*given, step)
    assert set(found) == set(expected)
    for name, value in expected.items():
        # float32 rounds a few ulps of the coordinates, and divides by a deviation
        error = abs(float(found[name].value) - value)
        assert error < {"float32": 3e-5, "float64": 1e-11}[dtype] * max(1, value), name


def test_weights_are_the_spec_s_and_the_capture_s_own_terms_fade(dtype):
    given = scenario(dtype)
    weights = dataclasses.asdict(TINY.weights)
    for step, fade in ((0, 1.0), (99, 1.0), (100, 0.1), (250, 0.01), (10**6, 0.0)):
        for name, term in terms_of(TINY, *given, step).items():
            expected = weights[name] * (fade if name in ("depth", "flow") else 1)
            np.testing.assert_allclose(term.weight, expected, rtol=1e-6, err_msg=name)


@pytest.mark.parametrize("step", [0, 250])
def test_the_whole_penalty_has_the_slope_of_its_differences(float64, step):
    params, frames, batch, arrays = scenario("float64")
    # What is held fixed on purpose has no slope to compare: left out, or its weight is
    # of another medium here.
    weights = dataclasses.replace(TINY.weights, magnitude=0.0, warped=0.0)
    spec = dataclasses.replace(TINY, weights=weights)

    def loss(params, arrays):
        terms = terms_of(spec, params, frames, batch, [*arrays, given_weight], step)
        return sum(term.value for term in terms.values())

    given_weight = arrays[2]
    assert gradients.directional_error(loss, params, arrays[:2], step=1e-6) < 1e-6


def test_terms_with_a_weight_of_zero_are_not_there(float64):
    params, frames, batch, arrays = scenario("float64")
    spec = dataclasses.replace(TINY, weights=FlowWeights(**dict.fromkeys(NAMES, 0.0)))
    assert terms_of(spec, params, frames, batch, arrays, 0) == {}
    assert scene_flow.effect(spec, 4, FEATURES).wants == frozenset()
    only_flow = dataclasses.replace(spec, weights=FlowWeights(depth=0.0))
    assert scene_flow.effect(only_flow, 4, FEATURES).wants == {"flow"}
    assert scene_flow.effect(TINY, 4, FEATURES).wants == {"flow", "depths"}


NAMES = tuple(field.name for field in dataclasses.fields(FlowWeights))


def test_without_depth_and_flow_in_the_capture_their_terms_are_not_there(float64):
    params, frames, batch, arrays = scenario("float64")
    bare = frames._replace(depths=None, flow=None)
    found = terms_of(TINY, params, bare, batch, arrays, 0)
    assert set(found) == set(NAMES) - {"depth", "flow"}


# --- edges of time


def test_the_first_and_the_last_moment_have_one_neighbour(float64):
    params, frames, batch, arrays = scenario("float64")

    def flow_terms(extras):
        context = context_of(TINY, params, frames, batch, *arrays, 0)
        level = context.levels[0]
        own = level.media["scene_flow"]
        own = own._replace(extras={**own.extras, **extras})
        level = level._replace(media={"scene_flow": own})
        terms = scene_flow.penalty(
            TINY, 1 / 3, params, context._replace(levels=(level,))
        )
        return sum(term.value for term in terms.values())

    context = context_of(TINY, params, frames, batch, *arrays, 0)
    extras = context.levels[0].media["scene_flow"].extras
    slope = jax.jit(jax.grad(flow_terms))(extras)
    strength = {name: np.abs(x).sum((1, -1)) for name, x in slope.items()}
    rows = np.array(ROWS)
    for name, missing in (("flow_forward", MOMENTS - 1), ("flow_backward", 0)):
        assert (strength[name][rows == missing] == 0).all()
        assert (strength[name][rows != missing] > 0).all()
    hidden = np.abs(slope["disocclusion"]).sum(1)  # rays, sides
    assert (hidden[rows == MOMENTS - 1, 0] == 0).all()
    assert (hidden[rows == 0, 1] == 0).all()


def test_a_single_moment_has_no_neighbours_and_no_flow_to_learn(dtype):
    params, frames, batch, arrays = scenario(dtype)
    still = frames._replace(times=jnp.zeros_like(frames.times))

    @jax.jit
    def loss(params):
        context = context_of(TINY, params, still, batch, *arrays, 0)
        terms = scene_flow.penalty(TINY, scene_flow.interval(1), params, context)
        return sum(term.weight * term.value for term in terms.values()), terms

    slope, terms = jax.grad(loss, has_aux=True)(params)
    for name in ("warped", "cycle", "disocclusion", "magnitude", "kinetic", "flow"):
        assert terms[name].value == 0, name
    assert terms["dynamic"].value > 0
    assert (slope.flow.weight == 0).all()
    assert (slope.flow.bias == 0).all()
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(slope))


def test_interval_of_moments():
    assert scene_flow.interval(11) == 0.1
    assert scene_flow.interval(1) > 1
    with pytest.raises(ValueError, match="moments=0"):
        scene_flow.interval(0)


# --- a wall that moves sideways


VELOCITY = np.array([0.12, -0.06, 0.0])  # field units from one moment to the next


def wall(velocity=VELOCITY, flow=VELOCITY):
    """A slanted, textured, opaque wall that slides in its own plane; analytic."""

    def at(spec, params, point, direction, time):
        # The wall is z = 0.3 x + 0.6 y, in which the velocity lies.
        depth = point[2] - 0.3 * point[0] - 0.6 * point[1]
        at_start = point - 3 * time * jnp.asarray(velocity, point.dtype)
        colour = 0.5 + 0.4 * jnp.sin(
            jnp.asarray([7.0, 5.0, 3.0], point.dtype) * (at_start[0] - 2 * at_start[1])
        )
        both = jnp.asarray(np.stack([flow, -np.asarray(flow)]), point.dtype)
        # Hidden is nothing: the logit of a probability of 2e-9.
        return scene_flow.Dynamic(
            jnp.where(depth > 0, 1e4, 0.0).astype(point.dtype),
            colour,
            both,
            jnp.full(2, -20.0, point.dtype),
        )

    return at


def filmed_wall(dtype):
    """Rays onto the wall with the pictures, depths and flow that a camera sees."""
    rng = np.random.default_rng(2)
    frames, batch = frames_and_batch(rng, "float64")
    distance = np.linspace(1.2, 3.0, 20)[None] * np.ones((RAYS, 1))
    width, height = SIZE
    forward = np.zeros((MOMENTS, height, width, 2))
    backward = np.zeros_like(forward)
    depths = np.zeros((MOMENTS, height, width))
    colour = np.zeros((RAYS, 3))
    batch = jax.tree.map(np.asarray, batch)
    for r, row in enumerate(ROWS):
        origin = (batch.origin[r] - BOX_CENTRE) * BOX_SCALE
        points = origin + distance[r][:, None] * batch.direction[r]
        inside = points[:, 2] - 0.3 * points[:, 0] - 0.6 * points[:, 1] > 0
        hit = points[np.argmax(inside)]
        assert inside.any()
        assert not inside[0]
        start = hit - 3 * float(frames.times[row]) * VELOCITY
        colour[r] = 0.5 + 0.4 * np.sin(np.array([7, 5, 3]) * (start[0] - 2 * start[1]))
        column, line = int(batch.pixel[r, 0]), int(batch.pixel[r, 1])
        # Twice too deep and off by one: the term is blind to both.
        along = distance[r][np.argmax(inside)] * batch.cosine[r] / BOX_SCALE
        depths[row, line, column] = 2 * along + 1
        for pictures, sign in ((forward, 1), (backward, -1)):
            other = min(max(row + sign, 0), MOMENTS - 1)
            elapsed = 3 * (float(frames.times[other]) - float(frames.times[row]))
            place = (hit + elapsed * VELOCITY) / BOX_SCALE + np.array(BOX_CENTRE)
            turn = np.asarray(frames.cameras.camera_from_world[other])
            x, y, z = turn @ (place - np.asarray(frames.cameras.position[other]))
            pixel = 9.0 * np.array([x, y]) / z + np.array(SIZE) / 2
            pictures[row, line, column] = pixel - batch.pixel[r]
    flow = frames.flow._replace(
        forward=forward,
        backward=backward,
        forward_seen=np.ones_like(frames.flow.forward_seen),
        backward_seen=np.ones_like(frames.flow.backward_seen),
    )
    batch = batch._replace(colour=colour, valid=np.ones(RAYS, bool))
    frames = frames._replace(flow=flow, depths=depths)

    def cast(x):
        x = np.asarray(x)
        return jnp.asarray(x.astype(dtype) if x.dtype.kind == "f" else x)

    arrays = [distance, np.zeros((RAYS, 20, FEATURES)), np.full((RAYS, 20), 0.05)]
    return jax.tree.map(cast, (frames, batch, arrays))


def wall_terms(monkeypatch, dtype, **motion):
    frames, batch, arrays = filmed_wall(dtype)
    params = scene_flow.init(TINY, jax.random.key(0), FEATURES, jnp.dtype(dtype))
    monkeypatch.setattr(scene_flow, "dynamic", wall(**motion))

    @jax.jit  # of this call: the wall is looked up while it is traced
    def values():
        context = context_of(TINY, params, frames, batch, *arrays, 0)
        found = scene_flow.penalty(TINY, 1 / 3, params, context)
        return {name: term.value for name, term in found.items()}

    return jax.tree.map(float, values())


def test_the_true_flow_of_a_moving_wall_costs_nothing(monkeypatch, dtype):
    found = wall_terms(monkeypatch, dtype)
    # float32: pixels to a few ulps of the picture's size
    least = {"float32": 2e-5, "float64": 1e-12}[dtype]
    for name in ("dynamic", "warped", "cycle", "kinetic", "smoothness", "flow"):
        assert found[name] < least, name
    assert found["depth"] < {"float32": 1e-9, "float64": 1e-20}[dtype]
    # of both sides, mean over the axes
    np.testing.assert_allclose(found["magnitude"], 2 * 0.18 / 3, rtol=1e-5)


def test_a_wall_that_is_said_to_stand_still_does_not_look_right(monkeypatch, float64):
    found = wall_terms(monkeypatch, "float64", flow=np.zeros(3))
    assert found["warped"] > 1e-2  # squared sRGB
    assert found["flow"] > 0.3  # px, of two sides
    assert found["cycle"] == 0
    assert found["magnitude"] == 0


# --- the medium


def test_the_medium_starts_still_and_undecided(dtype):
    params = scene_flow.init(TINY, jax.random.key(0), FEATURES, jnp.dtype(dtype))
    point = jnp.asarray([0.3, -0.2, 0.9], dtype)
    sample = Sample(
        point, jnp.asarray([0.0, 0.6, 0.8], dtype), jnp.ones(FEATURES, dtype)
    )
    moment = Moment(jnp.asarray(0.4, dtype), {}, jnp.asarray(0))
    found = scene_flow.medium(TINY, params, sample, moment)
    assert np.abs(found.extras["flow_forward"]).max() < 1e-3 * TINY.flow_bound
    assert np.abs(found.extras["disocclusion"]).max() < 1e-2
    assert abs(found.share) < 1e-2
    assert found.density >= 0


def test_what_is_surely_hidden_keeps_a_slope(dtype):
    params, frames, batch, arrays = scenario(dtype)
    sure = params._replace(
        disocclusion=params.disocclusion._replace(
            weight=jnp.zeros_like(params.disocclusion.weight),
            bias=jnp.full(2, 40.0, jnp.dtype(dtype)),
        )
    )

    @jax.jit
    def visible(params):
        context = context_of(TINY, params, frames, batch, *arrays, 0)
        found = scene_flow.neighbour(TINY, 1 / 3, params, context, scene_flow.FORWARD)
        return jnp.mean(found.visible)

    value, slope = jax.value_and_grad(visible)(sure)
    np.testing.assert_allclose(value, np.exp(-40.0), rtol=2e-5)
    np.testing.assert_allclose(slope.disocclusion.bias, [-np.exp(-40.0), 0], rtol=2e-5)


def test_flow_stays_within_its_bound(dtype):
    params = scenario(dtype)[0]
    wild = params._replace(
        flow=params.flow._replace(bias=jnp.full(6, 1e4, jnp.dtype(dtype)))
    )
    x = jnp.zeros(3, dtype)
    found = scene_flow.dynamic(TINY, wild, x, x, jnp.zeros((), dtype))
    np.testing.assert_allclose(found.flow, 0.3, rtol=1e-6)


def test_the_blending_says_what_width_it_was_built_for(float64):
    params = scenario("float64")[0]
    sample = Sample(jnp.zeros(3), jnp.zeros(3), jnp.zeros(FEATURES + 1))
    moment = Moment(jnp.zeros(()), {}, jnp.asarray(0))
    with pytest.raises(ValueError, match=r"reads 7 features .* has 8"):
        scene_flow.medium(TINY, params, sample, moment)


@pytest.mark.parametrize(
    "make",
    [
        lambda: SceneFlowSpec(flow_bound=0.0),
        lambda: SceneFlowSpec(flow_bound=float("nan")),
        lambda: SceneFlowSpec(decay_steps=0),
        lambda: FlowWeights(cycle=-1.0),
        lambda: FlowWeights(depth=float("inf")),
    ],
)
def test_impossible_settings_are_refused(make):
    with pytest.raises(ValueError, match=r"=(-?\d|nan|inf)"):
        make()
