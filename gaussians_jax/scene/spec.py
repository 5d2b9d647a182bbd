"""Settings of a scene of Gaussians, and the effects that they enable."""

import dataclasses

from gaussians_jax.core import protocols
from gaussians_jax.core.metadata import SceneMetadata
from gaussians_jax.core.protocols import Appearance, CameraOptimizer, Motion, Strategy
from gaussians_jax.core.records import SplatRecord
from gaussians_jax.init.points import InitSpec, StartSpec
from gaussians_jax.losses import flow as motion_flow
from gaussians_jax.losses import neighbors
from gaussians_jax.losses.acceleration import AccelerationSpec
from gaussians_jax.losses.depth import DepthSpec
from gaussians_jax.losses.flow import FlowSpec
from gaussians_jax.losses.neighbors import NeighborSpec
from gaussians_jax.losses.spectral import SpectralSpec
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
# Motions with a vector for each Gaussian that neighbors may be kept alike in.
EMBEDDED = {
    KanMotionSpec: kan_motion.NAME,
    TimeBasisSpec: time_basis.NAME,
    EmbeddingMotionSpec: embedding_motion.NAME,
}


# The way out where rows that carry Gaussians are refused.
ALONE = (
    "leave out what they carry (carried=none, or another motion than that of anchors)"
)
# What trains nothing without a motion.
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
    "poses": CameraOptimizer,
}
WITHOUT_NETWORKS = PolynomialMotionSpec, SplineMotionSpec  # all in their rows


