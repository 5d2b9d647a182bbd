"""Smooth grids: features of neighbouring vertices may not differ for nothing.

The total variation that Fang et al. 2022 (TiNeuVox), arXiv:2205.15285, put on their
voxel grid for real captures. Their code descends a Huber cost of every difference; here
it is the mean of their squares, as in K-Planes and HexPlane.
"""

import dataclasses
import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from nerfies_jax.effects.effect import Scalar
from nerfies_jax.nets import grids
from nerfies_jax.nets.grids import HashGridSpec
from nerfies_jax.nets.voxels import VoxelGridSpec
from nerfies_jax.radiance.template import Template, TemplateSpec
from nerfies_jax.training.effects import Effect, PenaltyContext, Term
from nerfies_jax.training.step_counts import steps


@dataclasses.dataclass(frozen=True)
class SmoothnessSpec:
    """What a mean squared difference of one counts for, up to the step `until`."""

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


def effect(spec: SmoothnessSpec, templates: dict[str, TemplateSpec]) -> Effect:
    """The seams of `spec` for the templates of a field, by level."""
    smooth = {name: one for name, one in templates.items() if levels_of(one)}
    if not smooth:
        raise ValueError(
            "smoothness is of grids that are not hashed, and no template has one; set "
            "smoothness=none, or choose a preset on a grid"
        )

    def penalty(_, context: PenaltyContext) -> dict[str, Term]:
        nets = context.params["template"]
        found = [variation(one, nets[name]) for name, one in smooth.items()]
        weight = spec.weight
        if spec.until is not None:
            weight = jnp.where(context.step < spec.until, weight, 0)
        return {"variation": Term(sum(found), weight)}

    return Effect("smoothness", penalty=penalty)


def levels_of(spec: TemplateSpec) -> tuple[tuple[int, int], ...]:
    """Number and cells of the levels with a row for each vertex."""
    position = spec.position
    if isinstance(position, VoxelGridSpec):
        return ((0, position.cells),)
    if not isinstance(position, HashGridSpec):
        return ()
    return tuple(
        (number, cells)
        for number, cells in enumerate(position.cells())
        if (cells + 1) ** 3 <= position.rows
    )


def variation(spec: TemplateSpec, params: Template) -> Scalar:
    """Mean over the levels of the total variation of each, features squared."""
    levels = levels_of(spec)
    tables: tuple[Float[Array, "rows features"], ...] = params.tables
    found = [grids.total_variation(tables[level], cells) for level, cells in levels]
    return sum(found) / len(found)
