"""Scripts of users have names of earlier versions."""

import importlib
import sys

import pytest

from nerfies_jax.runtime import earlier_names


@pytest.mark.parametrize(
    "name", [*earlier_names.CURRENT, "nerfies_jax.evidence.external_files"]
)
def test_an_earlier_name_is_the_module_of_today(name, monkeypatch):
    monkeypatch.delitem(sys.modules, name, raising=False)
    current = importlib.import_module(earlier_names.current_name(name))
    with pytest.warns(DeprecationWarning, match=f"{name} is {current.__name__}"):
        earlier = importlib.import_module(name)
    assert earlier is current
    assert earlier.__spec__.name == current.__name__
    package, _, last = name.rpartition(".")
    assert getattr(importlib.import_module(package), last) is current


@pytest.mark.parametrize("name", earlier_names.ATTRIBUTES)
def test_an_earlier_name_of_a_module_is_the_value_of_today(name):
    (module, _, attribute), current = (
        each.rpartition(".") for each in (name, earlier_names.ATTRIBUTES[name])
    )
    with pytest.warns(DeprecationWarning, match=name):
        earlier = getattr(importlib.import_module(module), attribute)
    assert earlier is getattr(importlib.import_module(current[0]), current[2])


def test_a_name_that_never_was_is_an_error():
    with pytest.raises(AttributeError, match="has no attribute 'pixel'"):
        _ = importlib.import_module("nerfies_jax.capture.frames").pixel
