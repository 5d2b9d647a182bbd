"""Export a finished run for other programs: Gaussians, cameras, tracks, EXR.

nerfies export RUN ply --time 0.4          # the scene at one time
nerfies export RUN ply --frames 48         # a numbered sequence
nerfies export RUN splat
nerfies export RUN spz --units world
nerfies export RUN sog --up -y             # compressed, for PlayCanvas
nerfies export RUN glb --keep seen         # glTF, for Babylon.js, three.js, Cesium
nerfies export RUN splatv                  # all times in one file
nerfies export RUN transforms              # cameras, images, points
nerfies export RUN colmap --units world
nerfies export RUN nerfies
nerfies export RUN path --path stabilized  # camera_path.json, with times
nerfies export RUN nerfies-path --path sway --frames 48
nerfies export RUN tracks --points 500     # what is seen, followed
nerfies export RUN exr --path stabilized   # color, alpha, depth, flow
nerfies export RUN mesh --time 0.4 --up z  # triangles with vertex colors
nerfies export RUN --for supersplat        # format, axes and crop for a program
"""

import dataclasses
import pathlib
from typing import Annotated, Any, Literal

import tyro

from experiments import cli, export_writers, render_folder
from nerfies_jax.runs import run_folder
from nerfies_jax.runtime import console, events

# Options of each format, in addition to --out, --overwrite and --device.
GAUSSIANS = ("time", "frames", "units", "up", "keep")
PATHS = ("frames", "path")
# That of `nerfies_jax.capture.axes`, which loads JAX.
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
# Of formats that define it: name, and the axes that may point up, the default first.
UP: dict[str, tuple[str, tuple[Axis, ...]]] = {
    "usda": ("OpenUSD", ("y", "z")),
    "glb": ("glTF", ("y",)),
}
MOST_VOXELS = 512  # 5 GB along all three sides
OPTIONS = {
    **{"ply": GAUSSIANS, "splat": GAUSSIANS, "spz": GAUSSIANS},
    **{"compressed-ply": GAUSSIANS, "sog": GAUSSIANS, "usda": GAUSSIANS},
    "glb": GAUSSIANS,
    "mesh": ("time", "units", "up", "voxels"),
    **{"splatv": (), "nerfies": ()},
    **{"transforms": ("units",), "colmap": ("units",)},
    **{"path": PATHS, "nerfies-path": PATHS, "exr": PATHS},
    "tracks": ("time", "frames", "units", "points"),
}
# What each program reads best: the format, and defaults of the options that it has.
PROGRAMS: dict[str, dict[str, str]] = {
    # PlayCanvas turns Gaussians by 180 degrees about z, as 3DGS trains with y down.
    "supersplat": {"format": "compressed-ply", "up": "-y", "keep": "seen"},
    "blender": {"format": "ply", "up": "z", "keep": "seen"},
    "usd": {"format": "usda", "up": "y", "keep": "seen"},
    "gsplat": {"format": "ply"},
    "nerfstudio": {"format": "transforms"},
}


