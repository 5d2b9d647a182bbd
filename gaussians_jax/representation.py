"""Gaussian splats as a `Representation` of `nerfies_jax.runs`."""

import pathlib
from typing import Any

import jax
import numpy as np

from gaussians_jax.core import splats
from gaussians_jax.io import files, model_file
from gaussians_jax.motion import anchor_motion, deformation
from gaussians_jax.motion.anchors import AnchorMotionSpec
from gaussians_jax.motion.basis import BasisMotionSpec
from gaussians_jax.motion.se3_bases import SE3BasesSpec
from gaussians_jax.player import browser_splats, page
from gaussians_jax.scene import (
    first_state,
    gaussian_tracks,
    held_out_exposure,
    presets,
    scene,
    step_time,
    variants,
)
from gaussians_jax.scene.spec import OF_MOTION, raster_of
from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation import method_curves
from nerfies_jax.evaluation.representation import (
    MODEL,
    Choice,
    Pair,
    Player,
    Products,
    Recommendation,
    Representation,
    Resources,
    Saved,
    Scoring,
)
from nerfies_jax.preprocessing import (
    findings,
    inspection,
    record,
    rigid_groups,
    usable_paths,
)
from nerfies_jax.preprocessing.findings import (
    CERTAIN,
    COLLECTION,
    DEPTH,
    LIGHT,
    MOTION,
    START,
    TRANSIENT,
)
from nerfies_jax.training import specs
from nerfies_jax.training.model import Model, TrainState
from nerfies_jax.training.track_start import FROM_REST

SMALL_PIXELS = 176 * 132  # image size that the counts of the small presets are for
# Candidates for the number of SE(3) bases. The smallest is chosen that explains four
# fifths of the residual that the largest explains beyond one rigid body. Median
# residuals of 1, 8, 12, 16, 20 and 24 groups, in 1e-4 scene units (number chosen):
# 100, 33, 29, 29, 28, 26 in the built-in scene and 106, 30, 27, 25, 23, 23 in its fast
# variant (8), 160, 115, 108, 101, 102, 101 for a hand before books (12) and 128, 75,
# 69, 67, 55, 53 for a bag that is handled (16). Held-out PSNR with 8 and with 12 bases,
# in the whole image and in moving regions: 32.14 / 29.28 and 31.72 / 29.10 dB, 31.23 /
# 27.74 and 31.03 / 27.36, 38.26 / 34.28 and 38.38 / 34.16 (one seed each).
BASES, EXPLAINED = (8, 12, 16, 20, 24), 0.8
# Mean share of the video that a track covers: 0.68 and 0.56 in the built-in scenes,
# 0.27 for a hand before books, 0.23 for a bag that is handled. Below `LONG`, more
# moving Gaussians are initialized, by the square root of the ratio. The bag with 8000
# instead of 4100 of them has 27.28 / 22.39 instead of 27.16 / 22.04 dB, the hand with
# 8000 instead of 4400 and 25 knots 39.15 / 34.83 instead of 39.22 / 34.86 in 1.2 times
# the time (one seed each), which is why the square root is used.
LONG, MOST_TIMES = 0.5, 3.0
# The ratio of the built-in scenes, with 20 knots for 60 frames.
FRAMES_A_KNOT, MOST_KNOTS = 3, 60
# Training time that the counts of the small presets are for, and the power of the time
# with which they grow, within these bounds.
USUAL_SECONDS, TIME_POWER = 120.0, 0.5
LEAST_CAPACITY, MOST_CAPACITY = 0.5, 3.0
# Presets among which `advise` chooses by the presence of motion.
ADVISED = ("splats-static", "splats-tracked", "splats-deformable")
# Preset for motion without usable tracks, in its small size and without them. Held-out
# PSNR in equal time, compared with `splats-deformable-small` and `dynmf-small` without
# tracks: D-NeRF's lego 21.8 dB, 20.7 and 21.3; bookshelf 36.8, 34.5 and 36.4; built-in
# scene 25.1, 24.6 and 25.9.
UNTRACKED = "spacetime"
# Preset for photographs of a static scene in changing light.
OF_PHOTOGRAPHS = "splats-collection"
# Share of moving pixels near tracks from which motion needs no comparison with a static
# scene, and the median relative deviation of the depths of tracks up to which it does
# not. Built-in scenes have deviations of 0.02 to 0.08, a bag that is handled 0.15.
WELL_COVERED, WELL_PLACED = 0.5, 0.3
# Settings of the motion, and those that have no effect without one.
MOTION_PARTS = ("motion", "neighbors", *OF_MOTION)


