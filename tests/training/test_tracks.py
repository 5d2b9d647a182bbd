import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from nerfies_jax.geometry import lie
from nerfies_jax.training.tracks import InverseSpec, inverse_warp, point_tracks
from tests import gradients

SPEC = InverseSpec()
# (angular, linear): still, a nudge, ordinary, half a turn (where the way from the
# identity is singular in the middle), nearly a full one.
SCREWS = (
    ((0, 0, 0), (0, 0, 0)),
    ((1e-8, 0, 0), (0, 1e-8, 0)),
    ((0.3, -0.8, 0.5), (0.1, 0.2, 0.3)),
    ((np.pi, 0, 0), (0.5, 0, 0)),
    ((0, 3.1, 0), (0, 0.2, 0.1)),
    ((0, 0, 6.2), (-0.3, 0, 0)),
)


def screw(params, point):
    return lie.displacement(params[0], params[1], point)


def waves(params, point):
    """Six plane waves in random directions."""
    directions, phases, amplitudes = params
    return amplitudes.T @ jnp.sin(directions @ point + phases)


def wave_params(rng, grad, dtype="float64"):
    """Waves whose displacement's Jacobian has spectral norms up to about `grad`."""
    directions = 4 * rng.normal(size=(6, 3))
    phases, amplitudes = rng.uniform(0, 6, 6), rng.normal(size=(6, 3))
    places = rng.uniform(-1, 1, (2000, 3))
    cosines = np.cos(places @ directions.T + phases)
    grads = np.einsum("fi,nf,fj->nij", amplitudes, cosines, directions)
    amplitudes *= grad / np.linalg.norm(grads, 2, axis=(1, 2)).max()
    return tuple(x.astype(dtype) for x in (directions, phases, amplitudes))


def wave(params, point):
    """A fold along x only: x + a sin(k x)."""
    amplitude, wavenumber = params
    return jnp.stack(
        [amplitude * jnp.sin(wavenumber * point[0]), 0 * point[1], 0 * point[2]]
    )


def saturating(params, point):
    """x + d(x) = a tanh(x): its image ends at a."""
    return params * jnp.tanh(point) - point


def hat(angular):
    """The matrix of w × (...)."""
    return np.cross(np.eye(3), angular)


def both(params, point):
    """A screw and waves: one program for all that has either."""
    (angular, linear), plane_waves = params
    return screw((angular, linear), point) + waves(plane_waves, point)


LANES = 256


@jax.jit
def _solved(screws, plane_waves, canonical):
    def one(screw_of, canonical):
        return inverse_warp(both, (screw_of, plane_waves), canonical, spec=SPEC)

    return jax.vmap(one)(screws, canonical)


def solved(screws, plane_waves, canonical, dtype):
    """The inverse at each point; the last is repeated up to LANES."""
    count = len(canonical)
    rows = np.minimum(np.arange(LANES), count - 1)
    screws = np.broadcast_to(np.asarray(screws, dtype), (count, 2, 3))[rows]
    solution = _solved((screws[:, 0], screws[:, 1]), plane_waves, canonical[rows])
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:count], solution)


def waved(params, points):
    """Where the waves take points, float64."""
    directions, phases, amplitudes = (np.asarray(x, float) for x in params)
    return points + np.sin(points @ directions.T + phases) @ amplitudes


def test_rigid_motions_are_inverted_to_rounding(dtype, rng):
    points = rng.uniform(-1, 1, (len(SCREWS), 3))
    canonical = []
    for (w, v), point in zip(SCREWS, points, strict=True):
        twist = np.zeros((4, 4))
        twist[:3, :3], twist[:3, 3] = hat(w), v
        motion = scipy.linalg.expm(twist)
        canonical.append(motion[:3, :3] @ point + motion[:3, 3])
    still = wave_params(rng, 0.0, dtype)
    fit = solved(SCREWS, still, np.asarray(canonical, dtype), dtype)
    assert fit.converged.all()
    assert fit.value.dtype == dtype
    # coordinates of order one: some ulps of them, through the sine of a large angle
    error = np.abs(fit.value - points).max()
    assert error < {"float32": 2e-6, "float64": 1e-14}[dtype]


def test_a_strongly_non_rigid_warp_is_inverted(dtype, rng):
    params = wave_params(rng, 0.95, dtype)
    points = rng.uniform(-1, 1, (LANES, 3)).astype(dtype)
    fit = solved(SCREWS[0], params, waved(params, points).astype(dtype), dtype)
    assert fit.converged.all()
    # one ulp of c becomes 1 / (1 - 0.95) in x at worst
    error = np.abs(fit.value - points).max()
    assert error < {"float32": 5e-6, "float64": 2e-14}[dtype]
    assert (fit.residual <= {"float32": 5e-7, "float64": 1e-15}[dtype]).all()


