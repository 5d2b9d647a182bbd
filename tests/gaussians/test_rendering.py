"""The whole pass, world to pixels, against the dense renderer and its autodiff."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.core.splats import Gaussians
from gaussians_jax.splatting import rendering
from gaussians_jax.splatting.raster_spec import GSPLAT, INRIA
from nerfies_jax.geometry.camera import Camera
from tests import gradients
from tests.gaussians.shared import close, jitted, put
from tests.oracles import dense_splats


def make_camera(dtype, size=(53, 37), skew=3.0, turn=0.2):
    (width, height), cos, sin = size, np.cos(turn), np.sin(turn)
    camera = Camera(
        camera_from_world=[[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]],
        position=[0.3, -0.1, -4.0],
        focal_px=0.9 * width,
        principal_point_px=[0.47 * width, 0.55 * height],
        skew_px=skew,
        pixel_aspect=1.1,
        radial=[0.0, 0.0, 0.0],
        tangential=[0.0, 0.0],
    )
    return put(camera, dtype)


def make_gaussians(rng, count, dtype):
    opacity = rng.uniform(0.05, 0.9, count)
    opacity[::3] = 0.9999  # above the clamp
    cloud = Gaussians(
        rng.normal(size=(count, 3)) * [1.5, 1.2, 1.5],
        rng.normal(size=(count, 4)),
        np.exp(rng.normal(-2.0, 0.7, (count, 3))),
        opacity,
    )
    return put(cloud, dtype)


def weights_for(rng, size, channels):
    width, height = size
    return rng.normal(size=(height, width, channels))


def test_render_equals_the_dense_renderer(float64, rng):
    """With features, a background image and means that are shifted in the image."""
    size = (21, 13)
    gaussians, camera = make_gaussians(rng, 24, float64), make_camera(float64, size)
    values, offset = put((rng.uniform(size=(24, 5)), rng.normal(size=(24, 2))))
    background = put(rng.uniform(size=(13, 21, 3)))
    spec = dataclasses.replace(GSPLAT, batch=8, chunk=2)

    @jitted
    def ours(gaussians, values):
        colors, features = values[:, :3], values[:, 3:]
        return rendering.render(
            gaussians, colors, camera, size, spec, background, features, offset
        )

    @jitted
    def dense(gaussians, values):
        return dense_splats.render(gaussians, values, camera, size, spec, offset)

    frame, exact = ours(gaussians, values), dense(gaussians, values)
    behind = np.asarray(background) * (1 - exact.alpha)[..., None]
    depth = exact.depth / np.maximum(exact.alpha, 1e-10)
    pairs = [
        (frame.rendering.color, exact.color[..., :3] + behind),
        (frame.features, exact.color[..., 3:]),
        (frame.rendering.alpha, exact.alpha),
        (frame.rendering.depth, depth),
    ]
    for result, expected in pairs:
        np.testing.assert_allclose(result, expected, atol=1e-12, rtol=0)


# RGBA or gray colors would put a color where depth is read.
WRONG = [
    ("colors", (24, 4), r"`colors` has shape \[24, 4\], expected \[gaussians, 3\]"),
    ("colors", (24, 1), r"`colors` has shape \[24, 1\]"),
    ("colors", (24,), r"`colors` has shape \[24\]"),
    ("background", (13, 21, 4), "`background` has shape"),
    ("features", (24,), "`features` has shape"),
    ("mean2d_offset", (2,), "`mean2d_offset` has shape"),
]


@pytest.mark.parametrize(("name", "shape", "words"), WRONG)
def test_arrays_of_the_wrong_shape_are_refused(name, shape, words, rng):
    arrays = dict(colors=np.ones((24, 3))) | {name: np.ones(shape)}
    scene = make_gaussians(rng, 24, "float32"), make_camera("float32", (21, 13))
    colors, *_ = put((arrays.pop("colors"),), "float32")
    others = {key: put(value, "float32") for key, value in arrays.items()}
    with pytest.raises(ValueError, match=words):
        rendering.render(scene[0], colors, scene[1], (21, 13), **others)


SPECS = [
    dataclasses.replace(GSPLAT, capacity=64, kept_chunks=2, antialiased=True),
    dataclasses.replace(INRIA, tile=16, batch=3, chunk=2),
]


@pytest.mark.slow
@pytest.mark.parametrize("spec", SPECS, ids=["tiny capacity", "large tile"])
def test_render_and_all_gradients_equal_the_dense_renderer(spec, float64, rng):
    size = (29, 21)
    gaussians = make_gaussians(rng, 60, float64)
    camera = make_camera(float64, size)
    values = put(rng.uniform(size=(60, 5)))
    background = put([0.2, 0.5, 0.9])
    toward = weights_for(rng, size, 7)

    def ours(gaussians, values, background, offset, pose):
        frame = rendering.render(
            gaussians,
            values[:, :3],
            pose,
            size,
            spec,
            background=background,
            features=values[:, 3:],
            mean2d_offset=offset,
        )
        image = frame.rendering
        depth = image.depth * jnp.maximum(image.alpha, 1e-10)
        return jnp.concatenate(
            [
                image.color,
                frame.features,
                image.alpha[..., None],
                depth[..., None],
            ],
            -1,
        )

    def dense(gaussians, values, background, offset, pose):
        image = dense_splats.render(gaussians, values, pose, size, spec, offset)
        color = image.color.at[..., :3].add(background * (1 - image.alpha)[..., None])
        return jnp.concatenate(
            [color, image.alpha[..., None], image.depth[..., None]], -1
        )

    args = (gaussians, values, background, put(np.zeros((60, 2))), camera)

    def differentiate(draw):
        def loss(*args):
            image = draw(*args)
            return jnp.sum(image * toward), image

        return jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3, 4), has_aux=True))(*args)

    (got, image), (want, exact) = differentiate(ours), differentiate(dense)
    # Products of a hundred factors in another order: a few hundred ulps of 1.
    np.testing.assert_allclose(image, exact, atol=2e-13, rtol=0)
    close(got, want, 1e-10, least=1e-12)


@pytest.mark.full
def test_render_gradient_equals_central_differences(float64, rng):
    # Large and soft, so that no threshold is crossed within the step: alpha stays above
    # the cut everywhere on the image and far below the clamp.
    size = (14, 12)
    gaussians = make_gaussians(rng, 6, float64)
    gaussians = gaussians._replace(
        scale=put(np.tile([2.0, 3.0, 2.5], (6, 1))),
        opacity=put(np.asarray(gaussians.opacity) * 0.2 + 0.3),
        mean=put(np.asarray(gaussians.mean) * 0.2),
    )
    camera = make_camera(float64, size)
    colors = put(rng.uniform(size=(6, 3)))
    toward = weights_for(rng, size, 3)

    def loss(gaussians, colors):
        frame = rendering.render(gaussians, colors, camera, size)
        image = frame.rendering
        return jnp.sum(image.color * toward) + jnp.sum(image.depth)

    assert gradients.directional_error(loss, gaussians, colors) < 1e-6
