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
from nerfies_jax.capture import camera_paths, exr
from nerfies_jax.capture.capture import Capture, CaptureError
from nerfies_jax.capture.extras import MissingExtra
from nerfies_jax.capture.images import write_png
from nerfies_jax.capture.json_files import merged_folder, write_json
from nerfies_jax.capture.video import write_video
from nerfies_jax.evaluation import Halves, Renderer, Scored, heldout
from nerfies_jax.evaluation.representation import HalfScorer, Saved
from nerfies_jax.metrics import clock
from nerfies_jax.metrics.clock import Metric
from nerfies_jax.metrics.metric_table import PROTOCOL, main_key, metric
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
from nerfies_jax.runs.run_folder import CONFIG, PREPROCESSING_NOTES
from nerfies_jax.runs.train import Trained
from nerfies_jax.runtime import console, events
from nerfies_jax.training.model import TrainState
from nerfies_jax.visualization import panels

METRICS = "metrics.json"
SHARE = "transient/share"  # of the losses of a field with a transient medium
COMPARISON_FRAMES = 4
COMPARISON_CAPTION = (
    "Held-out frames, which the model was not trained on. Each row shows the observed "
    "image, the rendered image, the error between them, and the rendered depth."
)
HALVES = (
    " Only right halves are shown, in the light of the image: the codes were fitted to "
    "the left halves."
)
VIDEO_CAPTION = (
    "The reconstructed scene over time, from a camera that sways around the captured "
    "viewpoints."
)


def make(
    folder: pathlib.Path,
    run: Run,
    trained: Trained,
    start_time: float,
    extra: quality.Extra = quality.NOTHING,
) -> None:
    """Write all products into the run folder and print their paths.

    Args:
      folder: The run folder.
      run: The run.
      trained: Its training.
      start_time: `time.perf_counter()` at the beginning of the run.
      extra: Additional metrics.

    Raises:
      FloatingPointError: If rendered images are not finite, which finite parameters do
        not exclude. In that case nothing is written.
      OSError: If products could not be written, after all others have been.
    """
    state, renderer = trained.result.state, trained.renderer
    run = with_found_cameras(run, state)
    rows, skipped_frames = _frames_to_score(run, trained)
    scores = evaluation.score(renderer, state, run.observed, rows)
    if not np.isfinite(scores.color).all():
        raise FloatingPointError(
            f"no report: the images rendered at step {trained.result.steps:,} are not "
            "finite"
        )
    quality.check_learned(trained.result.history, scores)
    ms_per_frame = renderer.ms_per_frame(len(scores.rows))
    # Products of an earlier call are replaced together or not at all.
    attempt = Attempts(all_or_none=(folder / METRICS).exists())
    with _stage(folder) as target:
        no_player: tuple[list[report.Figure], list[str]] = ([], [])
        player, player_notes = attempt(no_player, save_player, target, run, trained)
        # The parts of a step are compiled in the background while other products are
        # written. The player comes first, because its compilation uses all cores.
        with step_profile.profiling(run, state, extra.step_profile) as profile:
            figures = [*player]
            seconds = ms_per_frame / 1e3
            halves = fitted_halves(run, state, trained.scorer, scores, seconds)
            comparison = attempt(
                None,
                _save_comparison,
                target / "comparison.png",
                run.observed,
                scores if halves is None else _right_halves(scores, halves),
            )
            if comparison is not None:
                caption = COMPARISON_CAPTION + ("" if halves is None else HALVES)
                figures.append(report.Figure(comparison, caption))
            frame_ids = [run.capture.ids[row] for row in trained.watched]
            course = curves.course_of(folder)
            history = trained.result.history
            attempt(None, curves.write, target, history, frame_ids, course)
            path = target / "psnr_over_time.png"
            fitted_metrics, fit_notes = _fitted_metrics(scores, halves, run.capture)
            final = curve_figure.Result(
                fitted_metrics[0].value
                if fitted_metrics
                else evaluation.known_mean(scores.psnr),
                len(scores.rows),
                is_fitted=bool(fitted_metrics),
            )
            curve = attempt(
                None, _with_extra, curve_figure.save, path, run, trained, final
            )
            if curve is not None:
                caption = curve_figure.caption(run, trained, final)
                figures.append(report.Figure(curve, caption))
            path = target / "scene.mp4"
            video = attempt(
                None, _with_extra, save_video, path, run, renderer, state, seconds
            )
            attempt(None, save_depth, target / "depth", run.capture, scores)
            save = run.representation.products.save
            model = run.spec, run.metadata, state
            with events.stage("saving the model"):
                exports = attempt(Saved(), save, target, *model)
            numbers, quality_notes = quality.measure(
                run, state, renderer, scores, extra, seconds
            )
            metrics = heldout.metrics(numbers)
            metrics += measured(run, trained, scores, ms_per_frame, start_time)
            metrics += [*fitted_metrics, *model_size(exports)]
            attempt(None, _save_metrics, target / METRICS, metrics)
            main = {each.key: each.value for each in metrics}
            warnings = baselines_text.warnings(main, quality.tracked_share(run, main))
            notes = [*warnings, trained.result.message, *skipped_frames]
            notes += _capture_notes(run, folder)
            notes += [*quality_notes, *fit_notes, *exports.notes, *player_notes]
            step_ms, profile_notes = profile()
        notes += profile_notes
    page = attempt(
        None,
        report.write,
        folder,
        f"{run.capture.name}: {run.config.preset}",
        metrics,
        json.loads((folder / CONFIG).read_text()),
        [each._replace(path=folder / each.path.name) for each in figures],
        video if video is None else video._replace(path=folder / video.path.name),
        step_ms,
        notes,
        _next(folder.absolute(), run, trained, relative_paths.base_of(folder)),
    )
    for figure in player:
        console.say(f"player:     {folder / figure.link}")
    baselines = [*baselines_text.lines(numbers), *warnings]
    _log(folder, page, metrics, baselines, _next(folder, run, trained))
    attempt.finish()


