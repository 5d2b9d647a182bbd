"""`gj.rasterization` against the dense renderer, `gj.render` and differences."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gaussians_jax as gj
from gaussians_jax.core.splats import Gaussians
from gaussians_jax.splatting import rasterization as rasterization_api
from gaussians_jax.splatting import rendering
from gaussians_jax.splatting.raster_spec import GSPLAT
from nerfies_jax.geometry.camera import Camera
from tests.gaussians.shared import jitted, put
from tests.oracles import dense_splats

# Shared by the tests, so that they share programs: no whole number of tiles.
SIZE, COUNT, CAMERAS, CHANNELS = (21, 13), 24, 2, 2
SHAPE = SIZE[::-1]
# Compiles in half the time.
QUICK = dataclasses.replace(GSPLAT, batch=8, chunk=2)
# Every setting of the rasterizer that has no argument, away from its default.
CHANGED = dataclasses.replace(
    GSPLAT, capacity=64, kept_chunks=2, batch=3, chunk=2, clamp_gradient="through",
    alpha_max=0.3, alpha_threshold=0.01, transmittance_threshold=0.01,
    tangent_margin=0.1,
)  # fmt: skip
NAMES = (
    "means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds",
    "means2d_offset",
)  # fmt: skip


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(rasterization_api, "GSPLAT", QUICK)


def some_views():
    """A camera turned about y by 0.2 rad, and one turned about x that has skew."""
    cos, sin = np.cos(0.2), np.sin(0.2)
    views = np.tile(np.eye(4), (2, 1, 1))
    views[0, :3, :3] = [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
    views[1, :3, :3] = [[1, 0, 0], [0, cos, sin], [0, -sin, cos]]
    views[:, :3, 3] = [[0.3, -0.1, 4.0], [-0.2, 0.2, 5.0]]
    Ks = np.tile([[20.0, 0, 10.1], [0, 22.0, 6.7], [0, 0, 1]], (2, 1, 1))
    Ks[1, 0, 1] = 1.5
    return views, Ks


def some_scene(rng, dtype, **changes):
    """Arguments in the order of `NAMES`, some of them replaced."""
    views, Ks = some_views()
    opacity = rng.uniform(0.05, 0.9, COUNT)
    opacity[::3] = 0.9999  # above the clamp
    scene = {
        "means": rng.normal(size=(COUNT, 3)) * [1.5, 1.2, 1.5],
        "quats": rng.normal(size=(COUNT, 4)),
        "scales": np.exp(rng.normal(-2.0, 0.7, (COUNT, 3))),
        "opacities": opacity,
        "colors": rng.uniform(size=(COUNT, CHANNELS)),
        "viewmats": views,
        "Ks": Ks,
        "backgrounds": rng.uniform(size=(CAMERAS, CHANNELS)),
        "means2d_offset": np.zeros((CAMERAS, COUNT, 2)),
    }
    assert tuple(scene) == NAMES
    return put(tuple((scene | changes).values()), dtype)


def camera_of(view, K):
    turn, shift = view[:3, :3], view[:3, 3]
    no_lens = jnp.zeros(3, view.dtype)
    place = -jnp.linalg.inv(turn) @ shift
    lens = K[0, 0], K[:2, 2], K[0, 1], K[1, 1] / K[0, 0], no_lens, no_lens[:2]
    return Camera(turn, place, *lens)


def ours(mode, *scene):
    """Images [cameras, height, width, channels + depth + alpha]."""
    colors, alphas, info = gj.rasterization(
        *scene[:7], *SIZE, render_mode="RGB+ED", rasterize_mode=mode,
        backgrounds=scene[7], means2d_offset=scene[8],
    )  # fmt: skip
    return jnp.concatenate([colors, alphas], axis=-1), info


def dense(mode, means, quats, scales, opacities, colors, *views):
    """The same from the textbook, a camera at a time; no info."""
    spec = dataclasses.replace(CHANGED, antialiased=mode == "antialiased")

    def one(view, K, background, offset):
        gaussians = Gaussians(means, quats, scales, opacities)
        image = dense_splats.render(
            gaussians, colors, camera_of(view, K), SIZE, spec, offset
        )
        alpha = image.alpha[..., None]
        color = image.color + background * (1 - alpha)
        depth = image.depth[..., None] / jnp.maximum(alpha, 1e-10)
        return jnp.concatenate([color, depth, alpha], axis=-1)

    return jax.vmap(one)(*views), None


@functools.partial(jax.jit, static_argnums=(0, 1))
def _differentiated(rasterize, mode, toward, scene):
    def loss(*scene):
        images, info = rasterize(mode, *scene)
        return jnp.sum(images * toward), (images, info)

    every = tuple(range(len(scene)))
    (value, (images, info)), grads = jax.value_and_grad(loss, every, True)(*scene)
    return value, images, info, grads


def differentiated(rasterize, mode, toward, scene):
    """Loss, images, info and gradients by name, as NumPy's."""
    result = _differentiated(rasterize, mode, toward, scene)
    value, images, info, grads = jax.tree.map(np.asarray, result)
    return value, images, info, dict(zip(NAMES, grads, strict=True))


