"""Scripts of users import modules under the names of earlier versions."""

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
