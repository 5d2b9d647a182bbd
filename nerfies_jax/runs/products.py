"""Products of a finished run: metrics, images, a video, depth and a report."""

import contextlib
import dataclasses
import itertools
import json
import math
import pathlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from nerfies_jax import evaluation
from nerfies_jax.capture import camera_paths, exr, video
from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.extras import MissingExtra
from nerfies_jax.capture.json_files import merged_folder, write_json
from nerfies_jax.evaluation import Renderer, Scored, heldout
from nerfies_jax.evaluation.representation import Saved
from nerfies_jax.metrics import clock
from nerfies_jax.metrics.clock import Metric
from nerfies_jax.metrics.metric_table import metric
from nerfies_jax.runs import (
    baselines_text,
    budget,
    commands,
    curve_figure,
    curves,
    quality,
    relative_paths,
    report,
    step_profile,
)
from nerfies_jax.runs.attempts import Attempts
from nerfies_jax.runs.run import Run, with_found_cameras
from nerfies_jax.runs.run_folder import CONFIG, LEFT_OUT
from nerfies_jax.runs.train import Trained
from nerfies_jax.runtime import console, events
from nerfies_jax.training import losses
from nerfies_jax.training.model import TrainState
from nerfies_jax.visualization import panels

METRICS = "metrics.json"
SHOWN = 4  # held-out frames in the comparison
COMPARED = (
    "Held-out frames, which the model was not trained on. Each row shows the observed "
    "image, the rendered image, the error between them, and the rendered depth."
)
FILMED = (
    "The reconstructed scene over time, from a camera that sways around the captured "
    "viewpoints."
)


def make(
    folder: pathlib.Path,
    run: Run,
    trained: Trained,
    began: float,
    extra: quality.Extra = quality.NOTHING,
) -> None:
    """Write all products into the run folder and print where they are.

    Args:
      folder: The run folder.
      run: The run.
      trained: Its training.
      began: `time.perf_counter()` at the beginning of the run.
      extra: Additional metrics.

    Raises:
      FloatingPointError: If rendered images are not finite, in which case nothing is
        written. Parameters may be finite and yet unusable.
      OSError: If products could not be written, after all others have been.
    """
    state, renderer = trained.result.state, trained.renderer
    run = with_found_cameras(run, state)
    rows, left_out = frames_to_score(run, trained)
    scored = evaluation.score(trained.draw, state, run.filmed, rows)
    if not np.isfinite(scored.color).all():
        raise FloatingPointError(
            f"no report: what the state of step {trained.result.steps:,} draws is not "
            "finite"
        )
    quality.check_learned(trained.result.history, scored)
    ms_per_frame = renderer.ms_per_frame(len(scored.rows))
    # Products that replace earlier ones stay together.
    attempt = Attempts(together=(folder / METRICS).exists())
    with _staged(folder) as place:
        nothing: tuple[list[report.Figure], list[str]] = ([], [])
        player, unplayed = attempt(nothing, save_player, place, run, trained)
        # Compiles while all else is written, but for the player, whose own compiling
        # fills both cores.
        with step_profile.profiling(run, state) as profile:
            figures = [*player]
            comparison = attempt(
                None, save_comparison, place / "comparison.png", run.filmed, scored
            )
            if comparison is not None:
                figures.append(report.Figure(comparison, COMPARED))
            watched = [run.capture.ids[row] for row in trained.watched]
            course = curves.course_of(folder)
            history = trained.result.history
            attempt(None, curves.write, place, history, watched, course)
            path = place / "psnr_over_time.png"
            curve = attempt(
                None, with_extra, curve_figure.save, path, run, trained, scored
            )
            if curve is not None:
                caption = curve_figure.caption(run, trained, scored)
                figures.append(report.Figure(curve, caption))
            seconds, path = ms_per_frame / 1e3, place / "scene.mp4"
            film = attempt(
                None, with_extra, save_film, path, run, renderer, state, seconds
            )
            attempt(None, save_depth, place / "depth", run.capture, scored)
            save = run.representation.products.save
            model = run.spec, run.metadata, state
            with events.stage("saving the model"):
                saved = attempt(Saved(), save, place, *model)
            fitted, gain = score_halves(run, state, scored, ms_per_frame / 1e3)
            numbers, remarks = quality.measure(
                run, state, trained.draw, scored, extra, ms_per_frame / 1e3
            )
            metrics = heldout.metrics(numbers)
            metrics += [*measured(run, trained, scored, ms_per_frame, began), *fitted]
            metrics += model_size(saved)
            attempt(None, save_metrics, place / METRICS, metrics)
            warnings = baselines_text.warnings(numbers)
            notes = [*warnings, trained.result.message, *left_out]
            notes += _capture_notes(run, folder)
            notes += [*remarks, *gain, *saved.notes, *unplayed]
            with events.stage("timing the parts of a step"):
                step_ms, unknown = profile()
        notes += unknown
    page = attempt(
        None,
        report.write,
        folder,
        f"{run.capture.name}: {run.config.preset}",
        metrics,
        json.loads((folder / CONFIG).read_text()),
        [each._replace(path=folder / each.path.name) for each in figures],
        film if film is None else film._replace(path=folder / film.path.name),
        step_ms,
        notes,
        _next(folder.absolute(), run, trained, relative_paths.base_of(folder)),
    )
    following = _next(folder, run, trained)
    for figure in player:
        console.say(f"player:     {folder / figure.link}")
    _log(folder, page, metrics, [*baselines_text.lines(numbers), *warnings], following)
    attempt.finish()


