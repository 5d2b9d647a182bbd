"""Settings of a scene of Gaussians, and the components that they enable."""

import dataclasses
import math

from gaussians_jax.core import components
from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import (
    Appearance,
    CameraOptimizer,
    GaussianAppearance,
    Motion,
    Strategy,
)
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.init.points import InitSpec, StartSpec
from gaussians_jax.losses import flow as motion_flow
from gaussians_jax.losses import neighbors
from gaussians_jax.losses.acceleration import AccelerationSpec
from gaussians_jax.losses.depth import DepthSpec
from gaussians_jax.losses.flow import FlowSpec
from gaussians_jax.losses.neighbors import NeighborSpec
from gaussians_jax.losses.opacity_scale import OpacityScaleSpec
from gaussians_jax.losses.point_depth import PointDepthSpec
from gaussians_jax.losses.smooth_depth import SmoothDepthSpec
from gaussians_jax.losses.spectral import SpectralSpec
from gaussians_jax.losses.transients import TransientMaskSpec
from gaussians_jax.motion import carried, time_basis
from gaussians_jax.motion import embedding as embedding_motion
from gaussians_jax.motion import kan as kan_motion
from gaussians_jax.motion import mlp as mlp_motion
from gaussians_jax.motion.anchors import AnchorMotionSpec
from gaussians_jax.motion.basis import BasisMotionSpec
from gaussians_jax.motion.carried import CarriedSpec
from gaussians_jax.motion.embedding import EmbeddingMotionSpec
from gaussians_jax.motion.growth import MotionGrowthSpec, MotionGuided
from gaussians_jax.motion.kan import KanMotionSpec
from gaussians_jax.motion.mlp import MotionSpec
from gaussians_jax.motion.nodes import NodeMotionSpec
from gaussians_jax.motion.planes import PlaneMotionSpec
from gaussians_jax.motion.polynomial import PolynomialMotionSpec
from gaussians_jax.motion.se3_bases import SE3BasesSpec
from gaussians_jax.motion.splines import SplineMotionSpec
from gaussians_jax.motion.temporal_opacity import TemporalOpacitySpec
from gaussians_jax.motion.time_basis import TimeBasisSpec
from gaussians_jax.optim import phases
from gaussians_jax.optim.densification import DefaultStrategySpec
from gaussians_jax.optim.learning_rates import LearningRateSpec
from gaussians_jax.optim.mcmc import MCMCStrategySpec
from gaussians_jax.optim.optimizer import scale_by_row_adam, scale_by_row_radam
from gaussians_jax.optim.phases import AlternationSpec, AnnealingSpec
from gaussians_jax.per_frame.appearance import AppearanceSpec
from gaussians_jax.per_frame.exposure import ExposureSpec
from gaussians_jax.per_frame.poses import PoseRefinementSpec
from gaussians_jax.splatting.raster_spec import RasterSpec
from nerfies_jax.training import step_counts
from nerfies_jax.training.extensions import Settings, check
from nerfies_jax.training.protocols import Optimizer, Regularizer

OPTIMIZERS = {"adam": scale_by_row_adam, "radam": scale_by_row_radam}
AnyMotion = (
    MotionSpec
    | KanMotionSpec
    | BasisMotionSpec
    | SE3BasesSpec
    | TimeBasisSpec
    | PolynomialMotionSpec
    | SplineMotionSpec
    | PlaneMotionSpec
    | EmbeddingMotionSpec
    | NodeMotionSpec
    | AnchorMotionSpec
)
# Parameters that `NeighborSpec` keeps similar among neighbors, by type of motion.
EMBEDDED = {
    KanMotionSpec: kan_motion.NAME,
    TimeBasisSpec: time_basis.NAME,
    EmbeddingMotionSpec: embedding_motion.NAME,
}


# Ends the messages that refuse a setting next to child Gaussians.
ALONE = "disable child Gaussians (carried=none, and a motion without anchors)"
# Settings that have no effect without a motion.
OF_MOTION = (
    "temporal_opacity",
    "alternation",
    "acceleration",
    "motion_growth",
    "flow",
)

PROTOCOLS = {
    "motion": Motion,
    "strategy": Strategy,
    "exposure": Appearance,
    "appearance": GaussianAppearance,
    "poses": CameraOptimizer,
}
WITHOUT_NETWORKS = PolynomialMotionSpec, SplineMotionSpec  # only per-Gaussian params