def growth(spec: Any, state: TrainState) -> float:
    """Predict how much longer the steps of a whole run take than its first steps.

    The prediction is the square root of the growth in the number of Gaussians, at most
    two. Built-in scene: 1.5 times from 4500 to 8379 under a cap of 10,000
    (`splats-static-small`, 600 steps), 1.1 times from 7000 to the cap
    (`splats-tracked-small`, 250 steps).

    Args:
      spec: The scene.
      state: State after the first steps.

    Returns:
      A factor from 1 to 2.
    """
    if spec.strategy is None:
        return 1.0
    first = splats.active_count(state.params.rows["splats"])
    return min(max(spec.strategy.cap_max / first, 1.0) ** 0.5, 2.0)


def save(
    folder: pathlib.Path,
    spec: Any,
    metadata: Any,
    state: TrainState,
) -> Saved:
    """Write `model.npz`, the whole scene, and `gaussians.ply` for other viewers.

    Args:
      folder: Folder for the files.
      spec: The scene.
      metadata: Scene metadata.
      state: Trained state.

    Returns:
      Bytes of the model, and notes for the report.
    """
    if not splats.active_count(state.params.rows["splats"]):
        return Saved(notes=(f"No Gaussian is left, so there is no {MODEL}.",))
    about = {"spec": spec, "metadata": metadata, "step": int(state.step)}
    size = model_file.save(folder / MODEL, state.params, about)
    effects = scene.all_effects(spec, metadata)
    rows = deformation.rendered_rows(effects, state.params)
    files.save(folder / "gaussians.ply", rows)
    notes = []
    if spec.raster.antialiased:
        notes.append(
            "The Gaussians were trained with antialiased rendering, which viewers of "
            "gaussians.ply should enable as well."
        )
    if all(effect.deform is None for effect in effects):
        return Saved(size, tuple(notes))
    coded_size = None
    notes.append("gaussians.ply holds the canonical Gaussians, without their motion.")
    if isinstance(spec.motion, AnchorMotionSpec):
        features, others = anchor_motion.coded_bytes(state.params, spec.motion)
        coded_size = features + others
        notes.append(
            f"The features of the anchors take {features / 1e6:.2f} MB with entropy "
            f"coding by the learned distribution, the other parameters "
            f"{others / 1e6:.2f} MB at 32 bits each ({MODEL} stores all of them at 32 "
            "bits)."
        )
    if isinstance(spec.motion, BasisMotionSpec):
        notes.append(
            f"{MODEL} holds the whole scene in {size / 1e6:.1f} MB. MoBa-GS reports "
            "11.3 MB and 163 frames per second on an A100, for other scenes, so the "
            "numbers are not comparable."
        )
    return Saved(size, tuple(notes), coded_size)


