"""Render a finished run: held-out frames, camera paths, frozen time, slow motion.

nerfies render RUN                         # the held-out frames
nerfies render RUN --path orbit            # mp4 of the moving scene
nerfies render RUN --path sway --freeze 0.5
nerfies render RUN --path stabilized       # as captured, smoothed
nerfies render RUN --path camera_path.json # as nerfstudio writes it
nerfies render RUN --path sway --show depth
nerfies render RUN --path sway --show flow
nerfies render RUN --without warp          # the canonical scene
nerfies render RUN --hide-moving 0.02       # the static scene
nerfies render RUN --path sway --freeze 0 --appearance 0 7
nerfies render RUN --path sway --knots 32   # the motion from a table
nerfies render RUN --path sway --static-threshold 1e-4
"""

import dataclasses
import math
import pathlib
from typing import Annotated, ClassVar, Literal

import numpy as np
import tyro

from experiments import cli, render_folder
from nerfies_jax.runtime import console, events


@dataclasses.dataclass(frozen=True)
class Render:
    """Render a finished run, as PNG, mp4 and EXR."""

    GROUPS: ClassVar = {
        "camera": ("path", "frames", "freeze", "slow"),
        "scene": ("without", "appearance", "hide_moving"),
        "speed": ("knots", "interpolation", "static_threshold"),
        "images": ("show", "out", "formats", "max_side"),
    }

    run: cli.Positional[pathlib.Path]
    """Run folder that nerfies reconstruct made."""
    path: str = "heldout"
    """heldout: the held-out frames. Or a camera path within the captured viewpoints
    (sway, lemniscate), on a circle (orbit), as captured (captured), or captured and
    smoothed (stabilized). Or a file: nerfstudio's camera_path.json, or a folder of
    Nerfies' camera files."""
    frames: int | None = None
    """Images along a camera path (default: 96, or those of a file)."""
    freeze: float | None = None
    """Render at this fixed time in [0, 1], along the whole path."""
    slow: float = 1.0
    """Play so many times slower: 4 shows a quarter of the scene in the same frames."""
    without: Annotated[tuple[str, ...], tyro.conf.arg(metavar="EFFECT ...")] = ()
    """Effects to leave out: warp or motion shows the canonical scene, transient or
    scene_flow only what is static."""
    appearance: Annotated[tuple[str, str] | None, tyro.conf.arg(metavar="FROM TO")] = (
        None
    )
    """Interpolate between two appearances along the path: two frame names, or two
    appearance ids."""
    knots: int | None = None
    """Evaluate the motion of Gaussians at this many times only and interpolate between
    them; docs/results/deformation_cost.md has the error and the speedup."""
    interpolation: Literal["linear", "cubic"] = "linear"
    """Between the knots."""
    static_threshold: Annotated[float | None, cli.formerly("--still-below")] = None
    """Skip the deformation of Gaussians whose displacement is below this (scene units).
    1e-4 is visually lossless."""
    hide_moving: float | None = None
    """Hide Gaussians that move farther than this (scene units), to show the static
    scene. Occluded background is inpainted if the motion was initialized from tracks,
    and empty otherwise."""
    show: Literal["color", "depth", "flow"] = "color"
    """Channel of the png and mp4 images. Depth is bright near and dark far. Flow to the
    next image has its direction as hue and its length as saturation."""
    out: pathlib.Path | None = None
    """Folder for the images (default: RUN/renders/NAME, named by the settings)."""
    overwrite: bool = False
    """Replace an earlier render of other settings or of another step."""
    formats: tuple[Literal["png", "mp4", "exr"], ...] = ("png", "mp4")
    """Formats to write: png images, one mp4, exr with linear color, alpha and depth."""
    max_side: int | None = None
    """Longest side of the images, in pixels (default: as trained)."""
    trust: cli.Code = ()
    """Code from other packages that the run was trained with, as MODULE:NAME. It is
    loaded only if it is named here again."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Device to compute on."""

    def __post_init__(self):
        cli.check_frames(self.frames, self.path)
        if self.freeze is not None and not 0 <= self.freeze <= 1:
            raise ValueError(f"--freeze {self.freeze}: the time lies in [0, 1]")
        if not self.slow > 0:
            raise ValueError(f"--slow {self.slow}: a positive factor; 4 is slow motion")
        if self.interpolation != "linear" and self.knots is None:
            raise ValueError(
                f"--interpolation {self.interpolation} is for --knots; say how many"
            )
        for name in ("static_threshold", "hide_moving"):
            distance = getattr(self, name)
            if distance is not None and not 0 <= distance < math.inf:
                raise ValueError(
                    f"--{name.replace('_', '-')} {distance}: a distance in scene "
                    "units, not negative"
                )
        if self.slow != 1 and self.path == "heldout":
            raise ValueError(
                f"--slow {self.slow:g}: held-out frames have times of their own; "
                "choose a camera path, as --path captured"
            )
        if self.show == "flow" and (self.without or self.appearance is not None):
            raise ValueError(
                "--show flow follows the motion of the whole scene; leave out "
                "--without and --appearance"
            )
        cli.check_max_side(self.max_side)
        if not self.formats:
            raise ValueError("--formats: name at least one of png, mp4, exr")


