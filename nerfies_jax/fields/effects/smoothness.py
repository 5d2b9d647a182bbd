"""Total variation of grids and planes, a smoothness regularizer.

Fang et al. 2022 (TiNeuVox), arXiv:2205.15285, use it on their voxel grid for real
captures. The paper was not available. The published code (hustvl/TiNeuVox) minimizes a
Huber cost of each difference. Here it is the mean of their squares, as in K-Planes
(arXiv:2301.10241, equation 3). For a hashed grid it is estimated from random vertices
in each step.
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

VARIED = 1024  # random vertices per level of a hashed grid and step


@dataclasses.dataclass(frozen=True)
class SmoothnessSpec:
    """Weight of the mean squared difference, which is zero from step `until` on."""

    weight: float = 1e-2
    until: int | None = steps(10_000)  # None for the whole run

    def __post_init__(self):
        if not (math.isfinite(self.weight) and self.weight >= 0):
            raise ValueError(
                f"weight={self.weight} of smoothness must be finite and not negative"
            )
        if self.until is not None and self.until < 1:
            raise ValueError(
                f"until={self.until} must be at least 1; set the effect to none for no "
                "smoothness"
            )


@dataclasses.dataclass(frozen=True)
class Bound:
    """The `Regularizer` of a `SmoothnessSpec` on the templates of a field, by level."""

    spec: SmoothnessSpec
    templates: Mapping[str, object]  # only `TemplateSpec`s are regularized

    name = "smoothness"

    def __post_init__(self):
        if not any(map(_has_tables, self.templates.values())):
            raise ValueError(
                "smoothness regularizes grids and planes, but no template has one; set "
                "smoothness=none, or choose a preset with a grid"
            )

    def loss(self, params: PyTree, context: PenaltyContext) -> dict[str, Term]:
        """Compute the variation of the tables."""
        with_tables = {
            name: template
            for name, template in self.templates.items()
            if isinstance(template, TemplateSpec) and _has_tables(template)
        }
        variations = []
        for number, (name, template) in enumerate(with_tables.items()):
            key = jax.random.fold_in(context.key, number)
            variations.append(variation(template, params["template"][name], key))
        weight: Scalar | float = self.spec.weight
        if self.spec.until is not None:
            weight = jnp.where(context.step < self.spec.until, weight, 0)
        return {"variation": Term(total(variations), weight)}


def _has_tables(spec: object) -> bool:
    """Return True if the template encodes points by tables."""
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
    variations = [
        planes.total_variation(plane) for level in tables for plane in level.space
    ]
    return total(variations) / (2 * len(variations))  # mean over planes and axes
