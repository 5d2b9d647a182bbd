"""Gaussian splats, as `nerfies_jax.runs` finds them."""

import pathlib
from typing import Any

import numpy as np

from gaussians_jax.core import splats
from gaussians_jax.io import files, model_file
from gaussians_jax.motion import anchor_motion, deformation
from gaussians_jax.motion.anchors import AnchorMotionSpec
from gaussians_jax.motion.basis import BasisMotionSpec
from gaussians_jax.player import browser_splats, page
from gaussians_jax.scene import (
    first_state,
    held_out_exposure,
    point_tracks,
    presets,
    scene,
    step_time,
    variants,
)
from gaussians_jax.scene.spec import OF_MOTION, raster_of
from nerfies_jax.capture.cache import CACHE
from nerfies_jax.capture.capture import Capture
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
from nerfies_jax.preprocessing import record, rigid_groups, usable_paths
from nerfies_jax.preprocessing.findings import DEPTH, LIGHT, MOTION, START, TRANSIENT
from nerfies_jax.training import specs
from nerfies_jax.training.model import Model, TrainState
from nerfies_jax.training.track_start import FROM_REST

SMALL_PIXELS = 176 * 132  # for which the counts of the small presets were chosen
# SE(3) bases by the paths: the first that explain four fifths of what the last do
# beyond one body. Median misses of 1, 8, 12, 16, 20 and 24 groups, in 1e-4 of the unit:
# 100, 33, 29, 29, 28, 26 of the built-in scene and 106, 30, 27, 25, 23, 23 of its fast
# one (8), 160, 115, 108, 101, 102, 101 of a hand before books (12) and 128, 75, 69, 67,
# 55, 53 of a bag that is handled (16). Held out, whole and where it moves, 8 beside 12:
# 32.14 / 29.28 and 31.72 / 29.10 dB, 31.23 / 27.74 and 31.03 / 27.36, 38.26 / 34.28 and
# 38.38 / 34.16 (one seed each).
BASES, EXPLAINED = (8, 12, 16, 20, 24), 0.8
# Share of the film through which tracks are followed on average: 0.68 and 0.56 in the
# built-in scenes, 0.27 of a hand before books, 0.23 of a bag that is handled. The bag
# with 8000 for 4100 lifted Gaussians: 27.28 / 22.39 for 27.16 / 22.04 dB, the hand with
# 8000 for 4400 and 25 knots 39.15 / 34.83 for 39.22 / 34.86 in 1.2 times the time (one
# seed each): hence the root.
LONG, MOST_TIMES = 0.5, 3.0
# As in the built-in scenes, where 20 knots serve 60 frames.
FRAMES_A_KNOT, MOST_KNOTS = 3, 60
# Between these advice chooses by whether anything moves.
ADVISED = ("splats-static", "splats-tracked", "splats-deformable")
# What moves where nothing can be followed, of the small size and from rest. Held out in
# equal seconds, and those of `splats-deformable-small` and `dynmf-small` from rest:
# D-NeRF's lego 21.8 dB, 20.7 and 21.3; bookshelf 36.8, 34.5 and 36.4; built-in scene
# 25.1, 24.6 and 25.9.
UNTRACKED = "spacetime"
# Of a scene's spec: the motion, and what is nothing without one.
MOTION_PARTS = ("motion", "neighbors", *OF_MOTION)


def growth(spec: Any, state: TrainState) -> float:
    """Predict how much longer the steps of a whole run take than its first steps.

    The root of how many times the Gaussians may become, two at most. Built-in scene:
    1.5 times from 4500 to 8379 under a cap of 10,000 (`splats-static-small`, 600
    steps), 1.1 times from 7000 to the cap (`splats-tracked-small`, 250 steps).
    """
    if spec.strategy is None:
        return 1.0
    first = int(splats.active_mask(state.params.rows["splats"]).sum())
    return min(max(spec.strategy.cap_max / first, 1.0) ** 0.5, 2.0)


def save(
    folder: pathlib.Path,
    spec: Any,
    metadata: Any,
    state: TrainState,
) -> Saved:
    """`model.npz`, all of the scene, and `gaussians.ply` for viewers."""
    if not bool(splats.active_mask(state.params.rows["splats"]).any()):
        return Saved(notes=(f"No Gaussian is left, so there is no {MODEL}.",))
    about = {"spec": spec, "metadata": metadata, "step": int(state.step)}
    size = model_file.save(folder / MODEL, state.params, about)
    every = scene.all_effects(spec, metadata)
    drawn = deformation.drawn_rows(every, state.params)
    files.save(folder / "gaussians.ply", drawn)
    if all(effect.deform is None for effect in every):
        return Saved(size)
    coded = None
    notes = ["gaussians.ply holds the canonical Gaussians, without their motion."]
    if isinstance(spec.motion, AnchorMotionSpec):
        features, others = anchor_motion.kept_bytes(state.params, spec.motion)
        coded = features + others
        notes.append(
            f"The features of its anchors are {features / 1e6:.2f} MB by their bits "
            f"under the learned law, the rest {others / 1e6:.2f} MB at 32 bits each "
            f"({MODEL} holds all at 32 bits)."
        )
    if isinstance(spec.motion, BasisMotionSpec):
        notes.append(
            f"{MODEL} holds all of the scene in {size / 1e6:.1f} MB. MoBa-GS reports "
            "11.3 MB and 163 frames per second, on an A100, of other scenes: context, "
            "no comparison."
        )
    return Saved(size, tuple(notes), coded)


