"""Static scenes written out by hand, without effects, and presets made tiny.

What is here knows of no effect: neither the records of their seams nor the functions
that go through them. Samples, networks, compositing, drawing and losses are the
library's; how they are put together is not.
"""

import dataclasses

import jax
import jax.numpy as jnp
import optax

from gaussians_jax.core import splats
from gaussians_jax.core.splats import Params
from gaussians_jax.init.points import InitSpec, StartSpec
from gaussians_jax.motion.anchors import AnchorMotionSpec
from gaussians_jax.motion.embedding import EmbeddingMotionSpec
from gaussians_jax.motion.kan import KanMotionSpec
from gaussians_jax.motion.nodes import NodeMotionSpec
from gaussians_jax.motion.planes import PlaneMotionSpec
from gaussians_jax.motion.se3_bases import SE3BasesSpec
from gaussians_jax.motion.time_basis import TimeBasisSpec
from gaussians_jax.optim import densification, optimizer
from gaussians_jax.optim import learning_rates as splat_rates
from gaussians_jax.per_frame.appearance import ColorNetworkSpec
from gaussians_jax.per_frame.sky import SkySpec
from gaussians_jax.scene import presets as splat_presets
from gaussians_jax.splatting import harmonics, projection, raster
from nerfies_jax.fields import compositing, sampling, template
from nerfies_jax.geometry import rays
from nerfies_jax.nn import encoding
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.voxels import VoxelGridSpec
from nerfies_jax.scene import presets as field_presets
from nerfies_jax.training import losses, schedules
from nerfies_jax.training.model import TrainState
from nerfies_jax.training.updates import apply_updates

FEW = EncodingSpec(2)
STEPS = 100
# What cannot be without another.
LEANS_ON = {
    "elastic": ("warp",),
    "background": ("warp",),
    "mask": ("warp",),
    "temporal_opacity": ("motion",),
    "alternation": ("motion",),
    "acceleration": ("motion",),
    "neighbors": ("motion",),
    "motion_growth": ("motion", "strategy"),
    "flow": ("motion",),
}
# Settings of motions on tiny scenes. Each takes those that it has.
SMALL_NETWORK = {
    "position": FEW,
    "base_time": FEW,
    "time": FEW,
    "base_depth": 1,
    "base_width": 8,
    "basis_width": 8,
    "depth": 1,
    "width": 8,
    "skips": (),
}
SMALL_MOTIONS = {
    KanMotionSpec: {"embedding": 4, "time_code": 3, "hidden": (6,), "kernels": 3},
    EmbeddingMotionSpec: {"embedding": 4, "time_code": 3, "width": 6},
    SE3BasesSpec: {"bases": 2, "knots": 3},
    NodeMotionSpec: {"nodes": 6, "links": 2, **SMALL_NETWORK},
    AnchorMotionSpec: {
        "count": 2,
        "reference": 3,
        "residual": 2,
        "time_code": 3,
        "width": 6,
        "make_width": 6,
    },
    TimeBasisSpec: {"count": 2, **SMALL_NETWORK},
}


def from_rest(spec):
    """Any scene, its motion not fitted to tracks before training."""
    start = dataclasses.replace(spec.start, motion="none")
    return dataclasses.replace(spec, start=start)


def parts_of(spec):
    """The names of what the scene has and could be without."""
    return [
        field.name
        for field in dataclasses.fields(spec)
        if field.default is None and getattr(spec, field.name) is not None
        if field.name != "coarse"
    ]


def without(spec, *names):
    """The scene without these parts and what leans on them."""
    gone = set(names)
    gone |= {name for name, on in LEANS_ON.items() if gone & set(on)}
    fields = {field.name for field in dataclasses.fields(spec)}
    return dataclasses.replace(spec, **dict.fromkeys(gone & fields))


def shrunk(part, **changes):
    """The same settings with those of the changes that it has; None stays None."""
    if part is None:
        return None
    names = {field.name for field in dataclasses.fields(part)}
    return dataclasses.replace(part, **{k: v for k, v in changes.items() if k in names})


def tiny_template(spec):
    """The same kind of network, two layers of eight."""
    direction = None if spec is None or spec.direction is None else EncodingSpec(1)
    position = EncodingSpec(3)
    if spec is not None and isinstance(spec.position, VoxelGridSpec):
        position = shrunk(spec.position, cells=4, features=2)
    return shrunk(
        spec,
        position=position,
        direction=direction,
        depth=2,
        width=8,
        skips=(1,) if spec is not None and spec.skips else (),
        color_width=8,
    )


