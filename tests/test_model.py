"""Models of float32 and float64: the same start, and no other float in between."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gaussians_jax.scene.scene
import nerfies_jax.scene.scene
from nerfies_jax import evaluation
from nerfies_jax.training.model import in_default_precision
from tests import scenes
from tests.hard_cases import tiny_fields

SPLATS = {"sonata": scenes.TINY_SONATA, "moba": scenes.TINY_MOBA}
FIELDS = ("nerf-w", "hypernerf", "nsff")


def one_step(name):
    """The first parameters, and shapes of the second state, its log and its image."""
    if name in SPLATS:
        capture, spec, kind = (
            scenes.tiny_capture(),
            SPLATS[name],
            gaussians_jax.scene.scene,
        )
        metadata = kind.metadata_of(capture)
    else:
        capture, spec = scenes.tiny_capture(), tiny_fields.tiny(name)
        kind = nerfies_jax.scene.scene
        metadata = kind.metadata_of(capture, spec)
    model = kind.build(spec, metadata)
    first = model.init(capture, jax.random.key(0))
    frames = evaluation.frames_of(capture, model.required_data)
    second, logged = jax.eval_shape(model.step, first, frames)
    view = evaluation.view_of(capture, int(capture.heldout[0]))
    rendering = jax.eval_shape(
        lambda state, view: model.render(state.params, view, capture.size, state.step),
        second,
        view,
    )
    return jax.device_get(first.params), (first, second, logged, rendering)


def floats(tree):
    """Floating arrays by path."""
    return {
        jax.tree_util.keystr(path): leaf
        for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SPLATS, *FIELDS])
def test_float64_starts_alike_and_stays_float64(name):
    with jax.enable_x64(False):
        start, shapes = one_step(name)
    with jax.enable_x64(True):
        wide_start, wide_shapes = one_step(name)
    for precision, arrays in (("float32", shapes), ("float64", wide_shapes)):
        kinds = {str(leaf.dtype) for leaf in floats(arrays).values()}
        assert kinds == {precision}
    start, same = floats(start), floats(wide_start)
    assert start.keys() == same.keys()
    for path, leaf in start.items():
        np.testing.assert_allclose(leaf, same[path], rtol=1e-6, atol=1e-7, err_msg=path)


def test_default_precision_leaves_what_does_not_float(dtype):
    tree = {
        "half": np.float16(0.5),
        "single": np.full(2, 0.1, np.float32),
        "double": np.full(2, 0.1),
        "bytes": np.arange(3, dtype=np.uint8),
        "bits": np.array([True]),
        "key": jax.random.key(0),
        "none": None,
    }
    got = in_default_precision(tree)
    assert {str(got[name].dtype) for name in ("half", "single", "double")} == {dtype}
    assert got["bytes"].dtype == jnp.uint8
    assert got["bits"].dtype == bool
    assert got["key"].dtype == tree["key"].dtype
    assert got["none"] is None
    assert float(got["single"][0]) == np.float32(0.1)
