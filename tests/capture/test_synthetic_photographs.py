"""Built-in scenes of photographs: static, in no order, with one camera."""

import dataclasses

import numpy as np
import pytest

from nerfies_jax.capture import synthetic
from nerfies_jax.capture.synthetic import presets, rendering
from nerfies_jax.geometry import camera as cameras
from tests import scene_oracle


@pytest.mark.parametrize("name", ["static-20", "static-50"])
def test_photographs_of_a_static_scene_have_one_camera_and_no_order(name):
    spec = synthetic.PRESETS[name]
    plan = rendering.schedule(spec, seed=0)
    assert not any(thing.moves() for thing in spec.all_things())
    assert plan.light_gain.min() == plan.light_gain.max()
    assert len(plan.time) == int(name[-2:])
    np.testing.assert_array_equal(
        np.flatnonzero(~plan.learn), np.arange(0, len(plan.time), 8)
    )
    assert np.ptp(plan.camera_id) == np.ptp(plan.cameras.focal_px) == 0
    # The next photograph is no closer than any other one.
    position = plan.cameras.position
    away = np.linalg.norm(position[:, None] - position, axis=-1)
    typical = np.median(away[np.triu_indices(len(away), 1)])
    assert np.median(np.diag(away, 1)) > 0.8 * typical
    # Every photograph shows the middle, and has two others from less than 40 degrees.
    target = np.array(spec.snapshots.target)
    for row in range(len(position)):
        pixel = scene_oracle.project(cameras.take(plan.cameras, row), target[None])[0]
        assert np.all(np.abs(pixel / spec.size - 0.5) < 0.25)
    view = position - target
    view /= np.linalg.norm(view, axis=-1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(view @ view.T, -1, 1)))
    assert np.sort(angle, axis=1)[:, 2].max() < 40
    # Thin parts cover one to five pixels.
    width = 2 * min(min(getattr(one.shape, "half", (1,))) for one in spec.things)
    distance = np.linalg.norm(position - target, axis=1)
    px = width * plan.cameras.focal_px[0] / distance
    assert px.min() > 1
    assert px.max() < 5


def test_cameras_of_photographs_stay_on_their_side_or_go_around():
    angles = {}
    for name in ("static-20", "static-50"):
        plan = rendering.schedule(synthetic.PRESETS[name], seed=0)
        x, _, z = plan.cameras.position.T
        angles[name] = np.sort(np.degrees(np.arctan2(x, z)))
    assert np.abs(angles["static-20"]).max() < 18
    assert np.diff(angles["static-50"], append=angles["static-50"][0] + 360).max() < 40


@pytest.mark.full
def test_photographs_are_written_and_read_without_flow_and_masks(tmp_path):
    spec = dataclasses.replace(
        synthetic.PRESETS["static-20"],
        size=(32, 24),
        frames=4,
        heldout_every=2,
        supersampling=1,
        snapshots=synthetic.Snapshots(columns=2, rows=2, arc_rad=0.3),
    )
    capture, _ = synthetic.cached(spec, tmp_path)
    np.testing.assert_array_equal(capture.train, [1, 3])
    np.testing.assert_array_equal(capture.heldout, [0, 2])
    assert capture.moving is capture.flow is capture.background is None
    assert (capture.depths > 0).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": 19}, "frames=19 must be 5 columns times 4 rows of snapshots, 20"),
        ({"things": (presets.WALL, presets.CUBE)}, "remove cube"),
        ({"rig": synthetic.Rig()}, "remove rig"),
    ],
)
def test_photographs_that_contradict_their_scene_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(synthetic.PRESETS["static-20"], **change)
