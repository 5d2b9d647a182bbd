"""A moving scene as files of single times, read back by other readers."""

import dataclasses

import jax
import numpy as np
import plyfile
import pytest

from gaussians_jax.core import splats
from gaussians_jax.io import single_time
from gaussians_jax.scene import scene
from nerfies_jax import evaluation
from nerfies_jax.training.model import TrainState
from tests import scenes
from tests.gaussians.motions import moving_scene
from tests.gaussians.shared import jitted, put


@pytest.fixture(scope="module")
def swaying():
    """A model whose Gaussians move, and its state; some rows are inactive."""
    model = scene.build(
        scenes.TINY_DEFORMABLE, scene.metadata_of(scenes.tiny_capture())
    )
    return model, TrainState(moving_scene(), (), (), put(20, "int32"), None)


def columns(path, *names):
    vertex = plyfile.PlyData.read(path)["vertex"]
    return np.stack([vertex[name] for name in names], axis=-1)


@pytest.mark.full
def test_the_file_of_an_instant_is_drawn_as_the_scene_is_then(swaying):
    model, state = swaying
    rows = single_time.splats_at(model, state)(0.4)
    view = evaluation.view_of(scenes.tiny_capture(), 0)
    view = view._replace(time=put(0.4, "float32"))
    still = scene.build(scenes.TINY_SPLATS, model.spec[1])
    size = (20, 15)
    rendering = jitted(model.render, static_argnums=2)(
        state.params, view, size, state.step
    )
    params = state.params._replace(rows={"splats": rows}, nets={})
    posed = jitted(still.render, static_argnums=2)(params, view, size, state.step)
    np.testing.assert_allclose(posed.color, rendering.color, atol=1e-5)
    canonical = jitted(still.render, static_argnums=2)(
        state.params._replace(nets={}), view, size, state.step
    )
    assert np.abs(canonical.color - rendering.color).max() > 0.05


def test_a_sequence_is_numbered_files_of_the_same_rows(swaying, tmp_path):
    model, state = swaying
    at = single_time.splats_at(model, state)
    folder = tmp_path / "motion"
    times = single_time.save_sequence(folder, at, 3, ".ply")
    np.testing.assert_array_equal(times, [0, 0.5, 1])
    names = [f"frame_000{number}.ply" for number in range(3)]
    assert sorted(path.name for path in folder.iterdir()) == names
    active = np.asarray(splats.active_mask(state.params.rows["splats"]))
    assert not active.all()
    prepared = model.stages.prepare(state.params)
    deform = jitted(model.stages.deform)
    for name, time in zip(names, times, strict=True):
        exact = deform(state.params, prepared, np.float32(time))
        mean, turn, logarithm = (
            columns(folder / name, *keys)
            for keys in (
                ("x", "y", "z"),
                ("rot_0", "rot_1", "rot_2", "rot_3"),
                ("scale_0", "scale_1", "scale_2"),
            )
        )
        np.testing.assert_array_equal(mean, exact.mean[active])
        np.testing.assert_array_equal(turn, exact.quaternion[active])
        np.testing.assert_allclose(np.exp(logarithm), exact.scale[active], rtol=2e-6)
    with pytest.raises(ValueError, match="already there"):
        single_time.save_sequence(folder, at, 2, ".ply")
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"holds notes\.txt, which would be lost"):
        single_time.save_sequence(folder, at, 2, ".ply", overwrite=True)
    (folder / "notes.txt").unlink()
    single_time.save_sequence(folder, at, 2, ".ply", overwrite=True)
    assert sorted(path.name for path in folder.iterdir()) == names[:2]
    assert [path.name for path in tmp_path.iterdir()] == ["motion"]


def test_world_units_place_and_size_gaussians_as_the_capture_does(swaying):
    model, state = swaying
    rows = single_time.splats_at(model, state)(1.0)
    capture = dataclasses.replace(
        scenes.tiny_capture(), scale=0.25, center=(1.0, -2.0, 3.0)
    )
    world, rows = jax.tree.map(np.asarray, (single_time.in_world(rows, capture), rows))
    np.testing.assert_allclose(world.mean, 4 * rows.mean + capture.center, 1e-6)
    np.testing.assert_allclose(
        np.exp(world.log_scale), 4 * np.exp(rows.log_scale), 1e-5
    )
    # In meters of a map float32 has steps of half a meter.
    far = dataclasses.replace(capture, center=(500_000.0, 4_649_776.0, 120.0))
    with pytest.raises(ValueError, match=r"steps of 0\.5, .* scene \* 4 \+ \(500000, "):
        single_time.in_world(rows, far)


@pytest.mark.hard_cases
def test_opacities_that_a_motion_drives_to_the_ends_stay_finite(swaying):
    rows = swaying[1].params.rows["splats"]
    deformed = jax.jit(splats.activate)(rows)
    ends = np.resize(np.float32([0, 1]), len(deformed.opacity))
    as_rows = jax.jit(single_time._as_rows)(rows, deformed._replace(opacity=put(ends)))
    active = np.asarray(splats.active_mask(rows))
    logit = np.asarray(as_rows.opacity_logit)
    assert np.isfinite(logit).all()
    assert (np.asarray(splats.active_mask(as_rows)) == active).all()
    np.testing.assert_allclose(1 / (1 + np.exp(-logit[active])), ends[active], 0, 1e-6)


@pytest.mark.hard_cases
def test_scales_that_a_motion_takes_below_zero_keep_their_size(swaying):
    rows = swaying[1].params.rows["splats"]
    deformed = jax.jit(splats.activate)(rows)
    through = deformed._replace(scale=deformed.scale * put([1.0, -1.0, -0.5]))
    as_rows = jax.jit(single_time._as_rows)(rows, through)
    np.testing.assert_allclose(
        np.exp(as_rows.log_scale), np.abs(through.scale), rtol=1e-5
    )


def test_a_field_and_a_time_outside_have_no_gaussians(swaying):
    model, state = swaying
    with pytest.raises(ValueError, match=r"time=1\.5 must lie in"):
        single_time.splats_at(model, state)(1.5)
    with pytest.raises(ValueError, match="need a run of Gaussians"):
        single_time.splats_at(model._replace(stages=None), state)
    with pytest.raises(ValueError, match="not a sequence"):
        single_time.save_sequence(
            "nowhere", single_time.splats_at(model, state), 1, ".ply"
        )
