"""Export a finished run for other programs: Gaussians, cameras, tracks, EXR.

nerfies export RUN ply --time 0.4          # the scene at one time
nerfies export RUN ply --frames 48         # a numbered sequence
nerfies export RUN splat
nerfies export RUN spz --units world
nerfies export RUN splatv                  # all times in one file
nerfies export RUN transforms              # cameras, images, points
nerfies export RUN colmap --units world
nerfies export RUN nerfies
nerfies export RUN path --path stabilized  # camera_path.json, with times
nerfies export RUN nerfies-path --path sway --frames 48
nerfies export RUN tracks --points 500     # what is seen, followed
nerfies export RUN exr --path stabilized   # color, alpha, depth, flow
"""

import dataclasses
import pathlib
from typing import Any, Literal

from experiments import cli, render_folder
from nerfies_jax.runs import run_folder
from nerfies_jax.runtime import console, events

# Options of each format, in addition to --out, --overwrite and --device.
GAUSSIANS = ("time", "frames", "units")
PATHS = ("frames", "path")
OPTIONS = {
    **{"ply": GAUSSIANS, "splat": GAUSSIANS, "spz": GAUSSIANS},
    **{"splatv": (), "nerfies": ()},
    **{"transforms": ("units",), "colmap": ("units",)},
    **{"path": PATHS, "nerfies-path": PATHS, "exr": PATHS},
    "tracks": ("time", "frames", "units", "points"),
}


@dataclasses.dataclass(frozen=True)
class Export:
    """Write what a run learned in the formats of other programs (docs/formats.md)."""

    run: cli.Positional[pathlib.Path]
    """Run folder that nerfies reconstruct made."""
    format: cli.Positional[
        Literal[
            "ply",
            "splat",
            "spz",
            "splatv",
            "transforms",
            "colmap",
            "nerfies",
            "path",
            "nerfies-path",
            "tracks",
            "exr",
        ]
    ]
    """Gaussians as ply, splat or spz, or with their motion, on cubics, as splatv.
    Training images with cameras and points as nerfstudio's transforms, a colmap model
    or a nerfies directory. A camera path as nerfstudio's camera_path.json (path) or
    Nerfies' folder (nerfies-path). Tracks of points of a dynamic scene (npz). exr
    images with camera and motion."""
    time: float | None = None
    """Gaussians as they are at this time in [0, 1] (default: 0). Tracks: of what is
    seen then (default: 0.5)."""
    frames: int | None = None
    """Gaussians: a folder of that many numbered files over the whole time. Tracks:
    number of training frames (default: at most 96). Otherwise the images along a path
    (default: 96)."""
    points: int | None = None
    """Number of points to track (default: 1000)."""
    path: str | None = None
    """Camera path, as for nerfies render (default: sway)."""
    units: Literal["scene", "world"] | None = None
    """Lengths as in the run's own files, or as in those of the capture (default:
    scene)."""
    out: pathlib.Path | None = None
    """File or folder to write (default: in RUN/exports)."""
    overwrite: bool = False
    """Replace what is there."""
    trust: cli.Code = ()
    """Code from other packages that the run was trained with, as MODULE:NAME. It is
    loaded only if it is named here again."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Device to compute on."""

    def __post_init__(self):
        names = {name for known in OPTIONS.values() for name in known}
        for name in sorted(names - set(OPTIONS[self.format])):
            if getattr(self, name) is not None:
                fits = ", ".join(key for key, known in OPTIONS.items() if name in known)
                raise ValueError(
                    f"--{name.replace('_', '-')} is not for {self.format}, but for "
                    f"{fits}"
                )
        if self.gaussians and None not in (self.time, self.frames):
            raise ValueError("--time and --frames exclude each other: give one of them")
        if self.time is not None and not 0 <= self.time <= 1:
            raise ValueError(f"--time {self.time}: the capture runs from 0 to 1")
        cli.check_frames(self.frames, self.path or cli.PATHS[0])
        if self.frames == 1 and (self.gaussians or self.format == "tracks"):
            raise ValueError(f"--frames {self.frames}: a sequence has at least two")
        suffix = self.suffix
        if self.out is not None and suffix and self.out.suffix.lower() != suffix:
            raise ValueError(f"--out {self.out}: such a file ends in {suffix}")
        if self.points is not None and self.points < 1:
            raise ValueError(f"--points {self.points}: track at least one")

    @property
    def gaussians(self) -> bool:
        """True if Gaussians are exported."""
        return OPTIONS[self.format] == GAUSSIANS

    @property
    def suffix(self) -> str:
        """Suffix of the file, empty for a folder."""
        if self.gaussians:
            return f".{self.format}" if self.frames is None else ""
        suffixes = {"path": ".json", "tracks": ".npz", "splatv": ".splatv"}
        return suffixes.get(self.format, "")

    @property
    def place(self) -> pathlib.Path:
        """Path of the output."""
        name: str = self.format
        if self.gaussians and self.frames is None:
            name = f"at-{self.time or 0:g}"
        elif self.gaussians:
            name = f"{self.format}-{self.frames}"
        elif self.path is not None:
            name = f"{self.format}-{render_folder.path_name(self.path)}"
        return self.out or self.run / run_folder.EXPORTS / (name + self.suffix)


