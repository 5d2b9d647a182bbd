"""Adaptive density control: clone small Gaussians, split large ones, prune faint ones.

Kerbl et al. 2023, arXiv:2308.04079, section 5.2, with the constants of its reference
implementation. Statistics are accumulated in the step (`observe`, pure). Events run on
the host between two chunks, because they may change the capacity. They decide in NumPy
and change parameters by one compiled gather per pair of capacities.
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from gaussians_jax.core import splats
from gaussians_jax.core.protocols import Population, StepInfo, StrategyEvent
from gaussians_jax.core.splats import Params, Splats
from gaussians_jax.optim import floaters
from gaussians_jax.optim import optimizer as row_optimizer
from gaussians_jax.optim.floaters import FloaterSpec
from nerfies_jax.geometry import quaternion
from nerfies_jax.training.step_counts import steps

PyTree = Any
FAINT_LOGIT = -20.0  # below it an opacity is halved by its series
KEPT, CLONED, CLONE, CHILD = 0, 1, 2, 3  # role of a Gaussian after the event


@dataclasses.dataclass(frozen=True)
class DefaultStrategySpec:
    """Settings of densification, pruning and opacity resets."""

    refine_every: int = 100  # steps
    refine_start_iter: int = steps(600)  # the first event (500 in the paper)
    refine_stop_iter: int = steps(15_000)
    grow_grad2d: float = 2e-4  # gradient of the projected mean, NDC units per view
    grow_scale3d: float = 0.01  # larger ones are split, as a share of the scene extent
    shrink: float = 1.6  # scale of a parent divided by that of its children
    prune_opa: float = 0.005
    prune_scale3d: float = 0.1  # larger ones are pruned, as a share of the scene extent
    prune_radius_px: float | None = None  # 20 in the paper, where it had no effect
    # Pruning by size starts after the first reset.
    reset_every: int = steps(3000)
    reset_opacity: float = 0.01
    cap_max: int = 1_000_000  # Gaussians
    revised_opacity: bool = False  # two halves have the opacity of the parent together
    floaters: FloaterSpec | None = None  # which are pruned in scenes without motion

    def __post_init__(self):
        if not 0 < self.prune_opa < self.reset_opacity < 1:
            raise ValueError(
                "opacities must satisfy 0 < prune < reset < 1, or a reset prunes "
                f"everything; got prune_opa={self.prune_opa} and "
                f"reset_opacity={self.reset_opacity}"
            )
        for name in ("refine_every", "reset_every", "cap_max"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"{name} must be at least 1, got {getattr(self, name)}"
                )
        if not self.shrink > 1:
            raise ValueError(
                f"shrink must be larger than 1, got {self.shrink}, because children "
                "are smaller than their parent"
            )

    def init(self, gaussians: Splats) -> "RowStats":
        """Return the statistics before any view."""
        return empty_stats(gaussians)

    def update(self, state: "RowStats", info: StepInfo) -> "RowStats":
        """Return the statistics after one more view."""
        return observe(
            state,
            info.mean2d_gradient,
            info.visible,
            info.radius_px,
            info.size,
            info.significance,
        )

    def events(self, steps: int) -> tuple[StrategyEvent, ...]:
        """Return the events of densification, with pruning, and of opacity resets."""
        last = min(self.refine_stop_iter, steps)
        grow = tuple(range(self.refine_start_iter, last, self.refine_every))
        resets = tuple(range(self.reset_every, last, self.reset_every))
        return (
            StrategyEvent("densify", grow, self._densify),
            StrategyEvent("reset opacity", resets, self._reset, changes_rows=False),
        )

    def _densify(self, population: Population) -> Population:
        stats, frames = population.state, population.frames
        if self.floaters is not None and frames is not None:
            size = frames.images.shape[2], frames.images.shape[1]
            rows = population.params.rows["splats"]
            floating = floaters.find(self.floaters, rows, frames.cameras, size)
            stats = stats._replace(active=np.asarray(stats.active) & ~floating)
        update = densify(
            population.optimizer,
            population.params,
            population.moments,
            stats,
            population.key,
            self,
            step=population.step,
            extent=population.extent,
        )
        return population._replace(params=update.params, moments=update.moments)

    def _reset(self, population: Population) -> Population:
        params, moments = reset_opacity(
            population.optimizer, population.params, population.moments, self
        )
        return population._replace(params=params, moments=moments)


class RowStats(NamedTuple):
    """Statistics of each Gaussian since the last event."""

    active: Bool[Array, " gaussians"]
    grad2d: Float[Array, " gaussians"]  # summed norms, NDC units
    views: Int[Array, " gaussians"]  # in which the Gaussian was visible
    radius_px: Float[Array, " gaussians"]  # largest in any view


class Report(NamedTuple):
    """Numbers of Gaussians that an event cloned, split, pruned or refused."""

    cloned: int = 0
    split: int = 0
    pruned: int = 0  # faint or too large
    broken: int = 0  # pruned because a value was not finite
    refused: int = 0  # not densified because the cap is reached
    relocated: int = 0
    active: int = 0
    capacity: int = 0


class Changed(NamedTuple):
    """Per-Gaussian state after an event."""

    params: Params
    moments: PyTree
    stats: RowStats
    report: Report


@jax.jit
def empty_stats(rows: Splats) -> RowStats:
    """Return the statistics before any view.

    Args:
      rows: The Gaussians.

    Returns:
      Zeros, with the active Gaussians marked.
    """
    like = rows.opacity_logit
    return RowStats(
        active=splats.active_mask(rows),
        grad2d=jnp.zeros_like(like),
        views=jnp.zeros(like.shape, jnp.int32),
        radius_px=jnp.zeros_like(like),  # a separate buffer, because all are donated
    )


def observe(
    stats: RowStats,
    mean2d_gradient_px: Float[Array, "rendered 2"],
    visible: Bool[Array, " rendered"],
    radius_px: Float[Array, " rendered"],
    size: tuple[int, int],
    significance: Float[Array, " rendered"] | None = None,
) -> RowStats:
    """Add one view to the statistics.

    Thresholds are in normalized device coordinates. A pixel is 2/width of their range,
    so gradients are multiplied by width/2 and height/2. Each view of a batch counts
    separately. 4DGS, E-D3DGS and ADC-GS add the gradients of the mean loss and count a
    batch once. For two views that is as large if both gradients agree, and half if only
    one view shows the Gaussian.

    Args:
      stats: Statistics so far.
      mean2d_gradient_px: Gradient of the view's own loss (not of the mean over a
        batch) with respect to the projected means in pixels. For the absolute variant,
        the sum of its absolute values over the pixels.
      visible: True where the Gaussian overlaps the image.
      radius_px: Radius of the footprint in pixels.
      size: (width, height) of the image in pixels.
      significance: Weights of child Gaussians, if each parent has several. A parent
        counts the weighted mean gradient of its visible children, and the largest
        radius.

    Returns:
      The new statistics.
    """
    width, height = size
    per_ndc = jnp.asarray([width / 2, height / 2], mean2d_gradient_px.dtype)
    grad = mean2d_gradient_px * per_ndc
    # Summed squares underflow in float32 below 1e-19, hypot does not.
    norm = jnp.where(visible, jnp.hypot(grad[:, 0], grad[:, 1]), 0)
    radius_px = jnp.where(visible, radius_px, 0)
    rows = stats.active.shape[0]
    if len(norm) != rows:
        norm, visible, radius_px = (
            leaf.reshape(rows, -1) for leaf in (norm, visible, radius_px)
        )
        weight = visible.astype(norm.dtype)
        if significance is not None:
            weight = weight * significance.reshape(rows, -1)
        total = jnp.sum(weight, axis=1)
        # Without visible children there is no gradient.
        norm = jnp.sum(weight * norm, axis=1) / jnp.where(total > 0, total, 1)
        visible = jnp.any(visible, axis=1)
        radius_px = jnp.max(radius_px, axis=1)
    return RowStats(
        active=stats.active,
        grad2d=stats.grad2d + norm,
        views=stats.views + visible.astype(jnp.int32),
        radius_px=jnp.maximum(stats.radius_px, radius_px),
    )


def densify(
    optimizer: optax.GradientTransformation,
    params: Params,
    moments: PyTree,
    stats: RowStats,
    key: Key[Array, ""],
    spec: DefaultStrategySpec,
    *,
    step: int,
    extent: float,
) -> Changed:
    """Clone, split and prune Gaussians, on the host.

    A Gaussian is densified if its mean gradient per view reaches the threshold: a small
    one is cloned, and a large one is replaced by two samples from it. If the cap does
    not suffice for all, those with the largest gradient are chosen. A component with
    its own score scales `stats.grad2d` first. New Gaussians have zero moments.

    Args:
      optimizer: The optimizer.
      params: All parameters.
      moments: State of the optimizer.
      stats: Statistics since the last event.
      key: PRNG key of the samples.
      spec: Settings.
      step: Number of completed steps.
      extent: Scene extent (`splats.scene_extent`).

    Returns:
      The changed state and a report.
    """
    rows, kind, report = _plan(params.rows["splats"], stats, spec, step, extent)
    count, capacity = len(rows), stats.active.shape[0]
    new_capacity = splats.capacity_for(count, spec.cap_max)
    # Shrinks by two buckets only, so that small changes of the count do not recompile.
    if new_capacity > capacity or count * 9 < capacity * 4:
        capacity = new_capacity
    padding = capacity - count
    params, moments, fresh = _rebuild(
        optimizer,
        params,
        moments,
        np.pad(rows, (0, padding)).astype(np.int32),
        np.pad(kind, (0, padding)).astype(np.int32),
        np.arange(capacity) >= count,
        key,
        spec.shrink,
        spec.revised_opacity,
    )
    report = report._replace(active=count, capacity=capacity)
    return Changed(params, moments, fresh, report)


def _plan(rows, stats, spec, step, extent):
    """Choose the source of each new Gaussian, and its role."""
    stats = jax.tree.map(np.asarray, stats)
    finite, opacity, scale = map(np.asarray, row_summary(rows))
    score = stats.grad2d / np.maximum(stats.views, 1)

    keeps = stats.active & finite & (opacity >= spec.prune_opa)
    grows = keeps & (score >= spec.grow_grad2d)
    splits = grows & (scale > spec.grow_scale3d * extent)
    large = np.zeros_like(keeps)
    if step > spec.reset_every:
        bound = spec.prune_scale3d * extent
        large = scale > bound
        if spec.prune_radius_px is not None:
            large |= stats.radius_px > spec.prune_radius_px
        keeps &= np.where(splits, scale / spec.shrink <= bound, ~large)
    grows &= keeps
    free_slots = max(spec.cap_max - int(keeps.sum()), 0)
    candidates = np.flatnonzero(grows)
    best = candidates[np.argsort(-score[candidates], kind="stable")][:free_slots]
    selection = np.zeros_like(grows)
    selection[best] = True
    splits &= selection
    keeps &= splits | ~large  # large ones that the cap prevents from splitting stay

    clones = np.flatnonzero(selection & ~splits)
    parents = np.flatnonzero(splits)
    kept_rows = np.flatnonzero(keeps & ~splits)
    source = np.concatenate([kept_rows, clones, np.repeat(parents, 2)])
    kind = np.concatenate(
        [
            np.where(np.isin(kept_rows, clones), CLONED, KEPT),
            np.full(len(clones), CLONE),
            np.full(2 * len(parents), CHILD),
        ]
    )
    broken_count = int((stats.active & ~finite).sum())
    report = Report(
        cloned=len(clones),
        split=len(parents),
        pruned=int((stats.active & ~keeps).sum()) - broken_count,
        broken=broken_count,
        refused=len(candidates) - len(best),
    )
    return source, kind, report


@jax.jit
def row_summary(rows):
    """Return whether each Gaussian is finite, its opacity, and its largest scale.

    Args:
      rows: Raw parameters.

    Returns:
      Three arrays [gaussians].
    """

    def is_finite(leaf):
        return jnp.all(jnp.isfinite(leaf.reshape(leaf.shape[0], -1)), axis=1)

    finite = functools.reduce(jnp.logical_and, map(is_finite, rows))
    gaussians = splats.activate(rows)
    return finite, gaussians.opacity, jnp.max(gaussians.scale, axis=1)


@functools.partial(jax.jit, static_argnames=("optimizer", "shrink", "revised"))
def _rebuild(optimizer, params, moments, rows, kind, inactive, key, shrink, revised):
    fresh = (kind == CLONE) | (kind == CHILD)
    params, moments = row_optimizer.gather_rows(
        optimizer, params, moments, rows, fresh, inactive
    )
    split = _split_rows(params.rows["splats"], kind == CHILD, key, shrink)
    if revised:
        half_logit = halve_opacity(split.opacity_logit)
        logit = jnp.where((kind == KEPT) | inactive, split.opacity_logit, half_logit)
        split = split._replace(opacity_logit=logit)
    params = params._replace(rows=params.rows | {"splats": split})
    return params, moments, empty_stats(split)


def _split_rows(
    rows: Splats,
    child: Bool[Array, " gaussians"],
    key: Key[Array, ""],
    shrink: float,
) -> Splats:
    """Sample children from the Gaussians that they duplicate, and shrink them."""
    gaussians = splats.activate(rows)
    noise = jax.random.normal(key, rows.mean.shape, rows.mean.dtype)
    offset = jax.vmap(quaternion.rotate)(rows.quaternion, gaussians.scale * noise)
    child = child[:, None]
    return rows._replace(
        mean=jnp.where(child, rows.mean + offset, rows.mean),
        log_scale=jnp.where(child, rows.log_scale - math.log(shrink), rows.log_scale),
    )


def halve_opacity(logit: Float[Array, " n"]) -> Float[Array, " n"]:
    """Compute the logit of 1 - sqrt(1 - o), two of which together have opacity o.

    Args:
      logit: Opacity logits.

    Returns:
      Corrected logits.

    References:
      Rota Bulò et al. 2024 (arXiv:2404.06109), opacity correction after cloning.
    """
    faint = logit < FAINT_LOGIT
    # l - log 2 - e^l / 4, with an error of e^2l. The closed form is log 0 below -88 in
    # float32.
    low = jnp.where(faint, logit, FAINT_LOGIT)
    series = low - math.log(2) - jnp.exp(low) / 4
    # log sqrt(1 - o) without 1 - o, which is 0 above a logit of 17 in float32.
    half = jax.nn.log_sigmoid(-jnp.where(faint, 0, logit)) / 2
    return jnp.where(faint, series, jnp.log(-jnp.expm1(half)) - half)


def reset_opacity(
    optimizer: optax.GradientTransformation,
    params: Params,
    moments: PyTree,
    spec: DefaultStrategySpec,
) -> tuple[Params, PyTree]:
    """Clamp opacities to `spec.reset_opacity`, and reset the moments of the opacities.

    If Gaussians have children, only the shared opacity is clamped, and a child may
    exceed the bound. Inactive Gaussians stay inactive. With the renderer's cutoff of
    1/255, a Gaussian reset to 0.01 gets gradients only within 1.37 standard deviations.

    Args:
      optimizer: The optimizer.
      params: All parameters.
      moments: State of the optimizer.
      spec: Settings.

    Returns:
      Parameters and optimizer state.
    """
    rows = params.rows["splats"]
    bound = math.log(spec.reset_opacity / (1 - spec.reset_opacity))
    new_rows = rows._replace(opacity_logit=jnp.minimum(rows.opacity_logit, bound))
    params = params._replace(rows=params.rows | {"splats": new_rows})
    mask = jax.tree.map(lambda _: False, params)
    opacity_only = mask.rows["splats"]._replace(opacity_logit=True)
    mask = mask._replace(rows=mask.rows | {"splats": opacity_only})
    moments = row_optimizer.map_moments(optimizer, jnp.zeros_like, moments, mask)
    return params, moments