@cli.command(Render)
def main(args):
    """Run the command. Wrong input ends it with exit code 2."""
    with cli.user_errors():
        cli.start_for_run(args)
        from nerfies_jax import evaluation, runs
        from nerfies_jax.capture import json_files, video
        from nerfies_jax.capture.capture import CaptureError

        out = args.out or args.run / "renders" / render_folder.name(args)
        json_files.sweep(out.resolve().parent)
        render_folder.refuse_early(out, args)
        if "mp4" in args.formats:
            video.library()  # missing, it is said before anything is rendered
        run = runs.saved_run(args.run, trusted=args.trust)
        move = _mover(args, run)
        run_checkpoint = runs.restore(args.run, run)
        state = run_checkpoint.state
        settings = _settings_of(args, run_checkpoint)
        run = runs.with_found_cameras(run, state)
        trained_state = _view_of(args, run.model, state)
        model, state = _faster(args, _model(args, run), trained_state)
        names, views, own_size = _views(args, run)
        size = cli.scale_size(own_size, args.max_side)
        views = [evaluation.resized(view, own_size, size) for view in views]
        views = _blend(args, run, views)
        files = _files(args, names)
        may_go = render_folder.replaceable(out, args, settings, files)
    image_of = _Images(args.show, move, trained_state, views)
    renderer = evaluation.Renderer(model, size)
    replacement = json_files.replaced_folder(out, True, may_go)
    with cli.user_errors((CaptureError, OSError)), replacement as partial:
        _write(args, partial, renderer, state, names, views, image_of)
        record = render_folder.record(settings, args, files)
        json_files.write_json(partial / render_folder.RECORD, record)
    return _report(out, renderer, len(names), files)


def _settings_of(args, run_checkpoint):
    """Collect the settings that determine the images."""
    from nerfies_jax.training import provenance

    checkpoint = {
        "step": run_checkpoint.step,
        "checkpoint": run_checkpoint.about["crc32"],
    }
    request = render_folder.request(args)
    return render_folder.Made(request, checkpoint, provenance.revision())


def _files(args, names):
    """Names of all files of a render."""
    kinds = [kind for kind in args.formats if kind != "mp4"]
    files = [f"{name}.{kind}" for name in names for kind in kinds]
    return files + (["video.mp4"] if "mp4" in args.formats else [])


def _model(args, run):
    """Return the run's model or a variant; ValueError if it has no such variant."""
    blends = args.appearance is not None
    if not args.without and not blends:
        return run.model
    return run.representation.products.variant(
        run.spec, run.metadata, args.without, blends
    )


def _mover(args, run):
    """Return the function that moves points between images, if flow is shown."""
    if args.show != "flow":
        return None
    move = run.representation.scoring.mover(run.spec, run.metadata)
    if move is None:
        raise ValueError(
            "--show flow: nothing in this run moves points; it needs a warp or motion"
        )
    return move


def _view_of(args, model, state):
    """Return the state without what is hidden in all images."""
    if args.hide_moving is None:
        return state
    from gaussians_jax.scene import variants

    state, summary = variants.without_moving(model, state, args.hide_moving)
    console.say(summary)
    return state


def _faster(args, model, state):
    """Return the model and state with the motion from a table or of moving parts."""
    from gaussians_jax.scene import variants

    static_threshold = 0.0 if args.static_threshold is None else args.static_threshold
    if args.knots is not None:
        variant = variants.from_knots(
            model, state, args.knots, args.interpolation, static_threshold
        )
    elif args.static_threshold is not None:
        variant = variants.without_static(model, state, static_threshold)
    else:
        return model, state
    console.say(variant.summary)
    return variant.model, variant.state


