"""Surface-aware color, which depends on the observed position and normal of a surface.

Yan, Li and Lee 2023 (NeRF-DS), arXiv:2303.14435, surface-aware NeRF. The implementation
follows the published code (JokerYan/NeRF-DS), because the paper's equations were not
available. The reflections of a moving specular surface change, so color reads the
observed point and normal in addition to the view direction. A head of the template
predicts the normal in the template, and the warp rotates it to the observation. It is
supervised by the gradient of the density and penalized if it faces away from the
camera.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, Key

from nerfies_jax.fields.effects.effect import (
    RayOutput,
    Scalar,
    Surface,
    SurfaceOutput,
    Vector,
)
from nerfies_jax.fields.effects.records import FieldRecord
from nerfies_jax.geometry.precision import exact_einsum
from nerfies_jax.nn import encoding, mlp
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.mlp import Layer
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import FrameCondition, PenaltyContext, Term
from nerfies_jax.training.step_counts import steps

NAME = "surface"


@dataclasses.dataclass(frozen=True)
class SurfaceSpec:
    """Encodings that color reads, and weights of the losses of normals.

    Bands of both encodings are closed for `closed_steps` and opened one by one over the
    next `anneal_steps`, as those of the point in the published code. Those of the
    normal open there from step 10,000 to 12,000. Both weights are those of the code.

    Both losses are means over samples, weighted by the rendering weights, as in the
    code. There are these differences. The loss on back-facing normals uses the observed
    unit normal instead of the output of the head in the template. Normals are rotated
    by the transpose of the warp's Jacobian, which is exact for all warps, and equal to
    the rotation of the paper for rigid ones. Normals are supervised by the gradient of
    the template's density, but neither the density nor the trunk has a gradient from
    this. Squares of differences replace norms, which have no gradient at zero.
    """

    position: EncodingSpec = EncodingSpec(4)
    normal: EncodingSpec = EncodingSpec(4)
    closed_steps: int = steps(50_000)
    anneal_steps: int = steps(50_000)
    slope: float = 1e-3
    back_facing: float = 0.1

    def __post_init__(self):
        if self.closed_steps < 0 or self.anneal_steps < 1:
            raise ValueError(
                "the window needs closed_steps >= 0 and anneal_steps >= 1, got "
                f"closed_steps={self.closed_steps}, anneal_steps={self.anneal_steps}"
            )
        for name in ("slope", "back_facing"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(
                    f"the weight {name}={value} must be finite and not negative"
                )


def effect(spec: SurfaceSpec, widths: dict[str, int]) -> FieldRecord:
    """Return the hooks of `spec`, for levels with trunks of these widths.

    Args:
      spec: Settings of the surfaces.
      widths: Width of the trunk of each level, by name.

    Returns:
      The record.
    """
    return FieldRecord(
        NAME,
        init=lambda key: init(widths, key),
        surface=functools.partial(evaluate, spec),
        surface_width=spec.position.width(3) + spec.normal.width(3),
        penalty=functools.partial(penalty, spec),
    )


def init(
    widths: dict[str, int], key: Key[Array, ""], dtype: DTypeLike = jnp.float32
) -> dict[str, Layer]:
    """Initialize a head for each level.

    Args:
      widths: Width of the trunk of each level.
      key: PRNG key.
      dtype: Floating-point type of the parameters.

    Returns:
      A layer by level.
    """
    keys = jax.random.split(key, len(widths))
    return {
        name: mlp.init_layer(head_key, width, 3, "glorot", dtype)
        for head_key, (name, width) in zip(keys, widths.items(), strict=True)
    }


def evaluate(
    spec: SurfaceSpec,
    params: dict[str, Layer],
    level: str,
    surface: Surface,
    condition: FrameCondition,
) -> SurfaceOutput:
    """Compute the inputs of color for one sample, and its normals.

    Args:
      spec: Settings.
      params: Heads by level.
      level: Name of the level.
      surface: The sample.
      condition: Conditioning of the frame.

    Returns:
      The features. `values` contains "head", the output of the head in the template, of
      any length, "observed", the unit normal in the observation, and "slope", the unit
      vector along the negative gradient of density in the template. The latter two are
      zero if there is no direction.
    """
    # No gradient to the trunk: the gradients of the normal losses emptied the scene
    # within 60 steps of a small run.
    head = mlp.affine(params[level], jax.lax.stop_gradient(surface.features))
    observed_normal = unit(surface.observed_normal(unit(head)))
    # No gradient from color to normals, which would otherwise fit color.
    fixed_normal = jax.lax.stop_gradient(observed_normal)
    features = [
        encoding.encode(spec_, value, window(spec, spec_, condition.step, value))
        for spec_, value in (
            (spec.position, surface.point),
            (spec.normal, fixed_normal),
        )
    ]
    values = {
        "head": head,
        "observed": observed_normal,
        "slope": unit(surface.template_normal()),
    }
    return SurfaceOutput(jnp.concatenate(features), values)


def window(
    spec: SurfaceSpec,
    one: EncodingSpec,
    step: Int[Array, ""] | None,
    like: Float[Array, "..."],
) -> Float[Array, " bands"] | None:
    """Compute the coarse-to-fine window of an encoding.

    Args:
      spec: Settings.
      one: The encoding.
      step: Number of completed steps.
      like: Array of the type of the result.

    Returns:
      Weights in [0, 1] [bands], or None without bands.
    """
    if one.bands == 0:
        return None
    assert step is not None
    return schedules.band_window(
        one.bands, spec.anneal_steps, step, like.dtype, after=spec.closed_steps
    )


def unit(vector: Vector) -> Vector:
    """Normalize a vector. Zero stays zero, with zero gradient.

    It is divided by its largest entry first, because the squares of 1e-20 and 1e20 are
    out of the range of float32.

    Args:
      vector: A vector, [3].

    Returns:
      The unit vector, [3].
    """
    largest = jnp.max(jnp.abs(vector))
    nonzero = largest > 0
    # The gradient with respect to the scale is zero, so it need not be computed.
    largest = jax.lax.stop_gradient(jnp.where(nonzero, largest, 1))
    scaled_vector = jnp.where(nonzero, vector, 1) / largest
    length = jnp.sqrt(jnp.sum(scaled_vector**2))
    return jnp.where(nonzero, scaled_vector / length, 0)


def penalty(spec: SurfaceSpec, _, context: PenaltyContext) -> dict[str, Term]:
    """Compute the losses of the normals, summed over the levels.

    Args:
      spec: Settings.
      _: Parameters, which are not used.
      context: Context of the step.

    Returns:
      The terms "slope" and "back_facing".
    """
    costs = [
        costs_of(level, context.batch.direction, context.batch.valid)
        for level in context.levels
    ]
    slope, facing = (sum(parts) for parts in zip(*costs, strict=True))
    return {
        "slope": Term(slope, spec.slope),
        "back_facing": Term(facing, spec.back_facing),
    }


def costs_of(
    level: RayOutput,
    direction: Float[Array, "rays 3"],
    valid: Bool[Array, " rays"],
) -> tuple[Scalar, Scalar]:
    """Compute the means over samples of w |head - slope|² and of w max(0, n·d)².

    The rendering weights and the gradients of the density are constants. The first loss
    ignores samples where the density has no gradient.

    Args:
      level: Output of the level.
      direction: Unit directions of the rays, [rays, 3].
      valid: True for observed pixels, [rays].

    Returns:
      The two losses, scalars.
    """
    values = level.surfaces[NAME]
    weight = jnp.where(valid[:, None], jax.lax.stop_gradient(level.weight), 0)
    slope = jax.lax.stop_gradient(values["slope"])
    has_normal = jnp.any(slope != 0, axis=-1)
    error = jnp.sum((values["head"] - slope) ** 2, axis=-1)
    facing = exact_einsum("rsk,rk->rs", values["observed"], direction)
    return (
        jnp.mean(jnp.where(has_normal, weight * error, 0)),
        jnp.mean(weight * jnp.maximum(facing, 0) ** 2),
    )
