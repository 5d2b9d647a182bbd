"""Writers of `nerfies export`, one for each kind of file."""

import functools
from typing import Any

from experiments import cli

SUFFIXES = {"compressed-ply": ".compressed.ply", "path": ".json", "tracks": ".npz"}
SUFFIXES |= {"mesh": ".ply"}


def _gaussians(args: Any, run: Any) -> str:
    from gaussians_jax.core import splats
    from gaussians_jax.core.splats import Splats
    from gaussians_jax.io import files, keyframes, single_time, turned
    from nerfies_jax import runs
    from nerfies_jax.capture import axes

    state = runs.restore(args.run, run).state
    in_scene = single_time.splats_at(run.model, state)
    rotation = None if args.axis is None else axes.rotation_to(run.capture, args.axis)
    visible = None
    if args.selection == "seen":
        visible = keyframes.visible(_visible_statistics(run, state))
        left_out = splats.active_count(run.model.stages.rows(state.params))
        left_out -= int(visible.sum())

    def at(time):
        rows = in_scene(time)
        if visible is not None:
            rows = Splats(*(leaf[visible] for leaf in rows))
        if args.units == "world":
            rows = single_time.in_world(rows, run.capture)
        return rows if rotation is None else turned.turned(rows, rotation)

    save = functools.partial(files.save, usd_up="Z" if args.axis == "z" else "Y")
    if args.frames is None:
        count = save(args.place, at(args.time or 0.0))
        summary = f"{count} Gaussians at time {args.time or 0:g}"
    else:
        suffix = SUFFIXES.get(args.kind, f".{args.kind}")
        single_time.save_sequence(
            args.place, at, args.frames, suffix, save, overwrite=args.overwrite
        )
        summary = f"Gaussians at {args.frames} times"
    if args.axis is not None:
        summary += f", {args.axis} up"
    if visible is not None:
        summary += f", without {left_out} that no camera saw"
    return summary


def _visible_statistics(run: Any, state: Any) -> Any:
    """Return what the training cameras saw of each Gaussian."""
    from gaussians_jax.core import splats
    from gaussians_jax.io import keyframes, single_time
    from gaussians_jax.scene.spec import raster_of

    at = single_time.gaussians_at(run.model, state)
    rows = run.model.stages.rows(state.params)
    degree = splats.active_degree(state.step, run.spec.sh_every, run.spec.sh_degree)
    raster = raster_of(run.spec, run.metadata)
    return keyframes.measure_contributions(at, rows, raster, degree, run.capture)


def _mesh(args: Any, run: Any) -> str:
    import numpy as np

    from nerfies_jax import evaluation, runs
    from nerfies_jax.capture import axes, pinholes, units
    from nerfies_jax.evaluation import mesh
    from nerfies_jax.geometry import camera

    capture = run.capture
    rotation = None if args.axis is None else axes.rotation_to(capture, args.axis)
    rows = evaluation.spread(capture.train, mesh.MOST_VIEWS)
    cameras = pinholes.pinhole(camera.take(capture.cameras, rows))
    like = evaluation.view_of(capture, int(rows[0]))
    views = evaluation.path_views(cameras, np.full(len(rows), args.time or 0.0), like)
    surface = mesh.extract(
        evaluation.Renderer(run.model, capture.size),
        runs.restore(args.run, run).state,
        views,
        args.voxels or mesh.VOXELS,
    )
    vertices = units.places_in(args.units or "scene", capture, surface.vertices)
    if rotation is not None:
        vertices = vertices @ rotation.T
    mesh.write(args.place, surface._replace(vertices=vertices))
    return (
        f"mesh of {len(vertices)} vertices and {len(surface.faces)} triangles at "
        f"time {args.time or 0:g}"
    )


def _splatv(args: Any, run: Any) -> str:
    from gaussians_jax.io import keyframes, single_time, splatv
    from gaussians_jax.scene.spec import raster_of
    from nerfies_jax import evaluation, runs

    state, spec, capture = runs.restore(args.run, run).state, run.spec, run.capture
    at = single_time.gaussians_at(run.model, state)
    rows = run.model.stages.rows(state.params)
    raster = raster_of(spec, run.metadata)
    visible = _visible_statistics(run, state)
    samples = keyframes.sample(at, rows, visible, keyframes.MOST_KEYFRAMES)
    curves = splatv.write(args.place, samples, capture)
    model = run.model
    # The file has no exposures and no appearances.
    neutral = tuple(
        name for name in ("exposure", "appearance") if getattr(spec, name) is not None
    )
    if neutral:
        model = run.representation.products.variant(spec, run.metadata, neutral, False)
    draw = evaluation.Renderer(model, capture.size)
    fit = splatv.measured(curves, samples, draw, state, raster, capture)
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


def _cameras(args: Any, run: Any) -> str:
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
    if args.kind == "nerfies":
        with replaced_folder(args.place, args.overwrite) as folder:
            nerfies_format.write(capture, folder)
    else:
        writer = transforms_writer if args.kind == "transforms" else colmap_writer
        writer.write(capture, args.place, args.units or "scene", args.overwrite)
    return f"{len(capture.ids)} frames with their cameras"


def _path(args: Any, run: Any) -> str:
    from nerfies_jax.capture import path_files

    path = _camera_path(args, run)
    if args.kind == "path":
        path_files.write_nerfstudio(
            args.place,
            path,
            cli.RATE,
            args.overwrite,
            path_files.spaced_keyframes(path),
        )
    else:
        path_files.write_nerfies(args.place, path, run.capture, args.overwrite)
    return f"{len(path.times)} cameras"


def _camera_path(args: Any, run: Any) -> Any:
    """Return a path with its times, or with those of `nerfies render`."""
    from nerfies_jax.capture import camera_paths, path_files, pinholes

    path = path_files.named(args.path or cli.PATHS[0], run.capture, args.frames)
    if not run.representation.scoring.models_lenses(run.metadata):
        path = path._replace(cameras=pinholes.pinhole(path.cameras))
    if path.times is None:
        count = len(path.cameras.focal_px)
        path = path._replace(times=camera_paths.times(count))
    return path


def _tracks(args: Any, run: Any) -> str:
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


def _exr(args: Any, run: Any) -> str:
    from nerfies_jax import evaluation, runs
    from nerfies_jax.evaluation import exr_series

    path = _camera_path(args, run)
    like = evaluation.view_of(run.capture, int(run.capture.train[0]))
    move = _mover(run)
    exr_series.write(
        args.place,
        evaluation.Renderer(run.model, path.size),
        runs.restore(args.run, run).state,
        evaluation.path_views(path.cameras, path.times, like),
        move,
        args.overwrite,
    )
    flow = "without flow, since nothing moves points" if move is None else "and flow"
    return f"{len(path.times)} images: color, alpha, depth {flow}"


WRITERS = {
    **dict.fromkeys(
        ("ply", "compressed-ply", "splat", "spz", "sog", "usda", "glb"), _gaussians
    ),
    "mesh": _mesh,
    "splatv": _splatv,
    **dict.fromkeys(("transforms", "colmap", "nerfies"), _cameras),
    **dict.fromkeys(("path", "nerfies-path"), _path),
    **{"tracks": _tracks, "exr": _exr},
}