def _blend(args, run, views):
    """Return views that interpolate between the two appearances, if requested."""
    import jax.numpy as jnp

    from nerfies_jax.scene import variants
    from nerfies_jax.training.model import in_default_precision

    if args.appearance is None:
        return views
    start, end = (
        jnp.asarray(variants.appearance_id(run.capture, name), jnp.int32)
        for name in args.appearance
    )
    shares = np.linspace(0, 1, len(views), dtype=np.float32)
    return [
        variants.Between(
            view._replace(appearance=start), end, in_default_precision(share)
        )
        for view, share in zip(views, shares, strict=True)
    ]


def _views(args, run):
    """Return names and views of all images, and their size."""
    from nerfies_jax import evaluation
    from nerfies_jax.capture import camera_paths, path_files, pinholes

    if args.path == "heldout":
        rows = run.capture.heldout
        views = [evaluation.view_of(run.capture, row) for row in rows]
        names = [run.capture.ids[row].replace("/", "_") for row in rows]
        if args.freeze is not None:
            time = views[0].time.dtype.type(args.freeze)
            views = [view._replace(time=time) for view in views]
        return names, views, run.capture.size
    path = path_files.named(args.path, run.capture, args.frames)
    if not run.representation.scoring.models_lenses(run.metadata):
        path = path._replace(cameras=pinholes.pinhole(path.cameras))
    count = len(path.cameras.focal_px)
    if args.freeze is not None:
        times = np.full(count, args.freeze, np.float32)
    elif path.times is not None:
        times = path.times / np.float32(args.slow)
    else:
        times = camera_paths.times(count, loops=1 / args.slow)
    like = evaluation.view_of(run.capture, int(run.capture.train[0]))
    names = [f"{number:04d}" for number in range(count)]
    return names, evaluation.path_views(path.cameras, times, like), path.size


def _write(args, out, renderer, state, names, views, image_of):
    """Render view after view and write each as it comes."""
    from nerfies_jax.capture import images, video
    from nerfies_jax.evaluation import exr_series

    def rendered_images(stage):
        for place, (name, view) in enumerate(zip(names, views, strict=True)):
            rendering = renderer(state, view)
            image = image_of(rendering, place)
            if "png" in args.formats:
                images.write_png(out / f"{name}.png", image)
            if "exr" in args.formats:
                captured_view = getattr(view, "view", view)  # of a `variants.Between`
                exr_series.write_frame(out / f"{name}.exr", rendering, captured_view)
            stage.advance()
            yield image

    with events.stage("rendering images", len(views)) as stage:
        if "mp4" in args.formats:
            video.write_video(out / "video.mp4", rendered_images(stage), cli.RATE)
        else:
            for _ in rendered_images(stage):
                pass


def _report(out, renderer, count, files):
    """Print the location of the render, and return the result as JSON values."""
    width, height = renderer.size
    ms = renderer.ms_per_frame(count)
    console.say(f"{count} images of {width}x{height}, {ms:.0f} ms each, in {out}")
    return {
        "folder": str(out),
        "size": [width, height],
        "ms_per_frame": ms,
        "files": [str(out / file) for file in files],
    }


class _Images:
    """Convert renderings to 8-bit images.

    Depth and flow are normalized by the range of the first image that has any.
    """

    def __init__(self, show, move, state, views):
        self.show, self.limits = show, None
        self._move, self._state, self._views = move, state, views

    def __call__(self, rendering, place):
        from nerfies_jax import evaluation
        from nerfies_jax.visualization import panels

        if self.show == "color":
            return evaluation.to_uint8(rendering.color)
        if self.show == "flow":
            return self._draw_flow(rendering, place)
        opaque = rendering.alpha > 0.5
        color_map = panels.color_depth(rendering.depth, opaque, self.limits)
        if opaque.any():
            self.limits = color_map.low, color_map.high
        return color_map.image

    def _draw_flow(self, rendering, place):
        """Draw the flow to the next image; zero for the last one."""
        from nerfies_jax.evaluation import model_flow
        from nerfies_jax.visualization import panels

        start, end = self._views[place], self._views[place : place + 2][-1]
        flow = model_flow.image_flow(self._move, self._state, start, end, rendering)
        color_map = panels.color_flow(flow, self.limits)
        if np.nanmax(np.abs(flow), initial=0) > 0:
            self.limits = color_map.high
        return color_map.image


if __name__ == "__main__":
    main()
