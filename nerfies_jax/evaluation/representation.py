"""Interface between runs and representations (radiance fields, Gaussian splats).

Each package provides a `Representation` as an entry point of the group
"nerfies_jax.representations", so that `nerfies_jax.runs` imports none of them directly.
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
MODEL = "model.npz"  # in a run folder: a complete trained scene of Gaussians


class Saved(NamedTuple):
    """Exported files of a trained scene."""

    model_bytes: int | None = None  # size of the file with the complete scene
    notes: tuple[str, ...] = ()  # sentences about the files for the report
    # Size of the same scene if parameters with a learned entropy model are coded by it.
    coded_bytes: float | None = None


class Player(NamedTuple):
    """An interactive page of a trained scene, and a description of its contents."""

    path: pathlib.Path
    about: str


class Choice(NamedTuple):
    """A preset with overrides.

    Recommendations name the preset without "-small". The name of a default preset is
    complete.
    """

    preset: str
    overrides: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()  # on undecided or unsupported effects
    # Choice to compare this one with on frames left out of training, if in doubt.
    alternative: "Choice | None" = None


class Pair(NamedTuple):
    """Two variants of a preset that differ in one effect.

    The names are those in the metric keys of `experiments.speed effects`.
    """

    preset: str
    with_it: str
    without: str = "bare"


class Parts(NamedTuple):
    """Options for rendering a trained scene."""

    removable: tuple[str, ...]  # effects that can be disabled
    appearance: bool  # whether images depend on the appearance id


class SplatCloud(NamedTuple):
    """Gaussians at one time in world coordinates, for a rasterizer, in NumPy."""

    centers: np.ndarray  # [gaussians, 3], scene units
    covariances: np.ndarray  # [gaussians, 3, 3], scene units squared
    rgb: np.ndarray  # [gaussians, 3] sRGB seen from the camera, not clipped
    opacity: np.ndarray  # [gaussians] in [0, 1]
    background: np.ndarray  # [3] sRGB
    view_dependent: bool  # whether `rgb` depends on the position of the camera


# (state, time in [0, 1], appearance id, camera position [3]) -> Gaussians
Splatting = Callable[[TrainState, float, int, np.ndarray], SplatCloud]


class Resources(NamedTuple):
    """Cores, memory and time that training needs."""

    # Cores that XLA:CPU should see: "one" if dividing its loops slows them down.
    threads: Literal["one", "all"] = "all"
    # Number of equal shares that a step of a spec can be divided into, one per device.
    shares: Callable[[Spec], int] = lambda spec: 1
    share_setting: str = ""  # field of the spec that sets this number
    divisible: bool = False  # whether a step of one share can use any number of devices
    # (spec, capture) -> bytes of training frames, initial state and step. None disables
    # the check.
    estimate_memory_bytes: Callable[[Spec, Capture], int] | None = None
    memory_hint: str = ""  # advice on settings that reduce the initial state
    # Mean time of a step over a run, relative to one with the initial state.
    growth: Callable[[Spec, TrainState], float] = lambda spec, state: 1.0
    # (spec, metadata, model, state, frames) -> the parts of a step
    step_parts: Callable[..., StepParts] | None = None


HalfScorer = Callable[[TrainState, Capture, np.ndarray], Halves]


class Scoring(NamedTuple):
    """Evaluation of a trained scene beyond its renders."""

    # (metadata) -> True if lens distortion of any camera is modeled. That of the
    # capture's cameras always is.
    models_lenses: Callable[[Any], bool] = lambda metadata: True
    # (spec, metadata, size) -> a function (state, capture, rows) of metrics with codes
    # fitted to half of each frame, or None if the model has no per-frame codes
    half_scorer: Callable[..., HalfScorer | None] = lambda *args: None
    fitted_rays: int = 0  # rendered to fit the codes of one frame
    follow: Follow = lambda *args: None
    mover: Mover = lambda spec, metadata: None
    # True if a training frame that is left out can be rendered: no parameters belong to
    # single frames.
    validates: Callable[[Spec], bool] = lambda spec: False


def _no_variants(spec, metadata, without, blend):
    raise ValueError("this representation defines no variants of a trained scene")


class Products(NamedTuple):
    """Files and variants of a trained scene."""

    # (folder, spec, metadata, state) -> exported files
    save: Callable[..., Saved] = lambda *args: Saved()
    # (path, title, spec, model, state, capture, poster) -> an interactive page
    player: Callable[..., Player] | None = None
    # (spec, metadata, disabled effects) -> a function that returns the Gaussians of a
    # trained scene for another rasterizer
    splatting: Callable[..., Splatting] | None = None
    # (spec, metadata) -> options for rendering
    parts: Callable[..., Parts] = lambda spec, metadata: Parts((), False)
    # (spec, metadata, disabled effects, whether appearances are blended) -> model. With
    # blended appearances it renders a `nerfies_jax.scene.variants.Between` in place of
    # a view.
    variant: Callable[..., Model] = _no_variants


class Recommendation(NamedTuple):
    """Presets and settings for a capture."""

    # ({effect: True if needed, None if undecided}, True for the sizes of the papers,
    # preset of the user without "-small" or None, planned seconds of training or None)
    # -> recommendation
    advise: Callable[
        [dict[str, bool | None], bool, str | None, float | int | None], Choice
    ]
    # (capture, planned seconds of training or None) -> preset if the user names none
    default_preset: Callable[[Capture, float | int | None], Choice] | None = None
    # ({effect: True if needed, None if undecided}, spec) -> overrides that enable or
    # disable effects other than motion
    effect_overrides: Callable[[dict[str, bool | None], Spec], tuple[str, ...]] = (
        lambda effects, spec: ()
    )
    # By effect, as in `nerfies_jax.preprocessing.findings`.
    prices: Mapping[str, Pair] = MappingProxyType({})


class Representation(NamedTuple):
    """A type of scene model that runs can train. The last four fields are optional."""

    name: str
    spec_type: type
    presets: dict[str, Spec]
    with_steps: Callable[[Spec, int], Spec]  # rescales schedules to the steps
    metadata_of: Callable[[Capture, Spec], Any]
    build: Callable[..., Model]  # (spec, metadata) -> model
    resources: Resources = Resources()
    scoring: Scoring = Scoring()
    products: Products = Products()
    recommendation: Recommendation | None = None


def check_there(without: tuple[str, ...], there: tuple[str, ...]) -> None:
    """Check that a trained scene can be rendered without some effects.

    Args:
      without: Names of the effects to disable.
      there: Names of the effects that can be disabled.

    Raises:
      ValueError: If one of them cannot be disabled.
    """
    for name in without:
        if name not in there:
            raise ValueError(
                f"{name!r} cannot be disabled when this run is rendered; effects that "
                f"can be: {', '.join(there) or 'none'}"
            )
