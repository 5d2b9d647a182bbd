"""Motion as few rigid motions over time, with weights of each Gaussian.

Each basis is a rotation and a translation about a center at knots in time, interpolated
by a Catmull-Rom spline. A Gaussian moves by the mean of the bases under its softmax
weights, one of which is for a static basis. This is the form of Shape of Motion (Wang
et al. 2024, arXiv:2407.13764), which has a basis pose for each frame and no static
basis. With zero rotations and translations nothing moves, exactly.

Two splines are added. One with many knots is initialized from tracks. One with few
knots learns ten times faster from images, with less noise. Compared with the former
alone, on three seeds of the built-in scene, PSNR is 0.3 dB higher, 0.7 in moving
regions, and the error of tracked points is 0.0074 instead of 0.0085 scene units
(`docs/results/ablate_tracked.md`). Ten knots alone are even better in that scene (one
seed, 900 steps: 33.27 / 29.94 dB, 0.0060), but fifteen are too stiff for a hand in
front of books: 37.12 dB, 33.12 in moving regions, instead of 37.56 and 34.18.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core import splats, time_knots
from gaussians_jax.core.metadata import Number, SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.init.motion_fit import Guess, Paths, Points, captured
from gaussians_jax.motion.bound import BoundMotion
from nerfies_jax.geometry import lie
from nerfies_jax.geometry.fusion import components, stacked
from nerfies_jax.geometry.jacobi import dot
from nerfies_jax.geometry.precision import exact_einsum, exact_product
from nerfies_jax.preprocessing import rigid_groups
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.step_counts import steps

NAME = "se3_bases"
MEMBER_LOGIT, STILL_LOGIT = 3.0, -6.0  # of a moving point, before the fit to tracks
SMOOTHNESS, TURN_SMOOTHNESS = 0.02, 0.002  # weights of second differences of knots
# Weights of first differences of knots between which no path of a basis is known. With
# second differences alone, the last velocity would continue beyond the last track.
HOLD, TURN_HOLD = 0.2, 0.02


@dataclasses.dataclass(frozen=True)
class SE3BasesSpec:
    """Number of bases and knots, and their learning rates.

    `still_logit` is the initial logit of the static basis. With 4, static points move
    by 13 % of their neighbors' motion, with 9 by 0.1 %. With 100 they could never move:
    35.5 instead of 36.7 dB on a video of a hand in front of books whose camera poses
    are wrong by half a pixel. The rate of translations is in scene extents.
    """

    bases: int = 8
    knots: int = 20  # evenly spaced over the video
    coarse_knots: int = 10  # of the spline that learns from images; 0 disables it
    fine_rate: float = 0.1  # learning rate of the other spline, relative
    still_logit: float = 9.0
    logit_rate: float = 1e-2
    learning_rate: float = 1e-3  # of rotations (rad) and translations
    learning_rate_end: float = 1e-4
    warm_up: int = steps(0)  # steps without motion; none, because it starts from tracks

    def __post_init__(self):
        if self.bases < 1:
            raise ValueError(f"bases={self.bases} must be at least 1")
        if self.knots < 2:
            raise ValueError(
                f"knots={self.knots} must be at least two, at the first and the last "
                "frame time"
            )
        if self.coarse_knots < 2 and self.coarse_knots != 0:
            raise ValueError(
                f"coarse_knots={self.coarse_knots} must be at least two, or 0 to "
                "disable the coarse spline"
            )
        if not 0 <= self.fine_rate <= 1:
            raise ValueError(
                f"fine_rate={self.fine_rate} must lie in [0, 1], because it is "
                "relative to learning_rate"
            )
        if self.logit_rate <= 0:
            raise ValueError(f"logit_rate={self.logit_rate} must be positive")
        if self.warm_up < 0:
            raise ValueError(f"warm_up={self.warm_up} must not be negative")
        schedules.check_falling(self.learning_rate, self.learning_rate_end)

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` on this capture."""
        return Bound(self, run_steps, metadata.extent)


class Poses(NamedTuple):
    """Rotations and translations at knots that are evenly spaced over [0, 1]."""

    turn: Float[Array, "bases knots 3"]  # rotation vectors, rad
    shift: Float[Array, "bases knots 3"]  # scene units


class Bases(NamedTuple):
    """The rigid motions: x maps to center + R(turn) (x - center) + shift.

    `turn` and `shift` are the sums of the two splines.
    """

    fine: Poses
    coarse: Poses
    center: Float[Array, "bases 3"]  # scene units


class Motion(NamedTuple):
    """All bases at one time, as x -> x + linear x + offset."""

    turn: Float[Array, "bases 3"]
    linear: Float[Array, "bases 3 3"]  # R - 1
    offset: Float[Array, "bases 3"]


