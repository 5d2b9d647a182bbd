"""Cameras are moved by a known screw and found again; slopes against differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gaussians_jax.scene import scene as splat_scene
from nerfies_jax import evaluation
from nerfies_jax.capture import pinholes
from nerfies_jax.evaluation import fitted_cameras, heldout
from nerfies_jax.evaluation.fitted_cameras import CameraFitSpec
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import rays
from nerfies_jax.scene import scene
from nerfies_jax.training.model import (
    Model,
    Rendering,
    TrainState,
    in_default_precision,
)
from tests import gradients, scenes
from tests.evaluation.test_heldout import FIELD

CLOUD = np.random.default_rng(4).uniform((-0.3, -0.2, -0.1), (0.3, 0.2, 0.1), (24, 3))
COLORS = np.random.default_rng(5).uniform(0, 1, (24, 3))
WIDTH_PX = 2.5


def blobs(params, view, size, step):
    """A scene in closed form: a blot of color where each point is projected to."""
    del step
    points, colors = params
    place, depth = jax.vmap(lambda point: cameras.project(view.camera, point))(points)
    away = rays.pixel_centers(size, place.dtype)[:, :, None] - place
    # As wide as its distance makes it, on the image of whatever size.
    width = WIDTH_PX * view.camera.focal_px / 40 / depth
    near = jnp.exp(-jnp.sum(away**2, axis=-1) / (2 * width**2))
    # A mean of colors: none is clipped by eight bits, which the fit would feel.
    total = 0.5 + jnp.sum(near, axis=-1, keepdims=True)
    color = 0.1 + 0.8 * jnp.einsum("hwp,pc->hwc", near, colors) / total
    return Rendering(color, near[..., 0], near[..., 0])


MODEL = Model("blobs", None, None, blobs, (), lambda state: {})


@pytest.fixture(scope="module")
def capture():
    """Six frames of blobs as their cameras see them, all held out but one."""
    video = scenes.tiny_capture()
    params = in_default_precision((CLOUD + scene_center(video), COLORS))
    draw = jax.jit(lambda view: blobs(params, view, video.size, None).color)
    images = [draw(evaluation.view_of(video, row)) for row in range(len(video.ids))]
    return dataclasses.replace(
        video,
        images=evaluation.to_uint8(np.stack(images)),
        train=np.array([0]),
        heldout=np.arange(1, 6),
        moving=None,
        depths=None,
        flow=None,
    )


def scene_center(video):
    """What the first camera looks at."""
    depth = 2 / (1 / video.near + 1 / video.far)
    forward = video.cameras.camera_from_world[:, 2]
    return np.mean(video.cameras.position + depth * forward, axis=0)


def state_of(video):
    params = in_default_precision((CLOUD + scene_center(video), COLORS))
    return TrainState(params, (), (), jnp.zeros((), jnp.int32), jax.random.key(0))


def displaced(video, rng, turn, shift):
    """The capture with its held-out cameras turned (rad) and shifted (scene units)."""
    position = video.cameras.position.copy()
    rotation = video.cameras.camera_from_world.copy()
    for row in video.heldout:
        way = rng.normal(size=(2, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        spin = Rotation.from_rotvec(turn * way[0]).as_matrix()
        rotation[row] = spin @ rotation[row]
        position[row] += shift * way[1]
    moved = video.cameras._replace(camera_from_world=rotation, position=position)
    return dataclasses.replace(video, cameras=moved)


@pytest.mark.full
@pytest.mark.parametrize(
    ("turn", "shift", "most_pixels"), [(0.02, 0.01, 400), (0.02, 0.0, 5000)]
)
def test_a_displaced_camera_is_found_again(capture, rng, turn, shift, most_pixels):
    video = displaced(capture, rng, turn, shift)
    state = state_of(capture)
    renderer = evaluation.Renderer(MODEL, video.size)
    rows = video.heldout[:3]
    before = evaluation.score(renderer, state, video, rows)
    spec = CameraFitSpec(max_steps=200, tolerance=3e-3, most_pixels=most_pixels)
    # Scored through the lens of the capture, with the poses that were fitted without.
    lens = video.cameras._replace(radial=video.cameras.radial + np.float32(0.1))
    scored = []

    def draw(state, view):
        scored.append(view.camera)
        return renderer(state, view._replace(camera=pinholes.pinhole(view.camera)))

    fitted = fitted_cameras.fit_cameras(
        MODEL,
        draw,
        state,
        video,
        rows,
        spec,
        observed=dataclasses.replace(video, cameras=lens),
    )
    assert [float(camera.radial[0]) for camera in scored] == [np.float32(0.1)] * 3
    for camera, position in zip(scored, fitted.cameras.position, strict=True):
        np.testing.assert_allclose(camera.position, position, atol=1e-6)
    assert fitted.converged.all()
    apart = np.linalg.norm(
        fitted.cameras.position - capture.cameras.position[rows], axis=1
    )
    turns = np.einsum(
        "nij,nkj->nik",
        fitted.cameras.camera_from_world.astype(float),
        capture.cameras.camera_from_world[rows].astype(float),
    )
    angles = Rotation.from_matrix(turns).magnitude()
    # Measured: 4e-4 units and 6e-4 rad from eight bits and a valley in which turns and
    # shifts trade; 2e-3 and 4e-3 from images half as wide, of pixels that are
    # means where the scene is drawn at their centers.
    bound = 1e-3 if most_pixels == 5000 else 6e-3
    assert apart.max() < bound
    assert angles.max() < bound
    assert fitted.scored.psnr.min() > 55
    assert (fitted.scored.psnr > before.psnr + 5).all()
    # Held against the exact path, the errors are those of the fitted cameras.
    numbers = heldout._cameras(fitted, capture, exact=True)
    assert numbers["cameras.ate"] < bound
    assert numbers["cameras.rotation_error"] < 2 * np.degrees(bound)
    assert set(heldout._cameras(fitted, capture, exact=False)) == {
        "heldout.camera_fitted_psnr"
    }


@pytest.mark.full
def test_what_is_not_observed_does_not_count(capture, rng):
    video = displaced(capture, rng, 0.02, 0.01)
    valid = np.ones(video.images.shape[:3], bool)
    valid[:, :6] = False
    spoilt = video.images.copy()
    spoilt[:, :6] = 255
    video = dataclasses.replace(video, valid=valid, images=spoilt)
    renderer, state = evaluation.Renderer(MODEL, video.size), state_of(capture)
    rows = video.heldout[:2]
    fitted = fitted_cameras.fit_cameras(MODEL, renderer, state, video, rows)
    assert fitted.converged.all()
    apart = fitted.cameras.position - capture.cameras.position[rows]
    assert np.abs(apart).max() < 2e-3


@pytest.mark.full
def test_an_empty_scene_finds_no_camera(capture):
    blank = MODEL._replace(
        render=lambda params, view, size, step: Rendering(
            jnp.full((*size[::-1], 3), 0.5), jnp.ones(size[::-1]), jnp.ones(size[::-1])
        )
    )
    renderer = evaluation.Renderer(blank, capture.size)
    rows = capture.heldout[:1]
    fitted = fitted_cameras.fit_cameras(
        blank, renderer, state_of(capture), capture, rows
    )
    assert not fitted.converged.any()
    np.testing.assert_array_equal(
        fitted.cameras.position, capture.cameras.position[rows]
    )


KINDS = {
    "gaussians": (
        splat_scene,
        dataclasses.replace(scenes.TINY_SPLATS, strategy=None),
    ),
    "radiance": (scene, FIELD),
}


@pytest.mark.full
@pytest.mark.parametrize("kind", KINDS)
def test_the_slope_of_the_error_is_that_of_both_representations(kind, float64):
    """Through rendering, posing and the block by block map of a field."""
    module, spec = KINDS[kind]
    video = scenes.tiny_capture()
    metadata = (
        module.metadata_of(video)
        if kind == "gaussians"
        else module.metadata_of(video, spec)
    )
    model = module.build(spec, metadata)
    state = model.init(video, jax.random.key(1))
    small = (12, 9)
    view = evaluation.resized(evaluation.view_of(video, 2), video.size, small)
    image = jnp.asarray(video.images[2, 1::3, 1::3][: small[1], : small[0]])
    valid = jnp.ones(small[::-1], bool).at[2:4].set(False)
    depth = jnp.asarray(0.6, float64)
    loss = fitted_cameras.photometric_loss(model, state, view, image, valid, depth)
    screw = jnp.asarray([0.3, -0.2, 0.5, 0.1, 0.4, -0.3])  # pixels
    # A Gaussian enters or leaves a pixel by less than 1/255 of its color.
    bound = {"gaussians": 1e-4, "radiance": 1e-6}[kind]
    assert gradients.directional_error(loss, screw, step=1e-6) < bound


def test_a_fit_takes_a_step_at_least():
    with pytest.raises(ValueError, match="max_steps=0"):
        CameraFitSpec(max_steps=0)
