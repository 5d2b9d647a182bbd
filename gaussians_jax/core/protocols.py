"""Extension points of a scene of Gaussians.

A field of `SplatScene` takes either an object that implements the protocol, or settings
with a method `bind(steps, metadata)` that returns such an object for one training run.
The built-in components are settings.
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
from nerfies_jax.training.model import Frames
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
      moved: The Gaussians at the time of the frame.
      significance: Weight of each rendered Gaussian in the statistics of its parent.
        None if Gaussians have no children.
    """

    mean2d_gradient: Float[Array, "rendered 2"]
    visible: Bool[Array, " rendered"]
    radius_px: Float[Array, " rendered"]
    size: tuple[int, int]
    canonical: Gaussians
    moved: Gaussians
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


def bound(part: Any, steps: int, metadata: SceneMetadata) -> Any:
    """Return the object that implements a component of a scene.

    Args:
      part: An object that implements a protocol, or settings with `bind`.
      steps: Number of training steps.
      metadata: Metadata of the capture.

    Args:
      part: An object that implements a protocol, or settings with `bind`.
      steps: Number of training steps.
      metadata: Metadata of the capture.

    Returns:
      The object.
    """
    return part.bind(steps, metadata) if hasattr(part, "bind") else part


def moving_at_once(motion: Any) -> Any:
    """Return a motion, or its settings, without warm-up.

    Args:
      motion: The motion, or its settings.

    Returns:
      The same with `warm_up=0`.
    """
    if not getattr(motion, "warm_up", 0):
        return motion
    return dataclasses.replace(motion, warm_up=0)


# Optional members of built-in motions that have child Gaussians or temporal opacity.
_HOOKS = ("derive_rows", "derive", "significance", "lifted_rows")


def compile_motion(motion: Motion) -> SplatRecord:
    """Compile a motion to the internal record that a scene is built from.

    Args:
      motion: The motion, bound to a run.

    Returns:
      The record.
    """
    name = name_of(motion)

    def own_params(scene):
        return MotionParams(scene.rows.get(name), scene.nets.get(name))

    hooks = {hook: getattr(motion, hook) for hook in _HOOKS if hasattr(motion, hook)}
    if getattr(motion, "moves", True):
        hooks["deform"] = lambda scene, gaussians, frame, cache: motion.apply(
            own_params(scene), cache, gaussians, frame
        )
    if hasattr(motion, "precompute"):
        hooks["prepare"] = lambda scene: motion.precompute(
            own_params(scene), scene.rows["splats"]
        )
    if hasattr(motion, "refresh"):
        hooks["state"] = lambda scene: motion.refresh(
            own_params(scene), scene.rows["splats"]
        )
        hooks["ready_by_state"] = True
    if hasattr(motion, "loss"):
        hooks["penalty"] = lambda _, context: as_terms(
            motion.loss(own_params(context.params), context)
        )
    if hasattr(motion, "project"):
        hooks["revise"] = motion.project
        hooks["revise_at"] = getattr(motion, "project_steps", ())
    return SplatRecord(
        name,
        init=motion.init,
        learning_rate=functools.partial(rate_at, motion.learning_rate),
        warm_up=getattr(motion, "warm_up", 0),
        fit_to_paths=getattr(motion, "fit", None),
        **hooks,
    )


def compile_appearance(appearance: Appearance) -> SplatRecord:
    """Compile an appearance model to the internal record.

    Args:
      appearance: The appearance model, bound to a run.

    Returns:
      The record.
    """
    return SplatRecord(**_hooks(appearance), expose=appearance.apply)


def compile_gaussian_appearance(appearance: GaussianAppearance) -> SplatRecord:
    """Compile an appearance model of Gaussians to the internal record.

    Args:
      appearance: The appearance model, bound to a run.

    Returns:
      The record.
    """
    name = name_of(appearance)

    def own_params(scene):
        return MotionParams(scene.rows.get(name), scene.nets.get(name))

    backdrop = None
    if getattr(appearance, "background", None) is not None:

        def backdrop(scene, direction, code):
            return appearance.background(own_params(scene), direction, code)

    return SplatRecord(
        name,
        init=appearance.init,
        learning_rate=functools.partial(rate_at, appearance.learning_rate),
        code=lambda scene, id_: appearance.code(own_params(scene), id_),
        recolor=lambda scene, colors, code: appearance.apply(
            own_params(scene), colors, code
        ),
        backdrop=backdrop,
    )


def compile_camera_optimizer(optimizer: CameraOptimizer) -> SplatRecord:
    """Compile a camera optimizer to the internal record.

    Args:
      optimizer: The camera optimizer, bound to a run.

    Returns:
      The record.
    """
    apply_to_capture = getattr(optimizer, "apply_to_capture", None)
    return SplatRecord(
        **_hooks(optimizer), pose=optimizer.apply, found=apply_to_capture
    )


def compile_regularizer(regularizer: Regularizer) -> SplatRecord:
    """Compile a regularizer to the internal record.

    A regularizer may have parameters, from its `init(key)` and `learning_rate`. Its
    loss finds them in `params.nets`.

    Args:
      regularizer: The regularizer, bound to a run.

    Returns:
      The record.
    """
    hooks = regularizer_hooks(regularizer)
    if hasattr(regularizer, "init"):
        hooks |= _hooks(regularizer)
    return SplatRecord(
        **hooks,
        state=getattr(regularizer, "state", None),
        reads_depth=getattr(regularizer, "reads_depth", False),
    )


def _hooks(part):
    """Return the hooks of a component that has only shared parameters."""
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
    """Add the initial parameters of all components to a scene, on the host.

    The PRNG key of a component depends on its name only, not on the other components.

    Args:
      parts: Records of the components.
      key: PRNG key of the scene.
      scene: Parameters, with the Gaussians in `rows["splats"]`.

    Returns:
      The parameters with those of the components, under their names.
    """
    rows, nets = dict(scene.rows), dict(scene.nets)
    for part in parts:
        if part.init is None:
            continue
        own_params = part.init(
            jax.random.fold_in(key, stream(part.name)), rows["splats"]
        )
        if own_params.per_gaussian is not None:
            rows[part.name] = own_params.per_gaussian
        if own_params.shared is not None:
            nets[part.name] = own_params.shared
    return Params(rows, nets)
