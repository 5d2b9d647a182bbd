"""Compositing against mpmath loops, the Nerfies code's values and closed forms."""

import functools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from nerfies_jax.radiance import compositing
from nerfies_jax.radiance.compositing import AT_INFINITY, EMPTY_BELOW
from tests import gradients

# Compiled once for each precision and shape, which is much quicker than by operation.
weights_of = jax.jit(compositing.weights)
many_weights = jax.jit(jax.vmap(compositing.weights))
media_weights_of = jax.jit(compositing.media_weights)
composite = jax.jit(compositing.composite)
composite_media = jax.jit(compositing.composite_media)
thinned = jax.jit(compositing.thinned)
expected_distance = jax.jit(compositing.expected_distance)
median_indices = jax.jit(jax.vmap(compositing.median_index))


# A few roundings of numbers up to one.
ABSOLUTE = {"float32": 5e-7, "float64": 2e-15}
RELATIVE = {"float32": 1e-6, "float64": 1e-14}


def exact_weights(optical_depth):
    """Sample by sample, media as rows, with 50 digits."""
    with mpmath.workdps(50):
        depth = [[mpmath.mpf(float(d)) for d in row] for row in optical_depth]
        reaching, rows = mpmath.mpf(1), [[] for _ in depth]
        for sample in range(len(depth[0])):
            for row, medium in zip(rows, depth, strict=True):
                row.append(float(reaching * (1 - mpmath.exp(-medium[sample]))))
            for medium in depth:
                reaching *= mpmath.exp(-medium[sample])
    return np.array(rows)


def exact_thinned(depth, logit):
    with mpmath.workdps(60 + int(abs(logit))):
        share = 1 / (1 + mpmath.exp(-mpmath.mpf(float(logit))))
        opacity = 1 - mpmath.exp(-mpmath.mpf(float(depth)))
        return float(-mpmath.log(1 - share * opacity))


@pytest.mark.hard_cases
@pytest.mark.parametrize("level", [1e-8, 1e-4, 1.0, 30.0, 1e3])
def test_weights_are_exact_from_thin_air_to_walls(level, dtype, rng):
    depth = (rng.uniform(0.5, 1.5, 40) * level).astype(dtype)
    exact = exact_weights(depth[None])[0]
    # relative where float32 can hold the number; depths add up errors of their own size
    tolerance = RELATIVE[dtype] * (1 + np.cumsum(depth))
    shown = exact > 1e-30
    got = np.asarray(weights_of(depth), np.float64)
    assert np.all(np.abs(got / np.where(shown, exact, 1) - 1)[shown] < tolerance[shown])
    assert np.all(got[~shown] < 2e-30)


@pytest.mark.hard_cases
def test_thin_air_keeps_its_weight(dtype):
    weights = np.asarray(weights_of(np.full(40, 1e-8, dtype)), np.float64)
    assert abs(np.sum(weights) / 4e-7 - 1) < 1e-5


@pytest.mark.hard_cases
@pytest.mark.parametrize("case", ["walls", "mixed", "infinite last", "one wall"])
def test_weights_never_sum_to_more_than_one(case, dtype, rng):
    depth = {
        "walls": rng.uniform(0, 50, (256, 64)),
        "mixed": 10 ** rng.uniform(-8, 3, (256, 64)),
        "infinite last": np.concatenate(
            [rng.uniform(0, 0.2, (256, 63)), np.full((256, 1), 1e10)], axis=1
        ),
        "one wall": np.tile(np.eye(64) * 1e10, (4, 1)),
    }[case]
    total = np.sum(many_weights(depth.astype(dtype)), axis=1)
    assert total.dtype == dtype
    assert np.max(total) <= 1 + 1e-6
    if case in ("infinite last", "one wall"):
        assert np.min(total) >= 1 - 1e-6


@pytest.mark.hard_cases
def test_a_last_sample_at_infinity_leaves_the_others_alone(dtype, rng):
    depth = rng.uniform(0, 0.15, 40).astype(dtype)
    closed = depth.copy()
    closed[-1] = AT_INFINITY
    weights, open_ = (np.asarray(weights_of(x)) for x in (closed, depth))
    np.testing.assert_array_equal(weights[:-1], open_[:-1])
    passed = np.exp(-np.sum(np.asarray(depth[:-1], np.float64)))
    assert abs(float(weights[-1]) - passed) < ABSOLUTE[dtype]