@dataclasses.dataclass(frozen=True)
class SplatScene:
    """Settings of a scene of Gaussians, with `None` for disabled components."""

    steps: int
    batch_size: int = 1  # views per step; all rates are multiplied by its square root
    init: InitSpec = InitSpec()
    sh_degree: int = 3
    sh_every: int = step_counts.steps(1000)  # steps from one degree to the next
    dssim_weight: float = 0.2
    learning_rates: LearningRateSpec = LearningRateSpec()
    raster: RasterSpec = RasterSpec()
    strategy: DefaultStrategySpec | MCMCStrategySpec | Strategy | Settings | None = (
        DefaultStrategySpec()
    )
    optimizer: str | Optimizer = "adam"
    alternation: AlternationSpec | None = None
    annealing: AnnealingSpec | None = None
    motion: AnyMotion | Motion | Settings | None = None
    temporal_opacity: TemporalOpacitySpec | None = None
    carried: CarriedSpec | None = None  # child Gaussians, rendered in place of each
    start: StartSpec = StartSpec()
    acceleration: AccelerationSpec | None = None
    neighbors: NeighborSpec | None = None
    motion_growth: MotionGrowthSpec | None = None
    spectral: SpectralSpec | None = None
    depth: DepthSpec | None = None
    exposure: ExposureSpec | Appearance | Settings | None = None
    # The light of each photograph, in place of an exposure.
    appearance: AppearanceSpec | GaussianAppearance | Settings | None = None
    flow: FlowSpec | None = None
    opacity_scale: OpacityScaleSpec | None = None
    smooth_depth: SmoothDepthSpec | None = None
    point_depth: PointDepthSpec | None = None
    transients: TransientMaskSpec | None = None
    poses: PoseRefinementSpec | CameraOptimizer | Settings | None = None
    # In addition to those with a field of their own.
    regularizers: tuple[Regularizer | Settings, ...] = ()

    def __post_init__(self):
        for name, protocol in PROTOCOLS.items():
            if getattr(self, name) is not None:
                check(name, getattr(self, name), protocol)
        for regularizer in self.regularizers:
            check("regularizers", regularizer, Regularizer)
        if self.steps < 1:
            raise ValueError(f"steps={self.steps} must be at least 1")
        if self.batch_size < 1:
            raise ValueError(f"batch_size={self.batch_size} must be at least 1 view")
        if not 0 <= self.sh_degree <= 3:
            raise ValueError(f"sh_degree={self.sh_degree} must be 0, 1, 2 or 3")
        if self.sh_every < 1:
            raise ValueError(
                f"sh_every={self.sh_every} must be at least 1 step; 1 enables all "
                "degrees almost at once"
            )
        if not 0 <= self.dssim_weight <= 1:
            raise ValueError(f"dssim_weight={self.dssim_weight} must lie in [0, 1]")
        if isinstance(self.optimizer, str) and self.optimizer not in OPTIMIZERS:
            raise ValueError(
                f"unknown optimizer {self.optimizer!r}; choose from "
                f"{sorted(OPTIMIZERS)}"
            )


Scene = SplatScene  # the public name


def raster_of(spec: SplatScene, metadata: SceneMetadata) -> RasterSpec:
    """Adapt the settings of the rasterizer to a capture.

    The near plane is in front of all observed surfaces, and lens distortion is modeled
    if the cameras have any.

    Scenes with a distant background are small in the units of a box around all points.
    The default near plane of 0.01 would then be meters in front of the camera. A nearer
    plane is rounded down to a power of two, so that captures share compiled programs.

    Args:
      spec: Settings.
      metadata: Metadata of the capture.

    Returns:
      Settings of the rasterizer.
    """
    near = spec.raster.near
    if metadata.near < near:
        near = 2.0 ** math.floor(math.log2(metadata.near))
    has_distortion = spec.raster.distorted or metadata.distorted
    return dataclasses.replace(spec.raster, near=near, distorted=has_distortion)


def optimizer_of(spec: SplatScene) -> Optimizer:
    """Return the optimizer of a scene. Learning rates scale its updates.

    Args:
      spec: The scene.

    Returns:
      The optimizer.
    """
    optimizer = spec.optimizer
    return OPTIMIZERS[optimizer]() if isinstance(optimizer, str) else optimizer


def carried_count(spec: SplatScene) -> int | None:
    """Return the number of children per Gaussian, None without children.

    Args:
      spec: The scene.

    Returns:
      The number, or None.
    """
    if isinstance(spec.motion, AnchorMotionSpec):
        return spec.motion.count
    return None if spec.carried is None else spec.carried.count