def toward_for(rng, dtype):
    return put(rng.normal(size=(CAMERAS, *SHAPE, CHANNELS + 2)), dtype)


def test_images_and_all_gradients_equal_the_dense_renderer(float64, rng, monkeypatch):
    """With every setting away from its default; `test_raster.py` has the defaults."""
    monkeypatch.setattr(rasterization_api, "GSPLAT", CHANGED)
    scene, toward = some_scene(rng, float64), toward_for(rng, float64)
    _, images, _, grads = differentiated(ours, "antialiased", toward, scene)
    _, expected, _, wanted = differentiated(dense, "antialiased", toward, scene)
    np.testing.assert_allclose(images, expected, atol=1e-12, rtol=0)
    for name in NAMES:
        error = np.abs(grads[name] - wanted[name]).max() / np.abs(wanted[name]).max()
        assert error < 1e-10, name


@pytest.mark.full
def test_gradients_equal_differences(float64, rng):
    """Along one random direction in all arrays together."""
    scene, toward = some_scene(rng, float64), toward_for(rng, float64)
    _, _, _, grads = differentiated(ours, "classic", toward, scene)
    step = 1e-6
    along = [rng.normal(size=np.shape(x)) for x in scene]

    def at(sign):
        pairs = zip(scene, along, strict=True)
        moved = put(tuple(np.asarray(x) + sign * step * d for x, d in pairs))
        return differentiated(ours, "classic", toward, moved)[0]

    slope = sum(np.sum(g * d) for g, d in zip(grads.values(), along, strict=True))
    assert slope == pytest.approx((at(1) - at(-1)) / (2 * step), rel=1e-5)


def check_hidden(rng, dtype, name, value, rows=slice(None, None, 2)):
    """With `value` in some rows of an array: as without these Gaussians.

    They have no gradient, and all gradients are finite.
    """
    scene, toward = some_scene(rng, dtype), toward_for(rng, dtype)
    arrays = dict(zip(NAMES, (np.array(x) for x in scene), strict=True))
    changed = arrays[name].copy()
    changed[rows] = value
    without = arrays["opacities"].copy()
    without[rows] = 0
    _, images, info, grads = differentiated(
        ours, "classic", toward, put(tuple((arrays | {name: changed}).values()), dtype)
    )
    _, expected, _, wanted = differentiated(
        ours, "classic", toward,
        put(tuple((arrays | {"opacities": without}).values()), dtype),
    )  # fmt: skip
    np.testing.assert_array_equal(images, expected)
    assert not info.radii[:, rows].any()
    for of in NAMES:
        np.testing.assert_array_equal(grads[of], wanted[of])
        assert np.isfinite(grads[of]).all()
    for of in NAMES[:5]:
        assert not grads[of][rows].any()
    return images, scene


# In world coordinates; the cameras are at z of about -4 and -5 and look along +z.
HIDDEN = [
    ("means", [0.0, 0.0, -40.0]),  # behind the camera
    ("means", [0.0, 0.0, 3e10]),  # beyond the far plane
    ("means", [np.nan, 0.0, 0.0]),
    ("means", [np.inf, 0.0, 0.0]),
    ("quats", [0.0, 0.0, 0.0, 0.0]),
    ("scales", [np.nan, 1.0, 1.0]),
    ("opacities", 0.0039),  # below 1/255
    ("opacities", np.nan),
]


