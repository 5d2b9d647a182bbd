"""Interface of a representation to runs, which each package fills in one record.

`nerfies_jax.runs` finds the records by the entry points of the group
"nerfies_jax.representations", so it imports no package that has one.
"""

import pathlib
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np

from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.model_flow import Mover
from nerfies_jax.evaluation.protocol import Follow
from nerfies_jax.evaluation.scores import Halves
from nerfies_jax.metrics.part_time import StepParts
from nerfies_jax.training.model import Model, TrainState

Spec = Any
MODEL = "model.npz"  # in a run folder: all of a trained scene of Gaussians


class Saved(NamedTuple):
    """Files of a trained scene, besides its checkpoint."""

    model_bytes: int | None = None  # of the one file that holds all of it
    notes: tuple[str, ...] = ()  # what the reader should know of them
    coded_bytes: float | None = (
        None  # of the same scene, by bits where a law is learned
    )


class Player(NamedTuple):
    """A page that plays a trained scene, and a description of its contents."""

    path: pathlib.Path
    about: str


class Choice(NamedTuple):
    """A preset with overrides.

    Advice names the preset without "-small", a default preset as it is.
    """

    preset: str
    overrides: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()  # what could not be decided or done


class Pair(NamedTuple):
    """Two scenes of a preset that differ in one decision.

    The names are those of the keys of `experiments.speed effects`.
    """

    preset: str
    with_it: str
    without: str = "bare"


class Parts(NamedTuple):
    """Choices that a trained scene offers when it is rendered."""

    removable: tuple[str, ...]  # effects that it can be drawn without
    appearance: bool  # whether it looks otherwise for each appearance id


class SplatCloud(NamedTuple):
    """Gaussians at one time in world coordinates, for a rasterizer, in NumPy."""

    centers: np.ndarray  # [gaussians, 3], scene units
    covariances: np.ndarray  # [gaussians, 3, 3], scene units squared
    rgb: np.ndarray  # [gaussians, 3] sRGB as seen from the camera; not clipped
    opacity: np.ndarray  # [gaussians] in [0, 1]
    background: np.ndarray  # [3] sRGB
    view_dependent: bool  # whether `rgb` depends on the position of the camera


# (state, time in [0, 1], appearance id, camera position [3]) -> the Gaussians then
Splatting = Callable[[TrainState, float, int, np.ndarray], SplatCloud]


class Resources(NamedTuple):
    """Cores, memory and time that training needs."""

    # Cores that XLA:CPU should see: "one" if its own threading slows the loops down.
    threads: Literal["one", "all"] = "all"
    # Number of equal shares of a spec's step, for as many devices.
    shares: Callable[[Spec], int] = lambda spec: 1
    # (spec, capture) -> bytes of frames, first state and step; None: not checked
    estimate_memory_bytes: Callable[[Spec, Capture], int] | None = None
    memory_hint: str = ""  # which settings make the first state smaller
    # Mean time of a step over a run, relative to one with the first state.
    growth: Callable[[Spec, TrainState], float] = lambda spec, state: 1.0
    # (spec, metadata, model, state, frames) -> the parts of a step
    step_parts: Callable[..., StepParts] | None = None


class Scoring(NamedTuple):
    """Evaluation of a trained scene beyond its renders."""

    # True if rays are traced through the lens. Otherwise pinhole images are rendered,
    # and distorted before held-out frames are evaluated.
    traces_lenses: bool = False
    # (spec, metadata, state, capture, rows) -> scores with codes fitted to half of each
    # frame, None if the scene has no codes of its own for each frame
    score_halves: Callable[..., Halves | None] = lambda *args: None
    fitted_rays: int = 0  # rendered to fit the codes of one frame
    follow: Follow = lambda *args: None
    mover: Mover = lambda spec, metadata: None


def _no_variants(spec, metadata, without, blended):
    raise ValueError("this representation defines no variants of a trained scene")


class Products(NamedTuple):
    """Files and variants of a trained scene."""

    # (folder, spec, metadata, state) -> files beside the checkpoint
    save: Callable[..., Saved] = lambda *args: Saved()
    # (path, title, spec, model, state, capture, poster) -> a page that shows the scene
    # from anywhere at any time
    player: Callable[..., Player] | None = None
    # (spec, metadata, names left out) -> the Gaussians of a trained scene, for other
    # rasterizers
    splatting: Callable[..., Splatting] | None = None
    # (spec, metadata) -> the effects that can be left out
    parts: Callable[..., Parts] = lambda spec, metadata: Parts((), False)
    # (spec, metadata, names left out, whether appearances are blended) -> model. With
    # blended appearances it renders a `nerfies_jax.scene.variants.Between` in place of
    # a view.
    variant: Callable[..., Model] = _no_variants


class Recommendation(NamedTuple):
    """Presets and settings for a capture."""

    # ({effect: True, False, or None if undecided}, whether in the sizes of the papers,
    # preset of the user without "-small", or None) -> the choice
    advise: Callable[[dict[str, bool | None], bool, str | None], Choice]
    # Preset of a capture if the user names none.
    default_preset: Callable[[Capture], Choice] | None = None
    # By effect, as in `nerfies_jax.preprocessing.findings`.
    prices: Mapping[str, Pair] = MappingProxyType({})


class Representation(NamedTuple):
    """A kind of scenes that runs can train. The last four fields are optional."""

    name: str
    spec_type: type
    presets: dict[str, Spec]
    with_steps: Callable[[Spec, int], Spec]  # schedules stretch with the steps
    metadata_of: Callable[[Capture, Spec], Any]
    build: Callable[..., Model]  # (spec, metadata) -> model
    resources: Resources = Resources()
    scoring: Scoring = Scoring()
    products: Products = Products()
    recommendation: Recommendation | None = None


def check_there(without: tuple[str, ...], there: tuple[str, ...]) -> None:
    """Check that a trained scene can be rendered without some effects.

    Args:
      without: Names of the effects to leave out.
      there: Names of the removable effects.

    Raises:
      ValueError: If one of them is not removable.
    """
    for name in without:
        if name not in there:
            raise ValueError(
                f"{name!r} is no effect that this run can be rendered without; "
                f"those are: {', '.join(there) or 'none'}"
            )
