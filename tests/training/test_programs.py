"""Programs take the numbers of a capture as arguments if the model permits it."""

import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.training import programs
from tests.training import toy


def model(scale_of):
    """A toy whose count of Gaussians is the scale of the capture."""

    def build(numbers):
        scale = scale_of(numbers["scale"])
        return toy.MODEL._replace(counts=lambda state: {"scale": scale})

    numbers = {"scale": jnp.float32(3)}
    return programs.taking(build(numbers), numbers, build)


def scale_for(model, scale):
    program = programs.Program(lambda model, _: model.counts(None)["scale"], model)
    return program._program({"scale": jnp.float32(scale)}, 0)


@pytest.mark.parametrize(
    ("scale_of", "expected"),
    [
        (lambda x: 2 * x, 10),
        # Those that need a concrete number keep that of their capture.
        (lambda x: 2 * float(x), 6),
        (lambda x: np.multiply(x, 2), 6),
        (lambda x: 6 if x > 0 else 0, 6),
        (lambda x: [0, 0, 0, 6][x.astype(int)], 6),
    ],
)
def test_numbers_are_arguments_unless_they_must_be_concrete(scale_of, expected):
    assert scale_for(model(scale_of), 5) == expected


def test_errors_of_a_component_are_raised():
    calls = []

    def scale_of(scale):
        calls.append(scale)
        if len(calls) > 1:
            raise TypeError("a fault of the component")
        return scale

    with pytest.raises(TypeError, match="a fault of the component"):
        scale_for(model(scale_of), 5)


def test_building_a_model_may_compile_another_program_of_its_numbers():
    # An event has a program of its own, which is made whenever the model is built.
    def scale_of(scale):
        class Field:
            with_numbers = None

            @property
            def numbers(self):
                return {"scale": np.asarray(scale)}

        programs.Program(lambda field: field.numbers, Field())
        return 2 * scale

    assert scale_for(model(scale_of), 5) == 10
