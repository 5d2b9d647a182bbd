"""Protocols of components for both radiance fields and Gaussians."""

import re
from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

import jax
from jaxtyping import Array, Float

from nerfies_jax.training.effects import PenaltyContext, PyTree, Term

Scalar = Float[Array, ""]
# A float, a schedule of the traced step (as optax has them), or a tree of these that is
# a prefix of the parameters.
LearningRate = float | Callable[[Any], Any] | PyTree


@runtime_checkable
class Regularizer(Protocol):
    """A term of the loss.

    Optional members: `weight` multiplies a scalar loss (default 1). `required_data` is
    the set of data of the capture that it reads, of "depths", "points", "flow" and
    "moving". `state(params)` returns arrays that are passed as `context.state` until
    the number of Gaussians changes. `name` is the prefix of its metrics, by default the
    class name in snake case.
    """

    def loss(
        self, params: PyTree, context: PenaltyContext
    ) -> Scalar | Mapping[str, Term]:
        """Compute the loss of one step. The function is traced.

        Args:
          params: Parameters of the whole scene.
          context: Step, key, rendered frame or rays, and the motion at other times.

        Returns:
          A scalar, which is logged as `name/loss`, or several terms by name with their
          weights.
        """
        ...


@runtime_checkable
class Optimizer(Protocol):
    """Gradient transformation, as in optax.

    Its updates have unit scale and are subtracted after multiplication by the learning
    rates of the scene, so use `optax.scale_by_adam()` rather than `optax.adam(rate)`.
    """

    def init(self, params: PyTree) -> PyTree:
        """Return the initial state for parameters.

        Args:
          params: Parameters of the scene.

        Returns:
          The state, a pytree of arrays.
        """
        ...

    def update(
        self, updates: PyTree, state: PyTree, params: PyTree | None = None
    ) -> tuple[PyTree, PyTree]:
        """Return the updates for gradients, and the new state.

        Args:
          updates: Gradients, with the structure of the parameters.
          state: State of the optimizer.
          params: Parameters before the update.

        Returns:
          Updates that are to be subtracted after scaling, and the new state.
        """
        ...


def regularizer_hooks(regularizer: Regularizer) -> dict[str, Any]:
    """Return the hooks of a regularizer for the records of both representations.

    Args:
      regularizer: The regularizer.

    Returns:
      Its name, penalty and required data, as fields of a record.
    """
    weight = getattr(regularizer, "weight", 1.0)
    return {
        "name": name_of(regularizer),
        "penalty": lambda _, context: as_terms(
            regularizer.loss(context.params, context), weight
        ),
        "required_data": frozenset(getattr(regularizer, "required_data", ())),
    }


def name_of(part: Any) -> str:
    """Return the name of a component: its `name`, or its class name in snake case.

    Args:
      part: The component.

    Returns:
      The key of its parameters and metrics.
    """
    name = getattr(part, "name", None)
    if name is not None:
        return name
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", type(part).__name__).lower()


def as_terms(loss: Scalar | Mapping[str, Term], weight: float = 1.0) -> dict[str, Term]:
    """Return the terms of a loss. A scalar becomes the term "loss" with the weight.

    Args:
      loss: A scalar, or terms by name.
      weight: Weight of a scalar loss. Terms have their own weights.

    Returns:
      Terms by name.
    """
    if isinstance(loss, Mapping):
        return dict(loss)
    return {"loss": Term(loss, weight)}


def rate_at(learning_rate: LearningRate, step: Array) -> PyTree:
    """Evaluate a learning rate at a step.

    Args:
      learning_rate: A float, a schedule, or a tree of these.
      step: Number of completed steps.

    Returns:
      A number, or a tree of numbers.
    """
    if callable(learning_rate):
        return learning_rate(step)
    return jax.tree.map(
        lambda rate: rate(step) if callable(rate) else rate, learning_rate
    )