def refuse_what_cannot_train(spec: SplatScene) -> None:
    """Raise ValueError if a component needs another one that is disabled.

    This is not checked when the settings are constructed, because a trained scene may
    be rendered without its motion.

    Args:
      spec: The scene.

    Raises:
      ValueError: If a setting would have no effect.
    """
    motion = spec.motion
    if motion is None:
        orphans = [name for name in OF_MOTION if getattr(spec, name) is not None]
        orphans += ["start.motion"] if spec.start.motion == "tracks" else []
        if orphans:
            raise ValueError(
                f"{' and '.join(orphans)} without a motion would have no effect; leave "
                "them out as well, or choose a preset with a motion"
            )
    if spec.alternation is not None and isinstance(motion, WITHOUT_NETWORKS):
        raise ValueError(
            "alternation updates the networks of a motion in turn, and "
            f"{type(motion).__name__} has none, so their turns would train nothing; "
            "leave it out as well (alternation=none)"
        )
    if spec.neighbors is not None:
        _embedding_name(motion)
    if (
        isinstance(motion, AnchorMotionSpec)
        and not motion.moves
        and spec.start.motion == "tracks"
    ):
        raise ValueError(
            'motion.moves=false with start.motion="tracks": static anchors have no '
            "motion to fit to tracks; leave one of them out"
        )
    _refuse_beside_children(spec)
    if motion is not None and getattr(spec.strategy, "floaters", None) is not None:
        raise ValueError(
            "strategy.floaters tests the positions of Gaussians that do not move, and "
            "this scene has a motion; leave it out as well (strategy.floaters=none)"
        )
    if spec.exposure is not None and spec.appearance is not None:
        raise ValueError(
            "exposure and appearance both model the light of a photograph, and a code "
            "can be fitted for one of them only; leave one out (exposure=none or "
            "appearance=none)"
        )
    warm_up = 0 if spec.start.motion == "tracks" else getattr(motion, "warm_up", 0)
    if warm_up and _fading(motion) is not None:
        raise ValueError(
            f"motion.warm_up={warm_up} with motion.fading: rendered opacities fade "
            "from the first step, but are trained only after the warm-up; leave one of "
            "them out (motion.warm_up=0 or motion.fading=none)"
        )
    _refuse_growth(spec, warm_up)
    if spec.annealing is not None:
        phases.annealed(lambda step: step, spec.annealing, spec.steps)
    if isinstance(motion, MotionSpec):
        mlp_motion.trunk_spec(motion)
    _refuse_late(spec, warm_up)


def _refuse_beside_children(spec):
    """Raise ValueError for settings that child Gaussians rule out."""
    has_children = carried_count(spec) is not None
    if has_children and isinstance(spec.strategy, MCMCStrategySpec):
        raise ValueError(
            "MCMCStrategySpec shares the opacity of a Gaussian among its copies, and "
            "parents of child Gaussians have none of their own; choose "
            f"DefaultStrategySpec, or {ALONE}"
        )
    if has_children and spec.flow is not None:
        raise ValueError(
            "the flow loss needs rendered Gaussians, and parents of child Gaussians "
            f"are not rendered; leave it out (flow=none), or {ALONE}"
        )
    if has_children and spec.appearance is not None:
        raise ValueError(
            "appearance has a feature for each Gaussian, and parents of child "
            f"Gaussians are not rendered; leave it out (appearance=none), or {ALONE}"
        )
    settings = {
        "temporal_opacity": spec.temporal_opacity,
        "motion.fading": _fading(spec.motion),
    }
    enabled_names = [name for name, value in settings.items() if value is not None]
    if has_children and enabled_names:
        raise ValueError(
            f"{enabled_names[0]} changes opacities over time, but child Gaussians are "
            "rendered with opacities of their own; leave it out "
            f"({enabled_names[0]}=none), or {ALONE}"
        )


def _refuse_growth(spec, warm_up):
    """Raise ValueError if motion-guided densification would have no effect."""
    growth = spec.motion_growth
    if growth is not None and not isinstance(spec.strategy, DefaultStrategySpec):
        raise ValueError(
            "motion_growth changes the gradient threshold of DefaultStrategySpec, "
            "which this scene does not use; leave it out as well (motion_growth=none)"
        )
    if growth is not None and growth.form == "hard" and growth.start <= warm_up:
        raise ValueError(
            f"motion_growth.start={growth.start} lies in the warm-up of the motion "
            f"(up to step {warm_up}), when nothing moves and therefore nothing would "
            "be densified; start it some hundred steps later"
        )