@functools.partial(jax.jit, static_argnums=(1, 2))
def init(
    key: Key[Array, ""], spec: SE3BasesSpec, dtype: DTypeLike = jnp.float32
) -> Bases:
    """Initialize bases with small motions. Equal bases would get equal gradients.

    Args:
      key: PRNG key.
      spec: Settings of the motion.
      dtype: Type of the parameters.

    Returns:
      The bases.
    """
    shape = (spec.bases, spec.knots, 3)
    shift = 1e-3 * jax.random.normal(key, shape, dtype)
    fine = Poses(jnp.zeros(shape, dtype), shift)
    zero = jnp.zeros((spec.bases, spec.coarse_knots, 3), dtype)
    return Bases(fine, Poses(zero, zero), jnp.zeros((spec.bases, 3), dtype))


def init_logits(spec: SE3BasesSpec, gaussians: int, dtype: DTypeLike = jnp.float32):
    """Initialize logits [gaussians, 1 + bases] of static Gaussians.

    Args:
      spec: Settings of the motion.
      gaussians: Number of Gaussians.
      dtype: Type of the logits.

    Returns:
      The logits. The first column belongs to the static basis.
    """
    # On the host, because the number of Gaussians depends on the capture.
    logits = np.zeros((gaussians, 1 + spec.bases), dtype)
    logits[:, 0] = spec.still_logit
    return jax.device_put(logits)


def at_time(bases: Bases, time: Float[Array, ""]) -> Motion:
    """Evaluate the rigid motions of all bases at one time.

    R - 1 is computed without cancellation, so that small rotations are accurate.

    Args:
      bases: The bases.
      time: Normalized time.

    Returns:
      The rigid motions.
    """
    levels = [spline for spline in (bases.fine, bases.coarse) if spline.turn.shape[1]]
    tables = jnp.concatenate(
        [jnp.concatenate(spline, axis=-1) for spline in levels], axis=1
    )
    weights = [
        time_knots.spline_weights(spline.turn.shape[1], time) for spline in levels
    ]
    pose = exact_einsum("k,bkc->bc", jnp.concatenate(weights), tables)
    turn, shift = pose[:, :3], pose[:, 3:]
    axes, zero = jnp.eye(3, dtype=turn.dtype), jnp.zeros_like(turn[0])
    displacement = jax.vmap(lie.displacement, (None, None, 0))
    linear = jnp.swapaxes(
        jax.vmap(displacement, (0, None, None))(turn, zero, axes), 1, 2
    )
    return Motion(
        turn, linear, shift - exact_einsum("bij,bj->bi", linear, bases.center)
    )


def deform(
    motion: Motion, logits: Float[Array, "gaussians weights"], gaussians: Gaussians
) -> Gaussians:
    """Move Gaussians by the mean of the bases under their weights.

    Means move by the mean of the rigid motions (linear blend skinning), and rotate by
    the mean of the rotation vectors.

    Args:
      motion: The rigid motions at a time.
      logits: Logits of the weights, the static basis first.
      gaussians: Gaussians in their canonical state.

    Returns:
      The moved Gaussians.
    """
    weights = jax.nn.softmax(logits, axis=-1)[:, 1:]
    rows = len(motion.turn)
    flat = jnp.concatenate([motion.linear.reshape(rows, 9), motion.offset], axis=-1)
    table = jnp.concatenate([flat, motion.turn], axis=-1)
    blend, mean = components(exact_product(weights, table)), components(gaussians.mean)
    linear, offset, turn = blend[:9], blend[9:12], stacked(blend[12:])
    new_mean = [
        coordinate + (dot(linear[3 * i : 3 * i + 3], mean) + offset[i])
        for i, coordinate in enumerate(mean)
    ]
    return gaussians._replace(
        mean=stacked(new_mean), quaternion=splats.rotate(gaussians, turn)
    )


