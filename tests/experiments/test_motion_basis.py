"""The image of a motion basis: its colors, its order, and one of a whole run."""

import types

import jax
import numpy as np
import PIL.Image
import pytest

from experiments import motion_basis
from tests.experiments.test_export import SPLATS, saved

BASES = ("motion.count=3", "motion.basis_width=8", "motion.base_width=8")
BASES += ("motion.base_depth=1", "motion.warm_up=0", "motion_growth=none")
TINY = (*SPLATS, *BASES)


def test_basis_vectors_are_sorted_by_the_motion_that_they_make(rng):
    """Variance over time of the weight, times the squared length of the vector."""
    basis, weights = rng.normal(size=(5, 3, 4)), rng.normal(size=(6, 5, 4))
    weights[..., 2] = 7.0  # a constant weight moves nothing
    weights[..., 1] *= 10
    order = motion_basis.largest(basis, weights)
    assert (order[0], order[-1]) == (1, 2)
    sums = [
        sum(
            np.mean((weights[:, g, k] - weights[:, g, k].mean()) ** 2)
            * (basis[g, :, k] @ basis[g, :, k])
            for g in range(5)
        )
        for k in range(4)
    ]
    assert list(order) == sorted(range(4), key=lambda k: -sums[k])


def test_colors_are_relative_and_gray_is_nothing(rng):
    vectors = rng.normal(size=(9, 3))
    vectors[4] = 0
    color = motion_basis.signed_color(vectors)
    longest = max(np.sqrt(v @ v) for v in vectors)
    np.testing.assert_allclose(color, 0.5 + vectors / (2 * longest))
    np.testing.assert_array_equal(motion_basis.signed_color(0 * vectors), 0.5)
    gray, blue, orange = motion_basis.diverging(np.array([0.0, -2.0, 2.0]))
    np.testing.assert_allclose(gray, 0.5)
    assert blue[2] > 0.8 > 0.5 > blue[0]
    assert orange[0] > 0.8 > 0.5 > orange[2]
    np.testing.assert_array_equal(motion_basis.diverging(np.zeros(3)), 0.5)


def test_a_figure_of_no_basis_vector_is_refused(capsys):
    with pytest.raises(SystemExit) as stop:
        motion_basis.main(["run", "--bases", "0"])
    assert stop.value.code == 2
    assert "--bases 0: at least 1" in capsys.readouterr().err


@pytest.mark.full
def test_a_run_is_drawn_and_one_without_a_basis_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        motion_basis, "platform", types.SimpleNamespace(start_jax=lambda *_: None)
    )

    def shaken(params, shake):
        return params._replace(nets=jax.tree.map(shake, params.nets))

    run = saved(tmp_path / "moba", "moba-small", TINY, shaken)
    rows = motion_basis.images(run, 2, 2)
    observed, vectors, weights = rows.values()
    assert [len(images) for images in rows.values()] == [2, 2, 2]
    assert all(image.shape == observed[0].shape for image in (*vectors, *weights))
    assert np.ptp(vectors[0]) > 0.1
    # The weights change with time and the vectors do not.
    assert np.abs(weights[0] - weights[1]).max() > 0.01
    out = tmp_path / "basis.png"
    motion_basis.main([str(run), "--bases", "2", "--times", "2", "--out", str(out)])
    with PIL.Image.open(out) as image:
        assert image.size[0] > 300
    without = saved(tmp_path / "mlp", "splats-deformable-small", SPLATS, shaken)
    with pytest.raises(SystemExit) as stop:
        motion_basis.main([str(without), "--out", str(tmp_path / "other.png")])
    assert stop.value.code == 2
    assert "its motion is MotionSpec, which has no basis" in capsys.readouterr().err
