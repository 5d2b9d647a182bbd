"""Rendered OpenEXR sequences for compositing, with cameras and optical flow."""

from collections.abc import Sequence

import numpy as np

from nerfies_jax.capture import exr, exr_camera, images
from nerfies_jax.capture.json_files import AnyPath, alike, replaced_folder
from nerfies_jax.evaluation import model_flow
from nerfies_jax.evaluation.model_flow import Move
from nerfies_jax.evaluation.scores import Draw
from nerfies_jax.training.model import Rendering, TrainState, View


def write(
    folder: AnyPath,
    draw: Draw,
    state: TrainState,
    views: Sequence[View],
    move: Move | None = None,
    overwrite: bool = False,
) -> None:
    """Render views to `0000.exr`, `0001.exr` and so on, all of them or none.

    Args:
      folder: The folder.
      draw: Renderer.
      state: Trained state.
      views: The views, in order.
      move: Motion of points, to add flow to the next image (zero for the last). None
        for no flow.
      overwrite: True to replace earlier files of this kind.

    Raises:
      CaptureError: If the folder may not be replaced or cannot be written.
    """
    names = [f"{index:04d}.exr" for index in range(len(views))]
    with replaced_folder(folder, overwrite, alike(folder, names)) as partial:
        for index, (name, view) in enumerate(zip(names, views, strict=True)):
            rendering = draw(state, view)
            flow = None
            if move is not None:
                target = views[min(index + 1, len(views) - 1)]
                flow = model_flow.image_flow(move, state, view, target, rendering)
            write_frame(partial / name, rendering, view, flow)


def write_frame(
    path: AnyPath, rendering: Rendering, view: View, flow: np.ndarray | None = None
) -> None:
    """Write linear color (RGB), opacity (A), z-depth (Z) and the camera.

    Args:
      path: The file.
      rendering: The rendered image.
      view: Its view.
      flow: Flow in pixels right and down, [height, width, 2], for the channels `flow.x`
        and `flow.y`. If it is NaN, these and `flow.A` are 0.
    """
    extra = {}
    if flow is not None:
        finite = np.isfinite(flow).all(axis=-1)
        right, down = np.moveaxis(np.where(finite[..., None], flow, 0), -1, 0)
        extra = {"flow.x": right, "flow.y": down, "flow.A": finite.astype(np.float32)}
    height, width = rendering.alpha.shape
    exr.write_exr(
        path,
        color=images.linear_from_srgb(np.clip(rendering.color, 0, 1)),
        alpha=np.asarray(rendering.alpha),
        depth=None if rendering.depth is None else np.asarray(rendering.depth),
        extra=extra,
        header=exr_camera.attributes(view.camera, (width, height), float(view.time)),
    )