@dataclasses.dataclass(frozen=True)
class SplatScene:
    """Settings of a scene of Gaussians, with `None` for disabled components."""

    steps: int
    batch_size: int = 1  # views a step; all rates are times its root
    init: InitSpec = InitSpec()
    sh_degree: int = 3
    sh_every: int = step_counts.steps(1000)  # steps between one degree and the next
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
    carried: CarriedSpec | None = None  # what is drawn of each row; None: the row
    start: StartSpec = StartSpec()
    acceleration: AccelerationSpec | None = None
    neighbors: NeighborSpec | None = None
    motion_growth: MotionGrowthSpec | None = None
    spectral: SpectralSpec | None = None
    depth: DepthSpec | None = None
    exposure: ExposureSpec | Appearance | Settings | None = None
    flow: FlowSpec | None = None
    poses: PoseRefinementSpec | CameraOptimizer | Settings | None = None
    # Beside those with a field of their own.
    regularizers: tuple[Regularizer | Settings, ...] = ()

    def __post_init__(self):
        for name, protocol in PROTOCOLS.items():
            if getattr(self, name) is not None:
                check(name, getattr(self, name), protocol)
        for one in self.regularizers:
            check("regularizers", one, Regularizer)
        if self.steps < 1:
            raise ValueError(f"steps={self.steps}: train for at least one step")
        if self.batch_size < 1:
            raise ValueError(f"batch_size={self.batch_size}: a step takes a view")
        if not 0 <= self.sh_degree <= 3:
            raise ValueError(f"sh_degree={self.sh_degree} must be 0, 1, 2 or 3")
        if self.sh_every < 1:
            raise ValueError(
                f"sh_every={self.sh_every}: steps between degrees, at least 1, with "
                "which all are there almost at once"
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
    """Return rasterizer settings whose near plane is in front of all observed surfaces.

    Scenes with a distant background are small in the units of a box around all points.
    A plane at 0.01 would then be meters in front of the camera.

    Args:
      spec: Settings.
      metadata: Metadata of the capture.

    Returns:
      Settings of the rasterizer.
    """
    near = min(spec.raster.near, metadata.near)
    return dataclasses.replace(spec.raster, near=near)


def optimizer_of(spec: SplatScene) -> Optimizer:
    """Return the optimizer of a scene, whose updates are scaled by learning rates."""
    own = spec.optimizer
    return OPTIMIZERS[own]() if isinstance(own, str) else own


def carried_count(spec: SplatScene) -> int | None:
    """Return the number of children per Gaussian, None without children.

    Args:
      spec: Settings.

    Returns:
      The number.
    """
    if isinstance(spec.motion, AnchorMotionSpec):
        return spec.motion.count
    return None if spec.carried is None else spec.carried.count


def refuse_what_cannot_train(spec: SplatScene) -> None:
    """Raise ValueError where parts that are asked for need others that are not.

    Not when the settings are made: a trained scene may be drawn without its motion.
    """
    motion = spec.motion
    if motion is None:
        orphans = [name for name in OF_MOTION if getattr(spec, name) is not None]
        orphans += ["start.motion"] if spec.start.motion == "tracks" else []
        if orphans:
            raise ValueError(
                f"{' and '.join(orphans)} without a motion would train nothing; leave "
                "them out as well, or choose a preset that moves"
            )
    if spec.alternation is not None and isinstance(motion, WITHOUT_NETWORKS):
        raise ValueError(
            f"alternation takes turns with networks, and a {type(motion).__name__} has "
            "none: their turns would train nothing; leave it out as well "
            "(alternation=none)"
        )
    if spec.neighbors is not None:
        _embedded(motion)
    resting = isinstance(motion, AnchorMotionSpec) and not motion.moves
    if resting and spec.start.motion == "tracks":
        raise ValueError(
            'motion.moves=false with start.motion="tracks": anchors at rest have no '
            "motion to fit to tracks; leave one of them out"
        )
    _refuse_beside_carried(spec)
    still = 0 if spec.start.motion == "tracks" else getattr(motion, "warm_up", 0)
    if still and _fading(motion) is not None:
        raise ValueError(
            f"motion.warm_up={still} with motion.fading: what is drawn fades from the "
            "first step, and what is trained only then; leave one of them out "
            "(motion.warm_up=0 or motion.fading=none)"
        )
    _refuse_growth(spec, still)
    if spec.annealing is not None:
        phases.annealed(lambda step: step, spec.annealing, spec.steps)
    if isinstance(motion, MotionSpec):
        mlp_motion.trunk_spec(motion)
    _refuse_late(spec, still)


def _refuse_beside_carried(spec):
    """Raise ValueError for what rows that carry Gaussians cannot have."""
    carry = carried_count(spec) is not None
    if carry and isinstance(spec.strategy, MCMCStrategySpec):
        raise ValueError(
            "MCMCStrategySpec shares the opacity of a Gaussian among its copies, and "
            "rows that carry several have none of their own; choose "
            f"DefaultStrategySpec, or {ALONE}"
        )
    if carry and spec.flow is not None:
        raise ValueError(
            "flow is compared where rows are drawn, and rows that carry Gaussians are "
            f"not; leave it out (flow=none), or {ALONE}"
        )
    fading = {
        "temporal_opacity": spec.temporal_opacity,
        "motion.fading": _fading(spec.motion),
    }
    faded = [name for name, one in fading.items() if one is not None]
    if carry and faded:
        raise ValueError(
            f"{faded[0]} fades rows, and of rows that carry Gaussians only these are "
            "drawn, with opacities of their own; leave it out "
            f"({faded[0]}=none), or {ALONE}"
        )


def _refuse_growth(spec, still):
    """Raise ValueError where motion would steer no growth."""
    growth = spec.motion_growth
    if growth is not None and not isinstance(spec.strategy, DefaultStrategySpec):
        raise ValueError(
            "motion_growth steers the gradient threshold of DefaultStrategySpec, which "
            "this scene has not; leave it out as well (motion_growth=none)"
        )
    if growth is not None and growth.form == "hard" and growth.start <= still:
        raise ValueError(
            f"motion_growth.start={growth.start} lies in the warm-up of the motion "
            f"(up to step {still}), when nothing moves and so nothing would "
            "grow; start it some hundred steps later"
        )


def _refuse_late(spec, still):
    """Raise ValueError for what would begin after the last step."""
    starts, motion = {"motion.warm_up": still}, spec.motion
    parts = {
        "motion.rate": motion.rate if isinstance(motion, AnchorMotionSpec) else None,
        "neighbors": spec.neighbors,
        "acceleration": spec.acceleration,
        "flow": None if spec.start.motion == "tracks" else spec.flow,
    }
    starts |= {f"{name}.start": x.start for name, x in parts.items() if x is not None}
    for name, at in starts.items():
        if at >= max(spec.steps, 2):  # counts stay at least 1, in a run of one step too
            raise ValueError(
                f"{name}={at} of {spec.steps} steps: it would never begin; lower it, "
                "or shorten the run by --steps (presets.with_steps), which shortens "
                "all schedules with it"
            )


def _fading(motion):
    """Return the settings of opacity over time, or None if it is constant."""
    return motion.fading if isinstance(motion, PolynomialMotionSpec) else None


def _embedded(motion):
    """Return the motion parameter that neighbors keep similar, or raise ValueError."""
    if type(motion) not in EMBEDDED:
        raise ValueError(
            "neighbors keep embeddings or coefficients alike, and this motion has "
            "none; leave them out (neighbors=none), or choose a preset with a KAN "
            "motion or a time basis"
        )
    return EMBEDDED[type(motion)]


def motion_of(spec: SplatScene, metadata: SceneMetadata) -> SplatRecord | None:
    """Return the motion of the settings, without warm-up if it is initialized from
    tracks.
    """
    motion = spec.motion
    if motion is None:
        return None
    if spec.start.motion == "tracks":
        motion = protocols.moving_at_once(motion)
    return protocols.compile_motion(protocols.bound(motion, spec.steps, metadata))


def strategy_of(spec: SplatScene, metadata: SceneMetadata) -> Strategy | None:
    """Return the strategy of a scene, guided by its motion where the spec says so."""
    own = spec.strategy
    if own is None:
        return None
    strategy = protocols.bound(own, spec.steps, metadata)
    if spec.motion_growth is None:
        return strategy
    return MotionGuided(strategy, spec.motion_growth, metadata.extent)


def effects_of(spec: SplatScene, metadata: SceneMetadata) -> tuple[SplatRecord, ...]:
    """Return the parts of a scene, compiled, in the order in which they act.

    Args:
      spec: Settings of the scene.
      metadata: Sizes of the capture.

    Returns:
      The motion first, if there is one.
    """

    def bound(part):
        return protocols.bound(part, spec.steps, metadata)

    motion = motion_of(spec, metadata)
    effects = [] if motion is None else [motion]
    if spec.temporal_opacity is not None:
        effects.append(protocols.compile_motion(bound(spec.temporal_opacity)))
    if spec.carried is not None:
        # What is carried turns by itself from when on the rows move.
        still = 0 if motion is None else motion.warm_up
        effects.append(carried.effect(spec.carried, spec.steps, still))
    early, late = _regularizers(spec, metadata, motion)
    effects += [protocols.compile_regularizer(one) for one in early]
    if spec.exposure is not None:
        effects.append(protocols.compile_appearance(bound(spec.exposure)))
    effects += [protocols.compile_regularizer(one) for one in late]
    if spec.poses is not None:
        effects.append(protocols.compile_camera_optimizer(bound(spec.poses)))
    return tuple(effects)


def _regularizers(spec, metadata, motion):
    """The regularizers before and behind the exposure, which sums of terms keep to."""
    early, late = [spec.acceleration], [*spec.regularizers]
    # A trained scene is drawn without its motion as well.
    if spec.neighbors is not None and motion is not None:
        of = _embedded(spec.motion)
        early.append(neighbors.Bound(spec.neighbors, metadata.extent, of))
    early += [spec.spectral, spec.depth]
    if spec.flow is not None:
        at_once = spec.start.motion == "tracks"  # as the motion
        one = dataclasses.replace(spec.flow, start=0) if at_once else spec.flow
        late.insert(0, motion_flow.Bound(one, raster_of(spec, metadata)))
    return tuple(
        [protocols.bound(one, spec.steps, metadata) for one in some if one is not None]
        for some in (early, late)
    )