@pytest.mark.hard_cases
@pytest.mark.parametrize(("name", "value"), HIDDEN)
def test_gaussians_that_cannot_be_seen_change_nothing(name, value, dtype, rng):
    check_hidden(rng, dtype, name, value)


@pytest.mark.hard_cases
def test_nothing_visible_leaves_the_background(dtype, rng):
    images, scene = check_hidden(rng, dtype, "means", [0.0, 0.0, -40.0], slice(None))
    background = np.asarray(scene[7])[:, None, None]
    shape = (CAMERAS, *SHAPE, CHANNELS)
    np.testing.assert_array_equal(
        images[..., :CHANNELS], np.broadcast_to(background, shape)
    )
    assert not images[..., CHANNELS:].any()  # expected depth 0, alpha 0


def axis_scene(rng, dtype, count, scale, opacity, depths):
    """`count` round Gaussians on the axis of two equal cameras; the others hidden."""
    _, Ks = some_views()
    rows = np.arange(COUNT) < count
    means = np.zeros((COUNT, 3))
    means[:, 2] = np.resize(depths, COUNT)
    return some_scene(
        rng, dtype, means=means, quats=np.tile([1.0, 0, 0, 0], (COUNT, 1)),
        scales=np.full((COUNT, 3), scale), opacities=np.where(rows, opacity, 0),
        viewmats=np.tile(np.eye(4), (2, 1, 1)), Ks=np.tile(Ks[:1], (2, 1, 1)),
    )  # fmt: skip


def axis_images(*args):
    scene = axis_scene(*args)
    toward = put(np.ones((CAMERAS, *SHAPE, CHANNELS + 2)), args[1])
    _, images, info, grads = differentiated(ours, "classic", toward, scene)
    assert np.isfinite(images).all()
    assert all(np.isfinite(grad).all() for grad in grads.values())
    return images, info, [np.asarray(x) for x in scene]


@pytest.mark.hard_cases
def test_a_gaussian_at_the_near_plane_is_seen_and_one_before_it_is_not(dtype, rng):
    near = np.asarray(0.01, dtype)
    before = np.nextafter(near, np.zeros_like(near))
    for depth, seen in ((near, True), (before, False)):
        images, info, _ = axis_images(rng, dtype, 1, 1e-4, 0.9, [depth])
        assert images[..., -1].any() == seen
        assert (info.radii[:, 0] > 0).all() == seen


@pytest.mark.hard_cases
def test_a_stack_of_opaque_gaussians_shows_the_nearest(dtype, rng):
    """Alpha is clamped at 0.99; a third of them would leave less than 1e-4."""
    images, _, scene = axis_images(rng, dtype, COUNT, 1e3, 1.0, np.arange(COUNT) + 2.0)
    seen = {"float32": 1, "float64": 2}[dtype]  # rounding of 0.01^2 decides
    weight = 0.99 * 0.01 ** np.arange(seen)
    left = 1 - weight.sum()
    color = weight @ scene[4][:seen] + left * scene[7][:, None, None]
    np.testing.assert_allclose(
        images[..., :CHANNELS], np.broadcast_to(color, images[..., :CHANNELS].shape),
        rtol=1e-5,
    )  # fmt: skip
    depth = weight @ (np.arange(seen) + 2.0) / weight.sum()
    np.testing.assert_allclose(images[..., CHANNELS], depth, rtol=1e-5)


@pytest.mark.hard_cases
def test_a_huge_gaussian_covers_the_image_evenly(dtype, rng):
    images, info, _ = axis_images(rng, dtype, 1, 1e12, 0.5, [2.0])
    np.testing.assert_allclose(images[..., -1], 0.5, rtol=1e-5)
    np.testing.assert_allclose(images[..., CHANNELS], 2.0, rtol=1e-5)
    assert (info.tiles_per_gauss[:, 0] == 6).all()
    assert (info.radii[:, 0] == 10**9).all()


