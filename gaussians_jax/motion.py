"""Motion of Gaussians over time: the protocol and the built-in models.

Each model is a frozen dataclass of settings for `Scene.motion` and `fit_tracks`.
"""

from gaussians_jax.effects.anchors import AnchorMotionSpec
from gaussians_jax.effects.embedding_motion import EmbeddingMotionSpec
from gaussians_jax.effects.kan_motion import KanMotionSpec
from gaussians_jax.effects.mlp_motion import MotionSpec
from gaussians_jax.effects.motion_basis import BasisMotionSpec
from gaussians_jax.effects.node_motion import NodeMotionSpec
from gaussians_jax.effects.plane_motion import PlaneMotionSpec
from gaussians_jax.effects.polynomial_motion import PolynomialMotionSpec
from gaussians_jax.effects.se3_bases import SE3BasesSpec
from gaussians_jax.effects.spline_motion import SplineMotionSpec
from gaussians_jax.effects.time_basis import TimeBasisSpec
from gaussians_jax.protocols import Motion, MotionParams
from nerfies_jax.training.effects import FrameCondition

Anchors = AnchorMotionSpec
Embedding = EmbeddingMotionSpec
KAN = KanMotionSpec
MLP = MotionSpec
MotionBasis = BasisMotionSpec
Nodes = NodeMotionSpec
Planes = PlaneMotionSpec
Polynomial = PolynomialMotionSpec
SE3Bases = SE3BasesSpec
Spline = SplineMotionSpec
TimeBasis = TimeBasisSpec

__all__ = [
    "KAN",
    "MLP",
    "Anchors",
    "Embedding",
    "FrameCondition",
    "Motion",
    "MotionBasis",
    "MotionParams",
    "Nodes",
    "Planes",
    "Polynomial",
    "SE3Bases",
    "Spline",
    "TimeBasis",
]
