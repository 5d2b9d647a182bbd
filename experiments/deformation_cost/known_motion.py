"""A learned motion to try things on: in closed form, or of a run."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from gaussians_jax import scene, splats
from gaussians_jax.effects import mlp_motion
from gaussians_jax.effects.mlp_motion import Motion, MotionSpec
from gaussians_jax.spec import SceneMetadata, SplatScene
from gaussians_jax.splats import Params, Splats
from nerfies_jax import evaluation
from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.training.model import Model, TrainState, View

SIZE = (160, 120)  # of the built-in motion's pictures
FIT_STEPS, FIT_INSTANTS, FIT_POINTS = 1500, 4, 256


class Moving(NamedTuple):
    """A motion, and a view to draw it from."""

    name: str
    deform: Callable  # time -> Gaussians, compiled
    draw: Callable  # (Gaussians, time) -> color, compiled
    active: np.ndarray  # [gaussians] bool


class Change(NamedTuple):
    """How far points are from where they are at rest."""

    mean: Float[Array, "points 3"]  # scene units
    angle: Float[Array, " points"]  # rad, about z
    growth: Float[Array, " points"]  # of the logarithm of the scale


def of_run(model: Model, state: TrainState, capture: Capture) -> Moving:
    """The motion of a trained run, seen as its first held-out frame."""
    row = int((capture.heldout if len(capture.heldout) else capture.train)[0])
    view = evaluation.view_of(capture, row)
    return of_model(capture.name, model, state, view, capture.size)


def of_model(
    name: str, model: Model, state: TrainState, view: View, size: tuple[int, int]
) -> Moving:
    """The motion of any model that is drawn in stages."""
    if model.stages is None:
        raise ValueError(
            f"{name}: a radiance field has no Gaussians that could move; name a run of "
            "a preset of Gaussians"
        )
    stages, params = model.stages, state.params
    prepared = jax.jit(stages.prepare)(params)
    deform = jax.jit(stages.deform)

    @jax.jit
    def draw(params, gaussians, view, step):
        return stages.draw(params, gaussians, view, size, step).color

    return Moving(
        name,
        lambda time: deform(params, prepared, time),
        lambda deformed, time: draw(
            params, deformed, view._replace(time=time), state.step
        ),
        np.asarray(splats.active_mask(params.rows["splats"])),
    )


def fitted(count: int, spec: MotionSpec, steps: int) -> Moving:
    """`analytic` as a network has learned it: half a ball that moves, half a wall.

    A network, because its motion has the small fast parts that a smooth formula lacks;
    fitted, because one that was never trained does not move.
    """
    spec = dataclasses.replace(spec, smoothing=None, warm_up=0)
    whole = SplatScene(steps=1, sh_degree=0, densification=None, motion=spec)
    model = scene.build(
        whole, SceneMetadata(extent=1.0, background=(0.1, 0.1, 0.1), frames=2)
    )
    params = Params(
        {"splats": ball_and_wall(count)}, {mlp_motion.NAME: fit(spec, steps)}
    )
    camera = cameras.look_at((0.5, -0.5, -2.2), (0, 0, 0.2), (0, -1, 0), 150.0, SIZE)
    zero = jnp.zeros((), jnp.int32)
    view = View(jax.tree.map(jnp.asarray, camera), jnp.zeros(()), zero)
    state = TrainState(params, (), (), zero, None)
    return of_model("a motion in closed form", model, state, view, SIZE)


def ball_and_wall(count: int) -> Splats:
    """Round Gaussians, colored by where they are."""
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(count - count // 2, 3))
    ball *= (
        0.5
        * rng.uniform(0.3, 1, (len(ball), 1))
        / np.linalg.norm(ball, axis=1, keepdims=True)
    )
    wall = rng.uniform((-1.4, -1.2, 1), (1.4, 1.2, 1.1), (count // 2, 3))
    points = np.concatenate([ball, wall])
    colors = 0.5 + 0.5 * np.sin(9 * points + [0, 1, 2])
    return splats.from_points(points, colors, degree=0, opacity=0.8)


def analytic(points: Float[Array, "points 3"], time: Float[Array, ""]) -> Change:
    """A motion of one to three periods over the time in [0, 1].

    Points within 0.5 of the origin sway, turn and breathe; beyond 0.9 hardly anything
    moves.
    """
    near = jnp.exp(-((jnp.sum(points**2, axis=-1) / 0.4) ** 2))
    turn = 2 * jnp.pi * time
    sway = [
        jnp.sin(turn + points[:, 1]) / 3,
        jnp.sin(2 * turn + 2 * points[:, 0]) / 6,
        jnp.cos(3 * turn + points[:, 2]) / 10,
    ]
    return Change(
        near[:, None] * jnp.stack(sway, axis=-1),
        near * 0.8 * jnp.sin(turn),
        near * 0.2 * jnp.sin(2 * turn),
    )


def fit(spec: MotionSpec, steps: int) -> Motion:
    """A network after `steps` of Adam toward `analytic`, by its squared error."""
    rule = optax.adam(optax.cosine_decay_schedule(3e-3, steps))
    key = jax.random.key(0)
    params = mlp_motion.init(key, spec)

    def error(params, points, time):
        offsets = mlp_motion.deform(params, spec, points, time)
        exact = analytic(points, time)
        half = exact.angle / 2
        turn = jnp.stack(
            [jnp.cos(half) - 1, 0 * half, 0 * half, jnp.sin(half)], axis=-1
        )
        return (
            jnp.mean((offsets.mean - exact.mean) ** 2)
            + jnp.mean((offsets.quaternion - turn) ** 2)
            + jnp.mean((offsets.scale - exact.growth[:, None]) ** 2)
        )

    def loss(params, key):
        points_key, time_key = jax.random.split(key)
        points = jax.random.uniform(
            points_key, (FIT_INSTANTS, FIT_POINTS, 3), minval=-1.4, maxval=1.4
        )
        times = jax.random.uniform(time_key, (FIT_INSTANTS,))
        errors = [error(params, points[k], times[k]) for k in range(FIT_INSTANTS)]
        return sum(errors[1:], errors[0])

    def step(state, number):
        params, moments = state
        slopes = jax.grad(loss)(params, jax.random.fold_in(key, number))
        updates, moments = rule.update(slopes, moments)
        return (optax.apply_updates(params, updates), moments), None

    with jax.numpy_dtype_promotion("standard"):  # optax adds its step count to floats
        run = jax.jit(lambda state: jax.lax.scan(step, state, jnp.arange(steps)))
        (params, _), _ = run((params, rule.init(params)))
    return params