def _staged(folder):
    """Yield a folder to write to, next to earlier products until all new ones exist.

    A run without any keeps what it could write, whatever fails.
    """
    if (folder / METRICS).exists():
        return merged_folder(folder)
    return contextlib.nullcontext(folder)


def with_extra(save: Callable[..., Any], path: pathlib.Path, *arguments):
    """Save a product that may need an extra.

    Args:
      save: Function that saves the product.
      path: Its first argument.
      *arguments: Further arguments.

    Returns:
      Its result, or None, after a line of text, if the extra is not installed.
    """
    try:
        return save(path, *arguments)
    except MissingExtra as error:
        console.say(f"no {path.name}: {error}")
        return None


def save_metrics(path: pathlib.Path, metrics: list[Metric]) -> None:
    """Write metrics as JSON values by key, null for values that are not finite.

    Args:
      path: The file.
      metrics: The metrics.
    """
    write_json(
        path, {m.key: m.value if math.isfinite(m.value) else None for m in metrics}
    )


def _capture_notes(run, folder):
    """Notes on the training images, their preprocessing, and the evaluated images."""
    unpreprocessed = json.loads((folder / CONFIG).read_text()).get(LEFT_OUT, [])
    return dict.fromkeys([*run.capture.notes, *unpreprocessed, *run.filmed.notes])


def frames_to_score(run: Run, trained: Trained) -> tuple[np.ndarray, tuple[str, ...]]:
    """Select the held-out frames to evaluate.

    Args:
      run: The run.
      trained: Its training.

    Returns:
      Rows of the frames, and a note if time does not allow all of them.
    """
    heldout = run.capture.heldout
    seconds = trained.renderer.ms_per_frame(1) / 1e3
    count = budget.scored(seconds, len(heldout))
    if count == len(heldout):
        return heldout, ()
    note = (
        f"Scores are of {count} of the {len(heldout)} held-out frames, evenly spread: "
        f"one takes {seconds:.1f} s to render."
    )
    return evaluation.spread(heldout, count), (note,)


def measured(
    run: Run, trained: Trained, scored: Scored, ms_per_frame: float, began: float
) -> list[Metric]:
    """Collect the metrics of time, memory and size of a run.

    Args:
      run: The run.
      trained: Its training.
      scored: Its evaluated frames.
      ms_per_frame: Milliseconds to render a frame.
      began: `time.perf_counter()` at the beginning of the run.

    Returns:
      The metrics.
    """
    result = trained.result
    counts = run.model.counts(result.state)
    seconds, fps = time.perf_counter() - began, 1e3 / ms_per_frame
    return [
        metric("heldout.frames", len(scored.rows)),
        metric("train.seconds", result.seconds, 0.2 * result.seconds),
        metric("train.compile_seconds", result.compile_seconds, 10.0),
        metric("train.steps", result.steps),
        metric("render.ms_per_frame", ms_per_frame, 0.2 * ms_per_frame),
        metric("render.fps", fps, 0.2 * fps),
        metric("memory.peak_bytes", clock.peak_bytes(), 2e8),
        *_device_memory(),
        metric("total.seconds", seconds, 0.2 * seconds),
        *(metric(name, count, 0.1 * count) for name, count in counts.items()),
    ]


