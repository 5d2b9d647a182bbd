"""Extension points of a scene of Gaussians.

A field of `SplatScene` takes either an object that implements the protocol, or settings
with a method `bind(steps, metadata)` that returns such an object for one training run.
The built-in components are settings.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import optax
from jaxtyping import Array, Bool, Float, Int, Key

from gaussians_jax.core.splats import Gaussians, Params, Splats
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.model import Frames
from nerfies_jax.training.protocols import LearningRate

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

    Optional members: `precompute(params, gaussians)` returns the cache that `apply`
    receives. The cache must not depend on the time, and is None without this method.
    `loss(params, context)` adds terms to the loss, as `Regularizer.loss` does.
    `fit(paths, key)` returns a `motion_fit.Guess`, from which a fit to tracks starts.
    `warm_up` is the number of steps before the motion begins. `name` is the key of its
    parameters and metrics, by default the class name in snake case.

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
          gaussians: The Gaussians to move.

        Returns:
          Parameters with one row for each of `gaussians`, and shared parameters.
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
          gaussians: Gaussians in their canonical state, or as the previous component
            returned them.
          frame: Time in [0, 1] over the capture, and `step` and `key` in training.

        Returns:
          The moved Gaussians.
        """
        ...


@runtime_checkable
class Appearance(Protocol):
    """Appearance model: maps a render to the exposure or color of an observed frame."""

    @property
    def learning_rate(self) -> LearningRate:
        """Learning rate of the parameters."""
        ...

    def init(self, key: Key[Array, ""]) -> PyTree:
        """Initialize the parameters.

        Args:
          key: PRNG key of this component.

        Returns:
          Parameters, shared by all Gaussians.
        """
        ...

    def apply(
        self,
        params: PyTree,
        image: Float[Array, "*pixels 3"],
        appearance: Int[Array, ""],
    ) -> Float[Array, "*pixels 3"]:
        """Return the sRGB image as observed under an appearance id.

        Args:
          params: Parameters of this component.
          image: Rendered image, sRGB, not clipped.
          appearance: Appearance id of the frame, a row of per-frame parameters.

        Returns:
          The image, which need not lie in [0, 1].
        """
        ...


@runtime_checkable
class GaussianAppearance(Protocol):
    """Appearance model: maps the colors of all Gaussians to those in one photograph.

    The code of a photograph that is not a training frame is fitted to a part of it.

    Optional member: `background(params, direction, code)` returns the sRGB colors
    behind the Gaussians in unit directions of the world, as those of a sky.

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
          key: PRNG key of this component.
          gaussians: The Gaussians.

        Returns:
          Parameters with one row for each of `gaussians`, and shared parameters.
        """
        ...

    def code(
        self, params: MotionParams, appearance: Int[Array, ""]
    ) -> Float[Array, " code"]:
        """Return the code of an appearance id.

        Args:
          params: Parameters of this component.
          appearance: Appearance id of the frame.

        Returns:
          The code, which `apply` receives.
        """
        ...

    def apply(
        self,
        params: MotionParams,
        colors: Float[Array, "gaussians 3"],
        code: Float[Array, " code"],
    ) -> Float[Array, "gaussians 3"]:
        """Return the sRGB colors of the Gaussians for a code.

        Args:
          params: Parameters of this component.
          colors: Colors of the Gaussians toward the camera.
          code: Code of the photograph.

        Returns:
          The changed colors, which need not lie in [0, 1].
        """
        ...


@runtime_checkable
class CameraOptimizer(Protocol):
    """Refinement of the training cameras together with the scene.

    Optional member: `apply_to_capture(params, capture)` returns the capture with the
    refined cameras of all frames, including held-out ones, on the host.
    """

    @property
    def learning_rate(self) -> LearningRate:
        """Learning rate of the parameters."""
        ...

    def init(self, key: Key[Array, ""]) -> PyTree:
        """Initialize the parameters.

        Args:
          key: PRNG key of this component.

        Returns:
          Parameters, shared by all Gaussians.
        """
        ...

    def apply(self, params: PyTree, cameras: Camera) -> Camera:
        """Return the refined cameras of the training frames, in their order.

        Args:
          params: Parameters of this component.
          cameras: Captured cameras, batched over the training frames.

        Returns:
          Cameras of the same batch shape.
        """
        ...


class StepInfo(NamedTuple):
    """Statistics of the Gaussians in one view of a training step.

    Attributes:
      mean2d_gradient: Gradient of the loss of this view with respect to the projected
        means, per pixel.
      visible: True where the footprint of a Gaussian overlaps the image.
      radius_px: Radius of the footprint in pixels.
      size: (width, height) of the image in pixels.
      canonical: The Gaussians in their canonical state.
      deformed: The Gaussians at the time of the frame.
      significance: Weight of each rendered Gaussian in the statistics of its parent.
        None if Gaussians have no children.
    """

    mean2d_gradient: Float[Array, "rendered 2"]
    visible: Bool[Array, " rendered"]
    radius_px: Float[Array, " rendered"]
    size: tuple[int, int]
    canonical: Gaussians
    deformed: Gaussians
    significance: Float[Array, " rendered"] | None = None


class Population(NamedTuple):
    """The Gaussians of a scene in training, as an event of a `Strategy` receives them.

    Attributes:
      params: Parameters of the scene.
      moments: State of the optimizer.
      state: State of the strategy.
      key: PRNG key of this step.
      step: Number of completed steps.
      extent: Spread of the cameras in scene units.
      optimizer: The optimizer that `moments` belongs to.
      frames: Training frames, with their cameras.
    """

    params: Params
    moments: PyTree
    state: PyTree
    key: Key[Array, ""]
    step: int
    extent: float
    optimizer: optax.GradientTransformation
    frames: Frames | None = None


class StrategyEvent(NamedTuple):
    """A change of the set of Gaussians between two steps.

    Attributes:
      name: Name in logs.
      steps: Numbers of completed steps after which the event happens, sorted.
      apply: Returns the changed population, on the host.
      changes_rows: True if Gaussians are added, removed or reordered. The state of the
        strategy is then initialized again.
    """

    name: str
    steps: tuple[int, ...]
    apply: Callable[[Population], Population]
    changes_rows: bool = True


@runtime_checkable
class Strategy(Protocol):
    """Control of the number of Gaussians, as in gsplat's strategies.

    Optional members: `loss(params, context)` adds terms to the loss, as
    `Regularizer.loss` does. `perturb(key, params, learning_rate)` returns changed
    parameters after each update, where `learning_rate` is that of the means.

    Attributes:
      cap_max: Largest number of Gaussians.
    """

    @property
    def cap_max(self) -> int:
        """Largest number of Gaussians."""
        ...

    def init(self, gaussians: Splats) -> PyTree:
        """Return the initial state: a pytree of arrays, or () without any.

        Args:
          gaussians: The Gaussians, at the start or after an event that changed their
            rows.

        Returns:
          The state.
        """
        ...

    def update(self, state: PyTree, info: StepInfo) -> PyTree:
        """Return the state after one more view. This function is traced.

        Args:
          state: State of the strategy.
          info: Statistics of the view.

        Returns:
          State of the same structure, shapes and types.
        """
        ...

    def events(self, steps: int) -> tuple[StrategyEvent, ...]:
        """Return the events of a run of this many steps.

        Args:
          steps: Number of training steps of the run.

        Returns:
          Events in the order in which they happen after the same step.
        """
        ...