def player(
    path: pathlib.Path,
    title: str,
    spec: Any,
    model: Model,
    state: TrainState,
    capture: Capture,
    poster: np.ndarray,
) -> Player:
    """Write `player.html`, with a poster uint8 [height, width, 3]."""
    degree = splats.active_degree(state.step, spec.sh_every, spec.sh_degree)
    raster = raster_of(spec, model.spec[1])
    return page.write(path, title, model, raster, degree, state, capture, poster)


def advise(
    wanted: dict[str, bool | None], full: bool, family: str | None = None
) -> Choice:
    """The preset and its changes for what a capture calls for.

    A `family` that is none of `ADVISED` stays, unless it cannot move and should.
    """
    overrides, notes = [], []
    moves = wanted.get(MOTION)
    preset = "splats-deformable" if full else UNTRACKED
    if moves is not None:
        preset = "splats-tracked" if moves else "splats-static"
    if family is not None and family not in ADVISED:
        if moves and _spec_of(family, full).motion is None:
            notes.append(f"{MOTION}: {family} has none; {preset} is taken")
        else:
            preset = family
    spec = _spec_of(preset, full)
    if preset == UNTRACKED != family:
        overrides.append(FROM_REST)
    if moves is False:
        present = (name for name in MOTION_PARTS if getattr(spec, name) is not None)
        overrides += [f"{name}=none" for name in present]
        if spec.motion is not None and spec.start.motion == "tracks":
            overrides.append(FROM_REST)
    if wanted.get(LIGHT) and spec.exposure is None:
        overrides.append("exposure.learning_rate=0.01")
    if wanted.get(LIGHT) is False and spec.exposure is not None:
        overrides.append("exposure=none")
    if wanted.get(TRANSIENT) and (moves is False or spec.motion is None):
        notes.append(f"{TRANSIENT}: splats have no medium for it; prefer the field")
    if wanted.get(START) is False:
        overrides.append("init.source=random")
    if wanted.get(DEPTH) and spec.depth is None:
        overrides.append("depth.weight=0.1")
    if wanted.get(DEPTH) is False and spec.depth is not None:
        overrides.append("depth=none")
    return Choice(preset, tuple(overrides), tuple(notes))


def _spec_of(family, full):
    return presets.PRESETS[family if full else f"{family}-small"]


def default_preset(capture: Capture) -> Choice:
    """The small preset by what tracks say of the capture, gathered or from the cache.

    Few rigid motions where tracks tell them, no motion where nothing moves, and
    polynomials of each Gaussian, from rest, where tracks are of no use.
    """
    evidence = record.cached(capture, CACHE / "evidence")
    reason = usable_paths.unusable(evidence)
    start: tuple[str, ...] = ()
    name, notes = "splats-tracked-small", []
    if reason and usable_paths.stands_still(evidence, capture.times):
        name, notes = "splats-static-small", [reason]
    elif reason:
        name, start = f"{UNTRACKED}-small", (FROM_REST,)
        notes = [f"tracks are of no use: {reason}"]
    spec = specs.override(presets.PRESETS[name], start)
    paths = usable_paths.known_paths(evidence)
    followed = 1.0 if reason else float(paths.known.mean())
    overrides = start + capacity(spec, capture.size, followed)
    if overrides != start:
        size = "x".join(map(str, capture.size))
        short = f" and tracks of {followed:.0%} of the film" if followed < LONG else ""
        notes.append(f"for pictures of {size}{short}")
    if not reason:
        bases = rigid_groups.enough(paths.position, paths.known, BASES, EXPLAINED)
        if bases > spec.motion.bases:
            overrides += (f"motion.bases={bases}",)
            notes.append(f"its tracks move as {bases} rigid things or more")
        frames = paths.known.shape[1]
        knots = min(round(frames / FRAMES_A_KNOT), MOST_KNOTS)
        if knots > spec.motion.knots:
            overrides += (f"motion.knots={knots}",)
            notes.append(f"for {frames} frames")
    return Choice(name, overrides, tuple(notes))


def capacity(
    spec: Any, size: tuple[int, int], followed: float = 1.0
) -> tuple[str, ...]:
    """Overrides that let a small scene have more Gaussians where it needs them.

    With the root of the pixels beyond those of the built-in scene: detail grows with
    the pixels, the time of a step with both. And more of what moves, with the root of
    how much shorter tracks are than there, which are `followed` through that share of
    the film: each is first seen for about as long. To two digits.
    """
    share = max((size[0] * size[1] / SMALL_PIXELS) ** 0.5, 1.0)
    counts = {
        "strategy.cap_max": share * spec.strategy.cap_max,
        "init.points": share * spec.init.points,
    }
    if spec.start.motion == "tracks":
        moving = share * spec.start.moving_points
        more = min(max(LONG / followed, 1.0) ** 0.5, MOST_TIMES) * moving
        counts["start.moving_points"] = more
        counts["strategy.cap_max"] += more - moving
    if share <= 1 and counts.get("start.moving_points", 0) <= spec.start.moving_points:
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
        # Splats are tight loops. XLA splits their bodies over all cores it sees and
        # gains nothing: 87 to 94 ms a training step with one, 94 to 109 with four
        # (10,000 Gaussians, 176x132). With one, the bits do not depend on the core
        # count either.
        threads="one",
        shares=lambda spec: spec.batch_size,
        estimate_memory_bytes=first_state.estimate_memory_bytes,
        memory_hint="lower init.points, init.random or raster.capacity",
        growth=growth,
        step_parts=step_time.parts,
    ),
    scoring=Scoring(
        score_halves=held_out_exposure.score,
        follow=point_tracks.follow,
        mover=point_tracks.mover,
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
        prices={
            MOTION: Pair("splats-deformable-small", "only_motion"),
            DEPTH: Pair("sonata-small", "only_depth"),
            LIGHT: Pair("splats-static-small", "only_exposure"),
        },
    ),
)
