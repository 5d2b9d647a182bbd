"""Shapes of a synthetic scene, their ray intersections and non-rigid deformations.

Each shape maps its *material* points (which carry the texture) to *body* points at a
time, and back. Both maps are exact, and also defined off the surface.
"""

import abc
import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from nerfies_jax.capture.synthetic.motion import Vector
from nerfies_jax.geometry import rays

# Samples along a ray. Two intersections between neighboring samples are missed, as at a
# fold that is viewed edge-on: one of 350 rays at 14 to 34 degrees to the plane of the
# cloth, and none at larger angles.
PROBES = 16
REFINEMENTS = 5  # iterations of Newton's method within the bracket


class Crossing(NamedTuple):
    """First intersection of a ray with a shape, at infinity if it misses."""

    distance: Float[Array, ""]  # in lengths of the direction
    material: Float[Array, "3"]  # material point
    normal: Float[Array, "3"]  # outward unit normal in body coordinates


@dataclasses.dataclass(frozen=True)
class Squash:
    """Stretch along y that preserves the volume and the lowest point."""

    amount: float = 0.25  # natural logarithm of the largest stretch
    cycles: float = 2.0  # per capture
    phase: float = 0.0  # in cycles


class _Shape(abc.ABC):
    """Maps and intersections of a shape. By default its material does not move."""

    def bends(self) -> bool:
        """Return whether the material moves within the body."""
        return False

    def deform(self, material: Float[Array, "3"], time: Float[Array, ""]):
        """Map a material point [3] to the body at a time in [0, 1]."""
        return material

    def undeform(self, point: Float[Array, "3"], time: Float[Array, ""]):
        """Map a body point [3] to the material at a time in [0, 1]."""
        return point

    @abc.abstractmethod
    def cross(self, origin, direction, time) -> Crossing:
        """Find the first intersection of a ray.

        Args:
          origin: Origin of the ray in body coordinates, [3].
          direction: Direction of any length, [3].
          time: Time in [0, 1].

        Returns:
          The first intersection.
        """


@dataclasses.dataclass(frozen=True)
class Sphere(_Shape):
    """A sphere around the body's origin, or an ellipsoid if it is squashed."""

    radius: float
    squash: Squash | None = None

    def __post_init__(self):
        _positive(radius=self.radius)

    def bends(self) -> bool:
        return self.squash is not None

    def deform(self, material: Float[Array, "3"], time: Float[Array, ""]):
        scale, base = self._stretch(time)
        return base + scale * (material - base)

    def undeform(self, point: Float[Array, "3"], time: Float[Array, ""]):
        scale, base = self._stretch(time)
        return base + (point - base) / scale

    def cross(self, origin, direction, time) -> Crossing:
        """Intersect a ray in material coordinates, in which the shape is a sphere."""
        scale, _ = self._stretch(time)
        start, along = self.undeform(origin, time), direction / scale
        speed_sq = jnp.sum(along**2)
        # Relative to the point nearest to the center, since b² - ac relative to the
        # origin of the ray would cancel for a small, distant sphere.
        middle = -jnp.sum(start * along) / speed_sq
        nearest = start + middle * along
        half_chord_sq = (self.radius**2 - jnp.sum(nearest**2)) / speed_sq
        hit = half_chord_sq > 0
        distance = middle - jnp.sqrt(jnp.where(hit, half_chord_sq, 1))
        material = start + distance * along
        normal = material / scale
        normal = normal / jnp.sqrt(jnp.sum(jnp.where(hit, normal, 1) ** 2))
        return Crossing(_or_infinite(hit, distance), material, normal)

    def _stretch(self, time):
        if self.squash is None:
            return jnp.ones(3, time.dtype), jnp.zeros(3, time.dtype)
        squash = self.squash
        log = squash.amount * jnp.sin(
            2 * jnp.pi * (squash.cycles * time + squash.phase)
        )
        across = jnp.exp(-log / 2)
        base = jnp.asarray((0, -self.radius, 0), time.dtype)
        return jnp.stack([across, jnp.exp(log), across]), base


@dataclasses.dataclass(frozen=True)
class Box(_Shape):
    """A box around the body's origin with half sizes `half`."""

    half: Vector

    def __post_init__(self):
        _positive(half=min(self.half))

    def cross(self, origin, direction, time) -> Crossing:
        """Intersect a ray. Rays that start inside have no intersection."""
        half = jnp.asarray(self.half, time.dtype)
        distance, leave = rays.intersect_aabb(origin, direction, -half, half)
        hit = (distance > 0) & (distance < leave)
        material = origin + jnp.where(hit, distance, 0) * direction
        # The face is that of the largest coordinate relative to the half size.
        face = jax.nn.one_hot(jnp.argmax(jnp.abs(material) / half), 3, dtype=time.dtype)
        return Crossing(
            _or_infinite(hit, distance), material, face * jnp.sign(material)
        )