def _stage(folder):
    """Yield the folder to write products to.

    If the run has earlier products, it is a temporary folder, whose contents replace
    them when the block ends without an error.
    """
    if (folder / METRICS).exists():
        return merged_folder(folder)
    return contextlib.nullcontext(folder)


def _with_extra(save: Callable[..., Any], path: pathlib.Path, *arguments):
    """Save a product that may need an extra."""
    try:
        return save(path, *arguments)
    except MissingExtra as error:
        console.say(f"no {path.name}: {error}")
        return None


def _save_metrics(path: pathlib.Path, metrics: list[Metric]) -> None:
    """Write metrics as JSON values by key, null for values that are not finite."""
    write_json(
        path, {m.key: m.value if math.isfinite(m.value) else None for m in metrics}
    )


def _capture_notes(run, folder):
    """Notes on the training images, their preprocessing, and the evaluated images."""
    config = json.loads((folder / CONFIG).read_text())
    preprocessing = config.get(PREPROCESSING_NOTES, [])
    return dict.fromkeys([*run.capture.notes, *preprocessing, *run.observed.notes])


def _frames_to_score(run: Run, training: Trained) -> tuple[np.ndarray, tuple[str, ...]]:
    """Select the held-out frames to evaluate."""
    heldout = run.capture.heldout
    seconds = training.renderer.ms_per_frame(1) / 1e3
    count = budget.scored_frames(seconds, len(heldout))
    if count == len(heldout):
        return heldout, ()
    note = (
        f"Metrics are computed on {count} of the {len(heldout)} held-out frames, "
        f"evenly spaced, because each takes {seconds:.1f} s to render."
    )
    return evaluation.spread(heldout, count), (note,)


def measured(
    run: Run, trained: Trained, scored: Scored, ms_per_frame: float, start_time: float
) -> list[Metric]:
    """Collect the metrics of time, memory and size of a run.

    Args:
      run: The run.
      trained: Its training.
      scored: Its evaluated frames.
      ms_per_frame: Milliseconds to render a frame.
      start_time: `time.perf_counter()` at the beginning of the run.

    Returns:
      The metrics.
    """
    result = trained.result
    counts = run.model.counts(result.state)
    seconds, fps = time.perf_counter() - start_time, 1e3 / ms_per_frame
    return [
        metric("heldout.frames", len(scored.rows)),
        metric("train.seconds", result.seconds, 0.2 * result.seconds),
        *_processor_time(result.history),
        metric("train.compile_seconds", result.compile_seconds, 10.0),
        metric("train.steps", result.steps),
        metric("render.ms_per_frame", ms_per_frame, 0.2 * ms_per_frame),
        metric("render.fps", fps, 0.2 * fps),
        metric("memory.peak_bytes", clock.peak_bytes(), 2e8),
        *_device_memory(),
        *_transient_share(result.history),
        metric("total.seconds", seconds, 0.2 * seconds),
        *(metric(name, count, 0.1 * count) for name, count in counts.items()),
    ]