@jax.jit
def weights_and_slopes(density, spacing):
    """Weights, and their slopes in each of the densities."""

    def weights(density):
        return compositing.weights(density * spacing)

    return weights(density), jax.jacrev(weights)(density)


@pytest.mark.hard_cases
@pytest.mark.parametrize("density", [0.0, 1e-12, 1.0, 1e6])
def test_density_at_infinity_has_finite_values_and_slopes(density, dtype):
    spacing = np.asarray([1.0, 2.0, 4.0, 1e10], dtype)
    found = weights_and_slopes(np.full(4, density, dtype), spacing)
    assert all(np.all(np.isfinite(leaf)) for leaf in found)


@pytest.mark.hard_cases
def test_an_overflowing_depth_is_opaque(dtype):
    depth = np.asarray([0.1, np.inf, 1.0, np.inf], dtype)
    weights, grads = weights_and_slopes(depth, np.ones(4, dtype))
    np.testing.assert_allclose(weights, [1 - np.exp(-0.1), np.exp(-0.1), 0, 0], 1e-6)
    assert np.all(np.isfinite(grads))


def test_weights_have_the_slopes_of_central_differences(float64, rng):
    depth = jnp.asarray(rng.uniform(0, 1, 12))
    cotangent = jnp.asarray(rng.normal(size=12))
    error = gradients.directional_error(
        lambda d: jnp.vdot(weights_of(d), cotangent), depth
    )
    assert error < 1e-8


@pytest.mark.hard_cases
@pytest.mark.parametrize("level", [1e-8, 1.0, 30.0])
def test_media_share_their_transmittance(level, dtype, rng):
    depth = (rng.uniform(0.1, 1, (3, 16)) * level).astype(dtype)
    exact = exact_weights(depth)
    got = np.asarray(media_weights_of(depth), np.float64)
    tolerance = RELATIVE[dtype] * (1 + np.cumsum(np.sum(depth, axis=0)))
    assert np.all(np.abs(got - exact) <= tolerance * exact + 1e-35)


def test_one_medium_is_no_media(dtype, rng):
    depth = jnp.asarray(rng.uniform(0, 1, 16), dtype)
    np.testing.assert_array_equal(media_weights_of(depth[None])[0], weights_of(depth))