def _refuse_late(spec, warm_up):
    """Raise ValueError for components that would begin after the last step."""
    starts, motion = {"motion.warm_up": warm_up}, spec.motion
    parts = {
        "motion.rate": motion.rate if isinstance(motion, AnchorMotionSpec) else None,
        "neighbors": spec.neighbors,
        "acceleration": spec.acceleration,
        "flow": None if spec.start.motion == "tracks" else spec.flow,
    }
    starts |= {f"{name}.start": x.start for name, x in parts.items() if x is not None}
    for name, start in starts.items():
        # Step counts are at least 1, even in a run of one step.
        if start >= max(spec.steps, 2):
            raise ValueError(
                f"{name}={start} of {spec.steps} steps: it would never begin; lower it,"
                " or shorten the run with presets.with_steps, which scales all "
                "schedules with it"
            )


def _fading(motion):
    """Return the settings of opacity over time, or None if it is constant."""
    return motion.fading if isinstance(motion, PolynomialMotionSpec) else None


def _embedding_name(motion):
    """Return the name of the motion parameter that neighbors keep similar."""
    if type(motion) not in EMBEDDED:
        raise ValueError(
            "neighbors keep embeddings or coefficients similar, and this motion has "
            "none; leave them out (neighbors=none), or choose a preset with a KAN "
            "motion or a time basis"
        )
    return EMBEDDED[type(motion)]


def motion_of(spec: SplatScene, metadata: SceneMetadata) -> SplatRecord | None:
    """Return the motion of a scene. An initialization from tracks skips its warm-up.

    Args:
      spec: The scene.
      metadata: Scene metadata.

    Returns:
      The record, or None without motion.
    """
    motion = spec.motion
    if motion is None:
        return None
    if spec.start.motion == "tracks":
        motion = components.moving_at_once(motion)
    return components.motion_of_capture(motion, spec.steps, metadata)


def strategy_of(spec: SplatScene, metadata: SceneMetadata) -> Strategy | None:
    """Return the strategy of a scene, guided by its motion if the settings say so.

    Args:
      spec: The scene.
      metadata: Scene metadata.

    Returns:
      The strategy, or None for a fixed number of Gaussians.
    """
    if spec.strategy is None:
        return None
    strategy = components.bound(spec.strategy, spec.steps, metadata)
    if spec.motion_growth is None:
        return strategy
    return MotionGuided(strategy, spec.motion_growth, metadata.extent)


def effects_of(spec: SplatScene, metadata: SceneMetadata) -> tuple[SplatRecord, ...]:
    """Compile the components of a scene, in the order in which they act.

    Args:
      spec: Settings of the scene.
      metadata: Metadata of the capture.

    Returns:
      The records, the motion first if there is one.
    """

    def bound(part):
        return components.bound(part, spec.steps, metadata)

    motion = motion_of(spec, metadata)
    effects = [] if motion is None else [motion]
    if spec.temporal_opacity is not None:
        effects.append(components.compile_motion(bound(spec.temporal_opacity)))
    if spec.carried is not None:
        # Children rotate on their own as soon as their parents move.
        warm_up = 0 if motion is None else motion.warm_up
        effects.append(carried.effect(spec.carried, spec.steps, warm_up))
    early, late = _regularizers(spec, metadata, motion)
    effects += [components.compile_regularizer(one) for one in early]
    if spec.exposure is not None:
        effects.append(components.compile_appearance(bound(spec.exposure)))
    if spec.appearance is not None:
        effects.append(components.compile_gaussian_appearance(bound(spec.appearance)))
    effects += [components.compile_regularizer(one) for one in late]
    if spec.poses is not None:
        effects.append(components.compile_camera_optimizer(bound(spec.poses)))
    return tuple(effects)


def _regularizers(spec, metadata, motion):
    """Return the regularizers before and after the exposure, the order of their sum."""
    early, late = [spec.acceleration], [*spec.regularizers]
    # A trained scene may also be rendered without its motion.
    if spec.neighbors is not None and motion is not None:
        name = _embedding_name(spec.motion)
        early.append(neighbors.Bound(spec.neighbors, metadata.extent, name))
    early += [spec.spectral, spec.depth, spec.opacity_scale, spec.smooth_depth]
    early += [spec.point_depth]
    if spec.flow is not None:
        starts_at_once = spec.start.motion == "tracks"  # like the motion
        flow = dataclasses.replace(spec.flow, start=0) if starts_at_once else spec.flow
        late.insert(0, motion_flow.Bound(flow, raster_of(spec, metadata)))
    return tuple(
        [components.bound(one, spec.steps, metadata) for one in some if one is not None]
        for some in (early, late)
    )
