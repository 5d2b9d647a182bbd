"""The tables of what deformations cost, from the command line to the picture."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.deformation_cost import __main__ as deformation_cost
from experiments.deformation_cost import arms, knot_curve, known_motion
from experiments.deformation_cost import page as deformation_page
from gaussians_jax.effects import deformation, kan_motion
from gaussians_jax.effects.kan_motion import KanMotionSpec
from gaussians_jax.splats import Gaussians
from nerfies_jax.capture import images
from nerfies_jax.measure import clock
from tests import scenes


def narrowed(spec):
    """The same kind of network, small."""
    small = {"depth": 2, "width": 8, "skips": (), "base_depth": 2, "base_width": 8}
    small |= {"basis_width": 8, "block": 16}
    small |= {"embedding": 4, "time_code": 4, "hidden": (6, 6), "kernels": 3}
    there = {field.name for field in dataclasses.fields(spec)}
    return dataclasses.replace(spec, **{k: x for k, x in small.items() if k in there})


@pytest.fixture
def small(monkeypatch):
    """Networks that compile and run in no time, of every kind."""
    few = [
        network._replace(spec=narrowed(network.spec))
        for network in arms.NETWORKS
        if network.paper
    ]
    monkeypatch.setattr(arms, "NETWORKS", few)


def swinging(count=30):
    """A motion in closed form: a third of the rows swing, one of them is inactive."""
    rng = np.random.default_rng(0)
    center = jnp.asarray(rng.normal(size=(count, 3)), jnp.float32)
    still = Gaussians(
        center,
        jnp.tile(jnp.asarray([[1.0, 0, 0, 0]]), (count, 1)),
        jnp.full((count, 3), 0.1),
        jnp.ones(count).at[3].set(0),
    )
    swings = jnp.asarray(np.arange(count) % 3 == 0, jnp.float32)[:, None]

    def deform(time):
        way = swings * 0.5 * jnp.sin(2 * jnp.pi * time) * jnp.asarray([1.0, 0, 0])
        return still._replace(mean=still.mean + way)

    def draw(deformed, time):
        return jnp.broadcast_to(deformed.mean.mean(axis=0) / 10 + 0.5, (4, 5, 3))

    active = np.arange(count) != 3
    return known_motion.Moving("swing", jax.jit(deform), jax.jit(draw), active)


@pytest.mark.full
def test_the_curve_is_that_of_the_closed_form():
    curve = knot_curve.curve(swinging(), (2, 5, 9), 0.0, 1)
    assert (curve.gaussians, curve.moving) == (29, 9)
    np.testing.assert_allclose(curve.size, 0.5, rtol=1e-5)
    by = {(point.interpolation, point.knots): point for point in curve.points}
    assert list(by) == [
        *(("linear", count) for count in (2, 5, 9)),
        *(("cubic", count) for count in (5, 9)),  # which needs four
    ]
    # Two knots see no motion at all: everything is missing, and nothing is stored.
    nothing = by["linear", 2]
    times = np.linspace(0, 1, knot_curve.INSTANTS)
    swing = np.sin(2 * np.pi * times)
    np.testing.assert_allclose(nothing.rms, np.sqrt(np.mean(swing**2)), rtol=1e-3)
    np.testing.assert_allclose(nothing.largest, 1, rtol=1e-3)
    for knots in (5, 9):
        even = np.linspace(0, 1, knots)
        table = np.interp(times, even, np.sin(2 * np.pi * even))
        point = by["linear", knots]
        np.testing.assert_allclose(
            point.largest, np.abs(table - swing).max(), rtol=1e-3
        )
        rms = np.sqrt(np.mean((table - swing) ** 2))
        np.testing.assert_allclose(point.rms, rms, rtol=1e-3)
        assert point.bytes == 40 * knots * 9
        assert by["cubic", knots].rms < 0.5 * rms
        assert by["cubic", knots].psnr > point.psnr > nothing.psnr


@pytest.mark.full
def test_a_motion_that_is_none_is_refused():
    motion = swinging()
    still = motion._replace(deform=lambda time: motion.deform(jnp.zeros(())))
    with pytest.raises(ValueError, match="swing: nothing moves"):
        knot_curve.curve(still, (4,), 0.0, 1)


def test_a_run_of_fields_has_no_motion_to_tabulate():
    capture = scenes.tiny_capture()
    model, state = _field(capture)
    with pytest.raises(ValueError, match="a radiance field has no Gaussians"):
        known_motion.of_run(model, state, capture)


def _field(capture):
    from nerfies_jax.training.model import Model, TrainState

    zero = jnp.zeros((), jnp.int32)
    return Model("field", *[None] * 3, (), None), TrainState({}, (), (), zero, None)


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_arms_agree_with_the_network_they_shorten():
    by_name = {arm.name: arm for arm in arms.arms(40, 0.25)}
    for network in arms.NETWORKS:
        whole = by_name[network.name].used
        exact = jax.jit(whole.deform)(*whole.inputs)
        for name in (n for n in by_name if n.startswith(network.name)):
            way = by_name[name].used
            offsets = jax.jit(way.deform)(*way.inputs)
            off = np.abs(offsets.mean - exact.mean).max(axis=1) > 1e-6
            # What stands still is at rest instead, not where the network puts it.
            assert off.sum() <= (10 if "still" in name else 0)
        grads = jax.jit(whole.gradient)(*whole.inputs)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))
    papers = sum(network.paper for network in arms.NETWORKS)
    assert sum("still" in name for name in by_name) == papers
    assert sum("kept" in name for name in by_name) >= 2


@pytest.mark.slow
def test_a_loop_over_kernels_is_counted_in_full():
    count, time = 64, jnp.asarray(0.3)
    spec = KanMotionSpec(embedding=5, time_code=3, hidden=(7, 6), kernels=12)

    def flops(spec):
        effect = kan_motion.effect(spec, 1, 4)

        def deform(params):
            ready = {effect.name: effect.prepare(params)}
            return deformation.deform((effect,), params, ready, time)

        rows = arms.gaussians(count)
        return clock.cost(deform, arms.with_effect(rows, effect)).flops

    whole = dataclasses.replace(spec, block=count)
    two, three, four = (
        flops(dataclasses.replace(whole, kernels=kernels)) for kernels in (2, 3, 4)
    )
    np.testing.assert_allclose(three, (two + four) / 2, rtol=0.01)  # a line
    parts = arms.in_one_turn(spec, count)
    counted = sum(weight * flops(part) for weight, part in parts)
    np.testing.assert_allclose(counted, four + 8 * (four - three), rtol=0.05)
    products = 2 * (5 * 7 + 7 * 6 + 6 * 9)  # of one Gaussian and one kernel
    assert 12 * products * count < counted
    assert flops(whole) < 0.8 * counted  # the compiler's own count


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_the_job_prints_both_tables_and_saves_them(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(known_motion, "FIT_STEPS", 5)
    out = tmp_path / "cost.json"
    sizes = "--gaussians 60 --knots 4 8 --repeats 1 --device cpu"
    deformation_cost.main([*sizes.split(), "--out", str(out)])
    kept = json.loads(out.read_text())
    text = capsys.readouterr().out
    for row in kept["costs"]:
        assert row["name"] in text
        assert row["forward_cpu_ms"] > 0
        assert row["forward_flops"] > 0
        trained = row["name"] in {n.name for n in arms.NETWORKS}
        assert (row["both_ms"] is not None) == trained
        if trained:
            assert row["both_flops"] > 2 * row["forward_flops"]
    assert "of the deformation's multiply-adds" in text
    assert [point["knots"] for point in kept["knots"]["points"]] == [4, 8, 4, 8]
    page = deformation_page.page(kept)
    for row in kept["costs"]:
        assert f"| {row['name']} | {row['forward_cpu_ms']:.3g} |" in page
    assert page.count("\n| cubic | ") == 2
    picture, _ = images.read_image(out.with_suffix(".png"))
    assert picture.shape[2] == 3
    assert np.ptp(picture) > 200
