"""What the property tests draw: motions, cameras, Gaussians, rays, pictures.

Values are NumPy float64 of fixed shapes, so a test compiles once for each precision.
The draws of one checkout are always the same. For new ones, many of them, set
PROPERTY_PROFILE=search.
"""

import functools
import math
import os
from typing import NamedTuple

import jax
import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from hypothesis.internal.conjecture import providers

from gaussians_jax.splats import Gaussians
from nerfies_jax.geometry.camera import Camera

# Of the fixtures, `dtype` is one precision for all examples and `tmp_path` a folder in
# which they overwrite each other.
_QUIET = (HealthCheck.function_scoped_fixture, HealthCheck.too_slow)
settings.register_profile(
    "properties",
    max_examples=20,
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=_QUIET,
)
settings.register_profile(
    "search",
    max_examples=1000,
    database=None,
    deadline=None,
    suppress_health_check=_QUIET,
    print_blob=False,
)
_PROFILE = os.environ.get("PROPERTY_PROFILE", "properties")
settings.load_profile(_PROFILE)
if _PROFILE == "properties":
    # Hypothesis also draws the numbers that stand in whatever modules of ours are
    # loaded: other ones alone than in the whole suite, and after any edit.
    providers.is_local_module_file = lambda path: False

PICTURE = (24, 16)  # width, height of what is drawn
GAUSSIANS = 6


def eps(dtype) -> float:
    """The distance from 1 to the next number."""
    return float(np.finfo(dtype).eps)


def cast(dtype, *trees):
    """The same in a precision; one tree alone, several as a tuple.

    As NumPy arrays, which compiled functions take as they are: what a test does with
    them beside compiles nothing. Subnormal numbers become zero, as XLA's arithmetic
    makes them.
    """
    tiny = np.finfo(dtype).tiny

    def cast_(leaf):
        leaf = np.asarray(leaf, dtype)
        return np.where(np.abs(leaf) < tiny, leaf.dtype.type(0), leaf)

    cast_trees = jax.tree.map(cast_, trees)
    return cast_trees if len(trees) > 1 else cast_trees[0]


def compiled(function, **static):
    """`jax.jit` with NumPy results: what a test does with them compiles nothing."""
    run = jax.jit(function, **static)

    @functools.wraps(function)
    def run_(*args):
        return jax.tree.map(np.asarray, run(*args))

    return run_


def close(found, expected, bound) -> None:
    """|found - expected| <= bound in every entry; NaN is close to nothing."""
    found, expected = (np.asarray(x, np.float64) for x in (found, expected))
    off = np.abs(found - expected)
    # What is smaller than the smallest normal number may be flushed to zero.
    ok = off <= np.asarray(bound) + 1e-37
    assert np.all(ok), (
        f"off by {np.max(np.where(ok, 0, off)):.3g} where {np.max(bound):.3g} is "
        f"allowed:\n{found}\n{expected}"
    )


def same(found, expected) -> None:
    """Equal to the bit (zeros of both signs are equal), leaf by leaf."""
    for one, other in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_array_equal(one, other)


def numbers(low: float, high: float):
    return st.floats(low, high, allow_subnormal=False)


def many(shape, low: float, high: float):
    """An array whose entries are drawn one by one."""
    return arrays.arrays(
        np.float64, shape, elements=numbers(low, high), fill=st.nothing()
    )


def magnitudes(low: float = 1e-30, high: float = 1.0):
    """Zero, or evenly in the logarithm."""
    spread = numbers(math.log10(low), math.log10(high)).map(lambda e: 10.0**e)
    return st.one_of(st.just(0.0), spread)


@st.composite
def directions(draw):
    """Unit vectors [3]; the axes are among them."""
    height, turn = draw(numbers(-1, 1)), draw(numbers(-math.pi, math.pi))
    radius = math.sqrt(1 - height**2)
    return np.array([radius * math.cos(turn), radius * math.sin(turn), height])


@st.composite
def vectors(draw, high: float = 10.0):
    """Vectors [3] of length zero or 1e-30 to `high`."""
    return draw(magnitudes(high=high)) * draw(directions())


def angles(most: float = 2 * math.pi):
    """rad: 0, 1e-30 and up, evenly, and close to π from both sides."""
    kinds = [magnitudes(high=min(most, 1.0)), numbers(0, most)]
    if most > math.pi:
        near = st.tuples(st.sampled_from([-1, 0, 1]), numbers(-16, -1))
        kinds.append(near.map(lambda x: math.pi + x[0] * 10 ** x[1]))
    return st.one_of(kinds)


@st.composite
def rotation_vectors(draw, most: float = 2 * math.pi):
    """Axis times angle, rad [3]."""
    return draw(angles(most)) * draw(directions())


