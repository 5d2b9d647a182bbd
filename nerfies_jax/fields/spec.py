"""Settings of a radiance field and of its training."""

import dataclasses
import math
from typing import TypeVar

import optax

from nerfies_jax.capture.scene_metadata import SceneMetadata
from nerfies_jax.fields import sampling
from nerfies_jax.fields.effects import moving_mask, records, smoothness, surface
from nerfies_jax.fields.effects.ambient import AmbientSpec
from nerfies_jax.fields.effects.appearance import AppearanceSpec
from nerfies_jax.fields.effects.background import BackgroundSpec
from nerfies_jax.fields.effects.elastic import ElasticSpec
from nerfies_jax.fields.effects.moving_mask import MovingMaskSpec
from nerfies_jax.fields.effects.protocols import Conditioning, Medium, Template, Warp
from nerfies_jax.fields.effects.ray_distortion import DistortionSpec
from nerfies_jax.fields.effects.records import FieldRecord
from nerfies_jax.fields.effects.scene_flow import SceneFlowSpec
from nerfies_jax.fields.effects.smoothness import SmoothnessSpec
from nerfies_jax.fields.effects.surface import SurfaceSpec
from nerfies_jax.fields.effects.time_condition import TimeSpec
from nerfies_jax.fields.effects.time_warp import TimeWarpSpec
from nerfies_jax.fields.effects.transient import TransientSpec
from nerfies_jax.fields.effects.warp import WarpSpec
from nerfies_jax.fields.occupancy import OccupancySpec
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.training import schedules, step_counts
from nerfies_jax.training.effects import Table
from nerfies_jax.training.extensions import Settings, check
from nerfies_jax.training.protocols import Optimizer, Regularizer
from nerfies_jax.training.track_start import FieldStartSpec

OPTIMIZERS = {"adam": optax.scale_by_adam}
CENTER = "center"  # spacing of samples around the captured volume
VOLUMES = ("frustums", "subject")
PROTOCOLS = {"transient": Medium, "warp": Warp}


@dataclasses.dataclass(frozen=True)
class SamplingSpec:
    """Settings of the samples along a ray. The defaults are those of NeRF.

    `fine` is the number of samples drawn by the weights of the coarse level. With 0
    there is one level. If `union` is true, the fine level also evaluates the coarse
    samples. Otherwise the larger network evaluates half as many samples, few of them in
    empty space. `block` is the number of rays that are rendered at a time, which makes
    memory independent of the image size.

    With the spacing "center" the first samples of a ray are dense in the captured
    volume and get sparser with the distance from it. This suits cameras that look at
    one subject from various distances.
    """

    coarse: int = 64
    fine: int = 128
    spacing: str = "linear"  # or "disparity", or "center"
    jitter: bool = True  # while training
    shared: bool = False  # one network for both levels (D-NeRF)
    union: bool = True  # the fine level also evaluates the coarse samples
    block: int = 1024
    occupancy: OccupancySpec | None = None  # None for random rays

    def __post_init__(self):
        if self.coarse < 3 or self.fine < 0 or self.block < 1:
            raise ValueError(
                "sampling needs coarse >= 3, fine >= 0 and block >= 1, got "
                f"coarse={self.coarse}, fine={self.fine}, block={self.block}"
            )
        if self.spacing not in (*sampling.SPACINGS, CENTER):
            raise ValueError(
                f"spacing={self.spacing!r} must be 'linear', 'disparity' or 'center'"
            )
        if self.spacing != "linear" and self.occupancy is not None:
            raise ValueError(
                f"spacing={self.spacing!r} is of samples along all of a ray, and with "
                "occupancy they are where cells are filled: set occupancy=none, or "
                "spacing='linear'"
            )


