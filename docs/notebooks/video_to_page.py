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
# # From a video to a page that plays the scene
#
# A video has no camera poses, and something in it moves. This notebook goes the whole
# way: sharp frames, poses by COLMAP in two passes (the second with moving objects
# masked), a look at the results of preprocessing, dynamic Gaussians, held-out metrics,
# and `player.html`, which shows the scene from any viewpoint. `nerfies reconstruct
# clip.mp4` does all of it in one command. Here the steps are separate.

# %%
# %pip install --quiet "nerfies-jax[sfm,video,report]"

# %%
import dataclasses
import pathlib
import tempfile

import matplotlib.pyplot as plt
import numpy as np

import nerfies_jax as nj
from nerfies_jax import runs
from nerfies_jax.capture import synthetic, video
from nerfies_jax.runs import preparation
from nerfies_jax.runs.config import CaptureSource, Preparation, RunConfig

CLIP = None  # a video of yours; None renders the built-in scene
FRAMES = 24
STEPS = 600
PASSES = 2
PRESET = "splats-deformable-small"
MAX_SIDE = None  # of the images to learn from, pixels; None takes the capture's
OUT = pathlib.Path(tempfile.mkdtemp(prefix="video-to-page-"))

# %% [markdown]
# ## A video
#
# This renders the built-in scene from its first camera to an mp4. Replace it by a video
# of your own. The ground truth is only used to measure the error of the poses.

# %%
clip, rendered = CLIP, None
if clip is None:
    scene = dataclasses.replace(
        synthetic.PRESETS["default"],
        size=(320, 240),
        frames=FRAMES,
        supersampling=1,
    )
    rendered, _ = synthetic.make(scene)
    order = np.argsort(rendered.times, kind="stable")
    order = order[rendered.camera_ids[order] == 0]
    clip = OUT / "clip.mp4"
    video.write_video(clip, (rendered.images[row] for row in order), 12)
print(clip)

# %% [markdown]
# ## Cameras
#
# `prepare` keeps the sharpest frame of each interval of the video, runs COLMAP, detects
# moving objects with the first poses, and runs COLMAP again with these masked. Its
# messages report the number of registered images and the reprojection error of static
# points.

# %%
how = Preparation(frames=FRAMES, max_side=320, passes=PASSES)
capture = preparation.prepare(clip, OUT / "capture", how, tell=print)

# %% [markdown]
# COLMAP's world has no unit and no up direction, so poses are compared after the best
# similarity transform (Umeyama 1991). The result is the error of the camera path as a
# share of its length.


# %%
def path_error(found, true):
    """RMS distance after the best similarity, over the RMS extent of the true path."""
    found, true = found - found.mean(0), true - true.mean(0)
    left, stretch, right = np.linalg.svd(true.T @ found)
    flip = np.diag([1, 1, np.sign(np.linalg.det(left @ right))])
    scale = (stretch * np.diag(flip)).sum() / (found**2).sum()
    off = true - scale * found @ (left @ flip @ right).T
    return np.sqrt((off**2).sum() / (true**2).sum())


if rendered is not None:
    placed = np.argsort(capture.times, kind="stable")
    # Frames are named by their place in the video: selected and registered ones.
    kept = order[np.round(capture.times[placed] * (len(order) - 1)).astype(int)]
    error = path_error(
        np.asarray(capture.cameras.position, float)[placed],
        np.asarray(rendered.cameras.position, float)[kept],
    )
    print(f"the path is off by {error:.1%} of its extent")
    assert error < 0.2

# %% [markdown]
# ## Train
#
# The result is a run folder, as from the command: settings, checkpoints, metrics,
# images, a video from a moving camera, the page. Every eighth frame is held out.

# %%
source = CaptureSource(OUT / "capture", max_side=MAX_SIDE)
config = RunConfig(PRESET, source, steps=STEPS)
outcome = runs.reconstruct(config, OUT / "run")
print(*sorted(path.name for path in outcome.folder.iterdir()), sep="\n")

# %% [markdown]
# ## Look at it
#
# Held-out frames, with the original above and the render below. The run also prints the
# PSNR of two baselines, such as the mean of the two neighboring frames.

# %%
run = outcome.run
renderer = nj.Renderer(run.model, run.capture.size)
rows = run.capture.heldout
scored = nj.score(renderer, outcome.result.state, run.capture, rows)
figure, axes = plt.subplots(2, len(rows), figsize=(4 * len(rows), 6), squeeze=False)
for column, (row, color) in enumerate(zip(rows, scored.color, strict=True)):
    axes[0, column].imshow(run.capture.images[row])
    axes[0, column].set_title(f"frame {run.capture.ids[row]}")
    axes[1, column].imshow(np.clip(color, 0, 1))
    axes[1, column].set_title(f"{scored.psnr[column]:.1f} dB")
for axis in axes.flat:
    axis.axis("off")
plt.show()

# %% [markdown]
# The page contains the Gaussians and their motion, and needs no server.

# %%
page = outcome.folder / "player.html"
print(f"open {page} ({page.stat().st_size / 1e6:.1f} MB)")
assert not outcome.errors
assert page.stat().st_size > 1e5
assert np.isfinite(scored.psnr).all()