@pytest.mark.hard_cases
def test_no_gaussians_leave_the_background(dtype, rng):
    scene = some_scene(rng, dtype)
    none = [np.asarray(x)[:0] for x in scene[:5]]
    colors, alphas, info = jitted(
        lambda *args: gj.rasterization(*args[:7], *SIZE, backgrounds=args[7])
    )(*none, *scene[5:8])
    assert not alphas.any()
    assert info.means2d.shape == (CAMERAS, 0, 2)
    background = np.asarray(scene[7])[:, None, None]
    np.testing.assert_array_equal(colors, np.broadcast_to(background, colors.shape))


@pytest.mark.full
def test_images_and_info_are_those_of_render_bit_for_bit(dtype, rng):
    """Two scenes of spherical harmonics per camera, degree 2 of 3, as one batch."""
    scenes = [some_scene(rng, dtype) for _ in range(2)]
    batch = [np.stack(pair) for pair in zip(*scenes, strict=True)]
    means, quats, scales, opacities, _, views, Ks, *_ = batch
    harmonics = put(0.3 * rng.normal(size=(2, CAMERAS, COUNT, 16, 3)), dtype)
    # The camera's position is what `render` is given, and here it has no rounding.
    views[..., :3, :3] = np.eye(3)

    colors, alphas, info = jax.jit(
        lambda *args: gj.rasterization(*args, *SIZE, sh_degree=2, render_mode="RGB+ED")
    )(*put((means, quats, scales, opacities, harmonics, views, Ks)))
    assert (info.width, info.height, info.n_cameras) == (*SIZE, CAMERAS)  # static

    @jitted
    def render(gaussians, coefficients, view, K):
        camera = camera_of(view, K)
        return rendering.render_harmonics(gaussians, coefficients, camera, SIZE, QUICK)

    for scene in range(2):
        gaussians = Gaussians(*(x[scene] for x in batch[:4]))
        for camera in range(CAMERAS):
            at = scene, camera
            frame = render(
                gaussians, np.asarray(harmonics[at])[:, :9], views[at], Ks[at]
            )
            color, alpha, depth = frame.rendering[:3]
            np.testing.assert_array_equal(colors[at][..., :3], color)
            np.testing.assert_array_equal(colors[at][..., 3], depth)
            np.testing.assert_array_equal(alphas[at][..., 0], alpha)
            np.testing.assert_array_equal(info.means2d[at], frame.footprints.mean_px)
            np.testing.assert_array_equal(info.depths[at], frame.footprints.depth)


@pytest.mark.full
def test_accumulated_depth_and_radius_clip(dtype, rng):
    """ "D" is "ED" times alpha, and small Gaussians are left out by `radius_clip`."""
    scene = some_scene(rng, dtype)
    clip = 4.0
    depth, alpha, info = jitted(
        lambda *args: gj.rasterization(*args, *SIZE, render_mode="D", radius_clip=clip)
    )(*scene[:7])
    assert depth.shape == alpha.shape == (CAMERAS, *SHAPE, 1)
    toward = toward_for(rng, dtype)
    _, _, whole, _ = differentiated(ours, "classic", toward, scene)
    small = (whole.radii <= clip).all(-1)
    assert 0 < small[0].sum() < COUNT
    np.testing.assert_array_equal(
        info.radii, np.where(small[..., None], 0, whole.radii)
    )
    for camera in range(CAMERAS):
        left = np.where(small[camera], 0, np.asarray(scene[3]))
        others = put((*scene[:3], left, *scene[4:]), dtype)
        _, images, _, _ = differentiated(ours, "classic", toward, others)
        expected = (images[camera, ..., CHANNELS] * images[camera, ..., -1])[..., None]
        np.testing.assert_allclose(depth[camera], expected, rtol=2e-6, atol=1e-6)
        np.testing.assert_allclose(alpha[camera], images[camera, ..., -1:], rtol=1e-6)


