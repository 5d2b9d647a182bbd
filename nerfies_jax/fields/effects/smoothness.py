"""Smooth grids and planes: total variation of neighboring features.

It is the regularizer that Fang et al. 2022 (TiNeuVox), arXiv:2205.15285, use on their
voxel grid for real captures. Their text was not at hand. Their code (hustvl/TiNeuVox)
minimizes a Huber cost of every difference. Here it is the mean of their squares, as in
K-Planes (arXiv:2301.10241, equation 3). In a hashed grid some vertices are drawn in
every step.
"""

import dataclasses
import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from nerfies_jax.fields.effects.effect import Scalar
from nerfies_jax.fields.template import Template, TemplateSpec
from nerfies_jax.nn import grids, planes
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.grids import HashGridSpec
from nerfies_jax.nn.voxels import VoxelGridSpec
from nerfies_jax.training.effects import PenaltyContext, PyTree, Term, total
from nerfies_jax.training.step_counts import steps

VARIED = 1024  # vertices of each level of a hashed grid that are drawn in a step


@dataclasses.dataclass(frozen=True)
class SmoothnessSpec:
    """Weight of the mean squared difference, up to the step `until`."""

    weight: float = 1e-2
    until: int | None = steps(10_000)  # None: to the end

    def __post_init__(self):
        if not (math.isfinite(self.weight) and self.weight >= 0):
            raise ValueError(
                f"weight={self.weight} of smoothness must be finite and not negative"
            )
        if self.until is not None and self.until < 1:
            raise ValueError(
                f"until={self.until} must be at least 1; without smoothness, set the "
                "effect to none"
            )


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Regularizer` of a `SmoothnessSpec` on the templates of a field, by level."""

    spec: SmoothnessSpec
    templates: Mapping[str, object]  # of others than `TemplateSpec` nothing is known

    name = "smoothness"

    def __post_init__(self):
        if not any(map(has_tables, self.templates.values())):
            raise ValueError(
                "smoothness is of grids and planes, and no template has one; set "
                "smoothness=none, or choose a preset on a grid"
            )

    def loss(self, params: PyTree, context: PenaltyContext) -> dict[str, Term]:
        """Compute the variation of the tables."""
        tabled = {
            name: one
            for name, one in self.templates.items()
            if isinstance(one, TemplateSpec) and has_tables(one)
        }
        found = []
        for number, (name, one) in enumerate(tabled.items()):
            key = jax.random.fold_in(context.key, number)
            found.append(variation(one, params["template"][name], key))
        weight: Scalar | float = self.spec.weight
        if self.spec.until is not None:
            weight = jnp.where(context.step < self.spec.until, weight, 0)
        return {"variation": Term(total(found), weight)}


def has_tables(spec: object) -> bool:
    """Return True if the template reads a point from tables."""
    return isinstance(spec, TemplateSpec) and not isinstance(
        spec.position, EncodingSpec
    )


def variation(spec: TemplateSpec, params: Template, key: Key[Array, ""]) -> Scalar:
    """Compute the mean squared difference of neighboring features in the tables.

    For a hashed grid it is the mean over the levels, at `VARIED` vertices of each. For
    planes it is the mean over all planes of space.

    Args:
      spec: Settings of the template.
      params: Its parameters.
      key: PRNG key.

    Returns:
      A scalar.
    """
    position, tables = spec.position, params.tables
    if isinstance(position, VoxelGridSpec):
        return grids.total_variation(tables[0], position.cells)
    if isinstance(position, HashGridSpec):
        return grids.variation_at_random(position, tables, key, VARIED)
    every = [planes.total_variation(plane) for level in tables for plane in level.space]
    return total(every) / (2 * len(every))  # the mean over both axes as well
