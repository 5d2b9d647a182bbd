"""Analytic dynamic scenes with exact color, depth, flow, masks and point tracks.

    capture, truth = synthetic.make(synthetic.PRESETS["default"])

Scenes are ray-traced in JAX and need no download. `observe` is the true
canonical-to-observed map.
"""

from nerfies_jax.capture.synthetic.presets import DEFAULT as DEFAULT
from nerfies_jax.capture.synthetic.presets import PRESETS as PRESETS
from nerfies_jax.capture.synthetic.record import TRUTH_FILE as TRUTH_FILE
from nerfies_jax.capture.synthetic.record import VERSION as VERSION
from nerfies_jax.capture.synthetic.record import cached as cached
from nerfies_jax.capture.synthetic.record import digest as digest
from nerfies_jax.capture.synthetic.record import make as make
from nerfies_jax.capture.synthetic.record import write as write
from nerfies_jax.capture.synthetic.spec import Cameras as Cameras
from nerfies_jax.capture.synthetic.spec import Collection as Collection
from nerfies_jax.capture.synthetic.spec import Exposure as Exposure
from nerfies_jax.capture.synthetic.spec import Lens as Lens
from nerfies_jax.capture.synthetic.spec import PoseError as PoseError
from nerfies_jax.capture.synthetic.spec import Rig as Rig
from nerfies_jax.capture.synthetic.spec import SceneSpec as SceneSpec
from nerfies_jax.capture.synthetic.spec import Snapshots as Snapshots
from nerfies_jax.capture.synthetic.spec import Specular as Specular
from nerfies_jax.capture.synthetic.spec import Thing as Thing
from nerfies_jax.capture.synthetic.spec import Transient as Transient
from nerfies_jax.capture.synthetic.trace import canonical as canonical
from nerfies_jax.capture.synthetic.trace import observe as observe
from nerfies_jax.capture.synthetic.truth import SceneTruth as SceneTruth