@st.composite
def unit_quaternions(draw):
    """wxyz of either sign, half turns (w = 0 to rounding) among them."""
    vector = draw(rotation_vectors())
    half = np.linalg.norm(vector) / 2
    # numpy's sinc is sin(πx) / πx
    xyz = np.sinc(half / np.pi) / 2 * vector
    return draw(st.sampled_from([1, -1])) * np.concatenate([[np.cos(half)], xyz])


@st.composite
def quaternions(draw):
    """wxyz of lengths from 1e-5 to 1e5."""
    return 10.0 ** draw(numbers(-5, 5)) * draw(unit_quaternions())


class Motion(NamedTuple):
    """A rigid motion of the world, x to R x + t; float64."""

    quaternion: np.ndarray  # [4] of R
    rotation: np.ndarray  # [3, 3]
    translation: np.ndarray  # [3]


@st.composite
def motions(draw):
    quaternion = draw(unit_quaternions())
    return Motion(quaternion, matrix(quaternion), draw(vectors()))


def matrix(quaternion: np.ndarray) -> np.ndarray:
    """The rotation matrix of wxyz, in float64: columns are q e q*."""
    w, xyz = quaternion[0], quaternion[1:]
    inner = w * np.eye(3) + np.cross(np.eye(3), xyz)
    return np.outer(xyz, xyz) + inner @ inner


def times(second: np.ndarray, first: np.ndarray) -> np.ndarray:
    """The product of quaternions [..., 4] in float64, as pairs of complex numbers."""
    # q = a + b j with a = w + x i, b = y + z i, and j c = conj(c) j
    (a, b), (c, d) = (
        (q[..., 0] + 1j * q[..., 1], q[..., 2] + 1j * q[..., 3])
        for q in (second, first)
    )
    one, other = a * c - b * d.conj(), a * d + b * c.conj()
    return np.stack([one.real, one.imag, other.real, other.imag], axis=-1)


@st.composite
def cameras(draw):
    """Pinholes of `PICTURE` anywhere."""
    width, height = PICTURE
    wanted = numbers(-1, 1)
    return Camera(
        camera_from_world=matrix(draw(unit_quaternions())),
        position=draw(vectors()),
        focal_px=np.array(draw(numbers(15, 40))),
        principal_point_px=np.array([width, height]) / 2 + draw(many(2, -4, 4)),
        skew_px=np.array(draw(wanted)),
        pixel_aspect=np.array(2 ** (draw(wanted) / 2)),
        radial=np.zeros(3),
        tangential=np.zeros(2),
    )


@st.composite
def gaussians(draw, count: int = GAUSSIANS):
    """Gaussians in front of a camera at the origin that looks along z.

    Balls, needles and flat ones, of standard deviations from 1e-4 to 2; quaternions of
    any length and sign. Depths, from 3 to 5, are in order of the rows and at least
    0.02 apart, so that no rounding reorders them. Opacities are at least 1e-3: above
    the cut of `exactly`, whose crossing would be a jump.
    """
    across = draw(many((count, 2), -1.5, 1.5))
    depth = 3 + 2 * (np.arange(count) + 0.9 * draw(many(count, 0, 1))) / count
    quaternion = np.stack([draw(quaternions()) for _ in range(count)])
    return Gaussians(
        mean=np.concatenate([across, depth[:, None]], axis=1),
        quaternion=quaternion,
        scale=10.0 ** draw(many((count, 3), -4, 0.3)),
        opacity=draw(many(count, 1e-3, 1)),
    )


def moved(gaussians_: Gaussians, motion: Motion) -> Gaussians:
    """The same Gaussians in a world that was moved."""
    return gaussians_._replace(
        mean=gaussians_.mean @ motion.rotation.T + motion.translation,
        quaternion=times(motion.quaternion, gaussians_.quaternion),
    )


def moved_camera(camera: Camera, motion: Motion) -> Camera:
    """The camera that moved with its world."""
    return camera._replace(
        camera_from_world=camera.camera_from_world @ motion.rotation.T,
        position=motion.rotation @ camera.position + motion.translation,
    )


@st.composite
def optical_depths(draw, samples: int = 8):
    """Density times length: zero, thin air from 1e-30, and opaque up to 1e6."""
    return np.array([draw(magnitudes(high=1e6)) for _ in range(samples)])


@st.composite
def distances(draw, samples: int = 8):
    """Sorted distances along a ray from 0.1; some may be equal."""
    steps = [draw(magnitudes(1e-6, 1.0)) for _ in range(samples)]
    return 0.1 + np.cumsum(steps)
