"""Color that knows where its surface is, and how it lies, at the moment.

Yan, Li and Lee 2023 (NeRF-DS), arXiv:2303.14435, its surface-aware NeRF. The text with
its equations was not at hand; its code (JokerYan/NeRF-DS) is followed. A mirror that
moves shows other things, so color reads the observed point and the normal there,
beside the view direction. A head of the template says the normal in the template; the
warp turns it to where it is observed. It learns from the slope of the density, and may
not face away from the camera.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from nerfies_jax.effects.effect import Look, RayOutput, Scalar, Surface, Vector
from nerfies_jax.geometry.precision import exact_einsum
from nerfies_jax.nets import encoding, mlp
from nerfies_jax.nets.encoding import EncodingSpec
from nerfies_jax.nets.mlp import Layer
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import Effect, FrameCondition, PenaltyContext, Term
from nerfies_jax.training.step_counts import steps

NAME = "surface"


@dataclasses.dataclass(frozen=True)
class SurfaceSpec:
    """What color reads, and what a normal that is wrong counts for.

    Bands of both encodings are shut for `closed_steps` and open one by one over the
    next `anneal_steps`, as those of the point in the paper's code; those of the normal
    open there from step 10,000 to 12,000. Both weights are the code's.

    Both count as there: by the weights of the samples, as a mean over samples. What
    differs: the normal that may not face away is the one observed, of unit length, and
    not the head's answer in the template; a normal is turned by the transpose of the
    warp's Jacobian, which is exact for every warp and the paper's rotation for a rigid
    one; it learns from the slope of the template's density, which gets none from it,
    nor does the trunk; and squares of differences stand for their lengths, which have
    no slope at zero.
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


def effect(spec: SurfaceSpec, widths: dict[str, int]) -> Effect:
    """The seams of `spec` on levels whose trunks are so wide."""
    return Effect(
        NAME,
        init=lambda key: init(widths, key),
        surface=functools.partial(look, spec),
        surface_width=spec.position.width(3) + spec.normal.width(3),
        penalty=functools.partial(penalty, spec),
    )


def init(
    widths: dict[str, int], key: Key[Array, ""], dtype=jnp.float32
) -> dict[str, Layer]:
    """A head for each level."""
    keys = jax.random.split(key, len(widths))
    return {
        name: mlp.init_layer(one, width, 3, "glorot", dtype)
        for one, (name, width) in zip(keys, widths.items(), strict=True)
    }


def look(
    spec: SurfaceSpec,
    params: dict[str, Layer],
    level: str,
    surface: Surface,
    condition: FrameCondition,
) -> Look:
    """What color reads of one sample, and its normals.

    "head" is what the head says, of any length, in the template; "observed" is its
    direction turned to the observation; "slope" is where density falls fastest in the
    template. Both are unit vectors, or zero where there is no direction.
    """
    # Normals may not bend the density to theirs: within 60 steps of a small run their
    # slopes through the trunk emptied the scene.
    head = mlp.affine(params[level], jax.lax.stop_gradient(surface.features))
    observed = unit(surface.turned(unit(head)))
    # Color may not bend the normals to its liking.
    seen = jax.lax.stop_gradient(observed)
    read = [
        encoding.encode(one, value, window(spec, one, condition.step, value))
        for one, value in ((spec.position, surface.point), (spec.normal, seen))
    ]
    found = {"head": head, "observed": observed, "slope": unit(surface.outward())}
    return Look(jnp.concatenate(read), found)


def window(
    spec: SurfaceSpec,
    one: EncodingSpec,
    step: Int[Array, ""],
    like: Float[Array, "..."],
) -> Float[Array, " bands"] | None:
    """How far the bands of an encoding are open after `step` steps."""
    if one.bands == 0:
        return None
    return schedules.band_window(
        one.bands, spec.anneal_steps, step, like.dtype, after=spec.closed_steps
    )


def unit(vector: Vector) -> Vector:
    """The vector at length one; zero, with zero slope, where it has no direction.

    Divided by its largest entry first: the square of 1e-20, and of 1e20, is outside of
    float32.
    """
    largest = jnp.max(jnp.abs(vector))
    there = largest > 0
    # Its own slope would cancel.
    largest = jax.lax.stop_gradient(jnp.where(there, largest, 1))
    scaled = jnp.where(there, vector, 1) / largest
    length = jnp.sqrt(jnp.sum(scaled**2))
    return jnp.where(there, scaled / length, 0)


def penalty(spec: SurfaceSpec, _, context: PenaltyContext) -> dict[str, Term]:
    """What the normals of all levels cost, summed over the levels."""
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
    """Means over samples of w |head - slope|² and of w max(0, n·d)².

    Weights are those that the samples are drawn with and get no slope; so are slopes of
    the density. Samples where the density has no slope do not count in the first.
    """
    found = level.looks[NAME]
    weight = jnp.where(valid[:, None], jax.lax.stop_gradient(level.weight), 0)
    slope = jax.lax.stop_gradient(found["slope"])
    known = jnp.any(slope != 0, axis=-1)
    off = jnp.sum((found["head"] - slope) ** 2, axis=-1)
    facing = exact_einsum("rsk,rk->rs", found["observed"], direction)
    return (
        jnp.mean(jnp.where(known, weight * off, 0)),
        jnp.mean(weight * jnp.maximum(facing, 0) ** 2),
    )
