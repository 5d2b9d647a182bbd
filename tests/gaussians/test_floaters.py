"""Gaussians that one camera alone sees, or that hang in front of it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from gaussians_jax.core import splats
from gaussians_jax.optim import floaters
from gaussians_jax.optim.densification import DefaultStrategySpec
from gaussians_jax.optim.floaters import FloaterSpec
from gaussians_jax.scene import scene as splat_scene
from gaussians_jax.scene.spec import refuse_what_cannot_train
from nerfies_jax import evaluation
from nerfies_jax.geometry import camera as cameras
from tests import scenes
from tests.gaussians.shared import rows_of, some_gaussians

SIZE = (16, 12)


def scene(rng, count=300):
    """Gaussians around the origin and beyond, seen by cameras from several sides."""
    gaussians = some_gaussians(count, "float32")
    mean = rng.normal(size=(count, 3)) * 1.5
    rows = rows_of(gaussians._replace(mean=np.asarray(mean, np.float32)))
    logit = rng.normal(size=count).astype(np.float32)
    logit[:10] = splats.INACTIVE_LOGIT
    places = [(3, 0.5, -2), (-2, 1, 3), (0.5, -1, 4), (-3, 0.2, -1)]
    views = [cameras.look_at(p, (0, 0, 0), (0, 1, 0), 14.0, SIZE) for p in places]
    stacked = cameras.stack(views)
    skewed = stacked._replace(
        skew_px=np.full(4, 0.7, np.float32),
        pixel_aspect=np.full(4, 1.3, np.float32),
    )
    return rows._replace(opacity_logit=jnp.asarray(logit)), skewed


def slowly(spec, rows, views):
    """The definition, one Gaussian and camera after the other, in float64."""
    mean = np.asarray(rows.mean, np.float64)
    opacity = scipy.special.expit(np.asarray(rows.opacity_logit, np.float64))
    active = np.flatnonzero(opacity > 1e-6)
    count, near = np.zeros(len(mean), int), np.zeros(len(mean), bool)
    for index in range(len(views.position)):
        one = cameras.take(views, index)
        shown = {}
        for row in active:
            point = one.camera_from_world.astype(float) @ (mean[row] - one.position)
            pixel = np.asarray(cameras.camera_matrix(one), float) @ point / point[2]
            if point[2] > 0 and (pixel[:2] >= 0).all() and (pixel[:2] < SIZE).all():
                shown[row] = point[2]
                count[row] += 1
        total, before = sum(opacity[row] for row in shown), 0.0
        for row in sorted(shown, key=shown.get):
            before += opacity[row]
            if before >= total / 2:
                subject = shown[row]
                break
        for row, depth in shown.items():
            near[row] |= spec.near is not None and depth < spec.near * subject
    result = near | (count < spec.views)
    return result & (opacity > 1e-6)


@pytest.mark.parametrize(
    "spec", [FloaterSpec(0.5, 2), FloaterSpec(None, 3), FloaterSpec(0.4, 0)]
)
def test_floaters_are_those_of_the_definition(spec, rng):
    rows, views = scene(rng)
    actual = floaters.find(spec, rows, views, SIZE)
    expected = slowly(spec, rows, views)
    assert 0 < expected.sum() < 250
    np.testing.assert_array_equal(actual, expected)


@pytest.mark.hard_cases
def test_behind_all_cameras_or_in_one_nothing_is_near(rng):
    rows, views = scene(rng, 12)
    at_camera = jnp.broadcast_to(jnp.asarray(views.position[0]), (12, 3))
    actual = floaters.find(
        FloaterSpec(0.5, 0), rows._replace(mean=at_camera), views, SIZE
    )
    # At the center of a camera there is no direction, and no division by zero.
    assert not actual.any()
    behind = rows._replace(mean=rows.mean + 1000)
    actual = floaters.find(FloaterSpec(0.5, 1), behind, views, SIZE)
    np.testing.assert_array_equal(actual, [False] * 10 + [True] * 2)


def test_an_event_prunes_a_floater(rng):
    strategy = DefaultStrategySpec(
        refine_every=10,
        refine_start_iter=10,
        refine_stop_iter=15,
        cap_max=600,
        floaters=FloaterSpec(0.5, 0),
    )
    spec = dataclasses.replace(scenes.TINY_SPLATS, strategy=strategy)
    capture = scenes.tiny_capture()
    model = splat_scene.build(spec, splat_scene.metadata_of(capture))
    state = model.init(capture, jax.random.key(0))
    camera = cameras.take(capture.cameras, int(capture.train[0]))
    rows = state.params.rows["splats"]
    place = camera.position + 0.05 * camera.camera_from_world[2]
    mean = np.array(rows.mean)
    mean[3] = place
    state = state._replace(
        params=state.params._replace(
            rows={"splats": rows._replace(mean=jnp.asarray(mean))}
        )
    )
    (densify,) = (event for event in model.events if event.name == "densify")
    after = densify.apply(state, evaluation.frames_of(capture))
    left = np.asarray(after.params.rows["splats"].mean)
    active = np.asarray(splats.active_mask(after.params.rows["splats"]))
    assert not np.isclose(left[active], place).all(axis=1).any()
    assert active.sum() >= 0.9 * np.asarray(splats.active_mask(rows)).sum()


def test_settings_out_of_range_are_refused():
    with pytest.raises(ValueError, match=r"near=1\.0"):
        FloaterSpec(near=1.0)
    with pytest.raises(ValueError, match="views=-1"):
        FloaterSpec(views=-1)
    strategy = dataclasses.replace(
        scenes.TINY_DEFORMABLE.strategy, floaters=FloaterSpec()
    )
    moving = dataclasses.replace(scenes.TINY_DEFORMABLE, strategy=strategy)
    with pytest.raises(ValueError, match=r"strategy\.floaters=none"):
        refuse_what_cannot_train(moving)
