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
# # Fit Gaussians to an image
#
# A scene of Gaussians is a handful of arrays, and rendering is a differentiable
# function of these arrays. The smallest example takes an image, scatters Gaussians over
# a plane in front of a camera, and minimizes the error of the render. This is the inner
# loop of every `splats-*` preset, without moving cameras, time and densification.

# %%
# %pip install --quiet "nerfies-jax[report]"

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from PIL import Image

import gaussians_jax as gj
import nerfies_jax as nj

GAUSSIANS = 1200
STEPS = 400
WIDTH = 160  # pixels
IMAGE_FILE = None  # a file of yours; None takes a frame of the built-in scene

# %% [markdown]
# ## The image
#
# Colors lie in [0, 1]. `height, width, 3`, as everywhere in this library.

# %%
if IMAGE_FILE is None:
    capture = nj.built_in_scene("static")
    image = Image.fromarray(capture.images[0])
else:
    image = Image.open(IMAGE_FILE).convert("RGB")
height = round(WIDTH * image.height / image.width)
truth = jnp.asarray(np.asarray(image.resize((WIDTH, height))) / 255, jnp.float32)
size = (WIDTH, height)

# %% [markdown]
# ## The camera and the Gaussians
#
# A pinhole at the origin looks along z. With a focal length of `WIDTH` pixels the plane
# at a depth of one scene unit fills the image from -0.5 to 0.5. The parameters are
# unconstrained: scales are exponentials and opacities logistic functions of them, so
# every step is valid.

# %%
camera = nj.look_at((0, 0, 0), (0, 0, 1), (0, -1, 0), float(WIDTH), size)


def scattered(key, count):
    """Random Gaussians over the image, a few pixels wide and half transparent."""
    place_key, depth_key, color_key = jax.random.split(key, 3)
    reach = jnp.array([0.5, 0.5 * height / WIDTH])
    place = jax.random.uniform(place_key, (count, 2), minval=-reach, maxval=reach)
    depth = jax.random.uniform(depth_key, (count, 1), minval=0.98, maxval=1.02)
    return {
        "mean": jnp.concatenate([place, depth], axis=1),
        "log_scale": jnp.full((count, 3), jnp.log(0.012)),
        "quaternion": jnp.tile(jnp.array([1.0, 0, 0, 0]), (count, 1)),
        "opacity_logit": jnp.zeros(count),
        "color_logit": 0.1 * jax.random.normal(color_key, (count, 3)),
    }


def draw(params, spec=gj.RasterSpec()):
    gaussians = gj.Gaussians(
        mean=params["mean"],
        quaternion=params["quaternion"],
        scale=jnp.exp(params["log_scale"]),
        opacity=jax.nn.sigmoid(params["opacity_logit"]),
    )
    colors = jax.nn.sigmoid(params["color_logit"])
    frame = gj.render(gaussians, colors, camera, size, spec, depth=False)
    return frame.rendering.color


def loss(params, spec=gj.RasterSpec()):
    return jnp.mean((draw(params, spec) - truth) ** 2)


def psnr(params):
    return float(-10 * jnp.log10(loss(params)))


start = scattered(jax.random.key(0), GAUSSIANS)

# %% [markdown]
# ## Is the gradient right?
#
# First compare the directional derivative of the loss by `jax.grad` with a difference
# quotient. In training, a Gaussian is cut off where its alpha falls below 1/255, and a
# pixel is saturated when almost nothing shines through. The loss has tiny steps there
# that the gradient does not include, and the quotient is 3 to 8 percent higher. Without
# these two thresholds they agree to the precision of the quotient in float32, 1e-4 here
# and 1e-3 with fewer Gaussians.

# %%
leaves, tree = jax.tree.flatten(start)
keys = jax.random.split(jax.random.key(1), len(leaves))
direction = tree.unflatten(
    [jax.random.normal(key, leaf.shape) for key, leaf in zip(keys, leaves, strict=True)]
)
# In scene units, where the others are logarithms. Not in depth, because the render is
# discontinuous where one Gaussian passes in front of another.
direction["mean"] = direction["mean"] * jnp.array([0.01, 0.01, 0.0])


uncut = gj.RasterSpec(alpha_threshold=1e-7, transmittance_threshold=1e-8)


def along(distance):
    moved = jax.tree.map(lambda leaf, way: leaf + distance * way, start, direction)
    return loss(moved, uncut)


slope = float(jax.grad(along)(0.0))
quotient = float((along(1e-2) - along(-1e-2)) / 2e-2)
print(f"slope {slope:.6f}, difference quotient {quotient:.6f}")
assert abs(slope - quotient) < 5e-3 * abs(quotient)

# %% [markdown]
# ## Optimize
#
# Adam with a rate for each kind of parameter. The loop is a `lax.scan`, so all steps
# are one program.

# %%
rates = {
    "mean": 1e-3,
    "log_scale": 2e-2,
    "quaternion": 1e-2,
    "opacity_logit": 5e-2,
    "color_logit": 5e-2,
}
optimizer = optax.multi_transform(
    {name: optax.adam(rate) for name, rate in rates.items()},
    {name: name for name in rates},
)


@jax.jit
def train(params):
    def step(carry, _):
        params, state = carry
        value, slopes = jax.value_and_grad(loss)(params)
        updates, state = optimizer.update(slopes, state)
        return (optax.apply_updates(params, updates), state), value

    carry = params, optimizer.init(params)
    (params, _), values = jax.lax.scan(step, carry, length=STEPS)
    return params, values


fitted, values = train(start)

# %% [markdown]
# ## Look at it
#
# The ground truth, the initial state, the fit, and its error (five times brighter). A
# constant image of the mean color is the baseline to beat.

# %%
panels = {
    "truth": truth,
    f"start, {psnr(start):.1f} dB": draw(start),
    f"fitted, {psnr(fitted):.1f} dB": draw(fitted),
    "error x 5": 5 * jnp.abs(draw(fitted) - truth),
}
figure, axes = plt.subplots(1, len(panels), figsize=(14, 3.2))
for axis, (title, panel) in zip(axes, panels.items(), strict=True):
    axis.imshow(np.clip(panel, 0, 1))
    axis.set_title(title)
    axis.axis("off")
plt.show()

# %%
flat = float(-10 * jnp.log10(jnp.mean((truth - truth.mean((0, 1))) ** 2)))
print(f"mean color {flat:.1f} dB, Gaussians {psnr(fitted):.1f} dB")
assert psnr(fitted) > flat + 1
assert values[-1] < values[0]

# %% [markdown]
# ## Further
#
# - More Gaussians, or more steps: what is the error bounded by?
# - `depth=True` also composites depth. A loss on it is one more line.
# - `nj.fit` with `gj.build(gj.PRESETS["splats-static-small"], ...)` does the same from
# many cameras, and adds Gaussians where the image needs them.
