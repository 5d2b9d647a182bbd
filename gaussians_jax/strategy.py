"""Control of the number of Gaussians: the protocol and the built-in strategies."""

import functools

import jax
import numpy as np
from jaxtyping import Bool, Int

from gaussians_jax.core import splats
from gaussians_jax.core.protocols import Population, StepInfo, Strategy, StrategyEvent
from gaussians_jax.optim import optimizer as row_optimizer
from gaussians_jax.optim.densification import DefaultStrategySpec
from gaussians_jax.optim.mcmc import MCMCStrategySpec

MCMC = MCMCStrategySpec
Default = DefaultStrategySpec
Event = StrategyEvent

__all__ = [
    "MCMC",
    "Default",
    "Event",
    "Population",
    "StepInfo",
    "Strategy",
    "select",
]


def select(
    population: Population,
    rows: Int[np.ndarray, " count"],
    fresh: Bool[np.ndarray, " count"] | None = None,
) -> Population:
    """Keep, copy and drop Gaussians, on the host.

    Arrays are padded to one of a few capacities, so that few programs are compiled.

    Args:
      population: The Gaussians.
      rows: Indices of the Gaussians to keep, in their new order. An index that occurs
        twice copies a Gaussian, and one that is missing drops it.
      fresh: True where the optimizer state starts anew. None: nowhere.

    Returns:
      The selected Gaussians with their parameters and optimizer state.

    Raises:
      ValueError: If `rows` is empty.
    """
    count = len(rows)
    if not count:
        raise ValueError("rows is empty; keep at least one Gaussian")
    capacity = splats.capacity_for(count)
    padding = capacity - count
    fresh = np.zeros(count, bool) if fresh is None else np.asarray(fresh)
    params, moments = _gather(
        population.optimizer,
        population.params,
        population.moments,
        np.pad(np.asarray(rows), (0, padding)).astype(np.int32),
        np.pad(fresh, (0, padding)),
        np.arange(capacity) >= count,
    )
    return population._replace(params=params, moments=moments)


_gather = functools.partial(jax.jit, static_argnums=0)(row_optimizer.gather_rows)