def _device_memory():
    """Peak of device memory, if the backend reports it. That of a CPU does not."""
    peak = clock.device_peak_bytes()
    if peak is None:
        return []
    return [metric("memory.device_peak_bytes", peak, 2e8)]


def model_size(saved: Saved) -> list[Metric]:
    """Return the size of the file that holds the whole scene, if there is one.

    Args:
      saved: Exported files.

    Returns:
      One metric or none.
    """
    size = saved.model_bytes
    return [] if size is None else [metric("file.bytes", size, 1e5)]


@events.stage("scoring halves of frames")
def score_halves(
    run: Run, state: TrainState, scored: Scored, frame_seconds: float
) -> tuple[list[Metric], tuple[str, ...]]:
    """Evaluate the right halves of frames after fitting codes to their left halves.

    Args:
      run: The run.
      state: Trained state.
      scored: Evaluated frames.
      frame_seconds: Seconds to render a frame.

    Returns:
      Metrics and notes, both empty if frames have no codes of their own.
    """
    width, height = run.capture.size
    if width // 2 < len(losses.WINDOW):
        return [], ()  # too narrow for the window of the SSIM
    share = run.representation.scoring.fitted_rays / (width * height)
    count = budget.halves(frame_seconds, share, len(scored.rows))
    few = evaluation.spread(np.arange(len(scored.rows)), count)
    halves = run.representation.scoring.score_halves(
        run.spec,
        run.metadata,
        state,
        run.capture,
        scored.rows[few],
    )
    if halves is None:
        return [], ()
    before = evaluation.score_right_halves(
        run.capture, scored.rows[few], scored.color[few]
    )
    psnr, ssim = (evaluation.known_mean(each) for each in (halves.psnr, halves.ssim))
    unfitted = evaluation.known_mean(before.psnr)
    note = (
        f"Right halves of {count} held-out frames: {unfitted:.2f} dB with "
        f"codes interpolated in time, {psnr:.2f} dB with codes fitted to the left "
        "halves and without a transient medium."
    )
    metrics = [
        metric("heldout.fitted_psnr", psnr, 0.2),
        metric("heldout.fitted_ssim", ssim, 0.01),
    ]
    return metrics, (note,)


@events.stage("drawing the comparison")
def save_comparison(path: pathlib.Path, capture: Capture, scored: Scored):
    """Save an image of ground truth, render, error and depth of a few held-out frames.

    Args:
      path: The file.
      capture: The capture.
      scored: Evaluated frames.

    Returns:
      The path.
    """
    shown = evaluation.spread(np.arange(len(scored.rows)), SHOWN)
    captions = [
        f"frame {capture.ids[scored.rows[i]]}   {scored.psnr[i]:.2f} dB   "
        f"SSIM {scored.ssim[i]:.3f}"
        for i in shown
    ]
    truth, color = capture.images[scored.rows[shown]], scored.color[shown]
    if capture.valid is not None:  # what was not filmed is black in both: no error
        filmed = capture.valid[scored.rows[shown]][..., None]
        truth, color = np.where(filmed, truth, 0), np.where(filmed, color, 0)
    picture = panels.comparison(
        truth,
        color,
        scored.depth[shown],
        captions,
        known_depth=scored.alpha[shown] > 0.5,
    )
    panels.save(picture, path)
    return path


def save_film(
    path: pathlib.Path,
    run: Run,
    renderer: Renderer,
    state: TrainState,
    frame_seconds: float,
) -> report.Video:
    """Render a video of the scene over time from a moving camera, within a time budget.

    Args:
      path: The file.
      run: The run.
      renderer: Renderer at the size of the capture.
      state: Trained state.
      frame_seconds: Seconds to render a frame.

    Returns:
      The video for the report.
    """
    size = run.capture.size
    film = budget.film(frame_seconds, size)
    if film.size != size:
        renderer = Renderer(run.model, film.size)
    views = evaluation.path_views(
        camera_paths.path("sway", run.capture, film.frames),
        camera_paths.times(film.frames),
        evaluation.view_of(run.capture, int(run.capture.train[0])),
    )

    def frames(stage):
        for view in views:
            rendering = renderer(state, evaluation.resized(view, size, film.size))
            yield evaluation.as_picture(rendering.color)
            stage.advance()

    with events.stage("rendering the video", film.frames) as stage:
        rendered = frames(stage)
        poster = next(rendered)
        video.write_video(path, itertools.chain([poster], rendered), film.rate)
    return report.Video(path, FILMED, poster)


