"""Regularizers of Gaussians: the protocol and the built-in losses."""

from gaussians_jax.losses.acceleration import AccelerationSpec
from gaussians_jax.losses.depth import DepthSpec
from gaussians_jax.losses.isometry import IsometrySpec
from gaussians_jax.losses.opacity_scale import OpacityScaleSpec
from gaussians_jax.losses.point_depth import PointDepthSpec
from gaussians_jax.losses.smooth_depth import SmoothDepthSpec
from gaussians_jax.losses.spectral import SpectralSpec
from nerfies_jax.training.effects import PenaltyContext, Term
from nerfies_jax.training.protocols import Regularizer

Acceleration = AccelerationSpec
Depth = DepthSpec
LocalIsometry = IsometrySpec
OpacityScale = OpacityScaleSpec
PointDepth = PointDepthSpec
SmoothDepth = SmoothDepthSpec
Spectral = SpectralSpec

__all__ = [
    "Acceleration",
    "Depth",
    "LocalIsometry",
    "OpacityScale",
    "PenaltyContext",
    "PointDepth",
    "Regularizer",
    "SmoothDepth",
    "Spectral",
    "Term",
]
