"""Light that changes from frame to frame, beside a scene of Gaussians that does not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.per_frame import exposure
from gaussians_jax.per_frame.exposure import ExposureSpec
from gaussians_jax.scene import held_out_exposure, scene, variants
from nerfies_jax import evaluation
from tests import scenes

SPEC = dataclasses.replace(scenes.TINY_SPLATS, exposure=ExposureSpec())
EVEN = scenes.tiny_capture()
# Each frame in a light of its own, the one held out between two others in time.
CAPTURE = dataclasses.replace(
    EVEN,
    appearance_ids=np.arange(7, dtype=np.int32),
    times=np.where(np.arange(7) == EVEN.heldout[0], np.float32(0.5), EVEN.times),
)
# Warmer, brighter, and a little lifted
CHANGE = np.array([[0.3, 0.05, 0, 0.02], [0, 0.1, 0, 0], [0, 0.05, -0.2, 0.01]])


@pytest.fixture(scope="module")
def built():
    """A model, and a state whose exposures change the colors of some frames."""
    metadata = scene.metadata_of(CAPTURE)
    model = scene.build(SPEC, metadata)
    state = model.init(CAPTURE, jax.random.key(0))
    scale = jnp.arange(len(CAPTURE.train), dtype=jnp.float32)[:, None, None]
    table = scale * jnp.asarray(CHANGE, jnp.float32)
    params = state.params._replace(nets={"exposure": table})
    return model, metadata, state._replace(params=params)


def rendered(model, state, rows):
    renderer = evaluation.Renderer(model, CAPTURE.size)
    views = [evaluation.view_of(CAPTURE, row) for row in rows]
    return np.stack([renderer(state, view).color for view in views])


def test_a_frame_is_drawn_in_its_light_and_one_never_seen_between_its_neighbors(built):
    model, metadata, state = built
    rows = [int(row) for row in CAPTURE.train]
    between = int(CAPTURE.heldout[0])
    neutral = variants.without_effects(SPEC, metadata, ("exposure",), False)
    plain = rendered(neutral, state, [*rows, between])
    assert plain.max() > 0.1
    exposed = rendered(model, state, [*rows, between])
    shares = np.array([*range(6), 2.5]) - 2.5  # beside the mean
    for image, shown, share in zip(plain, exposed, shares, strict=True):
        expected = image + share * (image @ CHANGE[:, :3].T + CHANGE[:, 3])
        np.testing.assert_allclose(shown, expected, atol=2e-6)
    assert variants.parts(SPEC, metadata).appearance


@pytest.mark.full
def test_a_step_teaches_the_exposure_of_its_frame_and_of_no_other(built):
    model, _, state = built
    after, _ = jax.jit(model.step)(state, evaluation.frames_of(CAPTURE))
    moved = after.params.nets["exposure"] != state.params.nets["exposure"]
    assert sorted(np.asarray(moved).any(axis=(1, 2))) == [False] * 5 + [True]


def test_what_all_exposures_have_in_common_changes_no_image(dtype):
    rng = np.random.default_rng(1)
    table = rng.normal(size=(3, 3, 4)).astype(dtype)
    places = ((0, 0, 0.0), (1, 1, 0.0), (1, 2, 0.25), (2, 2, 0.0))
    change = jax.jit(exposure.of_id, static_argnums=1)
    for one in range(len(places)):
        left, right, share = places[one]
        expected = (1 - share) * table[left] + share * table[right] - table.mean(axis=0)
        for common in (0.0, 0.5):
            actual = change(table + np.asarray(common, dtype), places, np.int32(one))
            assert actual.dtype == dtype
            np.testing.assert_allclose(actual, expected, atol=1e-6)


def test_half_a_frame_tells_the_light_of_the_other_half(built):
    _, metadata, state = built
    neutral = variants.without_effects(SPEC, metadata, ("exposure",), False)
    plain = rendered(neutral, state, CAPTURE.heldout)
    lit = plain * 0.7 + 0.2 + plain @ CHANGE[:, :3].T
    images = CAPTURE.images.copy()
    images[CAPTURE.heldout] = np.round(255 * lit.clip(0, 1))
    capture = dataclasses.replace(CAPTURE, images=images)
    score = held_out_exposure.scorer(SPEC, metadata, capture.size)
    halves = score(state, capture, capture.heldout)
    # 8 bits of both images leave 56 dB; nothing else is between them
    assert halves.psnr.min() > 50
    still = dataclasses.replace(SPEC, exposure=None)
    assert held_out_exposure.scorer(still, metadata, capture.size) is None
    # Of a black image nothing can be told but the offset.
    black = np.zeros((4, 5, 3))
    change = exposure.fit(black, black + 0.25, None)
    np.testing.assert_allclose(change, [[0, 0, 0, 0.25]] * 3, atol=1e-5)
    with pytest.raises(ValueError, match="learning_rate"):
        ExposureSpec(learning_rate=1e-3, learning_rate_end=1e-2)
