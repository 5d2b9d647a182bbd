"""What no effect can be built with, and what is said about it."""

import math

import pytest

from nerfies_jax.fields.effects import timestamps
from nerfies_jax.fields.effects.ambient import AmbientSpec
from nerfies_jax.fields.effects.appearance import AppearanceSpec
from nerfies_jax.fields.effects.background import BackgroundSpec
from nerfies_jax.fields.effects.elastic import ElasticSpec
from nerfies_jax.fields.effects.moving_mask import MovingMaskSpec
from nerfies_jax.fields.effects.ray_distortion import DistortionSpec
from nerfies_jax.fields.effects.scene_flow import FlowWeights, SceneFlowSpec
from nerfies_jax.fields.effects.smoothness import SmoothnessSpec
from nerfies_jax.fields.effects.surface import SurfaceSpec
from nerfies_jax.fields.effects.time_condition import TimeSpec
from nerfies_jax.fields.effects.time_warp import TimeWarpSpec
from nerfies_jax.fields.effects.transient import TransientSpec
from nerfies_jax.fields.effects.warp import WarpSpec
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.nn.planes import PlanesSpec

STRICT = TemplateSpec(PlanesSpec(timestamps=4, outside="refuse"))
REFUSED = [
    (AmbientSpec, {"kind": "curved"}, "unknown kind of slicing surface 'curved'.*bent"),
    (AmbientSpec, {"dims": 0}, "dims=0 must be at least 1.*none"),
    (AmbientSpec, {"code_width": 0}, "code_width=0"),
    (AmbientSpec, {"anneal_steps": 0}, "anneal_steps=0"),
    (AmbientSpec, {"closed_steps": -1}, "closed_steps=-1"),
    (AmbientSpec, {"skips": (9,)}, "layer 9 is not in 1 .. 5"),
    (AmbientSpec, {"width": 0}, "width=0"),
    (AppearanceSpec, {"width": 0}, "width=0.*set the effect to none"),
    (BackgroundSpec, {"points": 0}, "points=0"),
    (BackgroundSpec, {"noise": -1.0}, "noise=-1"),
    (BackgroundSpec, {"weight": math.nan}, "weight=nan"),
    (BackgroundSpec, {"width": 0.0}, "width > 0"),
    (BackgroundSpec, {"width": math.inf}, "finite width > 0, got inf"),
    (BackgroundSpec, {"scaling": "twice"}, "'twice'"),
    (ElasticSpec, {"points": 0}, "points=0.*None"),
    (ElasticSpec, {"every": 0}, "every=0.*every step"),
    (ElasticSpec, {"weight": -1.0}, "weight=-1"),
    (ElasticSpec, {"fold_cost": math.nan}, "fold_cost=nan"),
    (ElasticSpec, {"robust_width": 0.0}, "width > 0"),
    (ElasticSpec, {"robust_width": math.inf}, "finite width > 0, got inf"),
    (ElasticSpec, {"scaling": "twice"}, "'twice'"),
    (ElasticSpec, {"decay_steps": 0}, "steps=0"),
    (MovingMaskSpec, {"code_width": 0}, "code_width=0"),
    (MovingMaskSpec, {"weight": -0.1}, "weight=-0.1"),
    (MovingMaskSpec, {"skips": (9,)}, "layer 9 is not in"),
    (SurfaceSpec, {"anneal_steps": 0}, "anneal_steps=0"),
    (SurfaceSpec, {"back_facing": math.inf}, "back_facing=inf"),
    (SceneFlowSpec, {"flow_bound": 0.0}, "flow_bound=0"),
    (SceneFlowSpec, {"flow_bound": math.nan}, "flow_bound=nan"),
    (SceneFlowSpec, {"decay_steps": 0}, "decay_steps=0"),
    (SceneFlowSpec, {"chain_steps": -1}, "chain_steps=-1"),
    (SceneFlowSpec, {"moving_rays": 1.5}, "moving_rays=1.5 must be a share"),
    (SceneFlowSpec, {"network": TemplateSpec(anneal_steps=9)}, "anneal_steps=9.*none"),
    (SceneFlowSpec, {"network": STRICT}, "before the first.*clamp"),
    (FlowWeights, {"cycle": -1.0}, "cycle=-1"),
    (FlowWeights, {"depth": math.inf}, "depth=inf"),
    (timestamps.interval, {"count": 0}, "count=0"),
    (SmoothnessSpec, {"weight": -1.0}, "weight=-1.0"),
    (DistortionSpec, {"weight": math.inf}, "weight=inf"),
    (SmoothnessSpec, {"until": 0}, "until=0.*none"),
    (TimeWarpSpec, {"embedding": 0}, "embedding=0"),
    (TimeWarpSpec, {"depth": -1}, "depth=-1"),
    (TimeSpec, {"condition": "frame"}, "unknown condition 'frame'.*time"),
    (TimeSpec, {"code_width": 0}, "code_width=0 must be at least 1"),
    (TransientSpec, {"code_width": 0}, "code_width=0"),
    (TransientSpec, {"beta_min": 0.0}, r"beta_min=0.0 must be positive.*0\.03"),
    (TransientSpec, {"beta_min": math.nan}, "beta_min=nan"),
    (TransientSpec, {"density_weight": -0.1}, "density_weight=-0.1"),
    (TransientSpec, {"density_weight": math.inf}, "density_weight=inf"),
    (TransientSpec, {"beta_power": -0.5}, r"beta_power=-0.5 must be in \[0, 2\]"),
    (TransientSpec, {"beta_power": math.nan}, "beta_power=nan"),
    (TransientSpec, {"depth": -1}, "depth=-1"),
    (WarpSpec, {"kind": "affine"}, "'affine'.*se3"),
    (WarpSpec, {"condition": "frame"}, "'frame'.*code"),
    (WarpSpec, {"code_width": 0}, "code_width=0"),
    (WarpSpec, {"anneal_steps": 0}, "anneal_steps=0.*None"),
    (WarpSpec, {"skips": (6,)}, "layer 6 is not in"),
    (WarpSpec, {"width": 0}, "width=0"),
]


@pytest.mark.parametrize(("make", "settings", "words"), REFUSED)
def test_wrong_settings_are_refused(make, settings, words):
    with pytest.raises(ValueError, match=words):
        make(**settings)