@dataclasses.dataclass(frozen=True)
class RadianceScene:
    """Settings of a radiance field and of its training. None disables an effect."""

    steps: int
    template: TemplateSpec | Template = TemplateSpec()
    coarse: TemplateSpec | Template | None = (
        None  # of the coarse level; None is like the fine one
    )
    sampling: SamplingSpec = SamplingSpec()
    rays: int = 1024  # per step
    # Curriculum of D-NeRF: until this step, rays are of the first frames in time alone,
    # whose number grows linearly from three to all. None for all frames from the start.
    curriculum_steps: int | None = step_counts.steps(None)
    # Number of equal parts of a step, on several devices or one after the other to save
    # memory. The losses of a part are means over its own valid rays.
    micro_batches: int = 1
    # Longest half side of the captured volume in units of the field. None to keep the
    # coordinates of the capture.
    extent: float | None = 1.0
    # The captured volume: all that cameras may see ("frustums"), or a box around the
    # points that most images show ("subject"), for photographs from various distances.
    volume: str = "frustums"
    # Decays log-linearly to `learning_rate_end`.
    learning_rate: float = 5e-4
    learning_rate_end: float = 5e-5
    template_rate: float = 1.0  # factor for the template
    table_rate: float = 1.0  # additional factor for the tables of the template
    # Factor for latent codes. If codes learn more slowly than the template, density
    # explains the exposures of photographs before codes do, and stays.
    code_rate: float = 1.0
    optimizer: str | Optimizer = "adam"
    density_noise: float = 0.0  # standard deviation during training
    appearance: AppearanceSpec | None = None
    transient: TransientSpec | Medium | Settings | None = None
    time: TimeSpec | None = None
    warp: WarpSpec | TimeWarpSpec | Warp | Settings | None = None
    ambient: AmbientSpec | None = None
    elastic: ElasticSpec | None = None
    background: BackgroundSpec | None = None
    scene_flow: SceneFlowSpec | None = None
    smoothness: SmoothnessSpec | None = None
    distortion: DistortionSpec | None = None
    mask: MovingMaskSpec | None = None
    surface: SurfaceSpec | None = None
    # Further conditionings.
    conditioning: tuple[Conditioning | Settings, ...] = ()
    regularizers: tuple[Regularizer | Settings, ...] = ()
    start: FieldStartSpec = FieldStartSpec()

    def __post_init__(self):
        for name, protocol in PROTOCOLS.items():
            if getattr(self, name) is not None:
                check(name, getattr(self, name), protocol)
        for one in self.conditioning:
            check("conditioning", one, Conditioning)
        for one in self.regularizers:
            check("regularizers", one, Regularizer)
        if self.steps < 1 or self.rays < 1:
            raise ValueError(
                f"train for at least one step of one ray, got steps={self.steps}, "
                f"rays={self.rays}"
            )
        if self.curriculum_steps is not None and self.curriculum_steps < 1:
            raise ValueError(
                f"curriculum_steps={self.curriculum_steps} must be at least 1, or None "
                "for all frames from the start"
            )
        if self.micro_batches < 1 or self.rays % self.micro_batches:
            raise ValueError(
                f"rays={self.rays} cannot be split into micro_batches="
                f"{self.micro_batches} equal parts; choose a multiple, or "
                "micro_batches=1"
            )
        if isinstance(self.optimizer, str) and self.optimizer not in OPTIMIZERS:
            raise ValueError(
                f"unknown optimizer {self.optimizer!r}; choose from "
                f"{sorted(OPTIMIZERS)}, or pass a gradient transformation of optax"
            )
        if not 0 <= self.density_noise < math.inf:
            raise ValueError(
                f"density_noise={self.density_noise} must be finite and not negative"
            )
        for name in ("template_rate", "table_rate", "code_rate"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name}={getattr(self, name)} must be positive and finite"
                )
        templates = (self.template, self.coarse or self.template)
        others = [one for one in templates if not isinstance(one, TemplateSpec)]
        for one in others:
            check("template", one, Template)
        if others:
            _refuse_beside_other_template(self)
        if any(getattr(one, "reads_time", False) for one in templates):
            raise ValueError(
                "a template is read at a point, at whatever time, and its planes have "
                "none: set position.timestamps=none (scene_flow.network may have them)"
            )
        if self.extent is not None and not 0 < self.extent < math.inf:
            raise ValueError(
                f"extent={self.extent} must be positive and finite, or none"
            )
        if self.volume not in VOLUMES:
            raise ValueError(f"volume={self.volume!r} must be one of {VOLUMES}")
        if self.sampling.spacing == CENTER and self.extent is None:
            raise ValueError(
                "spacing='center' is relative to the captured volume; set extent=1.0, "
                "or spacing='linear'"
            )
        schedules.check_falling(self.learning_rate, self.learning_rate_end)
        for name in ("elastic", "background"):
            if getattr(self, name) is not None and self.warp is None:
                raise ValueError(
                    f"{name} holds the warp in check, and there is none; set warp or "
                    f"{name}=none"
                )
        if self.mask is not None and not isinstance(self.warp, WarpSpec):
            raise ValueError(
                "a mask of what moves guides a warp, and there is none that reads it; "
                "set warp=WarpSpec or mask=none"
            )
        flow, has_guide = self.scene_flow, self.sampling.occupancy is not None
        if flow is not None and flow.moving_rays is not None and has_guide:
            raise ValueError(
                f"scene_flow.moving_rays={flow.moving_rays} chooses rays, and so does "
                "sampling.occupancy; set one of them to none"
            )
        moves = self.warp is not None or self.scene_flow is not None
        if self.start.motion == "tracks" and not moves:
            raise ValueError(
                'start.motion="tracks" fits a warp or a scene flow to tracks, and '
                "there is neither; set one of them, or start.motion=none"
            )


