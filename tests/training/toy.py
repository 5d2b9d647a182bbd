"""A small model with rows, a net, noise from the step's key and a growth event."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import rich.console

from nerfies_jax.geometry.camera import Camera
from nerfies_jax.training import loop
from nerfies_jax.training.model import Event, Frames, Model, TrainState

OPTIMIZER = optax.adam(1e-2)


@dataclasses.dataclass(frozen=True)
class ToySpec:
    rows: int = 6
    rate: float = 1e-2
    grow_at: tuple[int, ...] = (7,)


class Params(NamedTuple):
    rows: dict
    nets: dict


def frames():
    rng = np.random.default_rng(3)
    camera = Camera(*(np.zeros((), np.float32) for _ in Camera._fields))
    images = rng.integers(0, 255, (4, 2, 3, 3), dtype=np.uint8)
    times = np.linspace(0, 1, 4, dtype=np.float32)
    on_device = (images, camera, times, np.arange(4, dtype=np.int32))
    return Frames(*jax.device_put(on_device), None)


def init(_capture, key, spec=ToySpec()):
    return _init(key, spec)


@functools.partial(jax.jit, static_argnums=1)
def _init(key, spec):
    row_key, net_key = jax.random.split(key)
    params = Params(
        {"mean": jax.random.normal(row_key, (spec.rows, 3))},
        {"weight": jax.random.normal(net_key, (3, 8)), "bias": jnp.zeros(8)},
    )
    extra = {"hits": jnp.zeros(spec.rows), "rest": jnp.zeros((spec.rows, 0, 3))}
    zero = jnp.zeros((), jnp.int32)
    return TrainState(params, OPTIMIZER.init(params), extra, zero, key)


def loss(params, target, noise):
    hidden = jnp.tanh((params.rows["mean"] + noise) @ params.nets["weight"])
    return jnp.mean((hidden + params.nets["bias"] - target) ** 2)


def step(state, frames):
    frame_key, noise_key = jax.random.split(loop.step_key(state))
    row = jax.random.randint(frame_key, (), 0, frames.times.shape[0])
    target = jnp.mean(frames.images[row].astype(jnp.float32)) / 255 + frames.times[row]
    noise = 0.1 * jax.random.normal(noise_key, state.params.rows["mean"].shape)
    value, grad = jax.value_and_grad(loss)(state.params, target, noise)
    with jax.numpy_dtype_promotion("standard"):  # optax raises floats to integers
        updates, optimizer = OPTIMIZER.update(grad, state.optimizer)
    hits = state.aux_state["hits"] + jnp.abs(grad.rows["mean"]).sum(-1)
    return TrainState(
        optax.apply_updates(state.params, updates),
        optimizer,
        {**state.aux_state, "hits": hits},
        state.step + 1,
        state.key,
    ), {"loss": value, "mse": value}


@jax.jit
def grow(state, _frames):
    """Half as many rows again, moments and statistics with them."""
    capacity = state.aux_state["hits"].shape[0]
    take = jnp.arange(capacity * 3 // 2) % capacity

    def gather(path, leaf):
        in_rows = any("rows" in str(key) or "aux_state" in str(key) for key in path)
        return leaf[take] if in_rows else leaf

    return jax.tree_util.tree_map_with_path(gather, state)


def counts(state):
    return {"rows": state.aux_state["hits"].shape[0]}


def model(spec=ToySpec(), change=None):
    """`change` takes the place of `step`."""
    event = Event("grow", spec.grow_at, grow)
    return Model(
        spec, lambda c, k: init(c, k, spec), change or step, None, (event,), counts
    )


MODEL = model()
QUIET = rich.console.Console(quiet=True)


def start(seed=5):
    return init(None, jax.random.key(seed))


def fit(frames, state=None, model=MODEL, **settings):
    state = start() if state is None else state
    return loop.fit(model, state, frames, **({"console": QUIET} | settings))


def same(one, other):
    """Whether two states are the same, bit for bit."""
    leaves = [jax.tree.leaves(state) for state in (one, other)]
    return jax.tree.structure(one) == jax.tree.structure(other) and all(
        a.dtype == b.dtype and np.array_equal(bits(a), bits(b))
        for a, b in zip(*leaves, strict=True)
    )


def bits(leaf):
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.ascontiguousarray(leaf).view(np.uint8)
