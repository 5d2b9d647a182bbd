"""Internal record of a part of a scene of Gaussians."""

import dataclasses
from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Int, Key

from nerfies_jax.geometry.camera import Camera
from nerfies_jax.training.effects import FrameCondition, PyTree, Record


@dataclasses.dataclass(frozen=True)
class SplatRecord(Record):
    """Hooks of a component of a scene of Gaussians. None disables a hook.

    `params` are the shared parameters of the component, or None if it has none. `scene`
    are the `splats.Params` of the whole scene, because a deformation needs the
    per-Gaussian parameters.
    """

    # ([gaussians] frame times, [gaussians] durations of the nearby tracks, both as
    # shares of the video) -> per-Gaussian parameters of the Gaussians that are lifted
    # from moving pixels. Host side.
    lifted_rows: Callable[[Any, Any], PyTree] | None = None
    warm_up: int = 0  # steps before the deformation begins
    # scene -> cache that does not depend on the time
    prepare: Callable[[Any], PyTree] | None = None
    # (scene, `Gaussians`, condition, cache of `prepare` or None) -> `Gaussians`
    deform: Callable[[Any, Any, FrameCondition, PyTree], Any] | None = None
    # Child Gaussians, which are rendered in place of their parents. The children of one
    # parent are consecutive, in the order of the parents. At most one component of a
    # scene has children.
    # (scene, condition, or None after training) -> canonical `splats.Splats`, and other
    # input of `derive`
    derive_rows: Callable[[Any, FrameCondition | None], tuple[Any, PyTree]] | None = (
        None
    )
    # (scene, output of `derive_rows`, deformed parents as `Gaussians`, condition) ->
    # the children as `Gaussians`, which have the colors of `derive_rows`
    derive: Callable[[Any, tuple[Any, PyTree], Any, FrameCondition], Any] | None = None
    # output of `derive` -> weight of the gradient of each child in the gradient of its
    # parent, for densification. None: all visible children count equally.
    significance: Callable[[Any], Any] | None = None
    # (params, render [height, width, 3] sRGB, appearance id) -> the render with the
    # exposure of the observed frame, in training and afterwards
    expose: Callable[[PyTree, Any, Int[Array, ""]], Any] | None = None
    # Appearance of one photograph in the colors of the Gaussians. At most one component
    # of a scene has these.
    # (scene, appearance id) -> code [code]
    code: Callable[[Any, Int[Array, ""]], Any] | None = None
    # (scene, colors [gaussians, 3], code) -> colors
    recolor: Callable[[Any, Any, Any], Any] | None = None
    # (scene, unit world directions [..., 3], code) -> colors behind the Gaussians
    backdrop: Callable[[Any, Any, Any], Any] | None = None
    # (params, cameras of the training frames) -> refined cameras. All readers of a
    # training step's frames get these.
    pose: Callable[[PyTree, Camera], Camera] | None = None
    # (params, capture) -> the capture with refined cameras of all frames. Host side.
    apply_to_capture: Callable[[PyTree, Any], Any] | None = None
    # (`motion_fit.Paths`, key) -> `motion_fit.Guess`, from which the fit to tracks
    # starts. Host side. None: the fit starts from `init`.
    fit_to_paths: Callable[[Any, Key[Array, ""]], Any] | None = None
    # scene -> state of arrays only. Host side, at the beginning and after each change
    # of the number or order of the Gaussians.
    state: Callable[[Any], PyTree] | None = None
    # True if the penalty reads the depth of the rendered frame.
    reads_depth: bool = False
    # True if training passes the state to `deform` in place of the output of `prepare`,
    # because `prepare` is expensive and its result good enough until the next change.
    ready_by_state: bool = False
    # Projection step: (params, step) -> params of the same shapes, after each of the
    # steps `revise_at`. Host side.
    revise: Callable[[PyTree, int], PyTree] | None = None
    revise_at: tuple[int, ...] = ()
    # Numbers of the capture that the hooks of a motion read, and a function (record,
    # numbers) -> the record for other numbers (`training.programs`).
    numbers: PyTree = None
    with_numbers: Callable[["SplatRecord", PyTree], "SplatRecord"] | None = None
