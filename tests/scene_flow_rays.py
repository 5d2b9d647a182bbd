"""A few rays through frames with depth and flow, and NSFF's losses on them in NumPy.

The oracle goes one ray and one sample at a time, network included, in float64.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.capture.flow import FrameFlow
from nerfies_jax.fields.effects import scene_flow
from nerfies_jax.fields.effects.effect import Batch, Box, RayOutput, Sample
from nerfies_jax.fields.effects.scene_flow import SceneFlowSpec
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.training.effects import FrameCondition, PenaltyContext
from nerfies_jax.training.model import Frames
from tests.oracles import networks

TINY = SceneFlowSpec(
    network=TemplateSpec(
        EncodingSpec(2), EncodingSpec(1), depth=2, width=8, skips=(1,), color_width=6
    ),
    time=EncodingSpec(1),
    flow_bound=0.3,
    decay_steps=100,
)
TIMESTAMPS, RAYS, SAMPLES, FEATURES = 4, 6, 5, 7
SIZE = (8, 6)
ROWS = [0, 3, 1, 2, 2, 1]  # of the rays; rows are timestamps here
TIMES = (0.0, 1 / 3, 0.7, 1.0)
FAR = 3.2  # behind all samples, where a background is known
BOX_SCALE, BOX_CENTER = 0.5, (0.2, -0.1, 2.0)


def frames_and_batch(rng, dtype):
    """Four frames of one camera that moves, with depth and flow, and six rays."""
    width, height = SIZE
    poses = cameras.stack(
        [
            cameras.look_at([0.1 * k, 0, -2.0], [0, 0, 2.0], [0, 1, 0], 9.0, SIZE)
            for k in range(TIMESTAMPS)
        ]
    )
    shape = (TIMESTAMPS, height, width)
    flow = FrameFlow(
        forward=rng.normal(size=(*shape, 2)).astype(np.float32),
        forward_valid=rng.uniform(size=shape) < 0.8,
        next_row=np.minimum(np.arange(TIMESTAMPS) + 1, TIMESTAMPS - 1).astype(np.int32),
        backward=rng.normal(size=(*shape, 2)).astype(np.float32),
        backward_valid=rng.uniform(size=shape) < 0.8,
        previous_row=np.maximum(np.arange(TIMESTAMPS) - 1, 0).astype(np.int32),
    )
    depths = rng.uniform(2, 5, shape).astype(np.float32)
    frames = Frames(
        images=None,
        cameras=jax.tree.map(lambda leaf: leaf.astype(dtype), poses),
        # the third is observed a little late: timestamps are not even
        times=np.array(TIMES, dtype),
        appearance=np.arange(TIMESTAMPS, dtype=np.int32),
        valid=None,
        depths=np.where(depths < 2.3, 0, depths),
        flow=flow,
    )
    row = np.array(ROWS, np.int32)
    pixel = rng.integers(0, SIZE, (RAYS, 2)) + 0.5
    offset = (pixel - np.array(SIZE) / 2) / 9.0
    inside = np.concatenate([offset, np.ones((RAYS, 1))], 1)
    cosine = 1 / np.linalg.norm(inside, axis=1)
    turn = poses.camera_from_world[row]
    direction = np.einsum("rki,rk->ri", turn, inside) * cosine[:, None]
    batch = Batch(
        row=row,
        pixel=pixel.astype(dtype),
        origin=poses.position[row].astype(dtype),
        direction=direction.astype(dtype),
        cosine=cosine.astype(dtype),
        color=rng.uniform(size=(RAYS, 3)).astype(dtype),
        valid=np.array([True, True, True, False, True, True]),
    )
    return jax.tree.map(jnp.asarray, (frames, batch))


def context_of(
    spec, params, frames, batch, distance, features, weight, step, behind=None
):
    """The rays as the scene renders them, as far as the penalty reads it.

    `behind` is the color of a known background.
    """
    end = jnp.full((RAYS, 1), 1e10, distance.dtype)
    if behind is not None:
        end = FAR - distance[:, -1:]
        behind = jnp.broadcast_to(jnp.asarray(behind, distance.dtype), (RAYS, 3))
    center = jnp.asarray(BOX_CENTER, distance.dtype)
    origin = (batch.origin - center) * BOX_SCALE
    point = origin[:, None] + distance[..., None] * batch.direction[:, None]
    conditions = FrameCondition(frames.times[batch.row], {}, jnp.full(RAYS, step))

    def at(point, features, direction, condition):
        return scene_flow.medium(
            spec, params, Sample(point, direction, features), condition
        )

    media = jax.vmap(jax.vmap(at, (0, 0, None, None)))(
        point, features, batch.direction, conditions
    )
    none = jnp.zeros(RAYS, distance.dtype)
    level = RayOutput(
        distances=distance,
        point=point,
        warped=point,
        static_weight=jnp.zeros_like(weight),
        media={"scene_flow": media},
        media_weight={"scene_flow": weight},
        color=batch.color,
        alpha=none,
        distance=none,
        median_distance=none,
        beta=None,
        spacing=jnp.concatenate([jnp.diff(distance), end], 1),
        background=behind,
    )
    return PenaltyContext(
        condition=conditions,
        params=params,
        batch=batch,
        levels=(level,),
        frames=frames,
        box=Box(center, jnp.asarray(BOX_SCALE, distance.dtype)),
        step=jnp.asarray(step),
        key=jax.random.key(0),
    )


@functools.cache
def scenario(dtype):
    """Parameters and the rest, with nothing next to zero."""
    rng = np.random.default_rng(4)
    frames, batch = frames_and_batch(rng, dtype)
    # Drawn here: its own start is a program for each array.
    shapes = jax.eval_shape(
        lambda key: scene_flow.init(TINY, key, FEATURES, jnp.dtype(dtype)),
        jax.random.key(1),
    )
    params = jax.tree.map(
        lambda x: jax.device_put(0.5 * rng.normal(size=x.shape).astype(x.dtype)), shapes
    )
    distance = np.sort(rng.uniform(1.0, 3.0, (RAYS, SAMPLES)), 1)
    features = rng.normal(size=(RAYS, SAMPLES, FEATURES))
    weight = rng.uniform(0, 0.25, (RAYS, SAMPLES))
    arrays = [jnp.asarray(x, dtype) for x in (distance, features, weight)]
    return params, frames, batch, arrays


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def dynamic(params, point, direction, time):
    """Density, color, flow [2, 3], disocclusion [2] by the published network."""
    read = TINY.network
    places = networks.waves(read.position, point)
    inputs = np.concatenate([places, networks.waves(TINY.time, 2 * time - 1)])
    trunk, color = params.network.trunk, params.network.color
    hidden = networks.trunk(trunk.hidden, inputs, read.skips)
    heads = {name: networks.affine(x, hidden) for name, x in trunk.heads.items()}
    seen = networks.waves(read.direction, direction)
    shade = networks.heads(color, np.concatenate([heads["bottleneck"], seen]))
    flow = TINY.flow_bound * np.tanh(networks.affine(params.flow, hidden))
    hidden_share = networks.affine(params.disocclusion, hidden)
    density = np.log1p(np.exp(heads["density"][0]))
    return density, sigmoid(shade["color"]), flow.reshape(2, 3), sigmoid(hidden_share)


def composite(density, distance, behind):
    weights, light = [], 1.0
    ends = [*distance[1:], 1e10 if behind is None else FAR]
    for s in range(SAMPLES):
        length = ends[s] - distance[s]
        weights.append(light * (1 - np.exp(-density[s] * length)))
        light *= np.exp(-density[s] * length)
    return np.array(weights)


def weighted(pairs):
    """Mean of (value, weight) pairs."""
    total = sum(weight for _, weight in pairs)
    return sum(value * weight for value, weight in pairs) / total


def oracle(params, frames, batch, arrays, step, behind=None):
    """All terms as sums over rays and samples."""
    back = np.zeros(3) if behind is None else np.asarray(behind)
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
        origin = (batch.origin[r] - BOX_CENTER) * BOX_SCALE
        points = [origin + d * direction for d in distance]
        here = [dynamic(params, x, direction, time) for x in points]
        weight = composite([h[0] for h in here], distance, behind)
        mask = float(batch.valid[r])
        if step >= 100:
            mask *= blend_weight[r].sum()
        color = sum(w * h[1] for w, h in zip(weight, here, strict=True))
        color = color + (1 - weight.sum()) * back
        lists["dynamic"].append((np.mean((color - batch.color[r]) ** 2), mask))
        column, line = int(batch.pixel[r, 0]), int(batch.pixel[r, 1])
        for s in range(SAMPLES):
            logit = features[r, s] @ params.blend.weight[:, 0] + params.blend.bias[0]
            share = sigmoid(logit)
            lists["entropy"].append((-share * np.log(share), 1))
        reached = weight @ distance + (1 - weight.sum()) * distance[-1]
        expected = reached * batch.cosine[r] / BOX_SCALE
        known = frames.depths[row, line, column]
        if known > 0 and batch.valid[r]:
            depths.append((expected, known))
        flows = np.array([h[2] for h in here])  # samples, sides, axes
        for side in (0, 1):
            beside = row + (1, -1)[side]
            if not 0 <= beside < TIMESTAMPS:
                continue
            later = frames.times[beside]
            stretch = abs(later - time) * 3
            moved = [
                x + stretch * f for x, f in zip(points, flows[:, side], strict=True)
            ]
            there = [dynamic(params, x, direction, later) for x in moved]
            w = composite([t[0] for t in there], distance, behind)
            seen = 1 - np.array([h[3][side] for h in here])
            color = sum(a * t[1] for a, t in zip(w, there, strict=True))
            color = color + (1 - w.sum()) * back
            error = np.mean((color - batch.color[r]) ** 2)
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
        if 0 < row < TIMESTAMPS - 1:
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
    seen = (flow.forward_valid, flow.backward_valid)[side][row, line, column]
    if other == row or not seen or not batch.valid[r]:
        return
    stretch = abs(frames.times[other] - frames.times[row]) * 3
    place = sum(
        w * (x + stretch * f)
        for w, x, f in zip(weight, points, flows[:, side], strict=True)
    )
    last = points[-1] + stretch * flows[-1, side]
    place = place + (1 - weight.sum()) * last
    place = place / BOX_SCALE + np.array(BOX_CENTER)
    turn, position = (
        frames.cameras.camera_from_world[other],
        frames.cameras.position[other],
    )
    x, y, z = turn @ (place - position)
    pixel = 9.0 * np.array([x, y]) / z + np.array(SIZE) / 2
    lists[f"flow{side}"].append((np.abs(pixel - batch.pixel[r] - shift).mean(), 1))
