"""Gaussians: the rows that are trained, and what they stand for."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float

PyTree = Any


class Splats(NamedTuple):
    """What is trained: one row per Gaussian, unconstrained."""

    mean: Float[Array, "gaussians 3"]  # scene units
    log_scale: Float[Array, "gaussians 3"]  # log of the standard deviations
    quaternion: Float[Array, "gaussians 4"]  # wxyz, any length but zero
    opacity_logit: Float[Array, " gaussians"]
    sh_dc: Float[Array, "gaussians 1 3"]  # degree 0
    sh_rest: Float[Array, "gaussians rest 3"]  # degrees 1.., rest = (degree+1)^2 - 1


class Gaussians(NamedTuple):
    """What is drawn: activated, in world coordinates."""

    mean: Float[Array, "gaussians 3"]
    quaternion: Float[Array, "gaussians 4"]  # wxyz; normalised where it is used
    scale: Float[Array, "gaussians 3"]  # standard deviations, positive
    opacity: Float[Array, " gaussians"]  # in [0, 1]


class Params(NamedTuple):
    """Trained parameters, kept apart by structure.

    Every leaf of `rows` has the capacity as its first axis; nothing in `nets` has.
    """

    rows: dict[str, PyTree]  # {"splats": Splats, "embedding": ..., ...}
    nets: dict[str, PyTree]