def _refuse_beside_other_template(spec):
    """Raise ValueError for settings that need the built-in template."""
    alone = {
        "density_noise": spec.density_noise == 0,
        "table_rate": spec.table_rate == 1,
        "transient": spec.transient is None,
        "scene_flow": spec.scene_flow is None,
        "surface": spec.surface is None,
        "smoothness": spec.smoothness is None,
    }
    for name, fine in alone.items():
        if not fine:
            raise ValueError(
                f"{name}={getattr(spec, name)!r} needs the layers of the built-in "
                "template (TemplateSpec), and this scene has another; leave it out"
            )


def effects_of(spec: RadianceScene, metadata: SceneMetadata) -> tuple[FieldRecord, ...]:
    """The effects that the spec asks for, in the order in which they act.

    Args:
      spec: The scene.
      metadata: Scene metadata.

    Returns:
      Records of the components.
    """

    def bound(part):
        return part.bind(spec.steps, metadata) if hasattr(part, "bind") else part

    def conditioning(part):
        return records.compile_conditioning(bound(part))

    def medium(part):
        return records.compile_medium(bound(part), spec.template.width)

    def warp(part):
        return records.compile_warp(bound(part))

    def regularizer(part):
        return records.compile_regularizer(bound(part))

    def surfaces(one):
        widths = {name: net.width for name, net in templates_of(spec).items()}
        return surface.effect(one, widths)

    smooth = None
    if spec.smoothness is not None:
        smooth = smoothness.Bound(spec.smoothness, templates_of(spec))
    warp_spec, slice_ = spec.warp, spec.ambient
    if isinstance(warp_spec, WarpSpec) and spec.start.motion == "tracks":
        # The warp is fitted with all bands open. Closing them would undo the fit.
        warp_spec = dataclasses.replace(warp_spec, anneal_steps=None)
    if spec.mask is not None and isinstance(warp_spec, WarpSpec):
        warp_spec = add_guide(warp_spec)
    if spec.mask is not None and slice_ is not None:
        slice_ = add_guide(slice_)
    parts = (
        (spec.appearance, conditioning),
        (spec.transient, medium),
        (spec.time, conditioning),
        (warp_spec, warp),
        (slice_, conditioning),
        (spec.elastic, regularizer),
        (spec.background, regularizer),
        (spec.scene_flow, medium),
        (smooth, regularizer),
        (spec.distortion, regularizer),
        (spec.mask, conditioning),
        (spec.surface, surfaces),
        *((one, conditioning) for one in spec.conditioning),
        *((one, regularizer) for one in spec.regularizers),
    )
    return tuple(make(one) for one, make in parts if one is not None)


def optimizer_of(spec: RadianceScene) -> Optimizer:
    """Return the optimizer of a field, whose updates are scaled by learning rates.

    Args:
      spec: The scene.

    Returns:
      The optimizer.
    """
    optimizer = spec.optimizer
    return OPTIMIZERS[optimizer]() if isinstance(optimizer, str) else optimizer


GuidedT = TypeVar("GuidedT", WarpSpec, AmbientSpec)


def add_guide(spec: GuidedT) -> GuidedT:
    """Add the mask of moving points to the guides of a warp or ambient surface.

    Args:
      spec: Settings, or None.

    Returns:
      The changed settings.
    """
    if moving_mask.NAME in spec.guides:
        return spec
    return dataclasses.replace(spec, guides=(*spec.guides, moving_mask.NAME))


def tables_of(effects: tuple[FieldRecord, ...]) -> tuple[Table, ...]:
    """The latent tables of all effects, each once.

    Args:
      effects: Records of the components.

    Returns:
      The tables, in the order of their first use.

    Raises:
      ValueError: If two components have different tables of one name.
    """
    tables: dict[str, Table] = {}
    for effect in effects:
        for table in effect.tables:
            if tables.setdefault(table.name, table) != table:
                raise ValueError(
                    f"two effects share the codes {table.name!r} and disagree: "
                    f"{tables[table.name]} and {table}; give them one code_width"
                )
    return tuple(tables.values())


def templates_of(spec: RadianceScene) -> dict[str, TemplateSpec | Template]:
    """The networks of all levels that have one, by name.

    Args:
      spec: The scene.

    Returns:
      Templates by level, "coarse" and "fine".
    """
    single = spec.sampling.fine == 0 or spec.sampling.shared
    names = ("fine",) if single else ("coarse", "fine")
    return {name: template_of(spec, name) for name in names}


def template_of(spec: RadianceScene, level: str) -> TemplateSpec | Template:
    """The network of one level, "coarse" or "fine".

    Args:
      spec: The scene.
      level: "coarse" or "fine".

    Returns:
      The template, or its settings.
    """
    return spec.coarse if level == "coarse" and spec.coarse else spec.template
