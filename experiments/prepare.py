"""Make a capture out of something else: an archive of arrays, a film, or pictures.

python -m experiments.prepare npz FILE OUT       images, poses, times, focal in one .npz
python -m experiments.prepare video FILE OUT     sharp frames, cameras by COLMAP
python -m experiments.prepare pictures DIR OUT   cameras by COLMAP
"""

import dataclasses
import math
import pathlib
import zipfile

import numpy as np

from experiments import cli

SAME_POSE = 1e-6  # of matrix entries; a camera on a tripod repeats its matrix exactly
TRIPOD_ROWS = 5  # fewer rows of one pose are no validation sweep
BLURRED = 0.4  # of the usual sharpness around it; planted blurs came out below 0.2


@dataclasses.dataclass(frozen=True)
class Npz:
    """Arrays `images`, `poses` (OpenGL camera to world), `focal` and `times`.

    Where rows in a row share one pose, those are a validation sweep: they are held out,
    the rows before them are learnt from and the rows after them are left out.
    """

    file: cli.Positional[pathlib.Path]
    """The archive."""
    out: cli.Positional[pathlib.Path]
    """Folder to write; must not hold anything yet."""
    heldout: str | None = None
    """Rows to score on, as first:last+1."""
    train: str | None = None
    """Rows to learn from, as first:last+1; all others if not given."""


@dataclasses.dataclass(frozen=True)
class Video:
    """A film: its sharpest frames, their cameras by COLMAP, as a Nerfies directory."""

    file: cli.Positional[pathlib.Path]
    """The film."""
    out: cli.Positional[pathlib.Path]
    """Folder to write; must not hold anything yet."""
    frames: int = 100
    """How many frames to keep, evenly spread over the film."""
    max_side: int = 960
    """Longest side of the frames in pixels."""


@dataclasses.dataclass(frozen=True)
class Pictures:
    """A folder of pictures: cameras by COLMAP, as a Nerfies directory."""

    folder: cli.Positional[pathlib.Path]
    """The pictures, in the order of their names."""
    out: cli.Positional[pathlib.Path]
    """Folder to write; must not hold anything yet."""
    masks: pathlib.Path | None = None
    """Folder with NAME.png for every picture NAME; black: moves by itself."""


def main(arguments=None):
    """Parse, convert, and say what came out."""
    args = cli.parse(Npz | Video | Pictures, arguments)
    with cli.user_errors():
        for line in CONVERTERS[type(args)](args):
            print(line)
    print(f"next: python -m experiments.reconstruct {args.out}")


def convert_npz(args: Npz) -> list[str]:
    """Write transforms_train.json and transforms_val.json with their pictures."""
    from nerfies_jax.capture import load
    from nerfies_jax.capture.capture import describe
    from nerfies_jax.capture.images import write_png
    from nerfies_jax.capture.json_files import new_folder, write_json

    images, poses, times, focal = read_npz(args.file)
    train, heldout, note = rows_of(poses, args)
    common = {"camera_angle_x": 2 * math.atan(images.shape[2] / 2 / focal)}
    behind = background_of(images)
    if behind is not None:
        common["background"] = behind
    with new_folder(args.out) as folder:
        for name, rows in (("train", train), ("val", heldout)):
            (folder / name).mkdir()
            entries = []
            for row in rows:
                write_png(folder / name / f"r_{row:04d}.png", images[row])
                entry = {
                    "file_path": f"./{name}/r_{row:04d}",
                    "transform_matrix": poses[row].tolist(),
                }
                if times is not None:
                    entry["time"] = float(times[row])
                entries.append(entry)
            file = folder / f"transforms_{name}.json"
            write_json(file, common | {"frames": entries})
        load(folder)  # refused now rather than when it is used
    return [*describe(load(args.out)), note]


def read_npz(path):
    """uint8 images, poses, times or None, and the focal length in pixels."""
    from nerfies_jax.capture.capture import CaptureError
    from nerfies_jax.capture.frames import MAX_BYTES

    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > 4 * MAX_BYTES:  # float32 pictures
            raise CaptureError(f"{path}: unpacks to {size} bytes; split it first")
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        if isinstance(error, CaptureError):
            raise
        raise CaptureError(
            f"{path}: not a readable .npz ({' '.join(str(error).split())}); save it "
            "again with numpy.savez"
        ) from None
    absent = {"images", "poses", "focal"} - set(arrays)
    if absent:
        raise CaptureError(
            f"{path}: no array {min(absent)!r}; there are {sorted(arrays)}"
        )
    images, poses, times = arrays["images"], arrays["poses"], arrays.get("times")
    count = len(images)
    if (
        images.ndim != 4
        or images.shape[3] != 3
        or poses.shape[1:] not in ((4, 4), (3, 4))
    ):
        raise CaptureError(
            f"{path}: images {images.shape} and poses {poses.shape}; expected "
            "[n, height, width, 3] and [n, 4, 4]"
        )
    if len(poses) != count or (times is not None and times.shape != (count,)):
        raise CaptureError(
            f"{path}: {count} images but another number of poses or times"
        )
    if not all(np.isfinite(a).all() for a in (images, poses, arrays["focal"])):
        raise CaptureError(f"{path}: holds NaN or infinity; mend or remove those rows")
    focal = float(np.asarray(arrays["focal"]).ravel()[0])
    if not focal > 0:
        raise CaptureError(f"{path}: focal = {focal:g}; it must be positive")
    if images.dtype != np.uint8:
        if images.min() < 0 or images.max() > 1:
            raise CaptureError(
                f"{path}: images from {images.min():g} to {images.max():g}; expected "
                "uint8, or floats from 0 to 1"
            )
        images = np.round(images * 255).astype(np.uint8)
    return images, poses.astype(float), times, focal