@dataclasses.dataclass(frozen=True)
class Sheet(_Shape):
    """A cloth in the body's xy plane that hangs from its upper edge and billows.

    The material point (u, v, w) maps to (u + sway(v), v, w + billow(u, v)). This is a
    shear, so its inverse is exact everywhere and its Jacobian determinant is one. The
    upper edge is static.
    """

    half_width: float
    half_height: float
    billow: float = 0.03  # amplitude along z at the lower edge, scene units
    wavelength: float = 0.3  # of the horizontal wave, scene units
    billow_cycles: float = 2.0  # per capture
    sway: float = 0.04  # amplitude along x at the lower edge, scene units
    sway_cycles: float = 1.0

    def __post_init__(self):
        _positive(
            half_width=self.half_width,
            half_height=self.half_height,
            billow=self.billow,
            wavelength=self.wavelength,
        )
        if self.sway < 0:
            raise ValueError(f"sway={self.sway} must not be negative; 0 disables it")

    def bends(self) -> bool:
        return True

    def deform(self, material: Float[Array, "3"], time: Float[Array, ""]):
        u, v, w = material
        sway, billow = self._sway(v, time), self._billow(u, v, time)
        return jnp.stack([u + sway, v, w + billow])

    def undeform(self, point: Float[Array, "3"], time: Float[Array, ""]):
        x, y, z = point
        u = x - self._sway(y, time)
        return jnp.stack([u, y, z - self._billow(u, y, time)])

    def cross(self, origin, direction, time) -> Crossing:
        """Intersect a ray by sampling, with Newton's method in the bracket."""
        distance, hit = self._root(origin, direction, time)
        material = self.undeform(origin + distance * direction, time)
        normal = jax.grad(lambda point: self.undeform(point, time)[2])(
            origin + distance * direction
        )
        normal = normal / jnp.sqrt(jnp.sum(normal**2))  # not zero, since its z is one
        return Crossing(_or_infinite(hit, distance), material, normal)

    def _root(self, origin, direction, time):
        def height(distance):
            return self.undeform(origin + distance * direction, time)[2]

        def fixed_height(distance):  # a while loop has no reverse-mode derivative
            ray = jax.lax.stop_gradient((origin, direction, time))
            return self.undeform(ray[0] + distance * ray[1], ray[2])[2]

        low, high, has_root = self._bracket(
            *jax.lax.stop_gradient((origin, direction, time))
        )
        sign_low = jnp.sign(fixed_height(low))

        def is_unfinished(state):
            return has_root & (state[0] < REFINEMENTS)

        def refine(state):
            index, low, high, at = state
            value, slope = jax.jvp(fixed_height, (at,), (jnp.ones_like(at),))
            before = jnp.sign(value) == sign_low
            low, high = jnp.where(before, at, low), jnp.where(before, high, at)
            newton = at - value / jnp.where(slope == 0, 1, slope)
            inside = (newton >= low) & (newton <= high)
            return index + 1, low, high, jnp.where(inside, newton, (low + high) / 2)

        start = (jnp.int32(0), low, high, (low + high) / 2)
        at = jax.lax.stop_gradient(jax.lax.while_loop(is_unfinished, refine, start)[3])
        # One Newton step outside of the loop has the implicit derivative of the root.
        value, slope = jax.jvp(height, (at,), (jnp.ones_like(at),))
        slope = jax.lax.stop_gradient(slope)
        distance = at - value / jnp.where(slope == 0, 1, slope)
        u, v, _ = self.undeform(origin + at * direction, time)
        inside = (jnp.abs(u) <= self.half_width) & (jnp.abs(v) <= self.half_height)
        return jnp.where(has_root, distance, 0), has_root & inside & (at > 0)

    def _bracket(self, origin, direction, time):
        """The first interval between samples in which the ray crosses the cloth."""
        extent = (self.half_width + self.sway, self.half_height, _CREST * self.billow)
        # Slightly beyond the crests, since a sample on the border has no sign change.
        high = jnp.asarray(extent, time.dtype) * 1.001
        enter, leave = rays.intersect_aabb(origin, direction, -high, high)
        hit = enter < leave
        enter = jnp.where(hit, enter, 0)
        step = jnp.where(hit, leave - enter, 1) / (PROBES - 1)

        # A while loop ends early for a batch of rays that all miss or have all crossed.
        def is_unfinished(state):
            index, _, has_crossed, _, _ = state
            return hit & ~has_crossed & (index < PROBES)

        def probe(state):
            index, _, _, u_low, height_low = state
            at = enter + index.astype(time.dtype) * step
            u, _, height = self.undeform(origin + at * direction, time)
            # The box is wider than the cloth because of the sway, so crossings next to
            # the cloth are ignored. Linear interpolation locates the crossing to second
            # order in the step.
            fall = jnp.where(height_low == height, 1, height_low - height)
            crossing = u_low + height_low / fall * (u - u_low)
            on_cloth = jnp.abs(crossing) <= self.half_width
            has_crossed = (height_low * height <= 0) & (height_low != height) & on_cloth
            return index + 1, at - step, has_crossed, u, height

        u, _, height = self.undeform(origin + enter * direction, time)
        start = (jnp.int32(1), enter, jnp.zeros_like(hit), u, height)
        _, low, has_crossed, _, _ = jax.lax.while_loop(is_unfinished, probe, start)
        return low, low + step, has_crossed

    def _hang(self, v):
        """0 at the upper edge, 1 at the lower edge."""
        return (self.half_height - v) / (2 * self.half_height)

    def _sway(self, v, time):
        swing = jnp.sin(2 * jnp.pi * self.sway_cycles * time)
        return self.sway * self._hang(v) ** 2 * swing

    def _billow(self, u, v, time):
        turn = 2 * jnp.pi * self.billow_cycles * time
        across = 2 * jnp.pi / self.wavelength
        wave = jnp.sin(across * (u + 0.5 * v) - turn)
        ripple = _RIPPLE * jnp.sin(across * (1.7 * v - 0.6 * u) - 2 * turn)
        return self.billow * self._hang(v) * (wave + ripple)


_RIPPLE = 0.35  # amplitude relative to the main wave
_CREST = 1 + _RIPPLE  # upper bound of the sum of both waves

Shape = Sphere | Box | Sheet


def _or_infinite(hit: Bool[Array, ""], distance: Float[Array, ""]):
    return jnp.where(hit & (distance > 0), distance, jnp.inf)


def _positive(**values):
    for name, value in values.items():
        if not value > 0:
            raise ValueError(f"{name}={value} must be positive, in scene units")
