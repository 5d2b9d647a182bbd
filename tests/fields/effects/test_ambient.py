"""The slice through ambient dimensions, against loops in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.fields.effects import ambient
from nerfies_jax.fields.effects.ambient import AmbientSpec
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.training.effects import TIMESTAMP, FrameCondition, Table
from tests import gradients, random_params
from tests.oracles import networks

BENT = AmbientSpec(
    position=EncodingSpec(3, identity=False),
    depth=4,
    width=16,
    skips=(2,),
    code_width=4,
    encoding=EncodingSpec(2, identity=False),
)
PLANE = AmbientSpec(kind="plane", dims=3)
# Past the last step of the default window
OPEN = 11_000


def condition(dtype, step=OPEN, seed=3):
    rng = np.random.default_rng(seed)
    codes = {"motion": rng.normal(size=4), "ambient": rng.normal(size=3)}
    codes = {name: jnp.asarray(code, dtype) for name, code in codes.items()}
    return FrameCondition(jnp.asarray(0.4, dtype), codes, jnp.int32(step))


def bent_params(dtype):
    """A surface far from the plane it starts as."""
    return random_params.like(lambda key: ambient.init(BENT, key), dtype)


def window_by_hand(spec, step):
    passed = min(max(step - spec.closed_steps, 0), spec.anneal_steps)
    bands = spec.encoding.bands
    return networks.window(bands, bands * passed / spec.anneal_steps)


def slice_by_hand(params, point, when):
    inputs = [networks.waves(BENT.position, point), when.codes["motion"]]
    return networks.heads(params, np.concatenate(inputs), BENT.skips)["ambient"]


STEPS = np.asarray([0, 1000, 2300, 6000, 8500, OPEN, 250_000], np.int32)


@jax.jit
def slices(params, point, when):
    """The ambient point, and what the template reads of it at each of `STEPS`."""

    def lift(step):
        return BENT.bind(1, None).apply(params, point, when._replace(step=step))

    return ambient.ambient_point(BENT, params, point, when), jax.vmap(lift)(
        jnp.asarray(STEPS)
    )


def test_a_bent_slice_is_the_loop_over_its_layers(dtype, rng):
    params, when = bent_params(dtype), condition(dtype)
    point = rng.uniform(-1, 1, 3).astype(dtype)
    exact = slice_by_hand(params, point, when)
    ambient_point, lifted = slices(params, point, when)
    tolerance = {"float32": 3e-6, "float64": 1e-13}[dtype]
    assert ambient_point.dtype == lifted.dtype == dtype
    np.testing.assert_allclose(ambient_point, exact, atol=tolerance)
    assert lifted.shape == (len(STEPS), BENT.bind(1, None).features)
    opened = [window_by_hand(BENT, int(step)) for step in STEPS]
    features = [networks.waves(BENT.encoding, exact, shares) for shares in opened]
    np.testing.assert_allclose(lifted, features, atol=tolerance)


@pytest.mark.parametrize("spec", [BENT, PLANE], ids=["bent", "plane"])
def test_while_shut_the_template_reads_zeros_and_nothing_learns(spec, dtype, rng):
    effect = spec.bind(1, None)
    params = bent_params(dtype) if spec.kind == "bent" else None
    point = jnp.asarray(rng.uniform(-1, 1, 3), dtype)
    pull = jnp.asarray(rng.normal(size=effect.features), dtype)
    still = condition(dtype)

    @jax.jit
    def read(params, codes, step):
        def total(params, codes):
            lifted = effect.apply(
                params, point, FrameCondition(still.time, codes, step)
            )
            return pull @ lifted, lifted

        return jax.grad(total, argnums=(0, 1), has_aux=True)(params, codes)

    def slopes_at(step):
        return jax.tree.map(np.asarray, read(params, still.codes, np.int32(step)))

    for step in (0, 1000):
        grads, lifted = slopes_at(step)
        assert np.all(lifted == 0)
        for grad in jax.tree.leaves(grads):
            assert np.all(grad == 0)
    # and just after it has begun to open, both do
    grad = slopes_at(1500)[0][1][effect.tables[0].name]
    assert np.all(grad != 0)
    assert np.all(np.isfinite(grad))


def test_a_plane_has_one_ambient_point_for_all_points(dtype, rng):
    effect = PLANE.bind(1, None)
    assert not hasattr(effect, "init")
    assert effect.tables == (Table("ambient", TIMESTAMP, 3),)
    when = condition(dtype)

    @jax.jit
    @jax.vmap
    def seen(point):
        return ambient.ambient_point(PLANE, None, point, when), effect.apply(
            None, point, when
        )

    ambient_points, lifted = seen(rng.normal(size=(5, 3)).astype(dtype))
    code = when.codes["ambient"]
    np.testing.assert_array_equal(ambient_points, np.tile(code, (5, 1)))
    exact = networks.waves(PLANE.encoding, code)
    np.testing.assert_allclose(lifted, np.tile(exact, (5, 1)), atol=1e-6)


def test_a_bent_slice_shares_the_code_of_the_warp_and_starts_flat(rng):
    spec = AmbientSpec()
    effect = spec.bind(1, None)
    assert effect.tables == (Table("motion", TIMESTAMP, 8),)
    points = rng.uniform(-1, 1, (200, 3)).astype(np.float32)
    codes = {"motion": jnp.asarray(np.full(8, 0.05, np.float32))}
    when = FrameCondition(jnp.float32(0), codes, jnp.int32(0))

    @jax.jit
    def start(key):
        params = effect.init(key)
        one = jax.vmap(lambda x: ambient.ambient_point(spec, params, x, when))
        return params.heads["ambient"].weight, one(points)

    weight, ambient_points = map(np.asarray, start(jax.random.key(0)))
    # of 128 numbers the deviation is known to 6 %
    assert abs(np.std(weight) / 1e-5 - 1) < 0.2
    # 64 features of size one, each times 1e-5, of random sign
    assert 0 < np.abs(ambient_points).max() < 1e-3


def test_a_slice_has_its_slopes_in_point_code_and_weights(float64, rng):
    params, when = bent_params("float64"), condition("float64", 7000)
    effect = BENT.bind(1, None)
    pull = rng.normal(size=effect.features)

    def read(params, point, code):
        seen = when._replace(codes={"motion": code})
        return pull @ effect.apply(params, point, seen)

    point = rng.uniform(-1, 1, 3)
    error = gradients.directional_error(
        read, params, point, when.codes["motion"], step=1e-6
    )
    assert error < 1e-6