def fit_to_paths(spec: SE3BasesSpec, paths: Paths) -> Guess:
    """Group points into rigid bodies, with one basis for each, on the host.

    Args:
      spec: Settings.
      paths: 3D paths of points.

    Returns:
      Initial guess of a fit.
    """
    times, position, valid, unit, *_ = paths
    canonical_frame = len(times) // 2
    label = rigid_groups.labels(position, valid, spec.bases)
    bodies = rigid_groups.motion(position, valid, label, canonical_frame)
    canonical, middle = rigid_groups.centers(position, valid, bodies)
    turn = rigid_groups.rotation_vectors(bodies.rotation, canonical_frame)
    middle_path = np.einsum("gtij,gj->gti", bodies.rotation, middle) + bodies.shift
    turn = _at_knots(rigid_groups.smoothed(turn), times, spec)
    shift = _at_knots(rigid_groups.smoothed(middle_path - middle[:, None]), times, spec)
    middle = np.concatenate([middle, np.zeros((spec.bases - len(middle), 3))])
    zero = np.zeros((spec.bases, spec.coarse_knots, 3))
    fine, coarse = Poses._make((turn, shift)), Poses._make((zero, zero))
    bases = Bases._make((fine, coarse, middle))
    bases = jax.tree.map(captured, bases)
    logits = np.zeros((len(position), 1 + spec.bases), np.float32)
    logits[:, 0] = STILL_LOGIT
    logits[np.arange(len(position)), 1 + label] = MEMBER_LOGIT
    guess = Points(captured(canonical), captured(logits), bases)
    unknown = captured(~_supported_intervals(times, valid, label, spec))
    scale = captured(unit)

    def penalty(points, _times):
        def bend(table):
            if table.shape[1] < 3:  # two knots have no second difference
                return jnp.zeros((), table.dtype)
            return jnp.mean(jnp.abs(table[:, 2:] - 2 * table[:, 1:-1] + table[:, :-2]))

        fine = points.nets.fine
        shift, turn = bend(fine.shift) / scale, bend(fine.turn)
        return SMOOTHNESS * shift + TURN_SMOOTHNESS * turn + change_where_unknown(fine)

    def change_where_unknown(fine):
        def steps(table):
            return jnp.mean(unknown[..., None] * jnp.abs(jnp.diff(table, axis=1)))

        return HOLD * steps(fine.shift) / scale + TURN_HOLD * steps(fine.turn)

    fine_rates, coarse_rates = Poses._make((3.0, unit)), Poses._make((0.0, 0.0))
    base_rates = Bases._make((fine_rates, coarse_rates, 0.0))
    rates = Points._make((unit, 10.0, base_rates, None))
    return Guess(guess, rates, penalty, rigid=True)


def _supported_intervals(times, valid, label, spec):
    """Find the intervals between knots in which a path of each basis is known.

    An interval that contains no frame time belongs to the frame nearest to its middle.

    Returns booleans [bases, knots - 1]. Bases without paths are not restricted.
    """
    edges = np.linspace(0, 1, spec.knots)
    middle = (edges[1:] + edges[:-1]) / 2
    inside = np.abs(times - middle[:, None]) <= (edges[1] - edges[0]) / 2 + 1e-6
    nearest = np.argmin(np.abs(times - middle[:, None]), axis=1)
    inside[np.arange(len(middle)), nearest] = True
    is_supported = np.ones((spec.bases, spec.knots - 1), bool)
    for group in np.unique(label):
        is_supported[group] = (inside & valid[label == group].any(0)).any(1)
    return is_supported


def _at_knots(track, times, spec):
    """Interpolate values at the knots: [bases, knots, 3], zero without a group."""
    knots = np.linspace(0, 1, spec.knots)
    table = np.zeros((spec.bases, spec.knots, 3))
    for group, one in enumerate(track):
        for axis in range(3):
            table[group, :, axis] = np.interp(knots, times, one[:, axis])
    return table


@dataclasses.dataclass(frozen=True)
class Bound(BoundMotion):
    """The `Motion` of a `SE3BasesSpec` in a run of `steps`."""

    spec: SE3BasesSpec
    extent: Number  # of the scene, the unit of translations, in scene units

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of logits and bases."""
        # Centers are fixed, because a center and a shift are redundant.
        rate = self.rate(step)
        coarse = Poses(rate, self.extent * rate)
        fine = jax.tree.map(lambda rate: self.spec.fine_rate * rate, coarse)
        bases = Bases(fine, coarse, jnp.zeros_like(rate))
        return MotionParams(jnp.full((), self.spec.logit_rate), bases)

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize the bases, and logits without motion."""
        _, shared_key = jax.random.split(key)
        mean = gaussians.mean
        logits = init_logits(self.spec, len(mean), mean.dtype)
        return MotionParams(logits, init(shared_key, self.spec))

    def apply(
        self,
        params: MotionParams,
        cache: None,
        gaussians: Gaussians,
        frame: FrameCondition,
    ) -> Gaussians:
        """Move the Gaussians to their state at a time."""
        motion = at_time(params.shared, frame.time)
        return deform(motion, params.per_gaussian, gaussians)

    def fit(self, paths: Paths, key: Key[Array, ""]) -> Guess:
        """Fit groups of points in closed form, to start a fit of all points from."""
        return fit_to_paths(self.spec, paths)
