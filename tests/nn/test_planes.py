"""Features from planes against SciPy and the reference values, and where cells meet."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate

from nerfies_jax.nn import planes
from nerfies_jax.nn.planes import Level, PlanesSpec
from tests import gradients

SPECS = {
    "hexplane": PlanesSpec(vertices=3, multiples=(1, 2), timestamps=4, features=2),
    "triplane": PlanesSpec(
        vertices=4, multiples=(1,), features=3, combination="sum", outside="refuse"
    ),
}
by_name = pytest.mark.parametrize("name", SPECS)
encode = jax.jit(planes.encode, static_argnums=0)


@functools.partial(jax.jit, static_argnums=0)
def encode_at_time(spec, levels, place, time):
    """As a motion does, for which all points share one time."""
    space = planes.space_features(spec, levels, place)
    of_time = planes.time_features(spec, planes.at_time(levels, time), place)
    return planes.features(spec, space, of_time)


def filled(spec, dtype, seed=0):
    rng = np.random.default_rng(seed)
    shapes = jax.eval_shape(lambda key: planes.init(spec, key), jax.random.key(0))
    return jax.tree.map(lambda x: rng.normal(size=x.shape).astype(dtype), shapes)


def expected(spec, levels, places):
    """Features [points, width] by SciPy's interpolation of every plane."""
    together = np.multiply if spec.combination == "product" else np.add
    every = []
    for level in levels:
        pairs = [*planes.PAIRS, *((3, axis) for axis in range(len(level.time)))]
        total = None
        for pair, plane in zip(pairs, (*level.space, *level.time), strict=True):
            axes = [np.linspace(0, 1, side) for side in plane.shape[:2]]
            oracle = scipy.interpolate.RegularGridInterpolator(axes, plane)
            actual = oracle(np.clip(places[:, pair], 0, 1))
            total = actual if total is None else together(total, actual)
        every.append(total)
    return np.concatenate(every, axis=1)


@by_name
def test_planes_are_bilinear_between_their_vertices(name, dtype, rng):
    spec = SPECS[name]
    dimensions = 3 if spec.timestamps is None else 4
    places = rng.uniform(size=(20, dimensions)).astype(dtype)
    levels = filled(spec, dtype)
    exact = expected(spec, levels, places)
    atol = {"float32": 5e-5, "float64": 1e-12}[
        dtype
    ]  # cells of products of six normals
    actual = np.array([encode(spec, levels, place) for place in places])
    assert actual.shape == (20, spec.width(dimensions))
    np.testing.assert_allclose(actual, exact, rtol=0, atol=atol)
    if dimensions == 4:
        shared = [encode_at_time(spec, levels, p[:3], p[3]) for p in places]
        np.testing.assert_allclose(shared, exact, rtol=0, atol=atol)


@pytest.mark.hard_cases
@pytest.mark.parametrize("vertex", [0, 1, 3, 6])
def test_cells_agree_where_they_meet(vertex, dtype, rng):
    """One step of the number to either side; at the vertex, exactly what it has."""
    plane = rng.normal(size=(7, 7, 2)).astype(dtype)
    tiny, edge = np.finfo(dtype).eps, vertex / 6
    sides = [np.asarray(edge * (1 + k * tiny), dtype) for k in (-1, 0, 1)]
    read, other = jax.jit(planes.bilinear), np.asarray(0.4, dtype)
    actual = np.array([read(plane, side, other) for side in sides], np.float64)
    assert np.abs(np.diff(actual, axis=0)).max() < 100 * tiny
    # In float32 a third is not the place of a vertex; 0, 1/2 and 1 are.
    if vertex % 3 == 0:
        here = np.asarray(edge, dtype)
        np.testing.assert_array_equal(read(plane, here, here), plane[vertex, vertex])


@by_name
@pytest.mark.parametrize("beyond", [-1e30, -0.1, 1.1, 1e30])
def test_what_is_outside_is_clamped_or_refused_as_the_spec_says(name, beyond, dtype):
    spec = SPECS[name]
    place = np.full(3 if spec.timestamps is None else 4, 0.3, dtype)
    for axis in range(len(place)):
        outside, nearest = place.copy(), place.copy()
        outside[axis], nearest[axis] = beyond, np.clip(beyond, 0, 1)
        actual = encode(spec, filled(spec, dtype), outside)
        if spec.outside == "refuse":
            assert np.isnan(actual).all()
            actual = encode(spec, filled(spec, dtype), nearest)
            assert np.isfinite(actual).all()
            continue
        same = encode(spec, filled(spec, dtype), nearest)
        np.testing.assert_array_equal(actual, same)