def player(
    path: pathlib.Path,
    title: str,
    spec: Any,
    model: Model,
    state: TrainState,
    capture: Capture,
    poster: np.ndarray,
) -> Player:
    """Write `player.html`, with a poster uint8 [height, width, 3].

    Args:
      path: The file.
      title: Title of the page.
      spec: The scene.
      model: The model.
      state: Trained state.
      capture: The capture, whose cameras limit the views.
      poster: Image to show before the page has loaded.

    Returns:
      Path and description of the page.
    """
    degree = min(int(state.step) // spec.sh_every, spec.sh_degree)
    raster = raster_of(spec, model.spec[1])
    degree = jax.device_put(np.int32(degree))
    return page.write(path, title, model, raster, degree, state, capture, poster)


def advise(
    wanted: dict[str, bool | None],
    full: bool,
    family: str | None = None,
    seconds: float | int | None = None,
) -> Choice:
    """Choose a preset and overrides for the needs of a capture.

    A `family` outside of `ADVISED` is kept, unless it has no motion and needs one.

    Args:
      wanted: Decisions of an inspection by effect, None where it is undecided.
      full: True for presets of the published size, False for small ones.
      family: Preset without its size that the user prefers, or None.
      seconds: Planned seconds of training, or None.

    Returns:
      The preset, the overrides and notes.
    """
    notes = []
    moves = wanted.get(MOTION)
    preset, overrides = ("splats-deformable", []) if full else (UNTRACKED, [FROM_REST])
    if wanted.get(COLLECTION) and family in (None, *ADVISED):
        moves, family = False, OF_PHOTOGRAPHS
    if moves is not None:
        best = _best(moves, seconds)
        preset, overrides = best.preset.removesuffix("-small"), [*best.overrides]
    if family is not None and family not in ADVISED:
        if moves and _spec_of(family, full).motion is None:
            notes.append(
                f"{MOTION}: preset {family} is static, so {preset} is used instead"
            )
        else:
            preset, overrides = family, []
    spec = _spec_of(preset, full)
    if moves is False:
        present = (name for name in MOTION_PARTS if getattr(spec, name) is not None)
        overrides += [f"{name}=none" for name in present]
        if _starts_from_tracks(spec):
            overrides.append(FROM_REST)
    static = moves is False or spec.motion is None
    if wanted.get(TRANSIENT) and static and spec.transients is None:
        notes.append(
            f"{TRANSIENT}: splats cannot model transient objects, and can leave them "
            "out of the loss (transients.start=500); use a field, or set this"
        )
    overrides += effect_overrides(wanted, specs.override(spec, tuple(overrides)))
    return Choice(preset, tuple(overrides), tuple(notes))


def effect_overrides(wanted: dict[str, bool | None], spec: Any) -> tuple[str, ...]:
    """Return overrides that give a spec the effects other than motion that it needs.

    Args:
      wanted: Need of each effect, None if undecided.
      spec: Settings of a preset.

    Returns:
      Overrides such as "depth.weight=0.1".
    """
    overrides = []
    if wanted.get(LIGHT) and spec.exposure is spec.appearance is None:
        overrides.append("exposure.learning_rate=0.01")
    if wanted.get(LIGHT) is False and spec.exposure is not None:
        overrides.append("exposure=none")
    if wanted.get(LIGHT) is False and spec.appearance is not None:
        overrides.append("appearance=none")
    if wanted.get(START) is False:
        overrides.append("init.source=random")
    if wanted.get(DEPTH) and spec.depth is None and not _starts_from_tracks(spec):
        overrides.append("depth.weight=0.1")
    if wanted.get(DEPTH) is False and spec.depth is not None:
        overrides.append("depth=none")
    return tuple(overrides)


def _starts_from_tracks(spec: Any) -> bool:
    """Test if the motion of a spec is initialized from tracks.

    Tracks place what moves in depth. A depth loss in addition makes it worse, even with
    true depths: 32.08 instead of 32.55 dB in the built-in scene and 28.94 instead of
    29.95 in its moving regions, 31.15 instead of 31.46 and 28.59 instead of 29.85 with
    changing exposure (2000 steps of `splats-tracked-small`).
    """
    return spec.motion is not None and spec.start.motion == "tracks"


def _validates(spec: Any) -> bool:
    """Test if no parameters belong to single frames, and no loss to pairs of them."""
    parts = (spec.exposure, spec.appearance, spec.poses, spec.flow)
    return all(part is None for part in parts)


def _best(moves, seconds):
    """Return the best measured small preset of a static or a moving scene."""
    return method_curves.ranking(presets.PRESETS, moves, seconds)[0]


def _spec_of(family, full):
    return presets.PRESETS[family if full else f"{family}-small"]


def default_preset(capture: Capture, seconds: float | int | None = None) -> Choice:
    """Choose a small preset by the tracks of a capture, from the cache or computed.

    With usable tracks, and for a static scene, it is the best that was measured in the
    planned time (`method_curves.ranking`). Photographs in changing light get an
    appearance model, and motion without usable tracks a polynomial per Gaussian. The
    number of Gaussians follows from the image size, the length of the tracks and the
    planned seconds of training.

    Args:
      capture: The capture.
      seconds: Planned seconds of training, or None.

    Returns:
      The preset, the overrides and notes.
    """
    preprocessing = record.cached(capture, CACHE / "evidence")
    reason = usable_paths.unusable(preprocessing)
    static = bool(reason) and usable_paths.is_static(preprocessing, capture.times)
    needs_inspection = preprocessing.unusable or (reason and not static)
    inspection_result = _findings(capture, preprocessing) if needs_inspection else ()
    motion = next(
        (finding for finding in inspection_result if finding.effect == MOTION), None
    )
    start: tuple[str, ...]
    name, start, notes = f"{UNTRACKED}-small", (FROM_REST,), []
    if findings.is_collection(inspection_result):
        name, start = f"{OF_PHOTOGRAPHS}-small", ()
        notes = ["photographs of one scene in changing light"]
    elif static:
        name, start, _ = _best(False, seconds)
        notes = [f"nothing moves: {reason}"]
    elif motion and motion.wanted is False and motion.confidence == CERTAIN:
        name, start, _ = _best(False, seconds)
        notes = [f"nothing moves: {motion.evidence}"]
    elif reason:
        notes = [f"tracks are not usable: {reason}"]
    else:
        name, start, _ = _best(True, seconds)
    spec = specs.override(presets.PRESETS[name], start)
    paths = usable_paths.known_paths(preprocessing)
    share = 1.0 if reason else float(paths.known.mean())
    overrides = start + capacity(spec, capture.size, share, seconds)
    if overrides != start:
        size = "x".join(map(str, capture.size))
        size += "" if seconds is None else f" in {seconds:g} s"
        coverage = f" and tracks of {share:.0%} of the video" if share < LONG else ""
        notes.append(f"for images of {size}{coverage}")
    if isinstance(spec.motion, SE3BasesSpec) and not reason:
        bases = rigid_groups.enough(paths.position, paths.known, BASES, EXPLAINED)
        if bases > spec.motion.bases:
            overrides += (f"motion.bases={bases}",)
            notes.append(f"the tracks move as {bases} rigid groups or more")
        frames = paths.known.shape[1]
        knots = min(round(frames / FRAMES_A_KNOT), MOST_KNOTS)
        if knots > spec.motion.knots:
            overrides += (f"motion.knots={knots}",)
            notes.append(f"for {frames} frames")
    other = None if reason else _alternative(preprocessing, capture.size, seconds)
    return Choice(name, overrides, tuple(notes), other)


def _findings(capture, preprocessing):
    """Inspect the motion, and the light where nothing can be tracked."""
    effects = (MOTION, TRANSIENT, LIGHT) if preprocessing.unusable else (MOTION,)
    return inspection.find(capture, effects, CACHE / "evidence")


def _alternative(preprocessing, size, seconds):
    """Return the static choice if tracks hardly determine the motion, or None."""
    deviation = np.median(usable_paths.known_paths(preprocessing).depth_deviation)
    coverage = usable_paths.coverage(preprocessing)
    if coverage >= WELL_COVERED and deviation <= WELL_PLACED:
        return None
    static, start, _ = _best(False, seconds)
    spec = specs.override(presets.PRESETS[static], start)
    return Choice(static, start + capacity(spec, size, seconds=seconds))


def capacity(
    spec: Any,
    size: tuple[int, int],
    followed: float = 1.0,
    seconds: float | int | None = None,
) -> tuple[str, ...]:
    """Return overrides for more Gaussians: for large images, short tracks, long runs.

    Counts are multiplied by the square root of the image size relative to the built-in
    scene: details grow with the number of pixels, and the time of a step with both. The
    number of moving Gaussians is also multiplied by the square root of the ratio of
    track lengths, because each Gaussian is observed about as long as a track. All
    numbers are multiplied by the square root of the planned time relative to
    `USUAL_SECONDS`, so that steps and Gaussians both grow with it. Counts are rounded
    to two digits.

    Args:
      spec: Settings of a small preset.
      size: (width, height) of the images in pixels.
      followed: Mean share of the video that a track covers.
      seconds: Planned seconds of training, or None for the steps of the preset.

    Returns:
      Overrides such as "init.points=5000".
    """
    share = max((size[0] * size[1] / SMALL_PIXELS) ** 0.5, 1.0)
    if seconds is not None:
        by_time = (seconds / USUAL_SECONDS) ** TIME_POWER
        share *= min(max(by_time, LEAST_CAPACITY), MOST_CAPACITY)
    counts = {
        "strategy.cap_max": share * spec.strategy.cap_max,
        "init.points": share * spec.init.points,
    }
    if spec.start.motion == "tracks":
        moving = share * spec.start.moving_points
        count = min(max(LONG / followed, 1.0) ** 0.5, MOST_TIMES) * moving
        counts["start.moving_points"] = count
        counts["strategy.cap_max"] += count - moving
    moving_points = spec.start.moving_points
    if share == 1 and counts.get("start.moving_points", 0) <= moving_points:
        return ()
    return tuple(f"{k}={float(f'{n:.2g}'):.0f}" for k, n in counts.items())


GAUSSIANS = Representation(
    name="gaussians",
    spec_type=scene.SplatScene,
    presets=presets.PRESETS,
    with_steps=presets.with_steps,
    metadata_of=lambda capture, spec: scene.metadata_of(capture),
    build=scene.build,
    resources=Resources(
        # Splatting consists of small loops. XLA splits them over all cores without a
        # gain: a training step takes 87 to 94 ms with one thread and 94 to 109 with
        # four (10,000 Gaussians, 176x132). With one, results also do not depend on the
        # number of cores.
        threads="one",
        shares=lambda spec: spec.batch_size,
        share_setting="batch_size",
        divisible=True,  # by bands of the image
        estimate_memory_bytes=first_state.estimate_memory_bytes,
        memory_hint="lower init.points, init.random or raster.capacity",
        growth=growth,
        step_parts=step_time.parts,
    ),
    scoring=Scoring(
        models_lenses=lambda metadata: metadata.distorted,
        half_scorer=held_out_exposure.scorer,
        follow=gaussian_tracks.follow,
        mover=gaussian_tracks.mover,
        validates=_validates,
    ),
    products=Products(
        save=save,
        player=player,
        splatting=browser_splats.splatting,
        parts=variants.parts,
        variant=variants.without_effects,
    ),
    recommendation=Recommendation(
        advise,
        default_preset,
        effect_overrides,
        prices={
            MOTION: Pair("splats-deformable-small", "only_motion"),
            DEPTH: Pair("sonata-small", "only_depth"),
            LIGHT: Pair("splats-static-small", "only_exposure"),
        },
    ),
)
