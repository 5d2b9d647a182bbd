"""What no network, table or encoding can be built with, and what is said about it."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import pytest

from nerfies_jax.nn import codes, kan
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.kan import KANSpec
from nerfies_jax.nn.mlp import HeadSpec, MLPSpec

TWICE = (("a", HeadSpec(1)), ("a", HeadSpec(2)))
NET = MLPSpec(inputs=5, depth=4, width=7, heads=(("a", HeadSpec(3)),))
SPLINES = KANSpec(in_features=5, hidden=(7, 6), heads=(("a", HeadSpec(3)),))


def code_table(**size):
    return codes.init(jax.random.key(0), **size)


def net(**changes):
    return dataclasses.replace(NET, **changes)


def splines(**changes):
    return dataclasses.replace(SPLINES, **changes)


@pytest.mark.parametrize(
    ("make", "settings", "words"),
    [
        (code_table, {"ids": 0, "width": 8}, "ids=0, width=8"),
        (code_table, {"ids": 3, "width": 0}, "ids=3, width=0"),
        (EncodingSpec, {"bands": -1}, "bands=-1"),
        (EncodingSpec, {"bands": 25}, "bands=25"),
        (EncodingSpec, {"bands": 0, "identity": False}, "no features"),
        (HeadSpec, {"width": 0}, "width=0"),
        (HeadSpec, {"width": 1, "init": "one"}, "initializer"),
        (net, {"inputs": 0}, "inputs=0"),
        (net, {"depth": -1}, "depth=-1"),
        (net, {"skips": (0,)}, "layer 0 is not in 1 .. 3"),
        (net, {"skips": (4,)}, "layer 4 is not in 1 .. 3"),
        (net, {"activation": "swish"}, "'swish'; choose from"),
        (net, {"init": "xavier"}, "'xavier'; choose from"),
        (net, {"heads": TWICE}, "different names"),
        (splines, {"in_features": 0}, "in_features >= 1"),
        (splines, {"hidden": (4, 0)}, "hidden widths"),
        (splines, {"kernels": 1}, "two centers"),
        (splines, {"grid": (1.0, 1.0)}, "grid needs low < high"),
        (splines, {"hidden_grid": (0.0, math.inf)}, "hidden_grid needs"),
        (splines, {"width_ratio": 3.0}, "nearly linearly dependent"),
        (splines, {"width_ratio": math.nan}, "width_ratio=nan"),
        (splines, {"hidden": (7, 2)}, "features to signs"),
        (splines, {"heads": ()}, "either out_features or heads"),
        (splines, {"out_features": 2}, "either out_features or heads"),
        (splines, {"heads": (), "out_features": 0}, "out_features=0"),
        (splines, {"heads": TWICE}, "different names"),
        (splines, {"heads": (("a", HeadSpec(1, "he")),)}, "unknown init 'he'"),
    ],
)
def test_wrong_settings_are_refused(make, settings, words):
    with pytest.raises(ValueError, match=words):
        make(**settings)


def test_parts_outside_the_inputs_are_refused():
    params = jax.eval_shape(lambda key: kan.init(key, SPLINES), jax.random.key(0))
    with pytest.raises(ValueError, match=r"4 \.\. 6 .* 5 of this KAN"):
        jax.eval_shape(
            lambda params, part: kan.first_layer_part(SPLINES, params, part, 4),
            *(params, jax.ShapeDtypeStruct((3,), jnp.float32)),
        )
