"""Internal record of a part of a scene of Gaussians."""

import dataclasses
from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Int, Key

from nerfies_jax.geometry.camera import Camera
from nerfies_jax.training.effects import FrameCondition, PyTree, Record


@dataclasses.dataclass(frozen=True)
class SplatRecord(Record):
    """Hooks of a part of a scene of Gaussians, None where a part has none.

    `params` are the part's shared parameters, None without any; `scene` is the
    `splats.Params` of all, for deforming takes rows.
    """

    # (time of the picture, for how long tracks near were followed) [gaussians] each, in
    # films -> the rows of those lifted from moving pixels; host side
    lifted_rows: Callable[[Any, Any], PyTree] | None = None
    warm_up: int = 0  # steps before which it does not deform
    # scene -> what stays as it is while the parameters do, whatever the time
    prepare: Callable[[Any], PyTree] | None = None
    # (scene, `Gaussians`, condition, what `prepare` returned or None) -> `Gaussians`
    deform: Callable[[Any, Any, FrameCondition, PyTree], Any] | None = None
    # What is drawn in the place of the rows, where each of them carries several
    # Gaussians, those of the first row first; one effect of a scene at most.
    # (scene, condition or None once trained) -> `splats.Splats` at rest, and what else
    # `derive` reads
    derive_rows: Callable[[Any, FrameCondition | None], tuple[Any, PyTree]] | None = (
        None
    )
    # (scene, what `derive_rows` returned, rows as `Gaussians` where `deform` left them,
    # condition) -> `Gaussians`; what is drawn has the looks at rest
    derive: Callable[[Any, tuple[Any, PyTree], Any, FrameCondition], Any] | None = None
    # what `derive` returned -> how much the slope of each counts in that of its row,
    # which the density control compares; None: all that is seen alike
    significance: Callable[[Any], Any] | None = None
    # (params, picture [height, width, 3] sRGB, appearance id) -> the picture as it was
    # filmed; of all that is drawn, in training and afterwards
    expose: Callable[[PyTree, Any, Int[Array, ""]], Any] | None = None
    # (params, cameras of the frames that are learned from) -> the same, refined;
    # whoever reads the frames of a step has these
    pose: Callable[[PyTree, Camera], Camera] | None = None
    # (params, capture) -> the capture with all cameras as `pose` has them; host side
    found: Callable[[PyTree, Any], Any] | None = None
    # (`path_fit.Paths`, key) -> `path_fit.Guess`, from which the motion is fitted to
    # tracks; host side. None: it is fitted from where `init` starts it.
    fit_to_paths: Callable[[Any, Key[Array, ""]], Any] | None = None
    # scene -> state, arrays only; host side, at the start and after every change of the
    # rows, up to the next
    state: Callable[[Any], PyTree] | None = None
    # Whether in training `deform` gets the state for what `prepare` returns: where that
    # is dear, and good enough until the rows change.
    ready_by_state: bool = False
    # (params, step) -> params of the same shapes, after each of these steps; host side
    revise: Callable[[PyTree, int], PyTree] | None = None
    revise_at: tuple[int, ...] = ()