@events.stage("making the player")
def save_player(
    folder: pathlib.Path, run: Run, trained: Trained
) -> tuple[list[report.Figure], list[str]]:
    """Write an interactive page that plays the scene.

    Args:
      folder: The run folder.
      run: The run.
      trained: Its training.

    Returns:
      A figure that links to the page, or none and a note with the reason.
    """
    write = run.representation.products.player
    if write is None:
        return [], [
            f"The {run.representation.name} representation has no player; scene.mp4 "
            "shows it from a moving camera."
        ]
    first = evaluation.view_of(run.capture, int(run.capture.train[0]))
    try:
        state = trained.result.state
        poster = evaluation.as_picture(np.asarray(trained.renderer(state, first).color))
        player = write(
            folder / "player.html",
            f"{run.capture.name}: {run.config.preset}",
            run.spec,
            run.model,
            state,
            run.capture,
            poster,
        )
        picture = folder / "player.png"
        panels.save(poster, picture)
    except (OSError, CaptureError):  # a full disk is told with all that is not written
        raise
    except Exception as error:  # whatever it is, the run keeps all its other products
        return [], [f"There is no player: {type(error).__name__}: {error}"]
    caption = (
        f"The interactive player, {player.path.name}, shows the scene from any "
        f"viewpoint at any time in a web browser. It contains {player.about}"
    )
    return [report.Figure(picture, caption, player.path.name)], []


@events.stage("writing depth")
def save_depth(folder: pathlib.Path, capture: Capture, scored: Scored) -> None:
    """Write z-depth (scene units) and opacity of every evaluated frame as EXR.

    Args:
      folder: Folder to write to.
      capture: The capture.
      scored: Evaluated frames.
    """
    folder.mkdir(exist_ok=True)
    for row, depth, alpha in zip(scored.rows, scored.depth, scored.alpha, strict=True):
        name = capture.ids[row].replace("/", "_")
        exr.write_exr(folder / f"{name}.exr", alpha=alpha, depth=depth)


def _next(folder, run, trained, base=None):
    """Suggested next commands, with absolute paths relative to a `base`."""
    own = run.code
    line = commands.render(folder, own, base)
    looked = report.Command("Render it from other viewpoints and times:", line)
    if trained.result.stopped_by == "non-finite":
        return [looked]  # resumed, it would stop at the same step
    if trained.result.steps < run.spec.steps:
        line = commands.resume(folder, own, base)
        return [looked, report.Command("Train it to the end:", line)]
    others = tuple(o for o in run.config.overrides if not o.startswith("steps="))
    longer = dataclasses.replace(run.config, steps=2 * run.spec.steps, overrides=others)
    line = commands.reconstruct(longer, base)
    return [looked, report.Command("Train it twice as long:", line)]


def _log(folder, page, metrics, baselines, following):
    value = {metric.key: metric.value for metric in metrics}
    console.say(
        f"held out: {value['heldout.psnr']:.2f} dB, SSIM {value['heldout.ssim']:.3f} "
        f"over {value['heldout.frames']} frames{_parts(value)}; "
        f"{value['train.seconds']:.0f} s of "
        f"training, {value['train.compile_seconds']:.0f} s of compilation; "
        f"{value['render.ms_per_frame']:.0f} ms per frame"
    )
    if "tracks.epe" in value:
        console.say(
            f"tracks:    end-point error {value['tracks.epe']:.4f} scene units, "
            f"{value['tracks.static_epe']:.4f} for a static prediction"
        )
    for line in baselines:
        console.say(line)
    if page is not None:
        console.say(f"report:     {page}")
    for kind, name in (("comparison:", "comparison.png"), ("video:", "scene.mp4")):
        if (folder / name).exists():
            console.say(f"{kind:11} {folder / name}")
    for command in following:
        console.say(f"{command.purpose}\n  {command.line}")


def _parts(value):
    """Format the PSNR of moving and static regions, where masks separate them."""
    names = {"moving": "heldout.moving_psnr", "static": "heldout.static_psnr"}
    parts = [
        f"{value[key]:.2f} dB {name}" for name, key in names.items() if key in value
    ]
    return f" ({', '.join(parts)})" if parts else ""
