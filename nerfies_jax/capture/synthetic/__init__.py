"""Analytic dynamic scenes with exact color, depth, flow, masks and point tracks.

    capture, truth = synthetic.make(synthetic.PRESETS["default"])

Scenes are ray-traced in JAX and need no download. `observe` is the true
canonical-to-observed map.
"""

from nerfies_jax.capture.synthetic.presets import DEFAULT, PRESETS
from nerfies_jax.capture.synthetic.record import (
    TRUTH_FILE,
    VERSION,
    cached,
    digest,
    make,
    write,
)
from nerfies_jax.capture.synthetic.spec import (
    Cameras,
    Collection,
    Exposure,
    Lens,
    PoseError,
    Rig,
    SceneSpec,
    Snapshots,
    Specular,
    Thing,
    Transient,
)
from nerfies_jax.capture.synthetic.trace import canonical, observe
from nerfies_jax.capture.synthetic.truth import SceneTruth

__all__ = [
    "DEFAULT",
    "PRESETS",
    "TRUTH_FILE",
    "VERSION",
    "Cameras",
    "Collection",
    "Exposure",
    "Lens",
    "PoseError",
    "Rig",
    "SceneSpec",
    "SceneTruth",
    "Snapshots",
    "Specular",
    "Thing",
    "Transient",
    "cached",
    "canonical",
    "digest",
    "make",
    "observe",
    "write",
]