def rows_of(poses, args):
    """Rows to learn from, rows to score on, and why."""
    from nerfies_jax.capture.frames import HELD_OUT, hold_out_every

    count = len(poses)
    if args.heldout is not None:
        heldout = _range(args.heldout, count, "--heldout")
        others = np.setdiff1d(np.arange(count), heldout)
        train = others if args.train is None else _range(args.train, count, "--train")
        return train, heldout, "rows as asked for"
    if args.train is not None:
        raise ValueError("--train needs --heldout too, so that both are known")
    same = np.abs(np.diff(poses, axis=0)).max((1, 2)) < SAME_POSE
    best, first = (0, 0), 0
    for row in range(1, count + 1):
        if row == count or not same[row - 1]:
            best = max(best, (row - first, -first))
            first = row
    length, start = best[0], -best[1]
    if TRIPOD_ROWS <= length < count and start > 0:
        rest = count - start - length
        return (
            np.arange(start),
            np.arange(start, start + length),
            f"rows {start} to {start + length - 1} share one pose: held out; "
            f"{rest} rows after them left out",
        )
    train, heldout = hold_out_every(count, HELD_OUT, str(args.file))
    return train, heldout, f"every {HELD_OUT}th row is held out"


def _range(text, count, name):
    try:
        first, last = (int(part) for part in text.split(":"))
    except ValueError:
        raise ValueError(f"{name} {text}: expected first:last+1, as in 50:61") from None
    if not 0 <= first < last <= count:
        raise ValueError(f"{name} {text}: the archive has rows 0 to {count - 1}")
    return np.arange(first, last)


def background_of(images):
    """The colour [0, 1] of the corners, if nearly all corners have the same."""
    corners = images[:, [0, 0, -1, -1], [0, -1, 0, -1]].reshape(-1, 3)
    usual = np.median(corners, axis=0)
    if (corners == usual).all(1).mean() < 0.95:
        return None
    return (usual / 255).tolist()


def convert_video(args: Video) -> list[str]:
    """Pick sharp frames, find their cameras, write a Nerfies directory."""
    from nerfies_jax.capture.capture import shrink
    from nerfies_jax.capture.images import write_png
    from nerfies_jax.capture.json_files import scratch_folder
    from nerfies_jax.capture.video import read_video

    if args.frames < 2:
        raise ValueError(f"--frames {args.frames}: a reconstruction needs at least 2")
    scores = [sharpness(frame) for _, frame in read_video(args.file)]
    kept, blurred = sharp_rows(np.array(scores), args.frames)
    with scratch_folder(args.out) as scratch:
        (scratch / "pictures").mkdir()
        wanted = set(kept.tolist())
        for row, (seconds, frame) in enumerate(read_video(args.file)):
            if row in wanted:
                factor = max(1, math.ceil(max(frame.shape[:2]) / args.max_side))
                name = f"ms{round(seconds * 1000):08d}.png"  # the name keeps the time
                write_png(scratch / "pictures" / name, shrink(frame, factor))
        lines = _reconstruct(scratch, scratch / "pictures", None, args.out)
    return [f"{len(kept)} of {len(scores)} frames kept, {blurred} too blurred", *lines]


def sharpness(frame: np.ndarray) -> float:
    """Variance of the Laplacian of the grey picture: high where edges are sharp."""
    import scipy.ndimage

    grey = frame.mean(-1, dtype=np.float32)
    step = max(1, max(grey.shape) // 480)
    return float(scipy.ndimage.laplace(grey[::step, ::step]).var())


def sharp_rows(scores: np.ndarray, count: int) -> tuple[np.ndarray, int]:
    """The sharpest of each of `count` stretches, and how many were too blurred.

    Not a global threshold: a film may be sharper where the scene has more texture. (The
    filter in Nerfies' notebook removes the sharpest frames instead.)
    """
    stretches = np.array_split(np.arange(len(scores)), min(count, len(scores)))
    best = np.array([rows[np.argmax(scores[rows])] for rows in stretches])
    own = scores[best]
    clear = np.array([own[i] >= BLURRED * _usual(own, i) for i in range(len(own))])
    return best[clear], int((~clear).sum())


def _usual(scores, row):
    """The lower of the medians just before and just after; texture may jump between."""
    sides = scores[max(0, row - 5) : row], scores[row + 1 : row + 6]
    return min((np.median(side) for side in sides if side.size), default=0.0)


def convert_pictures(args: Pictures) -> list[str]:
    """Find the cameras of pictures, write a Nerfies directory."""
    from nerfies_jax.capture.json_files import scratch_folder

    with scratch_folder(args.out) as scratch:
        return _reconstruct(scratch, args.folder, args.masks, args.out)


def _reconstruct(scratch, pictures, masks, out):
    from nerfies_jax.capture import colmap, nerfies_format
    from nerfies_jax.capture.capture import describe
    from nerfies_jax.capture.structure_from_motion import run_sfm

    capture = colmap.read(run_sfm(pictures, scratch / "model", masks))
    capture = dataclasses.replace(capture, name=pathlib.Path(out).name, path=None)
    nerfies_format.write(capture, out)
    return list(describe(capture))


CONVERTERS = {Npz: convert_npz, Video: convert_video, Pictures: convert_pictures}

if __name__ == "__main__":
    main()
