"""How far off cameras are that were found while something large moved before them.

    python -m experiments.camera_masks --out camera_masks.json
    python -m experiments.camera_masks --half 0.1 --seeds 1

The built-in scene is filmed with a cube so large that it fills much of the picture, and
its pictures go to `experiments.prepare` without their cameras: in one pass, in two
(what moves is found with the first cameras and left out for the second), and with the
true masks. Positions are compared with the truth after the best similarity, as shares
of the path's extent; turns are those between neighboring frames. The hand that holds
the camera is drawn by the seed.
"""

import dataclasses
import pathlib
import tempfile

from experiments import cli, markdown
from nerfies_jax import console
from nerfies_jax.runs import platform

ARMS = ("one pass", "two passes", "true masks")
SIZE = (352, 264)


@dataclasses.dataclass(frozen=True)
class CameraMasks:
    """Find cameras with and without masks of what moves, beside the truth."""

    half: float = 0.06
    """Half the cube's side, scene units; it is 0.66 away."""
    seeds: int = 3
    """So many, from 0 on."""
    frames: int = 60
    """Of the film."""
    out: pathlib.Path | None = None
    """Also write the numbers here, as JSON."""

    def __post_init__(self):
        cli.check_out_file(self.out)
        if not 0.02 <= self.half <= 0.2:
            raise ValueError(f"--half {self.half}: from 0.02 to 0.2")
        if self.seeds < 1 or self.frames < 12:
            raise ValueError("at least one seed and 12 frames")


@cli.command(CameraMasks)
def main(args):
    """Run the job of the command line."""
    platform.start_jax("cpu")
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.measure import clock

    rows = []
    for seed in range(args.seeds):
        for row in _of_seed(args, seed):
            rows.append(row)
            console.say("  ".join(f"{k} {v}" for k, v in row.items()))
    record = {"machine": clock.machine(), "half": args.half, "rows": rows}
    if args.out is not None:
        write_json(args.out, record)
    return record


def _of_seed(args, seed):
    import numpy as np

    from nerfies_jax.capture import formats, synthetic
    from nerfies_jax.capture.capture import CaptureError
    from nerfies_jax.capture.images import write_png
    from nerfies_jax.runs import preparation
    from nerfies_jax.runs.config import Preparation

    capture, _ = synthetic.make(scene(args.half, args.frames), seed)
    film = np.flatnonzero(capture.camera_ids == 0)
    share = float(capture.moving[film].mean())
    with tempfile.TemporaryDirectory() as scratch:
        folder = pathlib.Path(scratch)
        for kind in ("pictures", "masks"):
            (folder / kind).mkdir()
        for number, row in enumerate(film):
            name = f"{number:04d}.png"
            write_png(folder / "pictures" / name, capture.images[row])
            write_png(folder / "masks" / f"{name}.png", ~capture.moving[row])
        how = {
            "one pass": Preparation(passes=1),
            "two passes": Preparation(),
            "true masks": Preparation(masks=folder / "masks"),
        }
        for arm in ARMS:
            row = {"seed": seed, "arm": arm, "moving": share, "frames": len(film)}
            out = folder / arm.replace(" ", "-")
            try:
                preparation.prepare(folder / "pictures", out, how[arm])
            except CaptureError as error:
                yield {**row, "placed": 0, "failed": str(error).partition(": ")[2]}
                continue
            yield {**row, **_errors(formats.load(out), capture, film)}


def scene(half: float, frames: int):
    """The built-in scene with a cube so large, before wider pictures."""
    from nerfies_jax.capture import synthetic
    from nerfies_jax.capture.synthetic.shapes import Box

    plain = synthetic.PRESETS["default"]
    cube = plain.things[-1]
    large = dataclasses.replace(cube, shape=Box((half,) * 3))
    things = (*plain.things[:-1], large)
    return dataclasses.replace(
        plain, name="large cube", things=things, size=SIZE, frames=frames
    )


def _errors(found, capture, film):
    """Of the frames that were placed, whose names are those of the film."""
    import numpy as np

    from nerfies_jax.measure import geometry_quality

    rows = film[[int(pathlib.Path(name).stem) for name in found.ids]]
    order = np.argsort(rows)
    true = capture.cameras.position[rows[order]]
    position = found.cameras.position[order]
    path = geometry_quality.path_errors(position, true)
    extent = float(np.linalg.norm(np.ptp(true, axis=0)))
    turned = geometry_quality.relative_errors(
        found.cameras.camera_from_world[order],
        path.alignment.scale * position,
        capture.cameras.camera_from_world[rows[order]],
        true,
    )
    return {
        "placed": len(rows),
        "position_rmse": path.rmse / extent,
        "position_median": path.median / extent,
        "turn_deg": turned.rotation_deg,
    }


def page(stored) -> str:
    """The page in docs/results below the docstring."""
    heads = ("seed", "cameras found in", "moving pixels", "placed of the frames")
    heads += ("position, rmse", "position, median", "turn, degrees")
    names = ("position_rmse", "position_median")
    rows = [
        [
            str(row["seed"]),
            row["arm"],
            f"{row['moving']:.0%}",
            f"{row['placed']} of {row['frames']}",
            *(f"{row[name]:.2%}" if name in row else "" for name in names),
            markdown.number(row.get("turn_deg"), 3),
        ]
        for row in stored["rows"]
    ]
    return markdown.table(heads, rows, words=2)


if __name__ == "__main__":
    main()
