"""The representation of radiance fields of the NeRF family, for `nerfies_jax.runs`."""

from nerfies_jax.evaluation import method_curves
from nerfies_jax.evaluation.representation import (
    Choice,
    Pair,
    Products,
    Recommendation,
    Representation,
    Resources,
    Scoring,
)
from nerfies_jax.preprocessing.findings import BACKGROUND, LIGHT, MOTION, TRANSIENT
from nerfies_jax.scene import (
    held_out_codes,
    presets,
    scene,
    step_time,
    variants,
    warp_tracks,
)
from nerfies_jax.training.track_start import FROM_REST

# Presets between which `advise` chooses by whether the scene moves, where no grid is
# wanted. The best of the small sizes are grids, which have no other size: after 90
# processor seconds on the built-in scene `d-nerf-grid-small` has 27.8 dB and
# `nerfies-small` 21.2 (docs/results/league.md).
ADVISED = ("nerf", "nerfies")
MOTIONS = ("warp", "time", "scene_flow")
# These and the effects that depend on them, in the order in which they can be removed.
MOTION_PARTS = ("elastic", "background", "mask", "ambient", *MOTIONS)


def advise(
    decisions: dict[str, bool | None],
    full: bool,
    family: str | None = None,
    seconds: float | int | None = None,
) -> Choice:
    """Recommend a preset and overrides for the effects that a capture needs.

    Args:
      decisions: Decision for each effect, None if undecided.
      full: True for the sizes of the papers.
      family: A preset without "-small". One that is not advised is kept, unless it is
        static and motion is needed.
      seconds: Planned seconds of training, or None.

    Returns:
      The recommendation.
    """
    overrides, notes = [], []
    light_changes, has_transients = decisions.get(LIGHT), decisions.get(TRANSIENT)
    moves = decisions.get(MOTION)
    grid = not full and (family is None or family.endswith("-grid"))
    static, dynamic = _best_grids(seconds) if grid else ADVISED
    preset = static if moves is False else dynamic
    if family is not None and family not in (static, dynamic):
        if moves and not _parts(_spec_of(family, full), MOTIONS):
            notes.append(
                f"{MOTION}: preset {family} is static, so {preset} is used instead"
            )
        else:
            preset = family
    spec = _spec_of(preset, full)
    is_dynamic = moves is not False and bool(_parts(spec, MOTIONS))
    # Where motion is undecided, there may be no usable tracks.
    from_rest = not is_dynamic or (moves is None and family is None)
    if from_rest and spec.start.motion == "tracks":
        overrides.append(FROM_REST)
    if not is_dynamic:
        overrides += [f"{name}=none" for name in _parts(spec, MOTION_PARTS)]
    has_codes = spec.appearance is not None
    if light_changes and not has_codes:
        overrides.append(f"appearance.width={48 if full else 4}")
    if light_changes is False and has_codes:
        overrides.append("appearance=none")
    if has_transients and is_dynamic:
        # The transient medium also absorbs the moving objects. On the built-in scene
        # "transient" it loses 1.7 dB after 1000 steps, and gains 0.9 dB after 700 if
        # there is no warp.
        notes.append(
            f"{TRANSIENT}: a transient medium lowers scores next to a warp, so the "
            "warp has to explain transient objects"
        )
    elif has_transients and spec.transient is None:
        size = (16, 4, 128) if full else (8, 2, 48)  # of NeRF-W and of its small preset
        names = ("code_width", "depth", "width")
        if spec.sampling.occupancy is not None:  # not with a medium
            overrides.append("sampling.occupancy=none")
        overrides += [f"transient.{n}={v}" for n, v in zip(names, size, strict=True)]
    if has_transients is False and spec.transient is not None:
        overrides.append("transient=none")
    if (
        is_dynamic
        and spec.background is not None
        and decisions.get(BACKGROUND) is False
    ):
        overrides.append("background=none")
    return Choice(preset, tuple(overrides), tuple(notes))


def _best_grids(seconds):
    """Return the best measured presets without and with motion, without "-small"."""
    grids = [name for name in presets.PRESETS if name.endswith("-grid-small")]
    best = (method_curves.ranking(grids, moves, seconds)[0] for moves in (False, True))
    return [one.preset.removesuffix("-small") for one in best]


def _spec_of(family, full):
    return presets.PRESETS[family if full else f"{family}-small"]


def _parts(spec, names):
    return [name for name in names if getattr(spec, name) is not None]


RADIANCE = Representation(
    name="radiance",
    spec_type=scene.RadianceScene,
    presets=presets.PRESETS,
    with_steps=presets.with_steps,
    metadata_of=scene.metadata_of,
    build=scene.build,
    resources=Resources(
        threads="all",  # matrix products scale with the number of cores
        shares=lambda spec: spec.micro_batches,
        share_setting="micro_batches",
        estimate_memory_bytes=scene.estimate_memory_bytes,
        memory_hint="lower rays, sampling.coarse or sampling.fine",
        step_parts=step_time.parts,
    ),
    scoring=Scoring(
        half_scorer=held_out_codes.scorer,
        fitted_rays=held_out_codes.RAYS * held_out_codes.EVALUATIONS,
        follow=warp_tracks.follow,
        mover=warp_tracks.mover,
    ),
    products=Products(parts=variants.parts, variant=variants.without_effects),
    recommendation=Recommendation(
        advise,
        # The price of motion includes the elastic penalty.
        prices={
            MOTION: Pair("nerfies-small", "warp_and_elastic"),
            LIGHT: Pair("nerf-w-small", "only_appearance"),
            TRANSIENT: Pair("nerf-w-small", "only_transient"),
            BACKGROUND: Pair("nerfies-small", "warp_and_background", "only_warp"),
        },
    ),
)
