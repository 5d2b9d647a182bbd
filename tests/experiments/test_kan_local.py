"""The nearest kernels alone: the dense sum where all count, its cut-off where not."""

import json

import jax
import numpy as np
import pytest

from experiments import kan_local
from nerfies_jax.nets import kan
from nerfies_jax.nets.mlp import HeadSpec

SPEC = kan.KANSpec(
    in_features=3, hidden=(), heads=(("y", HeadSpec(2)),), kernels=8, base=False
)


def test_the_nearest_kernels_are_the_terms_of_a_loop(float64, rng):
    fields = (rng.normal(size=shape) for shape in ((8, 3, 2), (3, 2), 2))
    layer = kan.KANLayer(*fields)
    local = jax.jit(
        lambda layer, x, nearest: kan_local.local(SPEC, layer, x, nearest),
        static_argnums=2,
    )
    x = rng.uniform(-1, 1, (20, 3))
    centers = np.linspace(-1, 1, 8)
    width = np.sqrt(2) * SPEC.width_ratio * 2 / 7
    for nearest in (3, 8):
        truth = np.zeros((20, 2)) + np.asarray(layer.bias)
        for n in range(20):
            for i in range(3):
                close = np.argsort(np.abs(x[n, i] - centers), kind="stable")[:nearest]
                for g in close:
                    height = np.exp(-(((x[n, i] - centers[g]) / width) ** 2))
                    truth[n] += height * np.asarray(layer.kernel)[g, i]
        nearby = local(layer, x, nearest)
        np.testing.assert_allclose(nearby, truth, rtol=0, atol=1e-13)


@pytest.mark.full
def test_a_tiny_table(tmp_path, capsys):
    words = "--kernels 6 --nearest 2 4 --points 30 --width 3 --repeats 1 --out"
    kan_local.main([*words.split(), str(tmp_path / "t.json")])
    record = json.loads((tmp_path / "t.json").read_text())
    rows = record["rows"]
    assert [row["nearest"] for row in rows] == ["all", 2, 4]
    dense, two, four = (row["error"] for row in rows)
    assert dense == 0
    assert 0 < four < two / 3
    assert "of dense" in capsys.readouterr().out
    assert f"| 6 | 2 | {two:.3g} |" in kan_local.page(record)
