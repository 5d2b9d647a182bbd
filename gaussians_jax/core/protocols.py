"""Extension points of a scene of Gaussians.

A value of a field of `SplatScene` is either the object with the functions of its
protocol, or settings with `bind(steps, metadata)`, which returns that object for a run
of so many steps of a capture. The built-in parts are of the second kind.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.core.splats import Gaussians, Params, Splats
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.training.effects import FrameCondition, stream
from nerfies_jax.training.protocols import (
    LearningRate,
    Regularizer,
    as_terms,
    name_of,
    rate_at,
    regularizer_hooks,
)

PyTree = Any


class MotionParams(NamedTuple):
    """Parameters of a motion or of another component, None where it has none.

    Attributes:
      per_gaussian: Arrays with one row per Gaussian. Rows are cloned, split and pruned
        together with their Gaussians.
      shared: Arrays shared by all Gaussians, such as the weights of a network.
    """

    per_gaussian: PyTree = None
    shared: PyTree = None


@runtime_checkable
class Motion(Protocol):
    """Motion of the Gaussians over time.

    Optional members: `precompute(params, gaussians)` returns the cache of `apply`,
    which does not depend on the time; without it the cache is None.
    `loss(params, context)` adds terms to the loss, as `Regularizer.loss` does.
    `fit(paths, key)` returns a `path_fit.Guess`, from which a fit to tracks starts.
    `warm_up` is the number of steps before which nothing moves. `name` is the key of
    its parameters and metrics; the default is the class name in snake case.

    Attributes:
      learning_rate: A float, a schedule of the traced step, or `MotionParams` with one
        of these for each leaf, or for several leaves at once.
    """

    @property
    def learning_rate(self) -> LearningRate:
        """Learning rate of the parameters."""
        ...

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize the parameters, on the host.

        Args:
          key: PRNG key of this motion.
          gaussians: The Gaussians that it is to move.

        Returns:
          Parameters with one row for each of `gaussians`, and shared ones.
        """
        ...

    def apply(
        self,
        params: MotionParams,
        cache: PyTree,
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Move the Gaussians to their state at one time.

        Args:
          params: Parameters of this motion.
          cache: Result of `precompute`.
          gaussians: Gaussians in their canonical state, or as the part before this one
            left them.
          frame: Time in [0, 1] over the capture; `step` and `key` while training.

        Returns:
          The moved Gaussians.
        """
        ...


@runtime_checkable
class Appearance(Protocol):
    """Change of the rendered image from one appearance id (exposure) to the next."""

    @property
    def learning_rate(self) -> LearningRate:
        """Learning rate of the parameters."""
        ...

    def init(self, key: Key[Array, ""]) -> PyTree:
        """Initialize the parameters."""
        ...

    def apply(
        self,
        params: PyTree,
        image: Float[Array, "*pixels 3"],
        appearance: Int[Array, ""],
    ) -> Float[Array, "*pixels 3"]:
        """Return the sRGB image as observed under an appearance id."""
        ...


@runtime_checkable
class CameraOptimizer(Protocol):
    """Corrections of the training cameras that are learned with the scene.

    Optional member: `apply_to_capture(params, capture)` returns the capture with the
    refined cameras of all frames, those held out as well; host side.
    """

    @property
    def learning_rate(self) -> LearningRate:
        """Learning rate of the parameters."""
        ...

    def init(self, key: Key[Array, ""]) -> PyTree:
        """Initialize the parameters."""
        ...

    def apply(self, params: PyTree, cameras: Camera) -> Camera:
        """Return the refined cameras of the training frames, in their order."""
        ...


class StepInfo(NamedTuple):
    """Observation of the Gaussians in one view of a training step.

    Attributes:
      mean2d_gradient: Gradient of the view's own loss with respect to the projected
        means, per pixel.
      visible: Whether a Gaussian reaches into the image.
      radius_px: Radius of its footprint.
      size: (width, height) of the image in pixels.
      canonical: The Gaussians in their canonical state.
      moved: The same at the time of the frame.
      significance: Weight of each drawn Gaussian for its row, where rows carry several.
    """

    mean2d_gradient: Float[Array, "drawn 2"]
    visible: Bool[Array, " drawn"]
    radius_px: Float[Array, " drawn"]
    size: tuple[int, int]
    canonical: Gaussians
    moved: Gaussians
    significance: Float[Array, " drawn"] | None = None


class Population(NamedTuple):
    """The Gaussians of a scene in training, for an event of a `Strategy`.

    Attributes:
      params: Parameters of the scene.
      moments: State of the optimizer.
      state: State of the strategy.
      key: PRNG key of this step.
      step: Number of completed steps.
      extent: Spread of the cameras, scene units.
      optimizer: The optimizer, which knows its state.
    """

    params: Params
    moments: PyTree
    state: PyTree
    key: Key[Array, ""]
    step: int
    extent: float
    optimizer: optax.GradientTransformation


class StrategyEvent(NamedTuple):
    """A change of the Gaussians between two steps.

    Attributes:
      name: Name in logs.
      steps: Numbers of completed steps after which it happens, sorted.
      apply: Returns the changed population; host side.
      changes_rows: Whether Gaussians come, go or change their places. The strategy's
        state is then initialized anew.
    """

    name: str
    steps: tuple[int, ...]
    apply: Callable[[Population], Population]
    changes_rows: bool = True


@runtime_checkable
class Strategy(Protocol):
    """Control of the number of Gaussians, as gsplat's strategies.

    Optional members: `loss(params, context)` adds terms to the loss, as
    `Regularizer.loss` does. `perturb(key, params, learning_rate)` returns the
    parameters after each update; `learning_rate` is that of the means.

    Attributes:
      cap_max: Largest number of Gaussians.
    """

    @property
    def cap_max(self) -> int:
        """Largest number of Gaussians."""
        ...

    def init(self, gaussians: Splats) -> PyTree:
        """Return the state between two events: arrays, or () without any."""
        ...

    def update(self, state: PyTree, info: StepInfo) -> PyTree:
        """Return the state after one more view, traced."""
        ...

    def events(self, steps: int) -> tuple[StrategyEvent, ...]:
        """Return the events of a run of so many steps."""
        ...


def bound(part: Any, steps: int, metadata: SceneMetadata) -> Any:
    """Return the object with the functions of a part of a scene.

    Args:
      part: An object of a protocol, or settings with `bind`.
      steps: Length of the run.
      metadata: Sizes of the capture.
    """
    return part.bind(steps, metadata) if hasattr(part, "bind") else part


def moving_at_once(motion: Any) -> Any:
    """Return a motion, or its settings, without warm-up."""
    if not getattr(motion, "warm_up", 0):
        return motion
    return dataclasses.replace(motion, warm_up=0)


# Optional members of built-in motions whose Gaussians carry others, or fade.
_HOOKS = ("derive_rows", "derive", "significance", "lifted_rows")


def compile_motion(motion: Motion) -> SplatRecord:
    """Compile a motion to the internal record that a scene is built from."""
    name = name_of(motion)

    def own(scene):
        return MotionParams(scene.rows.get(name), scene.nets.get(name))

    more = {hook: getattr(motion, hook) for hook in _HOOKS if hasattr(motion, hook)}
    if getattr(motion, "moves", True):
        more["deform"] = lambda scene, gaussians, frame, cache: motion.apply(
            own(scene), cache, gaussians, frame
        )
    if hasattr(motion, "precompute"):
        more["prepare"] = lambda scene: motion.precompute(
            own(scene), scene.rows["splats"]
        )
    if hasattr(motion, "refresh"):
        more["state"] = lambda scene: motion.refresh(own(scene), scene.rows["splats"])
        more["ready_by_state"] = True
    if hasattr(motion, "loss"):
        more["penalty"] = lambda _, context: as_terms(
            motion.loss(own(context.params), context)
        )
    if hasattr(motion, "project"):
        more["revise"] = motion.project
        more["revise_at"] = getattr(motion, "project_steps", ())
    return SplatRecord(
        name,
        init=motion.init,
        learning_rate=functools.partial(rate_at, motion.learning_rate),
        warm_up=getattr(motion, "warm_up", 0),
        fit_to_paths=getattr(motion, "fit", None),
        **more,
    )


def compile_appearance(appearance: Appearance) -> SplatRecord:
    """Compile an appearance model to the internal record."""
    return SplatRecord(**_hooks(appearance), expose=appearance.apply)


def compile_camera_optimizer(optimizer: CameraOptimizer) -> SplatRecord:
    """Compile a camera optimizer to the internal record."""
    found = getattr(optimizer, "apply_to_capture", None)
    return SplatRecord(**_hooks(optimizer), pose=optimizer.apply, found=found)


def compile_regularizer(regularizer: Regularizer) -> SplatRecord:
    """Compile a regularizer, which may have parameters, to the internal record.

    Those are its `init(key)` and `learning_rate`; it finds them in `params.nets`.
    """
    hooks = regularizer_hooks(regularizer)
    if hasattr(regularizer, "init"):
        hooks |= _hooks(regularizer)
    return SplatRecord(**hooks, state=getattr(regularizer, "state", None))


def _hooks(part):
    """The hooks of a part that has shared parameters alone."""
    return {
        "name": name_of(part),
        "init": lambda key, gaussians: MotionParams(shared=part.init(key)),
        "learning_rate": lambda step: MotionParams(
            shared=rate_at(part.learning_rate, step)
        ),
    }


def initialized(
    parts: tuple[SplatRecord, ...], key: Key[Array, ""], scene: Params
) -> Params:
    """Return a scene with the initial parameters of its parts, on the host.

    Each part has a key of its own by its name, whatever other parts there are.
    """
    rows, nets = dict(scene.rows), dict(scene.nets)
    for part in parts:
        if part.init is None:
            continue
        own = part.init(jax.random.fold_in(key, stream(part.name)), rows["splats"])
        if own.per_gaussian is not None:
            rows[part.name] = own.per_gaussian
        if own.shared is not None:
            nets[part.name] = own.shared
    return Params(rows, nets)
