"""Which radiance field, and how it is trained: settings only."""

import dataclasses

from nerfies_jax.effects import (
    ambient,
    appearance,
    background,
    elastic,
    scene_flow,
    time_condition,
    transient,
    warp,
)
from nerfies_jax.effects.ambient import AmbientSpec
from nerfies_jax.effects.appearance import AppearanceSpec
from nerfies_jax.effects.background import BackgroundSpec
from nerfies_jax.effects.elastic import ElasticSpec
from nerfies_jax.effects.scene_flow import SceneFlowSpec
from nerfies_jax.effects.time_condition import TimeSpec
from nerfies_jax.effects.transient import TransientSpec
from nerfies_jax.effects.warp import WarpSpec
from nerfies_jax.radiance.template import TemplateSpec
from nerfies_jax.scene_metadata import SceneMetadata
from nerfies_jax.training import schedules
from nerfies_jax.training.effects import Effect, Table
from nerfies_jax.training.track_start import TrackStartSpec


@dataclasses.dataclass(frozen=True)
class SamplingSpec:
    """Where along a ray the field is asked; the defaults are Mildenhall et al. 2020.

    `fine` samples are drawn where the coarse level found weight, and the fine level
    sees both; 0 leaves one level. `block` rays are rendered at a time when a whole
    frame is: memory does not grow with the picture.
    """

    coarse: int = 64
    fine: int = 128
    spacing: str = "linear"  # or "disparity"
    jitter: bool = True  # while training
    shared: bool = False  # one network for both levels (D-NeRF)
    block: int = 1024

    def __post_init__(self):
        if self.coarse < 3 or self.fine < 0 or self.block < 1:
            raise ValueError(
                "sampling needs coarse >= 3, fine >= 0 and block >= 1, got "
                f"coarse={self.coarse}, fine={self.fine}, block={self.block}"
            )
        if self.spacing not in ("linear", "disparity"):
            raise ValueError(
                f"spacing={self.spacing!r} must be 'linear' or 'disparity'"
            )


@dataclasses.dataclass(frozen=True)
class RadianceScene:
    """Which field and how it is trained; `None` for an effect: it is not there."""

    steps: int
    template: TemplateSpec = TemplateSpec()
    coarse: TemplateSpec | None = None  # of the coarse level; None is like the fine one
    sampling: SamplingSpec = SamplingSpec()
    rays: int = 1024  # in a step
    # In so many equal parts, on as many devices or one after the other: less memory.
    micro_batches: int = 1
    # Longest half-side of the filmed volume in units of the field; None keeps the
    # capture's own coordinates.
    extent: float | None = 1.0
    learning_rate: float = (
        5e-4  # of Adam, falling to `learning_rate_end` along a line in the logarithm
    )
    learning_rate_end: float = 5e-5
    template_rate: float = 1.0  # times that: of the template, for tables learn faster
    density_noise: float = 0.0  # standard deviation, while training
    appearance: AppearanceSpec | None = None
    transient: TransientSpec | None = None
    time: TimeSpec | None = None
    warp: WarpSpec | None = None
    ambient: AmbientSpec | None = None
    elastic: ElasticSpec | None = None
    background: BackgroundSpec | None = None
    scene_flow: SceneFlowSpec | None = None
    start: TrackStartSpec = TrackStartSpec()

    def __post_init__(self):
        if self.steps < 1 or self.rays < 1:
            raise ValueError(
                f"train for at least one step of one ray, got steps={self.steps}, "
                f"rays={self.rays}"
            )
        if self.micro_batches < 1 or self.rays % self.micro_batches:
            raise ValueError(
                f"rays={self.rays} cannot be split into micro_batches="
                f"{self.micro_batches} equal parts; choose a multiple, or "
                "micro_batches=1"
            )
        if not self.template_rate > 0:
            raise ValueError(f"template_rate={self.template_rate} must be positive")
        if self.extent is not None and not self.extent > 0:
            raise ValueError(f"extent={self.extent} must be positive, or none")
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        for name in ("elastic", "background"):
            if getattr(self, name) is not None and self.warp is None:
                raise ValueError(
                    f"{name} holds the warp in check, and there is none; set warp or "
                    f"{name}=none"
                )
        moves = self.warp is not None or self.scene_flow is not None
        if self.start.motion == "tracks" and not moves:
            raise ValueError(
                'start.motion="tracks" fits a warp or a scene flow to tracks, and '
                "there is neither; set one of them, or start.motion=none"
            )


def effects_of(spec: RadianceScene, metadata: SceneMetadata) -> tuple[Effect, ...]:
    """The effects that the spec asks for, in the order in which they act."""

    def flow(one):
        return scene_flow.effect(one, len(metadata.times), spec.template.width)

    bent = spec.warp
    if bent is not None and spec.start.motion == "tracks":
        # Fitted with all bands open, and closing them would undo it.
        bent = dataclasses.replace(bent, anneal_steps=None)
    built = (
        (spec.appearance, appearance.effect),
        (
            spec.transient,
            lambda one: transient.effect(one, spec.template.width),
        ),
        (spec.time, time_condition.effect),
        (bent, warp.effect),
        (spec.ambient, ambient.effect),
        (spec.elastic, elastic.effect),
        (spec.background, background.effect),
        (spec.scene_flow, flow),
    )
    return tuple(make(one) for one, make in built if one is not None)


def tables_of(effects: tuple[Effect, ...]) -> tuple[Table, ...]:
    """The latent tables of all effects, each once."""
    tables = {}
    for effect in effects:
        for table in effect.tables:
            if tables.setdefault(table.name, table) != table:
                raise ValueError(
                    f"two effects share the codes {table.name!r} and disagree: "
                    f"{tables[table.name]} and {table}; give them one code_width"
                )
    return tuple(tables.values())


def template_of(spec: RadianceScene, level: str) -> TemplateSpec:
    """The network of one level, "coarse" or "fine"."""
    return spec.coarse if level == "coarse" and spec.coarse else spec.template
