"""The local isometry loss against closed forms, and its gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.splats import Params
from gaussians_jax.losses.isometry import IsometrySpec, change_of_distances
from nerfies_jax.training.effects import FrameCondition, PenaltyContext
from tests.gaussians.shared import put, rows_of, some_gaussians
from tests.gradients import directional_error

EXTENT = 2.0
BOUND = IsometrySpec(count=3, gamma=0.0).bind(
    100, SceneMetadata(EXTENT, (0.0, 0.0, 0.0), 9)
)


def loss_of(move, dtype):
    """The loss of Gaussians whose means are moved."""
    params = Params({"splats": rows_of(some_gaussians(12, dtype))}, {})
    graph = BOUND.state(params)

    def at_time(some, time):
        canonical = some.rows["splats"].mean
        return some_gaussians(1, dtype)._replace(mean=move(canonical, time))

    def evaluate(params, time):
        context = PenaltyContext(
            FrameCondition(time),
            jnp.int32(3),
            jax.random.key(0),
            params,
            at_time=at_time,
            state=graph,
        )
        return BOUND.loss(params, context)

    return jax.jit(evaluate)(params, put(0.5, dtype))


def test_rigid_motion_is_free_and_stretching_has_the_change_of_lengths(dtype):
    turn = put(Rotation.from_rotvec([0.3, -0.8, 0.4]).as_matrix(), dtype)
    exact = {"float32": 1e-6, "float64": 1e-14}[dtype]
    assert loss_of(lambda mean, time: mean @ turn + 3 * time, dtype) < exact
    slow, fast = (
        float(loss_of(lambda mean, time, k=k: (1 + k * time) * mean, dtype))
        for k in (0.2, 0.4)
    )
    assert slow > 1e-3
    np.testing.assert_allclose(fast, 2 * slow, rtol=1e-5)


def test_one_pair_is_its_change_of_length(dtype):
    places = put([[[0, 0, 0], [3, 4, 0]]], dtype)
    moved = put([[[1, 1, 1], [1, 1, 8]]], dtype)
    ones = put([[1.0]], dtype)
    np.testing.assert_allclose(change_of_distances(places, moved, ones), 2, rtol=1e-6)
    assert change_of_distances(places, moved, 0 * ones) == 0


@pytest.mark.hard_cases
def test_points_that_coincide_have_a_finite_gradient(float64, rng):
    places = put(rng.normal(size=(4, 3, 3)))
    weight = put(rng.uniform(size=(4, 2)))

    def value(moved):
        return change_of_distances(places, moved, weight)

    moved = put(rng.normal(size=(4, 3, 3)))
    assert directional_error(value, moved) < 1e-6
    same = jnp.broadcast_to(moved[:, :1], moved.shape)
    assert np.isfinite(jax.grad(value)(same)).all()


def test_wrong_settings_are_refused():
    with pytest.raises(ValueError, match="samples=0"):
        IsometrySpec(samples=0)
    with pytest.raises(ValueError, match=r"weight=-1\.0"):
        IsometrySpec(weight=-1.0)