@dataclasses.dataclass(frozen=True)
class Export:
    """Write what a run learned in the formats of other programs (docs/formats.md)."""

    run: cli.Positional[pathlib.Path]
    """Run folder that nerfies reconstruct made."""
    format: cli.Positional[
        Literal[
            "ply",
            "compressed-ply",
            "splat",
            "spz",
            "sog",
            "usda",
            "glb",
            "splatv",
            "mesh",
            "transforms",
            "colmap",
            "nerfies",
            "path",
            "nerfies-path",
            "tracks",
            "exr",
        ]
        | None
    ] = None
    """Gaussians as ply, compressed-ply (SuperSplat), splat, spz, sog (PlayCanvas),
    usda (OpenUSD) or glb (glTF), or with their motion, on cubics, as splatv. A mesh
    with vertex colors (ply). Training images with cameras and points as nerfstudio's
    transforms, a colmap model or a nerfies directory. A camera path as nerfstudio's
    camera_path.json (path) or Nerfies' folder (nerfies-path). Tracks of points of a
    dynamic scene (npz). exr images with camera and motion."""
    program: Annotated[
        Literal["supersplat", "blender", "usd", "gsplat", "nerfstudio"] | None,
        tyro.conf.arg(name="for"),
    ] = None
    """Program that reads the files. It decides the format, the axes and which Gaussians
    to keep, where these are not given."""
    time: float | None = None
    """Gaussians or mesh at this time in [0, 1] (default: 0). Tracks: of what is
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
    up: Axis | None = None
    """Axis of the file that points up, by the mean of the training cameras (default:
    axes as in the capture, but y for usda and glb)."""
    keep: Literal["all", "seen"] | None = None
    """Gaussians to write: all, or those that a training camera saw (default: all)."""
    voxels: int | None = None
    """Voxels along the longest side of a mesh (default: 128)."""
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
        if self.format is None and self.program is None:
            raise ValueError(
                f"name a format ({', '.join(OPTIONS)}), or with --for a program "
                f"({', '.join(PROGRAMS)})"
            )
        names = {name for options in OPTIONS.values() for name in options}
        for name in sorted(names - set(OPTIONS[self.kind])):
            if getattr(self, name) is not None:
                fits = ", ".join(
                    key for key, options in OPTIONS.items() if name in options
                )
                raise ValueError(
                    f"--{name.replace('_', '-')} is not for {self.kind}, but for {fits}"
                )
        if self.gaussians and None not in (self.time, self.frames):
            raise ValueError("--time and --frames exclude each other: give one of them")
        if self.time is not None and not 0 <= self.time <= 1:
            raise ValueError(f"--time {self.time}: the capture runs from 0 to 1")
        cli.check_frames(self.frames, self.path or cli.PATHS[0])
        if self.frames == 1 and (self.gaussians or self.kind == "tracks"):
            raise ValueError(f"--frames {self.frames}: a sequence has at least two")
        suffix = self.suffix
        if self.out is not None and not self.out.name.lower().endswith(suffix):
            raise ValueError(f"--out {self.out}: such a file ends in {suffix}")
        if self.points is not None and self.points < 1:
            raise ValueError(f"--points {self.points}: track at least one")
        if self.voxels is not None and not 8 <= self.voxels <= MOST_VOXELS:
            raise ValueError(f"--voxels {self.voxels}: choose from 8 to {MOST_VOXELS}")
        if self.kind in UP and self.axis not in UP[self.kind][1]:
            name, axes = UP[self.kind]
            raise ValueError(f"--up {self.axis}: {name} has {' or '.join(axes)} up")

    @property
    def kind(self) -> str:
        """The format, which the program decides if none is given."""
        return self.format or PROGRAMS[self.program or ""]["format"]

    @property
    def axis(self) -> Axis | None:
        """The axis that points up, or None for the axes of the capture."""
        default = UP[self.kind][1][0] if self.kind in UP else None
        return self.up or self._of_program("up") or default

    @property
    def selection(self) -> str:
        """Gaussians to write."""
        return self.keep or self._of_program("keep") or "all"

    def _of_program(self, name: str) -> Any:
        if self.program is None or name not in OPTIONS[self.kind]:
            return None
        return PROGRAMS[self.program].get(name)

    @property
    def gaussians(self) -> bool:
        """True if Gaussians are exported."""
        return OPTIONS[self.kind] == GAUSSIANS

    @property
    def suffix(self) -> str:
        """Suffix of the file, empty for a folder."""
        if self.gaussians and self.frames is not None:
            return ""
        plain = f".{self.kind}" if self.gaussians or self.kind == "splatv" else ""
        return export_writers.SUFFIXES.get(self.kind, plain)

    @property
    def place(self) -> pathlib.Path:
        """Path of the output."""
        name = self.kind
        if self.gaussians and self.frames is None:
            name = f"at-{self.time or 0:g}"
        elif self.gaussians:
            name = f"{self.kind}-{self.frames}"
        elif self.kind == "mesh":
            name = f"mesh-at-{self.time or 0:g}"
        elif self.path is not None:
            name = f"{self.kind}-{render_folder.path_name(self.path)}"
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
        if run.model.apply_to_capture is not None:
            # What is written is in the cameras that training found.
            run = runs.with_found_cameras(run, runs.restore(args.run, run).state)
        args.place.parent.mkdir(parents=True, exist_ok=True)
        with events.stage(f"exporting {args.kind}"):
            summary = export_writers.WRITERS[args.kind](args, run)
        console.say(f"{summary}: {args.place}")
    return {"written": str(args.place), "format": args.kind, "said": summary}


if __name__ == "__main__":
    main()
