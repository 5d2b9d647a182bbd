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
# # A motion of your own, with its gradients checked
#
# The parts of a scene are small protocols ([extending.md](../extending.md)). Here is a
# motion that the library does not have: every Gaussian swings along a line of its own,
# all of them with one period that is learned as well. Its gradients are checked, it is
# trained on a scene that moves, and it is compared with the same scene without motion.

# %%
# %pip install --quiet "nerfies-jax[report]"

# %%
import dataclasses

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import gaussians_jax as gj
import nerfies_jax as nj
from nerfies_jax.capture import synthetic

STEPS = 600
SIZE = (96, 72)  # pixels
FRAMES = 24

# %% [markdown]
# ## The motion
#
# `per_gaussian` parameters have a row for each Gaussian and are cloned, split and
# removed with it, `shared` ones do not. `apply` moves the Gaussians to a time from 0
# to 1, and `loss` penalizes swinging. The swing starts at exactly zero: a motion that
# is added to a scene should not change it before it has learned something.


# %%
@dataclasses.dataclass(frozen=True)
class Swing:
    """Sinusoidal motion of each Gaussian along a line."""

    weight: float = 1e-3
    learning_rate: float = 1e-3

    def init(self, key, gaussians):
        reach = jnp.zeros_like(gaussians.mean)
        return gj.motion.MotionParams(reach, jnp.asarray(0.5))  # half a cycle

    def apply(self, params, cache, gaussians, frame):
        phase = 2 * jnp.pi * params.shared * frame.time
        shift = jnp.sin(phase) * params.per_gaussian
        return gaussians._replace(mean=gaussians.mean + shift)

    def loss(self, params, context):
        return {"reach_sq": nj.Term(jnp.mean(params.per_gaussian**2), self.weight)}


# %% [markdown]
# ## A scene that moves
#
# A built-in scene, at a small size. Its truth is known, but nothing here needs that.

# %%
scene = dataclasses.replace(synthetic.PRESETS["default"], size=SIZE, frames=FRAMES)
capture, _ = synthetic.make(scene)
frames = nj.frames_of(capture)
spec = gj.with_steps(gj.PRESETS["splats-static-small"], STEPS)
metadata = gj.metadata_of(capture)
motion = Swing()
models = {
    "without": gj.build(spec, metadata),
    "with swing": gj.build(dataclasses.replace(spec, motion=motion), metadata),
}

# %% [markdown]
# ## Are its gradients right?
#
# In float64, along random directions, against central differences: first the motion by
# itself, at times where the sine is flat and where it is steep; then the penalty. A
# motion that is smooth has to agree to far more digits than an image does, so this is
# where an error in the formula would show. Then the same in float32, as it is trained.


# %%
def checked(function, at, direction, step):
    """The slope along a direction by `jax.jvp`, and how far off the quotient is."""
    _, slope = jax.jvp(function, (at,), (direction,))
    ahead, behind = (
        function(jax.tree.map(lambda x, way, s=sign: x + s * step * way, at, direction))
        for sign in (1, -1)
    )
    quotient = (ahead - behind) / (2 * step)
    return float(slope), float(jnp.abs(quotient - slope) / jnp.abs(slope))


def moved(parameters, time, weights):
    """One number of where five Gaussians are at a time."""
    reach, cycles = parameters
    rows = len(reach)
    gaussians = gj.Gaussians(
        mean=jnp.zeros((rows, 3), reach.dtype),
        quaternion=jnp.ones((rows, 4), reach.dtype),
        scale=jnp.ones((rows, 3), reach.dtype),
        opacity=jnp.ones(rows, reach.dtype),
    )
    own = gj.motion.MotionParams(reach, cycles)
    placed = motion.apply(own, None, gaussians, nj.FrameCondition(time=time))
    return jnp.sum(weights * placed.mean)


rng = np.random.default_rng(0)
for dtype, step, allowed in (("float64", 1e-5, 1e-8), ("float32", 1e-2, 1e-2)):
    with jax.enable_x64(dtype == "float64"):
        rows = [jnp.asarray(rng.normal(size=(5, 3)), dtype) for _ in range(3)]
        reach, reach_way, weights = rows
        at = reach, jnp.asarray(0.5, dtype)
        way = reach_way, jnp.asarray(1.0, dtype)
        for time in (0.0, 0.3, 0.9):
            instant = jnp.asarray(time, dtype)

            def value(parameters, instant=instant, weights=weights):
                return moved(parameters, instant, weights)

            if time == 0.0:  # nothing has moved yet, whatever the parameters
                assert value(at) == 0
                continue
            slope, off = checked(value, at, way, step)
            print(f"{dtype}, time {time}: slope {slope:+.4f}, off by {off:.1e}")
            assert off < allowed

# %% [markdown]
# ## Train with it and without
#
# Same seed, same steps. The motion begins at zero, so both start from the same image.

# %%
states = {}
for name, model in models.items():
    start = model.init(capture, jax.random.key(0))
    states[name] = nj.fit(model, start, frames, steps=STEPS).state

# %%
scores, drawn = {}, {}
for name, model in models.items():
    renderer = nj.Renderer(model, capture.size)
    scored = nj.score(renderer, states[name], capture, capture.heldout)
    scores[name], drawn[name] = scored.psnr.mean(), scored.color[0]
truth = capture.images[capture.heldout[0]] / 255
figure, axes = plt.subplots(1, 3, figsize=(12, 3.4))
panels = {"truth": truth} | {f"{n}, {scores[n]:.2f} dB": drawn[n] for n in drawn}
for axis, (title, panel) in zip(axes, panels.items(), strict=True):
    axis.imshow(np.clip(panel, 0, 1))
    axis.set_title(title)
    axis.axis("off")
plt.show()

# %% [markdown]
# ## What it has learned
#
# The reach of most Gaussians stays near zero, for most of the scene stands still; a few
# swing. Was that worth it? The two numbers above the images say.

# %%
params = states["with swing"].params
reach = np.linalg.norm(params.rows["swing"], axis=1)
reach = reach[np.asarray(params.rows["splats"].opacity_logit) > -500]  # those in use
print(f"{params.nets['swing']:.3f} cycles over the video")
print(f"reach: median {np.median(reach):.4f}, largest {reach.max():.4f} scene units")
assert 0 < reach.max() < np.inf

# %% [markdown]
# ## Further
#
# - Put `Swing` into a module of yours, and `nerfies reconstruct CAPTURE --set
# motion=MODULE:Swing` trains a whole run with it.
# - `gj.motion.MLP`, `gj.motion.SE3Bases` and the other motions fill the same protocol.