def _device_memory():
    """Return the peak of device memory, which the CPU backend does not report."""
    peak = clock.device_peak_bytes()
    if peak is None:
        return []
    return [metric("memory.device_peak_bytes", peak, 2e8)]


def _processor_time(history):
    """Return the processor time of training, unless earlier sessions lack it."""
    seconds = history.cpu_seconds
    if math.isnan(seconds):
        return []
    return [metric("train.cpu_seconds", seconds, 0.2 * seconds)]


def _transient_share(history):
    """Return the share of training pixels that a transient medium explains."""
    shares = [row[SHARE] for row in history.rows if SHARE in row]
    return [metric("transient.share", shares[-1])] if shares else []


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
def fitted_halves(
    run: Run,
    state: TrainState,
    scorer: HalfScorer | None,
    scored: Scored,
    frame_seconds: float,
) -> Halves | None:
    """Evaluate the right halves of frames after fitting codes to their left halves.

    Args:
      run: The run.
      state: Trained state.
      scorer: The function of `train.half_scorer`.
      scored: Evaluated frames.
      frame_seconds: Seconds to render a frame.

    Returns:
      The right halves of as many frames as time allows, or None if the model has no
      per-frame codes.
    """
    if scorer is None:
        return None
    width, height = run.capture.size
    share = run.representation.scoring.fitted_rays / (width * height)
    count = budget.fitted_frames(frame_seconds, share, len(scored.rows))
    places = evaluation.spread(np.arange(len(scored.rows)), count)
    return scorer(state, run.capture, scored.rows[places])


def _fitted_metrics(scores, halves, capture):
    """Return metrics of fitted right halves and a note, both empty without them."""
    if halves is None:
        return [], ()
    colors = scores.color[np.isin(scores.rows, halves.rows)]
    before = evaluation.score_right_halves(capture, halves.rows, colors)
    psnr, ssim = (evaluation.known_mean(each) for each in (halves.psnr, halves.ssim))
    unfitted_psnr = evaluation.known_mean(before.psnr)
    note = (
        f"The main result follows {PROTOCOL}. The right halves of {len(colors)} "
        f"held-out frames have {psnr:.2f} dB with codes fitted to the left halves, "
        f"without the transient field, and {unfitted_psnr:.2f} dB without fitting, "
        "with codes interpolated in time."
    )
    metrics = [
        metric("heldout.fitted_psnr", psnr, 0.2),
        metric("heldout.fitted_ssim", ssim, 0.01),
    ]
    return metrics, (note,)


def _right_halves(scores, halves):
    """Return the fitted right halves of frames, with depths of the whole renders."""
    is_fitted = np.isin(scores.rows, halves.rows)
    left = scores.color.shape[2] - halves.color.shape[2]
    return Scored(
        halves.rows,
        np.clip(halves.color, 0, 1),
        scores.alpha[is_fitted, :, left:],
        scores.depth[is_fitted, :, left:],
        halves.psnr,
        halves.ssim,
    )


@events.stage("drawing the comparison")
def _save_comparison(
    path: pathlib.Path, capture: Capture, scores: Scored
) -> pathlib.Path:
    """Save truth, render, error and depth of a few held-out frames.

    Renders that are narrower than the images show their right part.
    """
    places = evaluation.spread(np.arange(len(scores.rows)), COMPARISON_FRAMES)
    captions = [
        f"frame {capture.ids[scores.rows[i]]}   {scores.psnr[i]:.2f} dB   "
        f"SSIM {scores.ssim[i]:.3f}"
        for i in places
    ]
    rows, color = scores.rows[places], scores.color[places]
    left = capture.size[0] - color.shape[2]
    truth = capture.images[rows, :, left:]
    # Pixels that were not observed are black in both, so that they show no error.
    if capture.valid is not None:
        valid = capture.valid[rows, :, left:, None]
        truth, color = np.where(valid, truth, 0), np.where(valid, color, 0)
    image = panels.comparison(
        truth,
        color,
        scores.depth[places],
        captions,
        known_depth=scores.alpha[places] > 0.5,
    )
    write_png(path, image)
    return path


