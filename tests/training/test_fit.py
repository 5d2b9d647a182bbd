import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy import optimize

from nerfies_jax.geometry import camera as cameras
from nerfies_jax.training.fit import CODE_SOLVERS, CameraSpec, fit_code, refine_camera

FOCAL = ("focal", "angular", "linear")
MOVE = jax.jit(cameras.move)
SIZE = (64, 48)
ANGULAR, LINEAR = np.array([0.03, -0.05, 0.04]), np.array([0.1, -0.06, 0.08])


def hat(angular):
    """The matrix of w × (...)."""
    return np.cross(np.eye(3), angular)


def scene_camera(dtype, distorted=True):
    camera = cameras.look_at((0.3, -0.4, -3), (0, 0, 0), (0, -1, 0), 80, SIZE, dtype)
    if distorted:
        camera = camera._replace(radial=np.array([-0.1, 0.02, 0], dtype))
    return camera


def scene_points(rng, dtype, count=20):
    return rng.uniform(-0.8, 0.8, (count, 3)).astype(dtype)


@jax.jit
def pixels(camera, points):
    return jax.vmap(cameras.project, (None, 0))(camera, points)[0]


@functools.partial(jax.jit, static_argnums=3)
def refine(start, points, seen, spec):
    return refine_camera(lambda c: pixels(c, points) - seen, start, spec)


def pose_error(camera, truth):
    """Angle (rad) and distance (scene units) between two cameras."""
    turn = (
        np.asarray(camera.camera_from_world, float)
        @ np.asarray(truth.camera_from_world, float).T
    )
    away = np.asarray(camera.position, float) - np.asarray(truth.position, float)
    return np.linalg.norm(turn - np.eye(3)) / np.sqrt(2), np.linalg.norm(away)


def test_a_camera_moves_as_its_matrix_does(float64):
    """Against the matrix exponential, also far out, where R x + t cancels."""
    camera = scene_camera("float64")
    camera = camera._replace(position=camera.position + 1e4)
    moved = MOVE(camera, ANGULAR, LINEAR)
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = hat(ANGULAR), LINEAR
    before = np.asarray(cameras.world_from_camera(camera))
    exact = before @ np.linalg.inv(scipy.linalg.expm(twist))
    # 1e-11: SciPy's side multiplies positions of 1e4
    np.testing.assert_allclose(cameras.world_from_camera(moved), exact, atol=1e-11)


def test_a_disturbed_camera_is_found_again_from_its_pixels(dtype, rng):
    truth, points = scene_camera(dtype), scene_points(rng, dtype)
    seen = pixels(truth, points)
    start = MOVE(truth, ANGULAR.astype(dtype), LINEAR.astype(dtype))
    start = start._replace(focal_px=start.focal_px * 1.2)
    refined = refine(start, points, seen, CameraSpec(unknowns=FOCAL))
    assert refined.converged
    assert refined.residual < {"float32": 1e-4, "float64": 1e-7}[dtype]
    # float32: an ulp of a pixel, 4e-6 px, over 80 px per rad, times the conditioning
    limit = {"float32": 2e-5, "float64": 1e-7}[dtype]
    assert max(pose_error(refined.value, truth)) < limit
    assert abs(refined.value.focal_px / truth.focal_px - 1) < limit


@pytest.mark.full
def test_noisy_pixels_give_the_least_squares_camera_of_scipy(float64, rng):
    truth, points = scene_camera("float64"), scene_points(rng, "float64")
    seen = np.asarray(pixels(truth, points)) + rng.normal(size=(20, 2))
    start = MOVE(truth, ANGULAR, LINEAR)
    refined = refine(start, points, seen, CameraSpec())
    assert refined.converged

    def residuals(step):
        rotation = scipy.linalg.expm(hat(step[:3])) @ np.asarray(
            truth.camera_from_world
        )
        moved = start._replace(camera_from_world=rotation, position=step[3:])
        return (np.asarray(pixels(moved, points)) - seen).ravel()

    exact = optimize.least_squares(
        residuals, [0, 0, 0, *start.position], xtol=1e-12, ftol=1e-12, gtol=1e-12
    )
    rms = np.sqrt(np.mean(exact.fun**2))
    assert refined.residual == pytest.approx(rms, rel=1e-9)
    assert refined.value.focal_px == start.focal_px
    # SciPy's slopes are differences; the optimum is flat to their 1e-6
    np.testing.assert_allclose(refined.value.position, exact.x[3:], atol=1e-5)


def texture(point):
    """A smooth picture on the plane z = 0."""
    x, y = point[0], point[1]
    return jnp.stack(
        [
            jnp.sin(3 * x + y) * jnp.cos(2 * y),
            jnp.cos(2 * x - 3 * y),
            jnp.sin(x * y * 2 + x),
        ]
    )


def photograph(camera):
    """The textured plane as the camera sees it, on a coarse grid of pixels."""
    across, down = np.meshgrid(np.arange(2, 64, 5) + 0.5, np.arange(2, 48, 5) + 0.5)
    centers = jnp.asarray(
        np.stack([across.ravel(), down.ravel()], -1), camera.position.dtype
    )

    def color(pixel):
        grads = (pixel - camera.principal_point_px) / camera.focal_px
        direction = jnp.append(grads, 1) @ camera.camera_from_world
        distance = -camera.position[2] / direction[2]
        return texture(camera.position + distance * direction)

    return jax.vmap(color)(centers)


