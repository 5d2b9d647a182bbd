"""Good captures: does any check of a capture find a fault that is not there?

    python -m experiments.capture_checks ../shared/data --out capture_checks.json

Every capture in the folder is read as a user's would be and checked by its numbers
(`nerfies_jax.capture.gate`). The captures are good, so each problem that a check
reports is either true or a fault of that check. Of a folder without images the cameras
are checked. An archive (.npz) of images and poses is converted first, and one of
Gaussians (gsplat's) is checked as cameras with points.
"""

import dataclasses
import pathlib
import tempfile

import numpy as np

from experiments import cli, markdown
from nerfies_jax.runtime import console

SMALL = 8  # reduction of the images that stand for those of cameras alone


@dataclasses.dataclass(frozen=True)
class CaptureChecks:
    """Check all captures of a folder and store the findings."""

    captures: cli.Positional[pathlib.Path]
    """Folder of captures."""
    out: pathlib.Path = pathlib.Path("capture_checks.json")
    """File of the findings."""

    def __post_init__(self):
        cli.check_out_file(self.out, "--out")


@cli.command(CaptureChecks)
def main(args):
    """Check the captures; exit code 1 where a problem is found."""
    from nerfies_jax.capture import gate
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.metrics import clock
    from nerfies_jax.training.provenance import revision

    with cli.user_errors():
        if not args.captures.is_dir():
            raise ValueError(f"{args.captures}: no such folder; check the path")
        rows, passed_over, problems = [], {}, 0
        for folder in sorted(args.captures.iterdir()):
            try:
                capture, kind = _read(folder)
            except ValueError as error:
                passed_over[folder.name] = str(error).replace(f"{args.captures}/", "")
                continue
            found = gate.findings(capture)
            problems += sum(bool(one.problem) for one in found)
            rows.append(
                {
                    "capture": folder.name,
                    "read as": kind,
                    "frames": len(capture.ids),
                    "notes": [
                        note.replace(f"{args.captures}/", "") for note in capture.notes
                    ],
                    "findings": [one._asdict() for one in found],
                }
            )
            console.say("\n".join([f"{folder.name} ({kind})", *gate.table(capture)]))
        stored = {
            "machine": clock.machine(),
            "revision": revision(),
            "captures": rows,
        }
        if passed_over:
            stored["passed over"] = passed_over
        write_json(args.out, stored)
        console.say(f"{len(rows)} captures, {problems} problems: {args.out}")
    return cli.Ended(stored, 1 if problems else 0)


def _read(folder):
    """Read a folder by what it holds: the capture, and how it was read."""
    from nerfies_jax.capture import formats, npz_archive

    archives = sorted(folder.glob("*.npz")) if folder.is_dir() else []
    derived = {"cameras.npz", "points_tri.npz"}  # of the tools that made the captures
    archives = [path for path in archives if path.name not in derived]
    try:
        capture = formats.load(folder)
        return capture, capture.source
    except ValueError:
        if (folder / "scene.json").is_file() and not (folder / "rgb").is_dir():
            return _cameras_alone(folder), "nerfies, cameras alone"
        if len(archives) != 1:
            raise
    with np.load(archives[0]) as arrays:
        if "viewmats" in arrays:
            return _gaussians(archives[0], dict(arrays)), "gsplat's archive"
    with tempfile.TemporaryDirectory() as scratch:
        converted = pathlib.Path(scratch) / folder.name
        npz_archive.convert(archives[0], converted)
        return formats.load(converted), "archive of images and poses"


def _cameras_alone(folder):
    """A Nerfies directory without images, which are gray and small instead."""
    from nerfies_jax.capture import nerfies_format
    from nerfies_jax.geometry import camera

    views = nerfies_format.read_cameras(folder)
    return _capture(
        folder,
        ids=views.ids,
        cameras=camera.resize(views.cameras, (SMALL, SMALL), (1, 1)),
        size=(views.size[0] // SMALL, views.size[1] // SMALL),
        times=views.times,
        camera_ids=views.camera_ids,
        near=views.scene.near,
        far=views.scene.far,
        scale=views.scene.scale,
        center=views.scene.center,
        notes=views.notes,
    )


def _gaussians(path, arrays):
    """gsplat's test scene: the means of its Gaussians, seen by its cameras."""
    from nerfies_jax.capture.capture import PointCloud
    from nerfies_jax.geometry import camera

    views, intrinsics = arrays["viewmats"].astype(float), arrays["Ks"].astype(float)
    size = int(arrays["width"]), int(arrays["height"])
    rotations = views[:, :3, :3]
    positions = -np.einsum("nji,nj->ni", rotations, views[:, :3, 3])
    cameras = [
        camera.pinhole(turn, place, lens[0, 0], size)._replace(
            principal_point_px=np.float32(lens[:2, 2]),
            pixel_aspect=np.float32(lens[1, 1] / lens[0, 0]),
        )
        for turn, place, lens in zip(rotations, positions, intrinsics, strict=True)
    ]
    offset = arrays["means3d"][None] - positions[:, None]
    depths = np.einsum("nk,npk->np", rotations[:, 2], offset)
    count = len(views)
    return _capture(
        path,
        ids=tuple(str(row) for row in range(count)),
        cameras=camera.stack(cameras),
        size=size,
        times=np.zeros(count, np.float32),
        camera_ids=np.zeros(count, np.int32),
        near=float(np.quantile(depths[depths > 0], 0.001)),
        far=float(depths.max()),
        points=PointCloud(
            arrays["means3d"].astype(np.float32), arrays["colors"].astype(np.uint8)
        ),
    )


def _capture(path, ids, size, times, **values):
    from nerfies_jax.capture.capture import Capture

    rows = np.arange(len(ids), dtype=np.int32)
    return Capture(
        name=path.name,
        source="cameras",
        ids=ids,
        images=np.full((len(ids), size[1], size[0], 3), 128, np.uint8),
        times=times,
        train=rows,
        heldout=rows[:0],
        warp_ids=rows,
        appearance_ids=rows,
        **values,
    )


def page(stored: dict) -> str:
    """List what the checks measured of each capture, and the problems."""
    rows, problems = [], []
    for capture in stored["captures"]:
        found = [one for one in capture["findings"] if one["problem"]]
        problems += [f"{capture['capture']}: {one['problem']}" for one in found]
        rows.append(
            [
                capture["capture"],
                capture["read as"],
                str(capture["frames"]),
                str(len(capture["findings"])),
                str(len(found)),
            ]
        )
    heads = ("capture", "read as", "frames", "checks", "problems")
    parts = [
        f"Of {len(rows)} captures {len(problems)} problems were reported (revision "
        f"{str(stored['revision'])[:12]}).",
        markdown.table(heads, rows, words=2),
    ]
    if problems:
        parts += ["Problems:", markdown.bullets(problems)]
    parts.append("Values of each check:")
    parts.append(_values(stored["captures"]))
    if "passed over" in stored:
        parts += [
            "These folders hold no capture:",
            markdown.bullets(
                f"{name}: {reason}" for name, reason in stored["passed over"].items()
            ),
        ]
    return "\n\n".join(parts)


def _values(captures):
    """A table of each capture, one check a line."""
    tables = []
    for capture in captures:
        rows = [[one["subject"], one["value"]] for one in capture["findings"]]
        tables.append(
            f"**{capture['capture']}**\n\n"
            + markdown.table(("check", "measured"), rows, words=2)
        )
    return "\n\n".join(tables)


if __name__ == "__main__":
    main()