@cli.command(Export)
def main(args):
    """Run the command. Wrong input ends it with exit code 2."""
    with cli.user_errors():
        cli.start_for_run(args)
        from nerfies_jax import runs
        from nerfies_jax.capture.json_files import refuse_existing, sweep

        sweep(args.place.resolve().parent)
        refuse_existing(args.place, args.overwrite)
        run = runs.saved_run(args.run, trusted=args.trust)
        if run.model.found is not None:
            # What is written is in the cameras that training found.
            run = runs.with_found_cameras(run, runs.restore(args.run, run).state)
        args.place.parent.mkdir(parents=True, exist_ok=True)
        with events.stage(f"exporting {args.format}"):
            said = WRITERS[args.format](args, run)
        console.say(f"{said}: {args.place}")
    return {"written": str(args.place), "format": args.format, "said": said}


def _gaussians(args: Export, run: Any) -> str:
    from gaussians_jax.io import files, instants
    from nerfies_jax import runs

    state = runs.restore(args.run, run).state
    in_scene = instants.splats_at(run.model, state)

    def at(time):
        rows = in_scene(time)
        return instants.in_world(rows, run.capture) if args.units == "world" else rows

    if args.frames is None:
        count = files.save(args.place, at(args.time or 0.0))
        return f"{count} Gaussians at time {args.time or 0:g}"
    instants.save_sequence(
        args.place, at, args.frames, f".{args.format}", overwrite=args.overwrite
    )
    return f"Gaussians at {args.frames} times"


def _splatv(args: Export, run: Any) -> str:
    from gaussians_jax.core import splats
    from gaussians_jax.io import instants, sampled, splatv
    from gaussians_jax.scene.spec import raster_of
    from nerfies_jax import evaluation, runs

    state, spec, capture = runs.restore(args.run, run).state, run.spec, run.capture
    at = instants.gaussians_at(run.model, state)
    rows = run.model.stages.rows(state.params)
    degree = splats.active_degree(state.step, spec.sh_every, spec.sh_degree)
    raster = raster_of(spec, run.metadata)
    seen = sampled.seen_in_training(at, rows, raster, degree, capture)
    learned = sampled.gathered(at, rows, seen, sampled.MOST_INSTANTS)
    curves = splatv.write(args.place, learned, capture)
    model = run.model
    if spec.exposure is not None:  # of which the file has none
        neutral = ("exposure",)
        model = run.representation.products.variant(spec, run.metadata, neutral, False)
    draw = evaluation.Renderer(model, capture.size)
    fit = splatv.measured(curves, learned, draw, state, raster, capture)
    summary = (
        f"{len(curves.position)} Gaussians on cubics in time, RMS error {fit.rms:.2g} "
        f"scene units ({fit.most:.2g} at the 99th percentile), PSNR to renders of the "
        f"run {fit.psnr:.1f} dB ({fit.views} views)"
    )
    if capture.near < splatv.NEAREST:
        summary += (
            f"; that viewer does not render what is nearer than {splatv.NEAREST:g} "
            f"scene units, and this scene begins at {capture.near:.2g}"
        )
    return summary