def tiny_field(name):
    """A preset of `nerfies_jax` with networks of eight and 16 rays."""
    spec = field_presets.with_steps(field_presets.PRESETS[name], STEPS)
    net = {"depth": 2, "width": 8, "skips": (), "position": FEW, "time": FEW}
    net |= {"embedding": 4}
    flow = spec.scene_flow
    if flow is not None:
        flow = shrunk(flow, network=tiny_template(flow.network), time=FEW)
    return dataclasses.replace(
        spec,
        template=tiny_template(spec.template),
        coarse=tiny_template(spec.coarse),
        sampling=shrunk(spec.sampling, coarse=6, fine=6 if spec.sampling.fine else 0),
        rays=16,
        micro_batches=1,
        extent=1.0,
        appearance=shrunk(spec.appearance, width=3),
        transient=shrunk(spec.transient, depth=1, width=8, code_width=4),
        time=shrunk(spec.time, encoding=FEW),
        warp=shrunk(spec.warp, **net),
        ambient=shrunk(spec.ambient, **net),
        elastic=shrunk(spec.elastic, points=2),
        background=shrunk(spec.background, points=16),
        scene_flow=flow,
        mask=shrunk(spec.mask, **net),
        surface=shrunk(spec.surface, position=FEW, normal=FEW),
    )


def tiny_splats(name):
    """A preset of `gaussians_jax` with a few hundred Gaussians and small networks."""
    spec = splat_presets.with_steps(splat_presets.PRESETS[name], STEPS)
    motion = spec.motion
    if isinstance(motion, PlaneMotionSpec):
        few = shrunk(
            motion.planes, vertices=4, multiples=(1, 2), timestamps=3, features=2
        )
        motion = shrunk(motion, planes=few, width=8)
    else:
        motion = shrunk(motion, **SMALL_MOTIONS.get(type(motion), SMALL_NETWORK))
    return dataclasses.replace(
        spec,
        batch_size=1,
        carried=shrunk(spec.carried, count=2),
        init=InitSpec(random=100, min_points=1000),
        start=StartSpec(motion="none"),
        sh_degree=1,
        strategy=shrunk(spec.strategy, cap_max=256),
        motion=motion,
        acceleration=shrunk(spec.acceleration, samples=16),
        neighbors=shrunk(spec.neighbors, count=3),
        appearance=shrunk(
            spec.appearance,
            code=4,
            network=ColorNetworkSpec(1, 1, 8),
            sky=SkySpec(1, 8),
        ),
    )


def field_loss(spec, metadata, params, batch, key):
    """Squared errors of the levels of a static NeRF: (their sum, each by name)."""

    def level(name, origin, direction, far, distance):
        one = spec.coarse if name == "coarse" and spec.coarse else spec.template
        condition = jnp.zeros(0)
        if one.direction is not None:
            condition = encoding.encode(one.direction, direction, None)

        def ask(at):
            point = rays.point_at(origin, direction, at)
            features = encoding.encode(one.position, point, None)
            return template.apply(one, params["template"][name], features, condition)

        answers = jax.vmap(ask)(distance)
        behind, end = None, compositing.AT_INFINITY
        if metadata.background is not None:
            behind = jnp.asarray(metadata.background, distance.dtype)
            end = jnp.maximum(far - distance[-1], 0)
        optical_depth = answers.density * compositing.intervals(distance, end)
        weights = compositing.weights(optical_depth)
        whole = compositing.composite(weights, answers.color, distance, behind)
        return weights, whole.color

    def ray(origin, direction, cosine, key):
        plan = spec.sampling
        origin = (origin - jnp.asarray(metadata.center, origin.dtype)) * metadata.scale
        span = metadata.scale / cosine
        near, far = metadata.near * span, metadata.far * span
        first, second, _ = jax.random.split(key, 3)
        if plan.spacing == "center":
            middle = -jnp.sum(origin * direction)
            miss_sq = jnp.sum(jnp.square(origin + middle * direction))
            width = jnp.sqrt(spec.extent**2 + miss_sq)
            distance = sampling.sample_around(
                first, near, far, plan.coarse, middle, width
            )
        else:
            distance = sampling.stratified(first, near, far, plan.coarse, plan.spacing)
        if plan.fine == 0:
            return (level("fine", origin, direction, far, distance)[1],)
        name = "fine" if plan.shared else "coarse"
        weights, coarse = level(name, origin, direction, far, distance)
        fine = sampling.refine(second, distance, weights, plan.fine)
        if plan.union:
            distance = sampling.union(distance, fine)
        else:
            last = () if metadata.background is not None else (distance[-1:],)
            distance = jnp.concatenate([fine, *last])
        return coarse, level("fine", origin, direction, far, distance)[1]

    keys = jax.random.split(jax.random.split(key)[0], len(batch.origin))
    seen = jax.vmap(ray)(batch.origin, batch.direction, batch.cosine, keys)
    terms = {"fine": losses.mse(seen[-1], batch.color, batch.valid)}
    if len(seen) > 1:
        terms["coarse"] = losses.mse(seen[0], batch.color, batch.valid)
    return sum(terms.values()), terms


