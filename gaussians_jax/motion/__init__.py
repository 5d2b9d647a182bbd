"""Motion of Gaussians over time: the protocol and the built-in models.

Each model is a frozen dataclass of settings for `Scene.motion` and `fit_tracks`.
"""

from gaussians_jax.core.protocols import Motion, MotionParams
from gaussians_jax.motion.anchors import AnchorMotionSpec
from gaussians_jax.motion.basis import BasisMotionSpec
from gaussians_jax.motion.embedding import EmbeddingMotionSpec
from gaussians_jax.motion.kan import KanMotionSpec
from gaussians_jax.motion.mlp import MotionSpec
from gaussians_jax.motion.nodes import NodeMotionSpec
from gaussians_jax.motion.planes import PlaneMotionSpec
from gaussians_jax.motion.polynomial import PolynomialMotionSpec
from gaussians_jax.motion.se3_bases import SE3BasesSpec
from gaussians_jax.motion.splines import SplineMotionSpec
from gaussians_jax.motion.time_basis import TimeBasisSpec
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
