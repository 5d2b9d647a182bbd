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

    Arrays grow and shrink in few sizes, so that few programs are compiled.

    Args:
      population: The Gaussians.
      rows: Indices of the rows that there are afterwards. A row that is named twice is
        copied, and one that is not named is dropped.
      fresh: Where the optimizer starts anew. None: nowhere.

    Returns:
      The selected Gaussians with their parameters and optimizer state.
    """
    count = len(rows)
    if not count:
        raise ValueError("rows names no Gaussian; keep at least one")
    capacity = splats.capacity_for(count)
    idle = capacity - count
    fresh = np.zeros(count, bool) if fresh is None else np.asarray(fresh)
    params, moments = _selected(
        population.optimizer,
        population.params,
        population.moments,
        np.pad(np.asarray(rows), (0, idle)).astype(np.int32),
        np.pad(fresh, (0, idle)),
        np.arange(capacity) >= count,
    )
    return population._replace(params=params, moments=moments)


_selected = functools.partial(jax.jit, static_argnums=0)(row_optimizer.gather_rows)
