"""Protocols of the components of a radiance field.

A component in `RadianceScene` is an object that implements one of these protocols, or
settings with `bind(steps, metadata)`, which returns such an object for a run of this
length on a capture. Functions take one point of one ray, in units of the field. The
caller vectorizes them.

Optional members of all components: `init(key)` returns parameters. Without it there are
none. `learning_rate` is a float, a schedule of the traced step or a tree of these.
Without it the rate of the field is used. `tables` are the tables of latent codes that
the component reads from `frame.codes`. `loss(params, context)` adds terms to the loss,
as `Regularizer.loss` does, but takes the parameters of the component. `required_data`
names the data of the capture that it reads. `name` is the key of its parameters and
metrics.
"""

import dataclasses
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from nerfies_jax.fields.effects.effect import Medium as MediumSample
from nerfies_jax.fields.effects.effect import Sample as Sample
from nerfies_jax.nn.adapters import Network
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.effects import Table as Table
from nerfies_jax.training.protocols import Regularizer as Regularizer

PyTree = Any
Scalar = Float[Array, ""]
Vector = Float[Array, "3"]


class TemplateInputs(NamedTuple):
    """Inputs of a template at one sample of a ray.

    Attributes:
      point: Warped point in the template, in units of the field.
      direction: Unit direction of the ray. Density must not depend on it.
      features: Features of the conditionings with the target "trunk".
      condition: Features of those with the target "color". Density must not depend on
        them.
      step: Training step, for schedules.
    """

    point: Vector
    direction: Vector
    features: Float[Array, " features"]
    condition: Float[Array, " condition"]
    step: Int[Array, ""] | None


@runtime_checkable
class Template(Protocol):
    """Density and color in the coordinates of the template."""

    def init(self, key: Key[Array, ""], features: int, condition: int) -> PyTree:
        """Initialize the parameters.

        Args:
          key: PRNG key.
          features: Number of `TemplateInputs.features`.
          condition: Number of `TemplateInputs.condition`.

        Returns:
          Parameters of the template.
        """
        ...

    def apply(self, params: PyTree, inputs: TemplateInputs) -> tuple[Scalar, Vector]:
        """Compute density (not negative, per unit of the field) and color (sRGB).

        Args:
          params: Parameters of the template.
          inputs: Inputs of one sample.

        Returns:
          Density and color.
        """
        ...


@dataclasses.dataclass(frozen=True)
class NetworkTemplate:
    """A `Template` from a network, such as one of `nn.adapters`.

    Attributes:
      network: Reads [point, features] and [direction, condition] of one sample and
        returns density and color.
    """

    network: Network

    def init(self, key: Key[Array, ""], features: int, condition: int) -> PyTree:
        """Initialize the parameters of the network.

        Args:
          key: PRNG key.
          features: Number of features, which the network knows.
          condition: Number of condition features, which the network knows.

        Returns:
          Parameters of the network.
        """
        return self.network.init(key)

    def apply(self, params: PyTree, inputs: TemplateInputs) -> tuple[Scalar, Vector]:
        """Evaluate the network at one sample.

        Args:
          params: Parameters of the network.
          inputs: Inputs of one sample.

        Returns:
          Density and color, as the network returns them.
        """
        place = jnp.concatenate([inputs.point, inputs.features])
        ray = jnp.concatenate([inputs.direction, inputs.condition])
        return self.network.apply(params, place, ray)


@runtime_checkable
class Warp(Protocol):
    """Deformation from the observed scene to the template.

    Optional member: `shortest_wave`, the shortest wavelength of the displacement in
    space. Warps that are smooth enough are evaluated on a grid to render an image.
    Without it they are evaluated at every sample.
    """

    def init(self, key: Key[Array, ""]) -> PyTree:
        """Initialize the parameters, with a displacement near zero.

        Args:
          key: PRNG key of this component.

        Returns:
          Parameters of the warp.
        """
        ...

    def apply(self, params: PyTree, point: Vector, frame: FrameCondition) -> Vector:
        """Compute the displacement of an observed point.

        Args:
          params: Parameters of the warp.
          point: An observed point.
          frame: Time, codes and training step of the frame.

        Returns:
          The point in the template minus the observed point.
        """
        ...


@runtime_checkable
class Conditioning(Protocol):
    """Features of a frame, or of a point and its time, as inputs of networks.

    Attributes:
      features: Number of features.
      target: Network that reads the features: "trunk" (density and color), "color" (for
        features of a frame), or "warp", which reads them from `frame.codes` by the name
        of the conditioning.
    """

    @property
    def features(self) -> int:
        """Number of features that `apply` returns."""
        ...

    @property
    def target(self) -> str:
        """Branch of the template that reads them."""
        ...

    def apply(
        self, params: PyTree, point: Vector | None, frame: FrameCondition
    ) -> Float[Array, " features"]:
        """Compute the features.

        Args:
          params: Parameters of the conditioning, None without `init`.
          point: The observed point, None if the target is color.
          frame: Time, codes and training step of the frame.

        Returns:
          The features.
        """
        ...


@runtime_checkable
class Medium(Protocol):
    """Second medium along a ray, next to the static scene.

    Optional members: `beta_min`, the minimum standard deviation of a ray's color, is
    required if the medium has a `beta`. `beta_power` weights the likelihood.
    """

    def init(self, key: Key[Array, ""], features: int) -> PyTree:
        """Initialize the parameters, for a trunk of `features` features.

        Args:
          key: PRNG key of this component.
          features: Number of features of the trunk, `sample.features`.

        Returns:
          Parameters of the medium.
        """
        ...

    def apply(
        self, params: PyTree, sample: Sample, frame: FrameCondition
    ) -> MediumSample:
        """Compute density and color of the medium at one sample of a ray.

        Args:
          params: Parameters of the medium.
          sample: The sample, with the features of the trunk.
          frame: Time, codes and training step of the frame.

        Returns:
          Density, color and, optionally, the uncertainty of the medium.
        """
        ...
