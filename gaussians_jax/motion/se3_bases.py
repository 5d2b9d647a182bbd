"""Motion as few rigid motions over time, and weights that say who takes part in which.

Each basis is a turn and a shift about a center of its own at knots in time, with a
Catmull-Rom spline between them. A Gaussian moves by the mean of the bases under softmax
weights of its own, one of which stands for staying where it is. The form of Shape of
Motion (Wang et al. 2024, arXiv:2407.13764), which has a basis for each frame and no
entry for what is still. Where nothing turns or shifts, nothing moves, exactly.

Two splines are added: one of many knots takes over what tracks know, one of few learns
ten times faster from pictures, and less of their noise. Against the former alone, three
seeds of the built-in scene: 0.3 dB more, 0.7 where it moves, points 0.0074 units off
for 0.0085 (`docs/results/ablate_tracked.md`). Ten knots alone are better still there
(one seed, 900 steps: 33.27 / 29.94 dB, 0.0060), but fifteen are too stiff for a hand
before books: 37.12 dB, 33.12 where it moves, for 37.56 and 34.18.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from gaussians_jax.core import splats, time_knots
from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Gaussians, Splats
from gaussians_jax.init.path_fit import Guess, Paths, Points
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
MEMBER_LOGIT, STILL_LOGIT = 3.0, -6.0  # of a moving point, before the fit to paths
SMOOTHNESS, TURN_SMOOTHNESS = 0.02, 0.002  # weights of second differences of knots


@dataclasses.dataclass(frozen=True)
class SE3BasesSpec:
    """Number of bases and knots, and their learning rates.

    `still_logit` is the initial logit of the static basis. From 4 on static points keep
    13 % of their neighbors' motion, from 9 on 0.1 %. At 100 they could never move: 35.5
    instead of 36.7 dB on a video of a hand in front of books, whose cameras are wrong
    by half a pixel. The rate of translations is in scene extents.
    """

    bases: int = 8
    knots: int = 20  # evenly over the film
    coarse_knots: int = 10  # of the spline that pictures change; 0: there is none
    fine_rate: float = 0.1  # what the other learns with, a share of the rate
    still_logit: float = 9.0
    logit_rate: float = 1e-2
    learning_rate: float = 1e-3  # of turns (rad) and shifts
    learning_rate_end: float = 1e-4
    warm_up: int = steps(0)  # steps without motion: none, for it starts from tracks

    def __post_init__(self):
        if self.bases < 1:
            raise ValueError(f"bases={self.bases}: a motion has at least one basis")
        if self.knots < 2:
            raise ValueError(
                f"knots={self.knots}: a motion has at least two, its first and its "
                "last instant"
            )
        if self.coarse_knots < 2 and self.coarse_knots != 0:
            raise ValueError(
                f"coarse_knots={self.coarse_knots}: a spline has at least two, or "
                "none (0)"
            )
        if not 0 <= self.fine_rate <= 1:
            raise ValueError(
                f"fine_rate={self.fine_rate} is a share of the rate, from 0 to 1"
            )
        if self.logit_rate <= 0:
            raise ValueError(f"logit_rate={self.logit_rate} must be positive")
        if self.warm_up < 0:
            raise ValueError(f"warm_up={self.warm_up} must not be negative")
        schedules.check_falling(self.learning_rate, self.learning_rate_end)

    def bind(self, run_steps: int, metadata: SceneMetadata) -> "Bound":
        """Return the motion for a run of `run_steps` of this capture."""
        return Bound(self, run_steps, metadata.extent)


class Poses(NamedTuple):
    """Turns and shifts at knots that lie evenly over [0, 1]."""

    turn: Float[Array, "bases knots 3"]  # rotation vectors, rad
    shift: Float[Array, "bases knots 3"]  # scene units


class Bases(NamedTuple):
    """The rigid motions: x goes to center + R(turn) (x - center) + shift.

    Turn and shift are the sums of the two splines.
    """

    fine: Poses
    coarse: Poses
    center: Float[Array, "bases 3"]  # scene units


class Motion(NamedTuple):
    """All bases at one time, as x -> x + linear x + offset."""

    turn: Float[Array, "bases 3"]
    linear: Float[Array, "bases 3 3"]  # R - 1
    offset: Float[Array, "bases 3"]


def init(key: Key[Array, ""], spec: SE3BasesSpec, dtype=jnp.float32) -> Bases:
    """Bases that hardly move: were all alike, all would keep the same slopes."""
    shape = (spec.bases, spec.knots, 3)
    shift = 1e-3 * jax.random.normal(key, shape, dtype)
    fine = Poses(jnp.zeros(shape, dtype), shift)
    none = jnp.zeros((spec.bases, spec.coarse_knots, 3), dtype)
    return Bases(fine, Poses(none, none), jnp.zeros((spec.bases, 3), dtype))


def init_logits(spec: SE3BasesSpec, gaussians: int, dtype=jnp.float32):
    """[gaussians, 1 + bases]: all stay where they are."""
    logits = jnp.zeros((gaussians, 1 + spec.bases), dtype)
    return logits.at[:, 0].set(spec.still_logit)


def at_time(bases: Bases, time: Float[Array, ""]) -> Motion:
    """The rigid motions of all bases at one time.

    R - 1 without the 1: a small turn keeps all its digits.
    """
    levels = [one for one in (bases.fine, bases.coarse) if one.turn.shape[1]]
    tables = jnp.concatenate([jnp.concatenate(one, axis=-1) for one in levels], axis=1)
    weights = [time_knots.spline_weights(one.turn.shape[1], time) for one in levels]
    now = exact_einsum("k,bkc->bc", jnp.concatenate(weights), tables)
    turn, shift = now[:, :3], now[:, 3:]
    axes, none = jnp.eye(3, dtype=turn.dtype), jnp.zeros_like(turn[0])
    turned = jax.vmap(lie.displacement, (None, None, 0))
    linear = jnp.swapaxes(jax.vmap(turned, (0, None, None))(turn, none, axes), 1, 2)
    return Motion(
        turn, linear, shift - exact_einsum("bij,bj->bi", linear, bases.center)
    )


def deform(
    motion: Motion, logits: Float[Array, "gaussians weights"], gaussians: Gaussians
) -> Gaussians:
    """Gaussians moved by the mean of the bases under their weights.

    Means move by the mean of the rigid motions (linear blend skinning), and turn by the
    mean of the rotation vectors.
    """
    weights = jax.nn.softmax(logits, axis=-1)[:, 1:]
    rows = len(motion.turn)
    flat = jnp.concatenate([motion.linear.reshape(rows, 9), motion.offset], axis=-1)
    table = jnp.concatenate([flat, motion.turn], axis=-1)
    mixed, mean = components(exact_product(weights, table)), components(gaussians.mean)
    linear, offset, turn = mixed[:9], mixed[9:12], stacked(mixed[12:])
    moved = [
        own + (dot(linear[3 * i : 3 * i + 3], mean) + offset[i])
        for i, own in enumerate(mean)
    ]
    return gaussians._replace(
        mean=stacked(moved), quaternion=splats.turned(gaussians, turn)
    )


def fit_to_paths(spec: SE3BasesSpec, paths: Paths) -> Guess:
    """Group points into rigid bodies, with one basis for each, on the host.

    Args:
      spec: Settings.
      paths: 3D paths of points.

    Returns:
      Initial guess of a fit.
    """
    times, position, known, unit, *_ = paths
    canonical_frame = len(times) // 2
    label = rigid_groups.labels(position, known, spec.bases)
    bodies = rigid_groups.motion(position, known, label, canonical_frame)
    canonical, middle = rigid_groups.centers(position, known, bodies)
    turn = rigid_groups.rotation_vectors(bodies.rotation, canonical_frame)
    moved = np.einsum("gtij,gj->gti", bodies.rotation, middle) + bodies.shift
    turn = _at_knots(rigid_groups.smoothed(turn), times, spec)
    shift = _at_knots(rigid_groups.smoothed(moved - middle[:, None]), times, spec)
    middle = np.concatenate([middle, np.zeros((spec.bases - len(middle), 3))])
    none = np.zeros((spec.bases, spec.coarse_knots, 3))
    fine, coarse = Poses._make((turn, shift)), Poses._make((none, none))
    bases = Bases._make((fine, coarse, middle))
    bases = jax.tree.map(lambda part: jnp.asarray(part, jnp.float32), bases)
    logits = np.zeros((len(position), 1 + spec.bases), np.float32)
    logits[:, 0] = STILL_LOGIT
    logits[np.arange(len(position)), 1 + label] = MEMBER_LOGIT
    guess = Points(jnp.asarray(canonical, jnp.float32), jnp.asarray(logits), bases)

    def penalty(points, _times):
        def bend(table):
            if table.shape[1] < 3:  # two knots are on a straight line
                return jnp.zeros((), table.dtype)
            return jnp.mean(jnp.abs(table[:, 2:] - 2 * table[:, 1:-1] + table[:, :-2]))

        fine = points.nets.fine
        shift, turn = bend(fine.shift) / unit, bend(fine.turn)
        return SMOOTHNESS * shift + TURN_SMOOTHNESS * turn

    fine_rates, coarse_rates = Poses._make((3.0, unit)), Poses._make((0.0, 0.0))
    base_rates = Bases._make((fine_rates, coarse_rates, 0.0))
    rates = Points._make((unit, 10.0, base_rates, None))
    return Guess(guess, rates, penalty, rigid=True)


def _at_knots(track, times, spec):
    """Interpolate values at the knots: [bases, knots, 3], static without a group."""
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
    extent: float  # of the scene, the unit of shifts, scene units

    name = NAME

    def learning_rate(self, step: Int[Array, ""]) -> MotionParams:
        """Evaluate the learning rates of logits and bases."""
        # A center and a shift say the same twice over; centers stay.
        now = self.rate(step)
        coarse = Poses(now, self.extent * now)
        fine = jax.tree.map(lambda own: self.spec.fine_rate * own, coarse)
        bases = Bases(fine, coarse, jnp.zeros_like(now))
        return MotionParams(jnp.full((), self.spec.logit_rate), bases)

    def init(self, key: Key[Array, ""], gaussians: Splats) -> MotionParams:
        """Initialize the bases, and logits with which nothing moves."""
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
        """Return a closed-form fit of groups of points, from which a fit starts."""
        return fit_to_paths(self.spec, paths)
