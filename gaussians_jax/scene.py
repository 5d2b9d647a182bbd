"""Gaussians and effects put together: a spec becomes a `Model` the loop can train."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial
from jaxtyping import Array, Int, Key

from gaussians_jax import density, rates, render, splats
from gaussians_jax.density import DensitySpec
from gaussians_jax.effects import mlp_motion
from gaussians_jax.effects.effect import Effect, Moment
from gaussians_jax.effects.mlp_motion import MotionSpec
from gaussians_jax.optimiser import scale_by_row_adam
from gaussians_jax.raster_spec import RasterSpec
from gaussians_jax.rates import RateSpec
from gaussians_jax.splats import Params
from nerfies_jax.capture.capture import Capture, point_depths
from nerfies_jax.training import loop, losses
from nerfies_jax.training.model import (
    Event,
    Frames,
    Model,
    TrainState,
    View,
)

# Streams of the run's key beside those of the steps, which are its 0, 1, 2, ...
ORDER, EVENT = 2**32 - 1, 2**32 - 2


@dataclasses.dataclass(frozen=True)
class StartSpec:
    """Where the first Gaussians come from."""

    points: int = 100_000  # at most so many of the capture's own points
    random: int = 10_000  # drawn in the views where the capture has fewer than `fewest`
    fewest: int = 100
    beside: int = 0  # drawn in the views beside the capture's own points
    opacity: float = 0.1
    widest: float = 0.03  # first scale, over the distance to the nearest camera

    def __post_init__(self):
        if self.points < 1 or self.random < 1 or self.beside < 0:
            raise ValueError(
                f"a scene starts from at least one Gaussian, got points={self.points}, "
                f"random={self.random} and beside={self.beside}"
            )


@dataclasses.dataclass(frozen=True)
class SplatScene:
    """Which scene of Gaussians; `None` for an effect means that it is not there."""

    steps: int
    start: StartSpec = StartSpec()
    sh_degree: int = 3
    sh_every: int = 1000  # steps between one degree and the next
    dssim_weight: float = 0.2
    rates: RateSpec = RateSpec()
    raster: RasterSpec = RasterSpec()
    density: DensitySpec | None = DensitySpec()
    motion: MotionSpec | None = None

    def __post_init__(self):
        if self.steps < 1:
            raise ValueError(f"steps={self.steps}: train for at least one step")
        if not 0 <= self.sh_degree <= 3:
            raise ValueError(f"sh_degree={self.sh_degree} must be 0, 1, 2 or 3")
        if not 0 <= self.dssim_weight <= 1:
            raise ValueError(f"dssim_weight={self.dssim_weight} must lie in [0, 1]")


@dataclasses.dataclass(frozen=True)
class Facts:
    """What a scene must know of its capture before anything is compiled."""

    extent: float  # scene units: how far the cameras spread
    background: tuple[float, float, float]
    frames: int  # to learn from


def facts_of(capture: Capture) -> Facts:
    """The facts of a capture; host side."""
    positions = np.asarray(capture.cameras.position)[capture.train]
    halfway = 2 / (1 / capture.near + 1 / capture.far)
    return Facts(
        extent=splats.scene_extent(positions, still=halfway),
        background=capture.background or (0.0, 0.0, 0.0),
        frames=len(capture.train),
    )


def effects_of(spec: SplatScene, facts: Facts) -> tuple[Effect, ...]:
    """The effects that the spec asks for, in the order in which they act."""
    effects = []
    if spec.motion is not None:
        effects.append(mlp_motion.effect(spec.motion, spec.steps, facts.frames))
    return tuple(effects)


def build(spec: SplatScene, facts: Facts) -> Model:
    """Everything the loop, the renderer and the report need of this scene."""
    effects = effects_of(spec, facts)
    # Counts updates per row; for the networks, whose rows are never born, plain Adam.
    optimiser = scale_by_row_adam()

    def draw(params, view, size, moment, degree, probe=None):
        gaussians = splats.activate(params.rows["splats"])
        for effect in effects:
            gaussians = effect.deform(params, gaussians, moment)
        return render.render_harmonics(
            gaussians,
            splats.active_harmonics(params.rows["splats"], degree),
            view.camera,
            size,
            spec.raster,
            jnp.asarray(facts.background, gaussians.mean.dtype),
            mean2d_offset=probe,
        )

    def whole_frame(params, view, size, step):
        moment = Moment(view.time)
        degree = splats.active_degree(step, spec.sh_every, spec.sh_degree)
        return draw(params, view, size, moment, degree).rendering

    def step(state: TrainState, frames: Frames):
        key = loop.step_key(state)
        row = shuffled_row(state.key, state.step, len(frames.times))
        view = _view(frames, row)
        size = frames.images.shape[2], frames.images.shape[1]
        truth = frames.images[row].astype(jnp.float32) / 255
        valid = None if frames.valid is None else frames.valid[row]
        degree = splats.active_degree(state.step, spec.sh_every, spec.sh_degree)

        def loss(params, probe):
            moment = Moment(view.time, state.step, key)
            frame = draw(params, view, size, moment, degree, probe)
            colour = frame.rendering.colour
            value = losses.photometric(
                colour, truth, valid, dssim_weight=spec.dssim_weight
            )
            return value, (losses.mse(colour, truth, valid), frame.footprints)

        probe = jnp.zeros_like(state.params.rows["splats"].mean[:, :2])
        (value, (mse, footprints)), (slopes, probe_slope) = jax.value_and_grad(
            loss, argnums=(0, 1), has_aux=True
        )(state.params, probe)
        directions, moments = optimiser.update(slopes, state.optimiser, state.params)
        rate = _rates(spec, facts, effects, state.step)
        params = rates.descend(state.params, directions, rate)
        extra = state.extra
        if spec.density is not None:
            extra = density.observe(
                extra,
                probe_slope,
                footprints.visible,
                jnp.max(footprints.extent_px, axis=1),
                size,
            )
        metrics = {"loss": value, "mse": mse}
        return TrainState(params, moments, extra, state.step + 1, state.key), metrics

    return Model(
        spec=(spec, facts),
        init=lambda capture, key: first_state(spec, effects, optimiser, capture, key),
        step=step,
        render=whole_frame,
        events=_events(spec, facts, optimiser),
        counts=count_rows,
    )


def _view(frames, row):
    camera = jax.tree.map(lambda leaf: leaf[row], frames.cameras)
    return View(camera, frames.times[row], frames.warp[row], frames.appearance[row])


def _rates(spec, facts, effects, step):
    """A prefix of `Params` with the learning rate of everything below each leaf."""
    rows = {"splats": rates.learning_rates(spec.rates, facts.extent, spec.steps, step)}
    nets = {}
    for effect in effects:
        if effect.init_rows is not None:
            rows[effect.name] = effect.learning_rate(step)
        if effect.init_nets is not None:
            nets[effect.name] = effect.learning_rate(step)
    return Params(rows, nets)


def shuffled_row(
    key: Key[Array, ""], step: Int[Array, ""], frames: int
) -> Int[Array, ""]:
    """The frame of a step: every epoch visits each frame once, in a new order."""
    epoch = jax.random.fold_in(jax.random.fold_in(key, ORDER), step // frames)
    return jax.random.permutation(epoch, frames)[step % frames]


def first_points(spec: StartSpec, capture: Capture, seed: int):
    """Positions and colours in [0, 1] of the first Gaussians; host side.

    Structure from motion finds what stands still, so what moves has no points of its
    own; `spec.beside` random ones in the volume give it something to grow from.
    """
    rng = np.random.default_rng(seed)
    cloud = capture.points
    if cloud is None or len(cloud.position) < spec.fewest:
        return _random_points(rng, capture, spec.random, (capture.near, capture.far))
    position, colour = cloud.position, cloud.colour / 255
    if len(position) > spec.points:
        kept = np.sort(rng.choice(len(position), spec.points, replace=False))
        position, colour = position[kept], colour[kept]
    span = _filmed_depths(capture)
    more, more_colour = _random_points(rng, capture, spec.beside, span)
    return np.concatenate([position, more]), np.concatenate([colour, more_colour])


def _random_points(rng, capture, count, span):
    filmed = jax.tree.map(lambda leaf: leaf[capture.train], capture.cameras)
    position = splats.random_in_views(rng, filmed, capture.size, *span, count)
    return position, rng.uniform(size=position.shape)


def _narrowed(rows, capture, widest):
    """The rows, none wider than a share of its distance to the nearest camera.

    A lone point gets the distance to its neighbours for a scale, and close to a camera
    it covers the picture: the first steps on a capture with such points took 2 s each.
    """
    cameras = scipy.spatial.cKDTree(capture.cameras.position[capture.train])
    distance, _ = cameras.query(np.asarray(rows.mean))
    bound = np.log(np.maximum(widest * distance, 1e-8)).astype(np.float32)
    return rows._replace(log_scale=jnp.minimum(rows.log_scale, bound[:, None]))


def _filmed_depths(capture):
    """The z-depths between which the capture's points lie, a little widened.

    Its near plane is often much nearer than anything filmed (0.05 where the first point
    is at 0.4), and a Gaussian there covers the whole picture: 20 times slower steps.
    """
    depth = point_depths(capture)
    if not depth.size:
        return capture.near, capture.far
    low, high = np.quantile(depth, (0.02, 0.98))
    return max(capture.near, 0.7 * float(low)), min(capture.far, 1.1 * float(high))


def first_bytes(spec: SplatScene, capture: Capture) -> int:
    """Roughly the memory of the first state and step; host side, nothing allocated."""
    cloud = capture.points
    if cloud is not None and len(cloud.position) >= spec.start.fewest:
        count = min(len(cloud.position), spec.start.points) + spec.start.beside
    else:
        count = spec.start.random
    harmonics = 3 * (spec.sh_degree + 1) ** 2
    # Parameters, two moments, gradient, update; the tables of one projection.
    numbers = count * (5 * (11 + harmonics) + 60)
    # A slab holds keys, rows and blending inputs of every pair.
    numbers += 16 * (spec.raster.capacity or 0)
    return 4 * numbers + capture.images.nbytes


def first_state(spec, effects, optimiser, capture, key) -> TrainState:
    """Parameters, moments and statistics before the first step; host side."""
    render.refuse_distortion(capture.cameras)
    start_key, run_key = jax.random.split(key)
    seed = int(jax.random.randint(start_key, (), 0, np.iinfo(np.int32).max))
    position, colour = first_points(spec.start, capture, seed)
    rows = splats.from_points(
        position, colour, degree=spec.sh_degree, opacity=spec.start.opacity
    )
    rows = _narrowed(rows, capture, spec.start.widest)
    count = len(position)
    most = None if spec.density is None else spec.density.most
    params = Params({"splats": rows}, {})
    for number, effect in enumerate(effects):
        effect_key = jax.random.fold_in(start_key, number)
        rows_key, nets_key = jax.random.split(effect_key)
        if effect.init_rows is not None:
            params.rows[effect.name] = effect.init_rows(rows_key, count)
        if effect.init_nets is not None:
            params.nets[effect.name] = effect.init_nets(nets_key)
    params = splats.pad_rows(params, splats.capacity_for(count, most))
    stats = () if spec.density is None else density.empty_stats(params.rows["splats"])
    return TrainState(
        params, optimiser.init(params), stats, jnp.zeros((), jnp.int32), run_key
    )


def _events(spec, facts, optimiser):
    if spec.density is None:
        return ()
    plan = spec.density
    last = min(plan.stop, spec.steps)

    def densify(state, frames):
        del frames
        changed = density.densify(
            optimiser,
            state.params,
            state.optimiser,
            state.extra,
            jax.random.fold_in(jax.random.fold_in(state.key, EVENT), state.step),
            plan,
            step=int(state.step),
            extent=facts.extent,
        )
        return state._replace(
            params=changed.params, optimiser=changed.moments, extra=changed.stats
        )

    def reset(state, frames):
        del frames
        params, moments = density.reset_opacity(
            optimiser, state.params, state.optimiser, plan
        )
        return state._replace(params=params, optimiser=moments)

    grow = tuple(range(plan.start, last, plan.interval))
    return (
        Event("densify", grow, densify),
        Event(
            "reset opacity",
            tuple(range(plan.reset_interval, last, plan.reset_interval)),
            reset,
        ),
    )


def count_rows(state: TrainState) -> dict[str, int]:
    """Living Gaussians, and `parameters`: the numbers of them and the networks."""
    counts = {"gaussians": int(splats.alive(state.params.rows["splats"]).sum())}
    rows = jax.tree.leaves(state.params.rows)
    nets = jax.tree.leaves(state.params.nets)
    each = sum(math.prod(leaf.shape[1:]) for leaf in rows)
    counts["parameters"] = counts["gaussians"] * each
    counts["parameters"] += sum(math.prod(leaf.shape) for leaf in nets)
    return counts