def field_step(spec, metadata, draw_batch):
    """One update of a static NeRF from rays that `draw_batch` draws."""
    adam = optax.scale_by_adam()
    rate = schedules.log_linear(spec.learning_rate, spec.learning_rate_end, spec.steps)

    def step(state, frames):
        key = jax.random.fold_in(state.key, state.step)
        batch_key, field_key = jax.random.split(key)
        batch = draw_batch(frames, spec.rays, batch_key)

        def loss(params):
            return field_loss(spec, metadata, params, batch, field_key)

        (value, terms), grads = jax.value_and_grad(loss, has_aux=True)(state.params)
        with jax.numpy_dtype_promotion("standard"):
            updates, moments = adam.update(grads, state.optimizer)
        now = spec.template_rate * rate(state.step)  # all of it is of the template
        params = jax.tree.map(lambda x, d: x - now * d, state.params, updates)
        state = TrainState(params, moments, (), state.step + 1, state.key)
        return state, {"loss": value, "mse": terms["fine"], **terms}

    return step


def splat_step(spec, metadata, shuffled_row):
    """One update of a static scene of Gaussians, from the frame that is its turn."""
    update = optimizer.scale_by_row_adam().update
    if spec.optimizer == "radam":
        update = optimizer.scale_by_row_radam().update

    def render_rows(rows, offset, camera, size, degree):
        gaussians = splats.activate(rows)
        shown = splats.active_harmonics(rows, degree)
        color = harmonics.color_toward(shown, gaussians.mean, camera.position)
        seen = projection.project(gaussians, camera, size, spec.raster)
        placed = seen
        if offset is not None:  # whose gradient densification wants to know
            placed = seen._replace(mean_px=seen.mean_px + offset)
        image, passing = raster.rasterize(placed, color, size, spec.raster)
        behind = jnp.asarray(metadata.background, image.dtype)
        return image + behind * passing[..., None], seen

    def step(state, frames):
        row = shuffled_row(state.key, state.step, len(frames.times))
        camera = jax.tree.map(lambda leaf: leaf[row], frames.cameras)
        truth = frames.images[row].astype(jnp.float32) / 255
        valid = None if frames.valid is None else frames.valid[row]
        size = frames.images.shape[2], frames.images.shape[1]
        degree = jnp.minimum(state.step // spec.sh_every, spec.sh_degree)

        def loss(params, offset):
            image, seen = render_rows(
                params.rows["splats"], offset, camera, size, degree
            )
            value = losses.photometric(
                image, truth, valid, dssim_weight=spec.dssim_weight
            )
            return value, (losses.mse(image, truth, valid), seen)

        still, wanted = None, (0,)
        if spec.strategy is not None:
            still = jnp.zeros_like(state.params.rows["splats"].mean[:, :2])
            wanted = (0, 1)
        (value, (mse, seen)), grads = jax.value_and_grad(
            loss, argnums=wanted, has_aux=True
        )(state.params, still)
        updates, moments = update(grads[0], state.optimizer, state.params)
        rates = splat_rates.at_step(
            spec.learning_rates, metadata.extent, spec.steps, state.step
        )
        rates = Params({"splats": rates}, {})
        params = apply_updates(state.params, updates, rates)
        aux_state = state.aux_state
        if spec.strategy is not None:
            radius_px = jnp.max(seen.extent_px, axis=1)
            stats = densification.observe(
                aux_state.stats, grads[1], seen.overlaps_image(size), radius_px, size
            )
            aux_state = aux_state._replace(stats=stats)
        state = TrainState(params, moments, aux_state, state.step + 1, state.key)
        return state, {"loss": value, "mse": mse}

    return step