@pytest.mark.full
def test_a_camera_is_found_from_colors_alone_and_wrong_minima_are_flagged(dtype):
    """Eight starts as one batch: near ones come back, far ones are flagged."""
    truth = scene_camera(dtype, distorted=False)
    seen = jax.jit(photograph)(truth)
    sizes = np.asarray([0, 0.2, 0.5, 1, 4, 8, 16, 32], dtype)
    spec = CameraSpec(max_residual=1e-3)

    def refine(size):
        start = MOVE(truth, size * ANGULAR.astype(dtype), size * LINEAR.astype(dtype))
        return refine_camera(lambda c: photograph(c) - seen, start, spec)

    refined = jax.jit(jax.vmap(refine))(sizes)
    right = []
    for row in range(8):
        error = max(pose_error(cameras.take(refined.value, row), truth))
        right.append(error < {"float32": 1e-4, "float64": 1e-6}[dtype])
    assert all(right[:4])
    assert not all(right)
    np.testing.assert_array_equal(refined.converged, right)


def test_what_cannot_determine_a_camera_is_flagged(dtype, rng):
    truth, points = scene_camera(dtype), scene_points(rng, dtype)
    start = MOVE(truth, ANGULAR.astype(dtype), LINEAR.astype(dtype))
    spec = CameraSpec(unknowns=FOCAL)
    one_point = np.tile(points[:1], (20, 1))
    a_line = np.linspace(-1, 1, 20, dtype=dtype)[:, None] * points[0]
    for degenerate in (one_point, a_line):
        refined = refine(start, degenerate, pixels(truth, degenerate), spec)
        assert refined.residual < 1e-3  # it fits, and means nothing
        assert not refined.converged
        assert np.isfinite(refined.value.position).all()
    lost = start._replace(position=np.full(3, np.nan, dtype))
    seen = pixels(truth, points)
    assert not refine(lost, points, seen, spec).converged
    with pytest.raises(ValueError, match="4 residuals cannot determine 7 unknowns"):
        refine(start, points[:2], seen[:2], spec)


@pytest.mark.full
def test_a_camera_that_sees_nothing_or_has_no_time_is_flagged(float64):
    start = scene_camera("float64")
    still = jax.jit(lambda c: refine_camera(lambda c: jnp.ones(8), c))(start)
    assert not still.converged
    assert max(pose_error(still.value, start)) < 1e-6

    def far_away(camera):
        return jnp.concatenate([camera.position - 1, camera.camera_from_world[0]]) ** 3

    hasty = CameraSpec(max_steps=1)
    assert not jax.jit(lambda c: refine_camera(far_away, c, hasty))(start).converged


FIRST, *OTHERS = CODE_SOLVERS
ONE_SOLVER = [FIRST, *(pytest.param(name, marks=pytest.mark.full) for name in OTHERS)]
# Steps and tolerance at which each solver has surely arrived. Adam only creeps there.
GENEROUS = {name: (200, 1e-3) for name in CODE_SOLVERS} | {"adam": (1000, 1e-2)}


@pytest.mark.parametrize("solver", ONE_SOLVER)
def test_every_solver_finds_the_ridge_regression(solver, dtype, rng):
    """Against the normal equations, for a code of two arrays."""
    matrix = rng.normal(size=(30, 8))
    wanted = matrix @ rng.normal(size=8) * 0.3
    exact = np.linalg.solve(matrix.T @ matrix + 0.1 * np.eye(8), matrix.T @ wanted)
    rows, target = matrix.astype(dtype), wanted.astype(dtype)

    def loss(code):
        flat = jnp.concatenate([code["a"], code["b"].reshape(-1)])
        return jnp.sum((rows @ flat - target) ** 2) + 0.1 * jnp.sum(flat**2)

    start = {"a": np.zeros(2, dtype), "b": np.zeros((2, 3), dtype)}
    steps, tolerance = GENEROUS[solver]
    solved = jax.jit(lambda start: fit_code(loss, start, solver, steps, tolerance))(
        start
    )
    assert solved.converged
    assert 1 < solved.steps <= steps
    assert solved.residual <= tolerance
    assert solved.value["b"].shape == (2, 3)
    code = np.concatenate([solved.value["a"], np.ravel(solved.value["b"])])
    # the gradient is the Hessian times the distance
    curvature = 2 * np.linalg.eigvalsh(matrix.T @ matrix + 0.1 * np.eye(8))[0]
    assert np.linalg.norm(code - exact) < tolerance / curvature + 1e-6


@pytest.mark.parametrize("solver", ONE_SOLVER)
def test_a_bad_start_comes_back_flagged(solver, dtype):
    start = np.asarray([-1.0, 2.0], dtype)
    solved = jax.jit(
        lambda start: fit_code(lambda c: jnp.sum(jnp.log(c)), start, solver, 20)
    )(start)
    assert not solved.converged
    np.testing.assert_array_equal(solved.value, start)


@pytest.mark.full
@pytest.mark.parametrize("solver", CODE_SOLVERS)
def test_a_solve_cut_short_is_flagged_and_no_worse_than_its_start(solver):
    """The loss is finite only left of 1, close to where the descent leads."""

    def loss(code):
        return jnp.sum(-jnp.log(1 - code) - 300 * code)

    start = np.float32([0.5, -3.0])
    value = jax.jit(loss)
    solved = jax.jit(lambda start: fit_code(loss, start, solver, 3, 1e-6))(start)
    assert not solved.converged
    assert np.isfinite(solved.value).all()
    assert value(solved.value) <= value(start)


@pytest.mark.parametrize("solver", CODE_SOLVERS)
@pytest.mark.full
def test_float32_codes_stay_float32_with_x64_on(solver, float64):
    solved = jax.jit(
        lambda start: fit_code(lambda c: jnp.sum((c - 0.5) ** 2), start, solver, 300)
    )(np.zeros(3, np.float32))
    assert solved.value.dtype == solved.residual.dtype == jnp.float32
    assert solved.converged
    np.testing.assert_allclose(solved.value, 0.5, atol=1e-3)
