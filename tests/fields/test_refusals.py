"""What no template, ray or scene can be built with, and what is said about it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax import evaluation
from nerfies_jax.capture.scene_metadata import SceneMetadata
from nerfies_jax.fields import sampling
from nerfies_jax.fields.effects.ambient import AmbientSpec
from nerfies_jax.fields.effects.appearance import AppearanceSpec
from nerfies_jax.fields.effects.background import BackgroundSpec
from nerfies_jax.fields.effects.elastic import ElasticSpec
from nerfies_jax.fields.effects.moving_mask import MovingMaskSpec
from nerfies_jax.fields.effects.scene_flow import SceneFlowSpec
from nerfies_jax.fields.effects.time_condition import TimeSpec
from nerfies_jax.fields.effects.warp import WarpSpec
from nerfies_jax.fields.occupancy import OccupancySpec
from nerfies_jax.fields.spec import SamplingSpec
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.nn.planes import PlanesSpec
from nerfies_jax.scene import scene
from nerfies_jax.scene.scene import RadianceScene
from tests import scenes

METADATA = SceneMetadata(
    near=1.0,
    far=3.0,
    center=(0.5, 0.0, -0.5),
    scale=0.5,
    background=None,
    times=(0.0, 1.0),
    exposures=((0, 0, 0.0),),
)
BENT = RadianceScene(
    steps=40, warp=WarpSpec(), time=TimeSpec(), appearance=AppearanceSpec()
)
WET = dataclasses.replace(BENT, warp=WarpSpec(guides=("wet",)))
UNMASKED = dataclasses.replace(BENT, ambient=AmbientSpec(guides=("mask",)))
MASKED = dataclasses.replace(WET, mask=MovingMaskSpec())
ON_POINTS = dataclasses.replace(BENT, background=BackgroundSpec())
TWO_WIDTHS = dataclasses.replace(
    BENT, warp=WarpSpec(code_width=5), time=TimeSpec(condition="code")
)
WITH_TIME = TemplateSpec(PlanesSpec(timestamps=4))
LINE = np.linspace(0.1, 1, 5, dtype=np.float32)


def stratified(*settings):
    return sampling.stratified(None, jnp.float32(0.1), jnp.float32(1), *settings)


def sample_pdf(edges, weights, count):
    return sampling.sample_pdf(None, jnp.asarray(edges), jnp.asarray(weights), count)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: TemplateSpec(density="sine"), "'sine'.*softplus"),
        (lambda: TemplateSpec(color_width=0), "color_width=0"),
        (lambda: TemplateSpec(width=0), "width=0"),
        (lambda: TemplateSpec(depth=0, skips=()), "depth=0"),
        (lambda: TemplateSpec(density_bias=np.nan), "density_bias=nan must be finite"),
        (lambda: TemplateSpec(density_bias=-np.inf), "density_bias=-inf"),
        (lambda: SamplingSpec(coarse=1), "coarse=1"),
        (lambda: RadianceScene(steps=1, density_noise=-1.0), "density_noise=-1.0"),
        (lambda: RadianceScene(steps=1, density_noise=np.nan), "density_noise=nan"),
        (lambda: RadianceScene(steps=1, curriculum_steps=0), "curriculum_steps=0"),
        (
            lambda: RadianceScene(
                steps=1,
                scene_flow=SceneFlowSpec(moving_rays=0.3),
                sampling=SamplingSpec(occupancy=OccupancySpec()),
            ),
            "moving_rays=0.3 chooses rays, and so does sampling.occupancy",
        ),
        (lambda: SamplingSpec(spacing="log"), "spacing='log'"),
        (
            lambda: SamplingSpec(spacing="disparity", occupancy=OccupancySpec()),
            "occupancy=none, or spacing='linear'",
        ),
        (lambda: stratified(1), "count=1"),
        (lambda: stratified(4, "log"), "'log'"),
        (lambda: sample_pdf(LINE, LINE, 4), "5 edges do not bound 5 bins"),
        (lambda: sample_pdf(LINE, LINE[1:], 0), "count=0"),
        (
            lambda: sampling.refine(None, *[jnp.asarray(LINE[:2])] * 2, 4),
            "2 distances",
        ),
        (lambda: RadianceScene(1, elastic=ElasticSpec()), "there is none"),
        (lambda: RadianceScene(1, rays=0), "rays=0"),
        (lambda: RadianceScene(0), "steps=0"),
        (lambda: RadianceScene(1, extent=0.0), "extent=0"),
        (lambda: RadianceScene(1, extent=np.inf), "extent=inf.*finite, or none"),
        (lambda: RadianceScene(1, learning_rate=np.inf), "learning_rate=inf.*finite"),
        (lambda: RadianceScene(1, template_rate=np.inf), "template_rate=inf.*finite"),
        (lambda: RadianceScene(1, table_rate=np.inf), "table_rate=inf.*finite"),
        (lambda: RadianceScene(1, code_rate=0.0), "code_rate=0.0.*positive"),
        (lambda: RadianceScene(1, WITH_TIME), "position.timestamps=none"),
        (lambda: RadianceScene(1, coarse=WITH_TIME), "position.timestamps=none"),
        (
            lambda: RadianceScene(1, learning_rate=1e-4, learning_rate_end=1e-3),
            "learning_rate_end",
        ),
        (lambda: scene.build(ON_POINTS, METADATA), "background=none"),
        (lambda: scene.build(WET, METADATA), "warp.guides names 'wet'.*there is none"),
        (lambda: scene.build(UNMASKED, METADATA), "ambient.guides names 'mask'.*mask"),
        (
            lambda: scene.build(MASKED, METADATA),
            "warp.guides names 'wet'.*there is mask",
        ),
        (lambda: scene.field(TWO_WIDTHS, METADATA), "code_width"),
        (
            lambda: scene.field(BENT, METADATA, ("elastic",)),
            "no effect 'elastic'.*warp",
        ),
        (lambda: scene.field(BENT, METADATA, ("time",)), "feeds the template"),
        (lambda: scene.field(BENT, METADATA, ("appearance",)), "feeds the template"),
    ],
)
def test_wrong_settings_are_refused(call, words):
    with pytest.raises(ValueError, match=words):
        call()


@dataclasses.dataclass(frozen=True)
class Rain:
    """A conditioning that warps read."""

    name: str = "wet"
    features: int = 1
    target: str = "warp"

    def apply(self, params, point, frame):
        return point[:1]


def test_a_guide_comes_from_a_conditioning_of_another_package():
    spec = dataclasses.replace(WET, conditioning=(Rain(),))
    capture = scenes.tiny_capture()
    model = scene.build(spec, scene.metadata_of(capture, spec))
    frames = evaluation.frames_of(capture, model.required_data)
    state = jax.eval_shape(lambda key: model.init(capture, key), jax.random.key(0))
    jax.eval_shape(model.step, state, frames)
    dry = dataclasses.replace(spec, conditioning=(Rain("dry"),))
    with pytest.raises(ValueError, match=r"'wet', and there is dry; .* target is"):
        scene.build(dry, METADATA)
