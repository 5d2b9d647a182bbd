"""What solvers are held against each other on: codes of pictures, poses of cameras."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import lie
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.nets import codes, encoding, mlp
from nerfies_jax.training.fit import (
    CODE_SOLVERS,
    CameraSpec,
    Fit,
    fit_code,
    refine_camera,
)

# Far below what float32 reaches here, so that no solver stops for being content.
TOLERANCE = 1e-6
LEVENBERG = "levenberg-marquardt"  # `refine_camera`: for sums of squares alone
POINTS = 300  # that a camera sees
NOISE_PX = 0.5
TURN, SHIFT = 0.05, 0.1  # by which a pose is off at first: rad, scene units


class Problem(NamedTuple):
    """Targets to be fitted from one start, and the solvers that can."""

    unseen: jax.Array  # [frames, ...]
    loss: Callable[[jax.Array, jax.Array], jax.Array]  # (numbers, one target) -> ()
    solvers: dict[str, Callable[[jax.Array, int], Fit]]  # (one target, most steps)


def _with_code_solvers(loss, start):
    def solve(name):
        def solver(target, most):
            return fit_code(
                lambda numbers: loss(numbers, target), start, name, most, TOLERANCE
            )

        return solver

    return {name: solve(name) for name in CODE_SOLVERS}


def pattern(moments: np.ndarray, pixels: int) -> np.ndarray:
    """A blob on a circle, a plaid, a changing light: [moments, pixels², 3]."""
    axis = (np.arange(pixels) + 0.5) / pixels * 2 - 1
    x, y = (part.ravel() for part in np.meshgrid(axis, axis))
    angle = 2 * np.pi * moments[:, None]
    away = (x - 0.5 * np.cos(angle)) ** 2 + (y - 0.5 * np.sin(angle)) ** 2
    blob = np.exp(-away / 0.1)
    plaid = 0.5 + 0.25 * np.sin(4 * x) + 0.2 * np.cos(5 * y)
    light = 1 + 0.3 * np.sin(3 * angle)
    return np.stack([light * plaid, plaid + 0 * angle, blob], axis=-1)


def drawn(spec, network, places, code):
    inputs = jnp.concatenate(
        [places, jnp.broadcast_to(code, (len(places), len(code)))], axis=1
    )
    return mlp.apply(spec, network, inputs)["color"]


def code_problem(settings: Any) -> Problem:
    """Train the network and its codes; put the held-out moments between theirs."""
    known = np.arange(settings.pictures) / settings.pictures
    spread = np.linspace(0, settings.pictures - 1, settings.frames).astype(int)
    between = known[spread] + 0.5 / settings.pictures
    pictures = jnp.asarray(pattern(known, settings.pixels), jnp.float32)
    unseen = jnp.asarray(pattern(between, settings.pixels), jnp.float32)
    axis = (np.arange(settings.pixels) + 0.5) / settings.pixels * 2 - 1
    grid = np.stack([part.ravel() for part in np.meshgrid(axis, axis)], -1)
    waves = encoding.EncodingSpec(3)
    places = jax.vmap(lambda point: encoding.encode(waves, point, None))(
        jnp.asarray(grid, jnp.float32)
    )
    spec = mlp.MLPSpec(
        inputs=places.shape[1] + settings.code_width,
        depth=3,
        width=settings.width,
        heads=(("color", mlp.HeadSpec(3)),),
        activation="softplus",
    )
    network_key, code_key = jax.random.split(jax.random.key(0))
    params = (
        mlp.init(spec, network_key),
        codes.init(code_key, settings.pictures, settings.code_width),
    )
    network, table = _train(spec, params, places, pictures, settings.training_steps)
    start = jnp.mean(table, axis=0)

    def loss(code, picture):
        return jnp.mean((drawn(spec, network, places, code) - picture) ** 2)

    return Problem(unseen, loss, _with_code_solvers(loss, start))


def _train(spec, params, places, pictures, steps):
    rule = optax.adam(optax.cosine_decay_schedule(3e-3, steps))

    def loss(params):
        images = jax.vmap(lambda code: drawn(spec, params[0], places, code))(params[1])
        return jnp.mean((images - pictures) ** 2)

    def step(state, _):
        params, memory = state
        updates, memory = rule.update(jax.grad(loss)(params), memory)
        return (optax.apply_updates(params, updates), memory), None

    # optax adds its step count to floats
    with jax.numpy_dtype_promotion("standard"):
        state = params, rule.init(params)
        (params, _), _ = jax.jit(lambda state: jax.lax.scan(step, state, length=steps))(
            state
        )
    return params


def looking_down_z() -> Camera:
    """320x240 pixels, three units before the origin."""
    numbers = (np.eye(3), [0, 0, -3], 300, [160, 120], 0, 1, np.zeros(3), np.zeros(2))
    return Camera(*(jnp.asarray(x, jnp.float32) for x in numbers))


def pose_problem(settings: Any) -> Problem:
    """A camera before points, each target their pixels from a pose nearby, with noise.

    The numbers are a screw of the camera in its own frame, rad and scene units; the
    loss is the mean squared distance in pixels.
    """
    rng = np.random.default_rng(0)
    camera = looking_down_z()
    points = jnp.asarray(rng.uniform(-1, 1, (POINTS, 3)), jnp.float32)

    def pixels_in(camera):
        return jax.vmap(lambda point: cameras.project(camera, point)[0])(points)

    def seen(numbers):
        return pixels_in(cameras.move(camera, numbers[:3], numbers[3:]))

    off = rng.normal(size=(settings.frames, 6)) * np.repeat([TURN, SHIFT], 3)
    noise = NOISE_PX * rng.normal(size=(settings.frames, POINTS, 2))
    unseen = jax.vmap(seen)(jnp.asarray(off, jnp.float32))
    unseen = unseen + jnp.asarray(noise, jnp.float32)

    def loss(numbers, pixels):
        return jnp.mean(jnp.sum((seen(numbers) - pixels) ** 2, axis=-1))

    def levenberg(pixels, most):
        spec = CameraSpec(tolerance=TOLERANCE, max_steps=most)
        fit = refine_camera(lambda moved: pixels_in(moved) - pixels, camera, spec)
        return fit._replace(value=screw_between(camera, fit.value))

    start = jnp.zeros(6, jnp.float32)
    return Problem(
        unseen, loss, {LEVENBERG: levenberg, **_with_code_solvers(loss, start)}
    )


def screw_between(camera: Camera, moved: Camera) -> jax.Array:
    """[6] the screw by which `camera.move` made the second of the first."""
    turn = jnp.matmul(
        moved.camera_from_world, camera.camera_from_world.T, precision="highest"
    )
    shift = moved.camera_from_world @ (camera.position - moved.position)
    return jnp.concatenate(lie.log_se3(turn, shift))


PROBLEMS = {"codes": code_problem, "poses": pose_problem}