@by_name
def test_slopes_are_those_of_differences(name, float64):
    spec = SPECS[name]
    place = np.array([0.21, 0.44, 0.83, 0.55])[: 3 if spec.timestamps is None else 4]
    weights = np.random.default_rng(0).normal(size=spec.width(len(place)))

    def value(levels, place):
        return weights @ planes.encode(spec, levels, place)

    levels = filled(spec, "float64")
    assert gradients.directional_error(value, levels, place) < 1e-7


PENALTIES = {
    "total_variation": lambda p: sum(
        np.mean(np.square(p.take(range(1, 5), a) - p.take(range(4), a))) for a in (0, 1)
    ),
    "time_smoothness": lambda p: np.mean(np.square(p[2:] - 2 * p[1:-1] + p[:-2])),
    "l1_time_planes": lambda p: np.mean(np.abs(1 - p)),
}


@pytest.mark.parametrize("name", PENALTIES)
def test_penalties_are_the_means_that_they_say(name, float64):
    plane = np.random.default_rng(0).normal(size=(5, 5, 2))
    penalty = getattr(planes, name)
    exact = PENALTIES[name](plane)
    assert abs(jax.jit(penalty)(plane) - exact) < 1e-14
    assert gradients.directional_error(penalty, plane, step=1e-7) < 1e-6


@pytest.mark.hard_cases
def test_planes_that_start_have_nothing_to_smooth_in_time_and_no_slope(dtype):
    spec = SPECS["hexplane"]
    level = planes.init(spec, jax.random.key(0), np.dtype(dtype))[0]
    for penalty in (planes.time_smoothness, planes.l1_time_planes):
        value, slope = jax.jit(jax.value_and_grad(penalty))(level.time[0])
        assert value == 0
        assert not np.any(slope)


def test_the_reference_values_of_4dgs_are_met(dtype, oracle_dir):
    """Features, the slope of the sum of their squares, and the three regularizers."""
    stored = np.load(oracle_dir / "splatting" / "4dgs_hexplane.npz", allow_pickle=False)
    pairs = ("0", "1", "3"), ("2", "4", "5")  # theirs: xy, xz, xt, yz, yt, zt

    def plane(level, name):
        """[row, column, features]; theirs has the second coordinate for rows."""
        theirs = stored[f"w_grids.{level}.{name}"][0]
        return jnp.asarray(np.moveaxis(theirs, 0, -1).astype(dtype))

    levels = tuple(
        Level(
            tuple(jnp.swapaxes(plane(level, name), 0, 1) for name in pairs[0]),
            tuple(plane(level, name) for name in pairs[1]),
        )
        for level in range(2)
    )
    spec = PlanesSpec(vertices=8, multiples=(1, 2), timestamps=5, features=8)
    high, low = stored["aabb"].astype(dtype)
    # Theirs runs from the high corner to the low one, and reads time in [-1, 1].
    timestamp = (stored["t"][:, 0].astype(dtype) + 1) / 2

    @jax.jit
    def field(x):
        places = jnp.concatenate(
            [(high - x) / (high - low), timestamp[:, None]], axis=1
        )
        return jax.vmap(lambda place: planes.encode(spec, levels, place))(places)

    x = stored["x"].astype(dtype)
    # Of features up to 0.1 and slopes up to 0.17; theirs are computed in float32.
    atol = {"float32": 2e-6, "float64": 5e-7}[dtype]
    np.testing.assert_allclose(field(x), stored["y"], rtol=0, atol=atol)
    slope = jax.jit(jax.grad(lambda x: jnp.sum(field(x) ** 2)))(x)
    np.testing.assert_allclose(slope, stored["g_x"], rtol=0, atol=atol)
    space = [p for level in levels for p in level.space]
    time = [p for level in levels for p in level.time]
    bend, unrest = jax.jit(planes.time_smoothness), jax.jit(planes.l1_time_planes)
    # Their "plane TV" is a second difference along the second coordinate alone.
    for ours, theirs in (
        (sum(bend(jnp.swapaxes(p, 0, 1)) for p in space), "reg_plane"),
        (sum(map(bend, time)), "reg_time"),
        (sum(map(unrest, time)), "reg_l1"),
    ):
        assert abs(ours - stored[theirs]) < 1e-6


def test_two_timestamps_change_evenly():
    assert planes.time_smoothness(jnp.arange(12.0).reshape(2, 3, 2)) == 0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"features": 0}, "features >= 1"),
        ({"multiples": ()}, "a positive multiple"),
        ({"vertices": 1}, "must lie between 2"),
        ({"timestamps": 1}, "None for planes without time"),
        ({"combination": "mean"}, "unknown combination"),
        ({"outside": "wrap"}, "unknown outside"),
    ],
)
def test_no_planes_of_nothing(changes, words):
    with pytest.raises(ValueError, match=words):
        PlanesSpec(**changes)
    with pytest.raises(ValueError, match="4 dimensions, but the points have 3"):
        SPECS["hexplane"].width(3)