def _cameras(args: Export, run: Any) -> str:
    """Write the capture of the run, undistorted for splats.

    Viewers of Gaussians render pinhole cameras.
    """
    from nerfies_jax.capture import (
        colmap_writer,
        nerfies_format,
        pinholes,
        transforms_writer,
    )
    from nerfies_jax.capture.json_files import replaced_folder

    capture = run.capture
    if run.representation.products.splatting is not None:
        capture = pinholes.as_pinholes(capture)
    if args.format == "nerfies":
        with replaced_folder(args.place, args.overwrite) as folder:
            nerfies_format.write(capture, folder)
    else:
        writer = transforms_writer if args.format == "transforms" else colmap_writer
        writer.write(capture, args.place, args.units or "scene", args.overwrite)
    return f"{len(capture.ids)} frames with their cameras"


def _path(args: Export, run: Any) -> str:
    from nerfies_jax.capture import path_files

    planned = _planned(args, run)
    if args.format == "path":
        path_files.write_nerfstudio(args.place, planned, cli.RATE, args.overwrite)
    else:
        path_files.write_nerfies(args.place, planned, run.capture, args.overwrite)
    return f"{len(planned.times)} cameras"


def _planned(args: Export, run: Any) -> Any:
    """Return a path with its times, or with those of `nerfies render`."""
    from nerfies_jax.capture import camera_paths, path_files, pinholes

    planned = path_files.named(args.path or cli.PATHS[0], run.capture, args.frames)
    if not run.representation.scoring.models_lenses(run.metadata):
        planned = planned._replace(cameras=pinholes.pinhole(planned.cameras))
    if planned.times is None:
        count = len(planned.cameras.focal_px)
        planned = planned._replace(times=camera_paths.times(count))
    return planned


def _tracks(args: Export, run: Any) -> str:
    from nerfies_jax import evaluation, runs
    from nerfies_jax.evaluation import surface_tracks

    move = _mover(run)
    if move is None:
        raise ValueError(
            f"{args.run}: nothing in this run moves points, so there are no tracks; it "
            "needs a warp or motion"
        )
    tracks = surface_tracks.follow(
        move,
        evaluation.Renderer(run.model, run.capture.size),
        runs.restore(args.run, run).state,
        run.capture,
        args.points or 1000,
        args.frames or min(96, len(run.capture.train)),
        0.5 if args.time is None else args.time,
    )
    surface_tracks.write(
        args.place, tracks, run.capture, args.units or "scene", args.overwrite
    )
    points, frames = tracks.visible.shape
    return f"{points} points over {frames} frames, {tracks.visible.mean():.0%} visible"


def _mover(run: Any):
    return run.representation.scoring.mover(run.spec, run.metadata)


def _exr(args: Export, run: Any) -> str:
    from nerfies_jax import evaluation, runs
    from nerfies_jax.evaluation import exr_series

    planned = _planned(args, run)
    like = evaluation.view_of(run.capture, int(run.capture.train[0]))
    move = _mover(run)
    exr_series.write(
        args.place,
        evaluation.Renderer(run.model, planned.size),
        runs.restore(args.run, run).state,
        evaluation.path_views(planned.cameras, planned.times, like),
        move,
        args.overwrite,
    )
    flow = "without flow, since nothing moves points" if move is None else "and flow"
    return f"{len(planned.times)} images: color, alpha, depth {flow}"


WRITERS = {
    **dict.fromkeys(("ply", "splat", "spz"), _gaussians),
    "splatv": _splatv,
    **dict.fromkeys(("transforms", "colmap", "nerfies"), _cameras),
    **dict.fromkeys(("path", "nerfies-path"), _path),
    **{"tracks": _tracks, "exr": _exr},
}

if __name__ == "__main__":
    main()
