"""Gaussians for a rasterizer elsewhere show what the model's own renderer shows."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussians_jax.core.splats import Gaussians
from gaussians_jax.per_frame.exposure import ExposureSpec
from gaussians_jax.player import browser_splats
from gaussians_jax.scene import scene, variants
from gaussians_jax.scene.spec import raster_of
from nerfies_jax import evaluation
from tests import scenes
from tests.oracles import dense_splats

pytestmark = pytest.mark.slow

CAPTURE = dataclasses.replace(
    scenes.tiny_capture(), appearance_ids=np.arange(7, dtype=np.int32)
)
SPEC = dataclasses.replace(scenes.TINY_DEFORMABLE, exposure=ExposureSpec())
STEP = 25  # of the degree that SPEC ends at


@pytest.fixture(scope="module")
def built():
    """Metadata, and a state in which everything that `SPEC` has is to be seen."""
    metadata = scene.metadata_of(CAPTURE)
    state = scene.build(SPEC, metadata).init(CAPTURE, jax.random.key(0))
    rng = np.random.default_rng(0)

    def shake(leaf):
        return leaf + np.asarray(0.1 * rng.normal(size=leaf.shape), leaf.dtype)

    rows = state.params.rows["splats"]
    rows = rows._replace(
        opacity_logit=jnp.where(rows.opacity_logit < -500, -1000.0, 1.0),
        quaternion=shake(rows.quaternion),
        log_scale=shake(shake(rows.log_scale)),
        sh_rest=shake(rows.sh_rest),
    )
    params = state.params._replace(
        rows=state.params.rows | {"splats": rows},
        nets=jax.tree.map(shake, state.params.nets),
    )
    return metadata, state._replace(params=params, step=jnp.asarray(STEP, jnp.int32))


def composited(cloud, camera, spec):
    """The image of a cloud by the dense renderer, which shares no code with ours."""
    variance, axes = np.linalg.eigh(np.asarray(cloud.covariances, np.float64))
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    gaussians = Gaussians(
        jnp.asarray(cloud.centers),
        jnp.asarray(Rotation.from_matrix(axes).as_quat(scalar_first=True), jnp.float32),
        jnp.asarray(np.sqrt(np.maximum(variance, 0)), jnp.float32),
        jnp.asarray(cloud.opacity),
    )
    rendering = dense_splats.render(
        gaussians, jnp.asarray(cloud.rgb), camera, CAPTURE.size, spec
    )
    return rendering.color + (1 - rendering.alpha[..., None]) * cloud.background


@pytest.mark.parametrize("without", [(), ("motion",)])
def test_a_cloud_composites_to_the_rendered_image(built, without):
    metadata, state = built
    view = evaluation.view_of(CAPTURE, int(CAPTURE.train[2]))
    model = variants.without_effects(SPEC, metadata, without, False)
    expected = evaluation.Renderer(model, CAPTURE.size)(state, view).color
    splatting = browser_splats.splatting(SPEC, metadata, without)
    cloud = splatting(
        state, float(view.time), int(view.appearance), view.camera.position
    )
    active = np.asarray(state.params.rows["splats"].opacity_logit) > -500
    assert len(cloud.centers) == active.sum() < len(active)
    assert cloud.view_dependent
    shown = composited(cloud, view.camera, raster_of(SPEC, metadata))
    # Colors below zero are clipped before the exposure in both; eigenvalues of float32
    # covariances are the difference.
    np.testing.assert_allclose(shown, expected, atol=2e-3)
    assert np.ptp(expected) > 0.3


def test_effects_times_and_positions_change_the_cloud(built):
    metadata, state = built
    splatting = browser_splats.splatting(SPEC, metadata, ())
    position = CAPTURE.cameras.position[0]
    first = splatting(state, 0.0, 0, position)
    later = splatting(state, 1.0, 0, position)
    assert np.abs(later.centers - first.centers).max() > 1e-3
    aside = splatting(state, 0.0, 0, position + 1)
    assert (aside.rgb != first.rgb).any()
    np.testing.assert_array_equal(aside.centers, first.centers)
    lit = splatting(state, 0.0, 3, position)
    assert (lit.background != first.background).any()
    static = browser_splats.splatting(SPEC, metadata, ("motion",))
    np.testing.assert_array_equal(
        *(static(state, time, 0, position).centers for time in (0.0, 1.0))
    )
    # Degree 0 is the same from everywhere, and the browser need not be told of turns.
    assert not splatting(state._replace(step=state.step * 0), 0.0, 0, position)[-1]