def save_video(
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
    plan = budget.video(frame_seconds, size)
    if plan.size != size:
        renderer = Renderer(run.model, plan.size)
    views = evaluation.path_views(
        camera_paths.path("sway", run.capture, plan.frames),
        camera_paths.times(plan.frames),
        evaluation.view_of(run.capture, int(run.capture.train[0])),
    )

    def frames(stage):
        for view in views:
            rendering = renderer(state, evaluation.resized(view, size, plan.size))
            yield evaluation.to_uint8(rendering.color)
            stage.advance()

    with events.stage("rendering the video", plan.frames) as stage:
        images = frames(stage)
        poster = next(images)
        write_video(path, itertools.chain([poster], images), plan.rate)
    return report.Video(path, VIDEO_CAPTION, poster)


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
            f"The {run.representation.name} representation has no interactive player; "
            "scene.mp4 shows the scene from a moving camera."
        ]
    first = evaluation.view_of(run.capture, int(run.capture.train[0]))
    try:
        state = trained.result.state
        poster = evaluation.to_uint8(np.asarray(trained.renderer(state, first).color))
        player = write(
            folder / "player.html",
            f"{run.capture.name}: {run.config.preset}",
            run.spec,
            run.model,
            state,
            run.capture,
            poster,
        )
        image = folder / "player.png"
        write_png(image, poster)
    except (OSError, CaptureError):  # `Attempts` reports files that are not written
        raise
    except Exception as error:  # no failure of the player may affect other products
        message = f"{type(error).__name__}: {error}"
        return [], [f"The interactive player could not be created: {message}"]
    caption = (
        f"The interactive player, {player.path.name}, shows the scene from any "
        f"viewpoint at any time in a web browser. It contains {player.about}"
    )
    return [report.Figure(image, caption, player.path.name)], []


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


def _next(folder, run, training, base=None):
    """Suggest the next commands, with absolute paths relative to a `base`."""
    line = commands.render(folder, run.code, base)
    render = report.Command("Render the scene from other viewpoints and times:", line)
    if training.result.stopped_by == "non-finite":
        return [render]  # a resumed run would stop at the same step
    if training.result.steps < run.spec.steps:
        line = commands.resume(folder, run.code, base)
        return [render, report.Command("Continue training to the last step:", line)]
    overrides = tuple(o for o in run.config.overrides if not o.startswith("steps="))
    longer = dataclasses.replace(
        run.config, steps=2 * run.spec.steps, overrides=overrides
    )
    line = commands.reconstruct(longer, base)
    return [render, report.Command("Train for twice as many steps:", line)]


def _log(folder, page, metrics, baselines, suggestions):
    """Print the main metrics, the paths of the products, and suggested commands."""
    value = {metric.key: metric.value for metric in metrics}
    psnr, ssim = (main_key(f"heldout.{name}", value) for name in ("psnr", "ssim"))
    protocol = ""
    if psnr != "heldout.psnr":
        protocol = (
            f" ({PROTOCOL}; {value['heldout.psnr']:.2f} dB PSNR, "
            f"{value['heldout.ssim']:.3f} SSIM of whole frames without fitting)"
        )
    console.say(
        f"held-out:   {value[psnr]:.2f} dB PSNR, "
        f"{value[ssim]:.3f} SSIM{protocol} over {value['heldout.frames']} frames"
        f"{_parts(value)}; "
        f"{value['train.seconds']:.0f} s of training, "
        f"{value['train.compile_seconds']:.0f} s of compilation; "
        f"{value['render.ms_per_frame']:.0f} ms per rendered frame"
    )
    if "tracks.epe" in value:
        console.say(
            f"tracks:     end-point error {value['tracks.epe']:.4f} scene units "
            f"({value['tracks.static_epe']:.4f} for a static prediction)"
        )
    for line in baselines:
        console.say(line)
    if page is not None:
        console.say(f"report:     {page}")
    for kind, name in (("comparison:", "comparison.png"), ("video:", "scene.mp4")):
        if (folder / name).exists():
            console.say(f"{kind:11} {folder / name}")
    for command in suggestions:
        console.say(f"{command.purpose}\n  {command.line}")


def _parts(value):
    """Format the PSNR of moving and static regions, if masks separate them."""
    names = {"moving": "heldout.moving_psnr", "static": "heldout.static_psnr"}
    parts = [
        f"{value[key]:.2f} dB {name}" for name, key in names.items() if key in value
    ]
    return f" ({', '.join(parts)})" if parts else ""
