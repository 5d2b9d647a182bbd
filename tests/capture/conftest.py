"""Fixtures of the tests of captures."""

import pytest

from nerfies_jax.capture import decoder


@pytest.fixture(scope="module")
def one_child():
    """One decoder process for all files of a module."""
    with decoder.session():
        yield
