"""Rigid motion of the objects of a synthetic scene, in closed form.

World axes are x right, y up, z toward the camera, and lengths are in scene units. Time
runs from 0 to 1 over the capture. `place` is the world position of a body's origin
without motion.
"""

import dataclasses
import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nerfies_jax.geometry.precision import exact_product

Vector = tuple[float, float, float]


class Pose(NamedTuple):
    """Pose of a body: `world = rotation @ body + position`."""

    rotation: Float[Array, "3 3"]
    position: Float[Array, "3"]


def unit_axis(axis: Vector) -> Vector:
    """Normalize an axis.

    Args:
      axis: A direction.

    Returns:
      The unit vector.

    Raises:
      ValueError: If the length is zero or not finite.
    """
    length = math.hypot(*axis)
    if not 0 < length < math.inf:
        raise ValueError(f"axis={axis} has no direction; give one that is not zero")
    x, y, z = (float(part / length) for part in axis)
    return x, y, z


@dataclasses.dataclass(frozen=True)
class Path:
    """Lissajous path with a rotation about an axis through the body."""

    sway: Vector = (0.0, 0.0, 0.0)  # amplitude about the place, scene units
    cycles: Vector = (1.0, 1.0, 1.0)  # per capture, for each axis of `sway`
    phase: Vector = (0.0, 0.0, 0.0)  # in cycles
    axis: Vector = (0.0, 1.0, 0.0)
    turns: float = 0.0  # per capture

    def __post_init__(self):
        unit_axis(self.axis)

    def pose(self, place: Vector, time: Float[Array, ""]) -> Pose:
        cycles, phase, sway, origin = (
            jnp.asarray(value, time.dtype)
            for value in (self.cycles, self.phase, self.sway, place)
        )
        shift = sway * jnp.sin(2 * jnp.pi * (cycles * time + phase))
        rotation = _axis_rotation(self.axis, 2 * jnp.pi * self.turns * time)
        return Pose(rotation, origin + shift)


@dataclasses.dataclass(frozen=True)
class Hinge:
    """One joint, with pivot and axis in world coordinates of the rest pose."""

    pivot: Vector
    axis: Vector = (0.0, 0.0, 1.0)
    rest_rad: float = 0.0  # mean angle
    swing_rad: float = 0.5  # amplitude about the mean angle
    cycles: float = 1.0  # per capture
    phase: float = 0.0  # in cycles

    def __post_init__(self):
        unit_axis(self.axis)


@dataclasses.dataclass(frozen=True)
class Arm:
    """A body at the end of a chain of hinges, the base hinge first.

    The product of exponentials of Brockett 1984: each joint moves everything after it
    from its rest pose, so the joints are applied last to first.
    """

    hinges: tuple[Hinge, ...]

    def __post_init__(self):
        if not self.hinges:
            raise ValueError("an arm needs at least one hinge; use Path() for none")

    def pose(self, place: Vector, time: Float[Array, ""]) -> Pose:
        rotation = jnp.eye(3, dtype=time.dtype)
        position = jnp.asarray(place, time.dtype)
        for hinge in reversed(self.hinges):
            swing = jnp.sin(2 * jnp.pi * (hinge.cycles * time + hinge.phase))
            joint = _axis_rotation(hinge.axis, hinge.rest_rad + hinge.swing_rad * swing)
            pivot = jnp.asarray(hinge.pivot, time.dtype)
            rotation = exact_product(joint, rotation)
            position = exact_product(joint, position - pivot) + pivot
        return Pose(rotation, position)


@dataclasses.dataclass(frozen=True)
class Glide:
    """Translation at constant speed between two times, static before and after."""

    travel: Vector  # scene units
    start: float = 0.0
    stop: float = 1.0

    def __post_init__(self):
        if not 0 <= self.start < self.stop <= 1:
            raise ValueError(
                f"a glide needs 0 <= start < stop <= 1, got start={self.start} and "
                f"stop={self.stop}; times run from 0 to 1 over the capture"
            )

    def pose(self, place: Vector, time: Float[Array, ""]) -> Pose:
        share = jnp.clip((time - self.start) / (self.stop - self.start), 0, 1)
        travel, origin = (jnp.asarray(x, time.dtype) for x in (self.travel, place))
        return Pose(jnp.eye(3, dtype=time.dtype), origin + share * travel)


Motion = Path | Arm | Glide


def pose(motion: Motion | None, place: Vector, time: Float[Array, ""]) -> Pose:
    """Return the pose of a body at a time.

    Args:
      motion: The motion. None for a static body.
      place: Position of the body without motion, in scene units.
      time: Time in [0, 1].

    Returns:
      The pose.
    """
    if motion is None:
        return Pose(jnp.eye(3, dtype=time.dtype), jnp.asarray(place, time.dtype))
    return motion.pose(place, time)


def to_world(pose: Pose, point: Float[Array, "3"]) -> Float[Array, "3"]:
    """Transform a point from body to world coordinates.

    Args:
      pose: Pose of the body.
      point: Point in body coordinates, [3].

    Returns:
      The point in world coordinates, [3].
    """
    return exact_product(pose.rotation, point) + pose.position


def to_body(pose: Pose, point: Float[Array, "3"]) -> Float[Array, "3"]:
    """Transform a point from world to body coordinates.

    Args:
      pose: Pose of the body.
      point: Point in world coordinates, [3].

    Returns:
      The point in body coordinates, [3].
    """
    return exact_product(pose.rotation.T, point - pose.position)


def _axis_rotation(axis: Vector, angle_rad: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Return the rotation about a fixed axis (Rodrigues' formula).

    It is a smooth function of the angle everywhere.
    """
    x, y, z = unit_axis(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    first = jnp.asarray(cross, angle_rad.dtype)
    second = jnp.asarray(cross @ cross, angle_rad.dtype)
    # 2 sin²(a/2) = 1 - cos a, without cancellation near zero.
    versine = 2 * jnp.sin(angle_rad / 2) ** 2
    eye = jnp.eye(3, dtype=angle_rad.dtype)
    return eye + jnp.sin(angle_rad) * first + versine * second