REFUSED = [
    (dict(means=np.zeros((24, 2))), r"means must have shape \[..., N, 3\] = \(24, 3\)"),
    (dict(means=np.zeros(3)), r"means must have shape \[..., N, 3\], got \(3,\)"),
    (dict(quats=np.zeros((24, 3))), r"quats must have shape \[..., N, 4\]"),
    (dict(scales=np.zeros(24)), r"scales must have shape \[..., N, 3\]"),
    (dict(opacities=np.zeros((24, 1))), r"opacities must have shape \[..., N\]"),
    (dict(colors=np.zeros((23, 4))), r"colors must have shape \[..., N, D\]"),
    (dict(colors=np.zeros((3, 24, 4))), r"colors must .*\[..., C, N, D\] = \(2, 24, 4"),
    (dict(colors=np.zeros(24)), "D >= 1"),
    (dict(colors=np.zeros((24, 0))), "D >= 1"),
    (dict(viewmats=np.eye(4)), r"one camera is viewmats\[None\]"),
    (dict(viewmats=np.zeros((0, 4, 4))), "at least one camera"),
    (dict(Ks=np.eye(3)), r"Ks must have shape \[..., C, 3, 3\] = \(2, 3, 3\)"),
    (dict(backgrounds=np.zeros((2, 3))), r"backgrounds .*= \(2, 2\), got \(2, 3\)"),
    (dict(means2d_offset=np.zeros((24, 2))), r"means2d_offset .*\[..., C, N, 2\]"),
    (dict(colors=np.zeros((24, 2), np.uint8)), "colors must be float32 .* uint8"),
    (dict(opacities=np.zeros(24, np.float16)), "opacities .* got float16"),
    (dict(sh_degree=4), "sh_degree must be an integer from 0 to 3"),
    (dict(sh_degree=1), "K >= 4 for sh_degree=1"),
    (dict(sh_degree=0, colors=np.zeros((24, 1, 4))), r"colors .*K, 3\] = \(24, 1, 3\)"),
    (dict(render_mode="depth"), "render_mode must be one of"),
    (dict(rasterize_mode="mip"), "rasterize_mode must be one of"),
    (dict(tile_size=12), "tile_size must be one of"),
    (dict(width=0), "width must be a Python integer of at least 1, got 0"),
    (dict(height=-1), "height must be a Python integer"),
    (dict(near_plane=2.0, far_plane=1.0), "0 < near < far"),
    (dict(eps2d=0.0), "eps2d must be positive"),
]


@pytest.mark.parametrize(("changes", "words"), REFUSED)
def test_wrong_arguments_are_refused_by_name(changes, words, rng):
    scene = dict(zip(NAMES, some_scene(rng, "float32"), strict=True))
    changes = {
        name: value.astype(np.float32)
        if getattr(value, "dtype", None) == np.float64
        else value
        for name, value in changes.items()
    }
    arguments = dict(width=SIZE[0], height=SIZE[1]) | scene | changes
    with pytest.raises(ValueError, match=words):
        gj.rasterization(**arguments)


def test_arrays_of_two_dtypes_are_refused(float64, rng):
    scene = list(some_scene(rng, "float64"))
    scene[4] = np.asarray(scene[4], np.float32)
    with pytest.raises(ValueError, match="colors is float32 but means are float64"):
        gj.rasterization(*scene[:7], *SIZE)


@pytest.mark.full
def test_user_transformations_equal_single_calls(float64, rng):
    """`vmap` over cameras, and `scan` over scenes, with gradients."""
    scene, toward = some_scene(rng, float64), toward_for(rng, float64)

    def one(view, K, toward):
        def loss(means):
            colors, _, _ = gj.rasterization(
                means, *scene[1:5], view[None], K[None], *SIZE, render_mode="RGB+ED"
            )
            return jnp.sum(colors[0] * toward[..., :-1])

        return jax.value_and_grad(loss)(scene[0])

    single = [
        jitted(one)(*(np.asarray(x)[i] for x in (*scene[5:7], toward)))
        for i in range(CAMERAS)
    ]
    single = jax.tree.map(lambda *leaves: np.stack(leaves), *single)
    args = (*scene[5:7], toward)
    scan = jitted(lambda *x: jax.lax.scan(lambda _, y: (None, one(*y)), None, x)[1])
    for together in (jitted(jax.vmap(one)), scan):
        for result, wanted in zip(together(*args), single, strict=True):
            np.testing.assert_allclose(result, wanted, rtol=1e-12, atol=1e-12)