@pytest.mark.full
@pytest.mark.hard_cases
def test_a_flag_is_true_only_at_upright_roots_of_a_folding_warp(float64, rng):
    params = wave_params(rng, 4.0)
    points = rng.uniform(-1, 1, (256, 3))
    directions, phases, amplitudes = params
    canonical = waved(params, points)
    fit = solved(SCREWS[0], params, canonical, "float64")
    place = fit.value
    angles = place @ directions.T + phases
    residual = np.linalg.norm(waved(params, place) - canonical, axis=1)
    grads = np.einsum("fi,nf,fj->nij", amplitudes, np.cos(angles), directions)
    upright = np.linalg.det(np.eye(3) + grads) > 0
    np.testing.assert_array_equal(fit.converged, (residual < 1e-5) & upright)
    np.testing.assert_allclose(fit.residual, residual, atol=1e-12)
    before = np.einsum(
        "fi,nf,fj->nij", amplitudes, np.cos(points @ directions.T + phases), directions
    )
    assert (np.linalg.det(np.eye(3) + before) < 0).mean() > 0.2  # it does fold
    # measured 0.91; Newton started at the canonical point 0.57, dogleg 0.62
    assert fit.converged.mean() > 0.85
    assert not fit.converged.all()


@pytest.mark.hard_cases
def test_a_fold_has_no_unique_inverse_and_is_flagged(dtype):
    """Against the number of roots counted by sign changes on a fine grid."""
    params = (np.asarray(0.1, dtype), np.asarray(20.0, dtype))  # slope 1 ± 2
    canonical = np.linspace(-0.5, 0.49, 101)
    grid = np.linspace(-1, 1, 200_001)
    image = grid + 0.1 * np.sin(20 * grid)
    roots = np.array([(np.diff(np.sign(image - c)) != 0).sum() for c in canonical])
    # At the edge of a fold two roots merge, and rounding decides.
    edges = image[1:-1][np.diff(np.sign(np.diff(image))) != 0]
    clear = np.abs(canonical[:, None] - edges).min(1) > 2e-3
    assert {1, 3} <= set(roots[clear])  # the test sees both
    targets = np.stack([canonical, 0 * canonical, 0 * canonical], 1)
    spec = InverseSpec(reach=0.2)  # the displacement's whole range
    fit = jax.jit(jax.vmap(lambda c: inverse_warp(wave, params, c, spec=spec)))(
        targets.astype(dtype)
    )
    np.testing.assert_array_equal(fit.converged[clear], (roots == 1)[clear])


