"""Base of the built-in motions in a run."""

import dataclasses
from typing import Any

from jaxtyping import Array, Float, Int

from nerfies_jax.training import schedules


@dataclasses.dataclass(frozen=True)
class BoundMotion:
    """Base of the `Motion` that the settings of a built-in motion are bound to.

    Attributes:
      spec: Settings with `warm_up`, `learning_rate` and `learning_rate_end`.
      steps: Number of training steps of the run.
    """

    spec: Any
    steps: int

    @property
    def warm_up(self) -> int:
        """Number of steps without motion."""
        return self.spec.warm_up

    def rate(self, step: Int[Array, ""]) -> Float[Array, ""]:
        """Evaluate the learning rate of the settings.

        Args:
          step: Training step.

        Returns:
          The rate, log-linear from `learning_rate` to `learning_rate_end`.
        """
        first, last = self.spec.learning_rate, self.spec.learning_rate_end
        return schedules.log_linear(first, last, self.steps)(step)
