# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A NeRF with a flax module of your own
#
# A radiance field needs three things: rays, samples along them, and a sum of their
# colors by volume rendering. The library has these as functions, and the network is
# yours. Here it is a `flax.linen` module with the layout of NeRF (Mildenhall et al.
# 2020, arXiv:2003.08934): density from the position, color from the direction as well.
# It is trained on the static built-in scene and scored on views that it has not seen.

# %%
# %pip install --quiet "nerfies-jax[flax,report]"

# %%
import flax.linen as nn
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import nerfies_jax as nj

STEPS = 1500
RAYS = 512  # in a step
SAMPLES = 32  # along a ray
WIDTH = 64
FACTOR = 2  # images are this many times smaller

# %% [markdown]
# ## Images and rays
#
# `nj.pixel_rays` makes the rays of all pixels of a camera, through its lens. Colors lie
# in [0, 1].

# %%
capture = nj.built_in_scene("static")
size = capture.size[0] // FACTOR, capture.size[1] // FACTOR
height, width = size[1] * FACTOR, size[0] * FACTOR


def smaller(image):
    blocks = image[:height, :width].reshape(size[1], FACTOR, size[0], FACTOR, 3)
    return blocks.mean((1, 3)) / 255


def camera_of(row):
    camera = jax.tree.map(lambda leaf: leaf[row], capture.cameras)
    return camera._replace(
        focal_px=camera.focal_px / FACTOR,
        principal_point_px=camera.principal_point_px / FACTOR,
    )


rays_of = jax.jit(lambda camera: nj.pixel_rays(camera, size))
images = {row: smaller(capture.images[row]) for row in range(len(capture.ids))}
train = [rays_of(camera_of(row)) for row in capture.train]
origins, directions = (
    jnp.concatenate([getattr(rays, name).reshape(-1, 3) for rays in train])
    for name in ("origin", "direction")
)
colors = jnp.asarray(
    np.concatenate([images[row].reshape(-1, 3) for row in capture.train]), jnp.float32
)

# %% [markdown]
# ## The module
#
# It takes points and directions of any leading axes. Positions are divided by the far
# distance, so that the encoding sees numbers of about one.


# %%
class Field(nn.Module):
    """Density and color of points that are seen along directions."""

    width: int
    far: float

    @nn.compact
    def __call__(self, points, directions):
        position = nj.positional_encoding(points / self.far, num_frequencies=6)
        x = position
        for layer in range(4):
            x = nn.relu(nn.Dense(self.width)(x))
            if layer == 1:
                x = jnp.concatenate([x, position], axis=-1)
        density = nn.softplus(nn.Dense(1)(x)[..., 0])
        view = nj.positional_encoding(directions, num_frequencies=2)
        x = nn.relu(nn.Dense(self.width // 2)(jnp.concatenate([x, view], axis=-1)))
        return density, nn.sigmoid(nn.Dense(3)(x))


near, far = capture.near, capture.far
example = jnp.zeros((1, 3))
network = nj.adapters.linen(Field(WIDTH, far), example, example)

# %% [markdown]
# ## Rendering and training
#
# With a key, samples are random within their bins, as in training. Without one they lie
# in the middle.


# %%
def render(params, origin, direction, key=None):
    t, points, _ = nj.sample_along_rays(key, origin, direction, near, far, SAMPLES)
    along = jnp.broadcast_to(direction[..., None, :], points.shape)
    density, color = network.apply(params, points, along)
    # Density is in units of 1 / (far - near), so that training starts in a light fog.
    density = density * 10 / (far - near)
    return nj.composite(density, color, t, jnp.zeros(3), last_interval=far - t[..., -1])


optimizer = optax.adam(optax.exponential_decay(3e-3, STEPS, 0.1))


@jax.jit
def fit(params, key):
    def step(carry, key):
        params, state = carry
        row_key, sample_key = jax.random.split(key)
        rows = jax.random.randint(row_key, (RAYS,), 0, len(colors))

        def loss(params):
            rendered = render(params, origins[rows], directions[rows], sample_key)
            return jnp.mean(jnp.square(rendered.color - colors[rows]))

        value, gradient = jax.value_and_grad(loss)(params)
        update, state = optimizer.update(gradient, state)
        return (optax.apply_updates(params, update), state), value

    carry = params, optimizer.init(params)
    (params, _), values = jax.lax.scan(step, carry, jax.random.split(key, STEPS))
    return params, values


params, values = fit(network.init(jax.random.key(0)), jax.random.key(1))

# %% [markdown]
# ## A view that was held out
#
# The baseline to beat is an image of one color, the mean of this view.


# %%
@jax.jit
def image_of(params, rays):
    # A row of pixels at a time, which bounds the memory.
    return jax.lax.map(
        lambda row: render(params, *row).color, (rays.origin, rays.direction)
    )


row = int(capture.heldout[0])
truth = jnp.asarray(images[row], jnp.float32)
image = image_of(params, rays_of(camera_of(row)))
score = float(nj.psnr(image, truth))
flat = float(nj.psnr(jnp.broadcast_to(truth.mean((0, 1)), truth.shape), truth))
print(f"one color {flat:.1f} dB, NeRF {score:.1f} dB")
assert score > flat + 1
assert values[-20:].mean() < values[:20].mean()

figure, axes = plt.subplots(1, 2, figsize=(9, 3.4))
for axis, (title, panel) in zip(
    axes, {"truth": truth, f"NeRF, {score:.1f} dB": image}.items(), strict=True
):
    axis.imshow(np.clip(panel, 0, 1))
    axis.set_title(title)
    axis.axis("off")
plt.show()

# %% [markdown]
# ## Further
#
# - `nj.adapters.nnx` and `nj.adapters.equinox` take modules of those libraries.
# - A warp of the points before the network, by a code of each frame, makes this a
#   Nerfies. The presets have it: `nj.PRESETS["nerfies-small"]`.
# - For samples where the density is, and empty space that is skipped, train a preset
#   with `nj.fit`.