@pytest.mark.hard_cases
def test_outside_the_image_of_a_warp_there_is_nothing(dtype):
    """Flagged, finite, and without any derivative; the lane beside it keeps its own."""
    half = np.asarray(0.5, dtype)
    targets = np.asarray([[0.9, 0, 0], [0.2, 0.1, -0.3]], dtype)

    def places(width, targets):
        fit = jax.vmap(lambda c: inverse_warp(saturating, width, c))(targets)
        return fit.value, fit

    @jax.jit
    def every(width, targets):
        _, pull, fit = jax.vjp(places, width, targets, has_aux=True)
        one_by_one = np.eye(6, dtype=dtype).reshape(6, 2, 3)
        return fit, *jax.vmap(pull)(one_by_one)

    fit, by_width, grads = jax.tree.map(np.asarray, every(half, targets))
    grads = grads.reshape(2, 3, 2, 3)
    assert fit.converged.tolist() == [False, True]
    assert np.isfinite(fit.value).all()
    np.testing.assert_allclose(
        fit.value[1], np.arctanh(2 * np.asarray(targets[1], float)), atol=2e-6
    )
    np.testing.assert_array_equal(grads[0], 0)
    exact = np.diag(2 / (1 - (2 * np.asarray(targets[1], float)) ** 2))
    np.testing.assert_allclose(grads[1, :, 1], exact, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(by_width[:3], 0)


@pytest.mark.hard_cases
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_field_that_is_not_finite_is_flagged(bad, dtype, rng):
    point = np.asarray([[0.1, 0.2, 0.3]], dtype)
    directions, phases, amplitudes = wave_params(rng, 0.5, dtype)
    fit = solved(SCREWS[0], (directions, phases, amplitudes * bad), point, dtype)
    assert not fit.converged
    np.testing.assert_array_equal(fit.value, point)


def test_gradients_are_those_of_the_implicit_function(float64, rng):
    params = wave_params(rng, 0.9)
    target = np.array([0.2, -0.5, 0.7])

    @jax.jit
    def place_and_slopes(params, target):
        def place(params, target):
            value = inverse_warp(waves, params, target).value
            return value, value

        slopes = jax.jacrev(place, (0, 1), has_aux=True)
        (by_params, by_target), value = slopes(params, target)
        return value, by_params, by_target

    x, by_params, by_target = place_and_slopes(params, target)
    directions, phases, amplitudes = params
    sine, cosine = (f(directions @ x + phases) for f in (np.sin, np.cos))
    inverse = np.linalg.inv(np.eye(3) + amplitudes.T @ (cosine[:, None] * directions))
    exact = {
        "directions": -np.einsum("ij,fj,f,k->ifk", inverse, amplitudes, cosine, x),
        "phases": -np.einsum("ij,fj,f->if", inverse, amplitudes, cosine),
        "amplitudes": -np.einsum("ij,f->ifj", inverse, sine),
    }
    for grad, slope in zip(by_params, exact.values(), strict=True):
        np.testing.assert_allclose(grad, slope, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(by_target, inverse, rtol=1e-10, atol=1e-12)


def moving(params, point, condition):
    """Turns by `rate` rad per time about an axis through `center`, and swells."""
    rate, swell = params
    center = condition["center"]
    offset = point - center
    turned = lie.displacement(rate * condition["time"], 0 * rate, offset)
    return turned + swell * jnp.sin(3 * condition["time"]) * offset


def moving_truth(params, canonical, times, center):
    """The observed points, by rotation matrices."""
    rate, swell = (np.asarray(p, np.float64) for p in params)
    tracks = []
    for time in times:
        turn = scipy.linalg.expm(hat(rate * time))
        matrix = turn + swell * np.sin(3 * time) * np.eye(3)
        tracks.append((canonical - center) @ np.linalg.inv(matrix).T + center)
    return np.stack(tracks, 1)


@pytest.mark.parametrize(
    "row", [4, *(pytest.param(row, marks=pytest.mark.full) for row in (None, 8))]
)
def test_tracks_follow_points_through_a_known_motion(row, dtype, rng):
    params = (np.asarray([0.0, 2.5, 0.4], dtype), np.asarray(0.2, dtype))
    times = np.linspace(0, 1, 9)
    center = np.array([0.2, 0.0, -0.1])
    conditions = {
        "time": times.astype(dtype),
        "center": np.tile(center.astype(dtype), (9, 1)),
    }
    canonical = rng.uniform(-1, 1, (5, 3))
    truth = moving_truth(params, canonical, times, center)
    inputs = canonical if row is None else truth[:, row]
    tracks = jax.jit(lambda p, x, m: point_tracks(moving, p, x, m, row))(
        params, inputs.astype(dtype), conditions
    )
    assert tracks.converged.all()
    error = np.abs(np.asarray(tracks.points) - truth).max()
    assert error < {"float32": 3e-6, "float64": 1e-13}[dtype]


@pytest.mark.full
def test_a_track_survives_a_time_at_which_it_is_lost(dtype):
    """At two times the image of the warp ends before the point."""
    widths = np.asarray([2, 2, 0.5, 0.5, 2, 1.9], dtype)

    def field(params, point, width):
        return saturating(width, point)

    points = np.asarray([[0.9, 0.0, 0.0], [0.1, 0.2, -0.3]], dtype)
    tracks = jax.jit(lambda x, w: point_tracks(field, None, x, w))(points, widths)
    assert tracks.converged[0].tolist() == [True, True, False, False, True, True]
    assert tracks.converged[1].all()
    exact = np.arctanh(0.9 / np.array([2, 2, 2, 2, 2, 1.9]))
    np.testing.assert_allclose(tracks.points[0, :, 0], exact, atol=1e-6)


@pytest.mark.full
def test_gradients_of_tracks_equal_central_differences(float64):
    params = (np.array([0.0, 2.5, 0.4]), np.array(0.2))
    conditions = {"time": np.linspace(0, 1, 5), "center": np.full((5, 3), 0.1)}

    def total(params, points):
        tracks = point_tracks(moving, params, points, conditions, 2)
        return jnp.sum(tracks.points * jnp.arange(15.0).reshape(5, 3))

    assert gradients.directional_error(total, params, np.ones((2, 3)) / 3) < 1e-7