def test_overlapping_media_count_as_in_the_papers(dtype):
    """Both walls of one sample are seen whole; opacity stays that of the ray."""
    depth = jnp.full((2, 1), 50.0, dtype)
    np.testing.assert_allclose(media_weights_of(depth), 1, rtol=1e-6)
    colours = jnp.asarray([[[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]], dtype)
    seen = composite_media(depth, colours, jnp.ones(1, dtype), jnp.ones(3, dtype))
    np.testing.assert_allclose(seen.colour, [1, 1, 0], atol=1e-6)
    assert abs(float(seen.alpha) - 1) < 1e-6


def test_media_composite_term_by_term(float64, rng):
    depth = rng.uniform(0, 0.3, (2, 9))
    colours, background = rng.uniform(size=(2, 9, 3)), rng.uniform(size=3)
    distances = np.sort(rng.uniform(1, 2, 9))
    seen = composite_media(
        *(jnp.asarray(x) for x in (depth, colours, distances, background))
    )
    passed = np.exp(-depth.sum())
    colour = passed * background
    for medium, weights in enumerate(exact_weights(depth)):
        for sample, weight in enumerate(weights):
            colour = colour + weight * colours[medium, sample]
    np.testing.assert_allclose(seen.colour, colour, rtol=1e-13)
    assert abs(float(seen.alpha) - (1 - passed)) < 1e-14
    joint = exact_weights(depth.sum(0)[None])[0]
    assert abs(float(seen.distance) - joint @ distances / joint.sum()) < 1e-13


LOGITS = [-100.0, -20.0, -1.0, 0.0, 3.0, 20.0, 100.0]
DEPTHS = [0.0, 1e-8, 0.1, 1.0, 17.0, 50.0, 1e10]


@functools.cache
def thin_grid(dtype):
    """Value and both slopes for all of `DEPTHS` and `LOGITS`, inside the precision."""
    grid = np.meshgrid(DEPTHS, LOGITS, indexing="ij")
    depth, logit = (values.astype(dtype) for values in grid)
    function = jax.value_and_grad(compositing.thinned, argnums=(0, 1))
    value, grads = jax.jit(jax.vmap(jax.vmap(function)))(depth, logit)
    return np.asarray(value, np.float64), np.asarray(grads, np.float64)


@pytest.mark.hard_cases
@pytest.mark.parametrize("logit", LOGITS)
@pytest.mark.parametrize("depth", DEPTHS)
def test_thinned_is_exact_with_finite_slopes(depth, logit, dtype):
    values, grads = thin_grid(dtype)
    row, column = DEPTHS.index(depth), LOGITS.index(logit)
    depth, logit = float(np.asarray(depth, dtype)), float(np.asarray(logit, dtype))
    exact = exact_thinned(depth, logit)
    # float32 has no sigmoid(-100)
    assert abs(values[row, column] - exact) <= RELATIVE[dtype] * exact + 1e-38
    with mpmath.workdps(200):
        share = 1 / (1 + mpmath.exp(-mpmath.mpf(logit)))
        through = mpmath.exp(-mpmath.mpf(depth))
        left = 1 - share * (1 - through)
        by_depth = float(share * through / left)
        by_logit = float(share * (1 - share) * (1 - through) / left)
    for grad, wanted in zip(grads[:, row, column], (by_depth, by_logit), strict=True):
        assert np.isfinite(grad)
        assert abs(grad - wanted) < 3 * ABSOLUTE[dtype] * max(wanted, 1)


@pytest.mark.full
@pytest.mark.hard_cases
def test_thinned_meets_itself_at_the_switch(dtype):
    """Opacity one quarter: the two forms may not differ by more than they err."""
    logit = np.full(3, np.log(3.0), dtype)  # a share of 3/4 of an opacity of 1/3
    depth = (np.log(1.5) * np.array([1 - 1e-6, 1, 1 + 1e-6])).astype(dtype)
    exact = [exact_thinned(*pair) for pair in zip(depth, logit, strict=True)]
    np.testing.assert_allclose(thinned(depth, logit), exact, atol=ABSOLUTE[dtype])


@pytest.mark.hard_cases
def test_thinned_keeps_its_digits_at_any_opacity(dtype):
    """XLA's log1p of float64 loses 120 eps about -0.41."""
    depth, logit = np.meshgrid([0.3, 1.0, 8.0], np.linspace(-2, 2, 41))
    depth, logit = depth.astype(dtype).ravel(), logit.astype(dtype).ravel()
    exact = [exact_thinned(*pair) for pair in zip(depth, logit, strict=True)]
    found = np.asarray(thinned(depth, logit), np.float64)
    # twice what was measured
    np.testing.assert_allclose(found, exact, rtol=6 * np.finfo(dtype).eps)


@pytest.mark.full
def test_thinned_multiplies_the_opacity(dtype, rng):
    depth, logit = rng.uniform(0, 3, 50), rng.normal(size=50)
    thin = thinned(jnp.asarray(depth, dtype), jnp.asarray(logit, dtype))
    wanted = (1 - np.exp(-depth)) / (1 + np.exp(-logit))
    np.testing.assert_allclose(-np.expm1(-thin), wanted, rtol=2 * RELATIVE[dtype])


def test_thinned_has_the_slopes_of_central_differences(float64, rng):
    depth, logit = jnp.asarray(rng.uniform(0, 5, 40)), jnp.asarray(rng.normal(size=40))
    error = gradients.directional_error(
        lambda d, v: jnp.sum(jnp.sin(thinned(d, v))), depth, logit
    )
    assert error < 1e-7


@pytest.mark.full
def test_blended_media_composite_as_nsff_prints_it(float64, rng):
    """T = prod (1 - a_d v) (1 - a_s (1 - v)), opacities a_d v and a_s (1 - v)."""
    depth, logit = rng.uniform(0, 1, (2, 10)), rng.normal(size=10)
    share = 1 / (1 + np.exp(-logit))
    opacity = (1 - np.exp(-depth)) * np.stack([share, 1 - share])
    passed = np.cumprod(np.prod(1 - opacity, axis=0))
    wanted = opacity * np.concatenate([[1], passed[:-1]])
    logits = jnp.asarray(np.stack([logit, -logit]))
    got = media_weights_of(thinned(jnp.asarray(depth), logits))
    np.testing.assert_allclose(got, wanted, rtol=1e-12)


def test_intervals_end_as_told(dtype):
    distances = jnp.asarray([0.5, 0.75, 1.75], dtype)
    for last in (AT_INFINITY, jnp.asarray(0.25, dtype)):
        got = compositing.intervals(distances, last)
        assert got.dtype == dtype
        np.testing.assert_array_equal(got, np.asarray([0.25, 1, last], dtype))


@pytest.mark.full
def test_a_ray_cut_in_two_is_the_ray(dtype, rng):
    """The back part is the background of the front."""
    depth = jnp.asarray(rng.uniform(0, 0.4, 20), dtype)
    colours = jnp.asarray(rng.uniform(size=(20, 3)), dtype)
    distances = jnp.asarray(np.sort(rng.uniform(1, 2, 20)), dtype)
    background = jnp.asarray(rng.uniform(size=3), dtype)

    def part(samples, behind):
        return composite(
            weights_of(depth[samples]),
            colours[samples],
            distances[samples],
            behind,
        )

    whole = part(slice(None), background)
    back = part(slice(8, None), background)
    front = part(slice(8), back.colour)
    np.testing.assert_allclose(front.colour, whole.colour, atol=ABSOLUTE[dtype])
    joined = front.alpha + (1 - front.alpha) * back.alpha
    assert abs(float(joined - whole.alpha)) < ABSOLUTE[dtype]
    stopped = (
        front.alpha * front.distance + (1 - front.alpha) * back.alpha * back.distance
    )
    assert abs(float(stopped / joined - whole.distance)) < 3 * ABSOLUTE[dtype]


def scene(dtype, samples=6):
    colours = np.linspace(0.1, 0.9, 3 * samples).reshape(-1, 3).astype(dtype)
    return colours, np.linspace(2.0, 4.5, samples).astype(dtype)


@jax.jit
def seen_and_slope(weights, colours, distances, background):
    """The composite, and the slope of its depth in the weights."""

    def depth(weights):
        seen = compositing.composite(weights, colours, distances, background)
        return seen.distance, seen

    grad, seen = jax.grad(depth, has_aux=True)(weights)
    return seen, grad


@pytest.mark.hard_cases
@pytest.mark.parametrize("scale", [0.0, 1e-38, 1e-20, 1e-8])
def test_an_empty_ray_is_background_at_its_far_end(scale, dtype):
    colours, distances = scene(dtype)
    background = np.asarray([1.0, 0.5, 0.25], dtype)
    weights = (scale * np.array([0.0, 1, 0, 2, 0, 0])).astype(dtype)
    seen, grads = seen_and_slope(weights, colours, distances, background)
    np.testing.assert_allclose(seen.colour, background, atol=1e-7)
    assert abs(float(seen.distance) - 4.5) < 1e-4
    assert float(seen.median_distance) == 4.5
    assert np.all(np.abs(grads) <= 4.5 / EMPTY_BELOW)


def test_a_single_hit_is_where_it_is(dtype):
    colours, distances = scene(dtype)
    weights = np.eye(6, dtype=dtype)[2]
    seen = composite(weights, colours, distances, np.ones(3, dtype))
    np.testing.assert_array_equal(seen.colour, colours[2])
    assert seen.distance == distances[2] == seen.median_distance
    assert seen.alpha == 1


@pytest.mark.hard_cases
def test_expected_distance_joins_its_two_ranges(dtype):
    """Continuous where the far end comes in, and between the two beyond."""
    _, distances = scene(dtype)

    def depth(alpha):
        weights = np.zeros(6, dtype)
        weights[1] = alpha
        return float(expected_distance(weights, distances, distances[-1]))

    assert abs(depth(1.0) - 2.5) < 1e-6
    assert abs(depth(EMPTY_BELOW * 1.0001) - 2.5) < 1e-6
    assert abs(depth(EMPTY_BELOW * 0.9999) - 2.5) < 3e-4
    assert abs(depth(EMPTY_BELOW / 2) - 3.5) < 1e-5


@pytest.mark.hard_cases
def test_median_is_the_first_sample_past_half(dtype, rng):
    weights = rng.dirichlet(np.ones(9), size=50) * rng.uniform(0.3, 1, (50, 1))
    got = np.asarray(median_indices(weights.astype(dtype)))
    for row, index in zip(weights, got, strict=True):
        total, wanted = 0.0, 8
        for sample, weight in enumerate(row):
            total += weight
            if total >= 0.5:
                wanted = sample
                break
        assert index == wanted


@pytest.mark.parametrize("background", [None, (0.2, 0.4, 0.9)])
def test_composite_has_the_slopes_of_central_differences(background, float64, rng):
    depth = jnp.asarray(rng.uniform(0.05, 0.4, 8))
    colours = jnp.asarray(rng.uniform(size=(8, 3)))
    distances = jnp.asarray(np.sort(rng.uniform(1, 2, 8)))
    behind = None if background is None else jnp.asarray(background)

    def loss(depth, colours, distances):
        seen = composite(weights_of(depth), colours, distances, behind)
        return jnp.sum(jnp.sin(3 * seen.colour)) + seen.alpha**2 + seen.distance**2

    error = gradients.directional_error(loss, depth, colours, distances)
    assert error < 1e-7


@pytest.mark.hard_cases
def test_faint_rays_have_the_slopes_of_central_differences(float64, rng):
    distances = jnp.asarray(np.sort(rng.uniform(1, 2, 8)))
    faint = jnp.asarray(rng.uniform(0, 1e-4, 8))
    error = gradients.directional_error(
        lambda w: compositing.expected_distance(w, distances, distances[-1]),
        faint,
        step=1e-8,
    )
    assert error < 1e-6


@pytest.mark.full
def test_no_light_is_lost_in_half_precision_products(dtype, rng):
    """Colours are summed, not multiplied as matrices: exact against a slow sum."""
    weights = rng.dirichlet(np.ones(64))
    colours, distances = rng.uniform(size=(64, 3)), np.sort(rng.uniform(1, 2, 64))
    to = functools.partial(jnp.asarray, dtype=dtype)
    seen = composite(to(weights), to(colours), to(distances), None)
    np.testing.assert_allclose(
        seen.colour, sum(w * c for w, c in zip(weights, colours, strict=True)), 1e-6
    )
    assert abs(float(seen.alpha) - sum(weights[:-1])) < 1e-6


@pytest.mark.full
class TestNerfies:
    """Values of the official code; five rays of ten samples, four modes."""

    def render(self, oracle_dir, dtype, infinite, background):
        values = np.load(oracle_dir / "nerfies.npz")
        sigma, z, rgb, dirs = (
            values[f"unit/render/{name}"] for name in ("sigma", "z", "rgb", "dirs")
        )
        # Its rays are not of unit length; ours are, so distances carry the length in
        # the optical depth alone.
        length = np.linalg.norm(dirs, axis=-1)

        def ray(sigma, z, rgb, length):
            last = AT_INFINITY if infinite else 0.0
            spacing = compositing.intervals(z, last) * length
            weights = weights_of(sigma * spacing)
            return weights, composite(weights, rgb, z, background)

        prefix = "unit/render" if dtype == "float32" else "unit64/render"
        weights, seen = jax.vmap(ray)(
            *(jnp.asarray(x, dtype) for x in (sigma, z, rgb, length))
        )
        mode = f"inf{int(infinite)}_white{int(background is not None)}"
        names = ("rgb", "depth", "med_depth", "acc", "weights")
        wanted = {name: values[f"{prefix}/{mode}/{name}"] for name in names}
        return weights, seen, wanted, np.asarray(z, dtype), rgb

    # its 1e-10 in the transmittance, ten times
    TOLERANCE = {"float32": 1e-6, "float64": 2e-9}  # noqa: RUF012

    def test_infinite_last_sample(self, oracle_dir, dtype):
        weights, seen, wanted, z, _ = self.render(oracle_dir, dtype, True, None)
        close = functools.partial(
            np.testing.assert_allclose, atol=self.TOLERANCE[dtype]
        )
        close(weights, wanted["weights"])
        close(seen.colour, wanted["rgb"])
        close(seen.alpha, wanted["acc"])
        close(np.sum(weights * z, axis=-1), wanted["depth"])
        # ours leaves out the sample at infinity, theirs takes it for a surface
        hit = 1 - np.asarray(weights[:, -1])
        ours = seen.distance * hit + weights[:, -1] * z[:, -1]
        close(ours, wanted["depth"])
        close(seen.median_distance, wanted["med_depth"])

    def test_white_behind_a_finite_last_sample(self, oracle_dir, dtype):
        white = jnp.ones(3, dtype)
        weights, seen, wanted, z, _ = self.render(oracle_dir, dtype, False, white)
        close = functools.partial(
            np.testing.assert_allclose, atol=self.TOLERANCE[dtype]
        )
        close(weights, wanted["weights"])
        close(seen.colour, wanted["rgb"])
        close(seen.alpha, wanted["acc"])
        close(np.sum(weights * z, axis=-1), wanted["depth"])
        close(seen.distance * seen.alpha, wanted["depth"])
        close(seen.median_distance, wanted["med_depth"])

    def test_black_behind_a_finite_last_sample(self, oracle_dir, dtype):
        weights, _, wanted, _, rgb = self.render(oracle_dir, dtype, False, None)
        black = jnp.zeros(3, dtype)
        close = functools.partial(
            np.testing.assert_allclose, atol=self.TOLERANCE[dtype]
        )
        colours = jnp.asarray(rgb, dtype)
        seen = jax.vmap(lambda w, c: composite(w, c, w, black))(weights, colours)
        close(seen.colour, wanted["rgb"])
        close(seen.alpha, wanted["acc"])

    def test_its_white_never_shows_and_ours_does(self, oracle_dir, dtype):
        """White and a sample at infinity together: the official code adds nothing."""
        values = np.load(oracle_dir / "nerfies.npz")
        theirs, without = (
            values[f"unit/render/inf1_white{white}/rgb"] for white in (1, 0)
        )
        np.testing.assert_allclose(theirs, without, atol=2e-7)  # the known fault
        white = jnp.ones(3, dtype)
        _, seen, _, _, rgb = self.render(oracle_dir, dtype, False, white)
        weights = values["unit64/render/inf0_white0/weights"]
        wanted = np.einsum("rs,rsc->rc", weights, rgb) + (1 - weights.sum(1))[:, None]
        np.testing.assert_allclose(seen.colour, wanted, atol=self.TOLERANCE[dtype])
        assert np.max(np.abs(np.asarray(seen.colour) - theirs)) > 0.05


@pytest.mark.full
@pytest.mark.hard_cases
@pytest.mark.parametrize("narrow", [jnp.bfloat16, jnp.float16])
def test_narrow_depths_are_summed_in_float32(narrow, rng):
    """A running sum of 128 depths in bfloat16 loses a hundredth of the light."""
    depth = rng.uniform(0, 0.1, 128).astype(narrow)
    exact = exact_weights(np.asarray(depth, np.float64)[None])[0]
    found = weights_of(depth)
    joint = media_weights_of(np.stack([depth, depth]) / narrow(2))
    assert found.dtype == joint.dtype == narrow
    unit = float(jnp.finfo(narrow).eps)
    near = {"rtol": unit, "atol": 2.0**-24}  # of which float16 has no less
    np.testing.assert_allclose(np.asarray(found, np.float64), exact, **near)
    both = np.sum(np.asarray(joint, np.float64), axis=0)
    # Two halves of the opacity of one sample overlap.
    wanted = exact * 2 * -np.expm1(-np.asarray(depth, np.float64) / 2)
    wanted /= -np.expm1(-np.asarray(depth, np.float64))
    np.testing.assert_allclose(both, wanted, **near)
    middle = np.searchsorted(np.cumsum(exact), 0.5)
    assert abs(int(median_indices(found[None])[0]) - middle) <= 1
