"""Small valid files of every kind that is read, and their readers."""

import functools
import io
import json
import pathlib
import pickle
import zipfile
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import PIL.Image

SIDE = (12, 8)  # width and height of the images


class Target(NamedTuple):
    """One reader."""

    make: Callable[[pathlib.Path], Any]  # writes valid files into an empty folder
    read: Callable[[pathlib.Path], Any]  # of the same folder, after the damage
    weight: int  # mutations at a time: many of those that are fast


@functools.cache
def _capture():
    """Six frames, with all that a capture may have."""
    from nerfies_jax.capture.capture import Capture, PointCloud
    from nerfies_jax.geometry import camera

    rng, count = np.random.default_rng(0), 6
    places = [(0.1 * row, 0.02 * row, 0.0) for row in range(count)]
    cameras = [camera.pinhole(np.eye(3), place, 11.0, SIDE) for place in places]
    moving = np.zeros((count, *SIDE[::-1]), bool)
    moving[:, 2:4, 3:6] = True
    rows = np.arange(count, dtype=np.int32)
    return Capture(
        name="fuzz",
        source="fuzz",
        ids=tuple(f"{row:03d}" for row in range(count)),
        images=rng.integers(0, 256, (count, *SIDE[::-1], 3), np.uint8),
        cameras=camera.stack(cameras),
        times=np.linspace(0, 1, count, dtype=np.float32),
        train=np.array([0, 1, 2, 4, 5]),
        heldout=np.array([3]),
        near=0.5,
        far=8.0,
        warp_ids=rows,
        appearance_ids=rows,
        camera_ids=np.zeros(count, np.int32),
        valid=rng.random(moving.shape) < 0.9,
        moving=moving,
        depths=np.full(moving.shape, 3, np.float32),
        points=PointCloud(
            rng.uniform((-1, -1, 2), (1, 1, 4), (20, 3)).astype(np.float32),
            rng.integers(0, 256, (20, 3), np.uint8),
        ),
    )


def _gaussians(count=12):
    import jax.numpy as jnp

    from gaussians_jax.core.splats import Splats

    rng = np.random.default_rng(0)

    def some(*shape):
        return jnp.asarray(rng.normal(size=(count, *shape)), jnp.float32)

    return Splats(some(3), some(3), some(4), some(), some(1, 3), some(3, 3))


def _load(folder):
    from nerfies_jax.capture import formats

    formats.load(folder)


def _nerfies(folder):
    from nerfies_jax.capture import nerfies_format

    nerfies_format.write(_capture(), folder / "capture")


def _images(folder, count=6, channels=3):
    folder.mkdir(parents=True)
    rng = np.random.default_rng(1)
    for row in range(count):
        pixels = rng.integers(0, 256, (SIDE[1], SIDE[0], channels), np.uint8)
        PIL.Image.fromarray(pixels).save(folder / f"f_{row}.png")


def _transforms(folder):
    import plyfile

    from nerfies_jax.capture.json_files import write_json

    folder = folder / "capture"
    _images(folder / "images", channels=4)
    (folder / "masks").mkdir()
    entries = []
    for row in range(6):
        mask = np.full((SIDE[1], SIDE[0]), 255, np.uint8)
        mask[: row + 1] = 0
        PIL.Image.fromarray(mask).save(folder / f"masks/{row}.png")
        matrix = np.eye(4)
        matrix[:3, 3] = 0.2 * row, 0.1, 4
        entries.append(
            {
                "file_path": f"images/f_{row}.png",
                "mask_path": f"masks/{row}.png",
                "time": row / 5,
                "transform_matrix": matrix.tolist(),
            }
        )
    lens = {"fl_x": 11.0, "fl_y": 11.5, "cx": 6.0, "cy": 4.0, "w": 12, "h": 8}
    lens |= {"k1": 0.01, "p1": 1e-3, "camera_model": "OPENCV", "fps": 30.0}
    points = np.random.default_rng(2).normal(size=(20, 3))
    table = np.array([tuple(row) for row in points], [(axis, "f4") for axis in "xyz"])
    element = plyfile.PlyElement.describe(table, "vertex")
    plyfile.PlyData([element]).write(str(folder / "points.ply"))
    top = {"ply_file_path": "points.ply", "frames": entries}
    write_json(folder / "transforms.json", lens | top)


def _colmap(folder):
    folder = folder / "capture"
    _images(folder / "images")
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 OPENCV 12 8 11 11.5 6 4 0.01 0 0 0\n")
    points = np.random.default_rng(3).uniform((-1, -1, 5), (1, 1, 7), (12, 3))
    observations = " ".join(f"1 1 {row + 1}" for row in range(12))
    lines = [
        f"{row + 1} 1 0 0 0 {-0.2 * row} 0 0 1 f_{row}.png\n{observations}\n"
        for row in range(6)
    ]
    (model / "images.txt").write_text("".join(lines))
    track = [" ".join(f"{image + 1} {row}" for image in range(6)) for row in range(12)]
    rows = [
        f"{row + 1} {x} {y} {z} 9 9 9 0.5 {track[row]}\n"
        for row, (x, y, z) in enumerate(points)
    ]
    (model / "points3D.txt").write_text("".join(rows))


def _colmap_binary(folder):
    from nerfies_jax.capture.colmap_library import library

    _colmap(folder)
    model = folder / "capture/sparse/0"
    library().Reconstruction(str(model)).write_binary(str(model))
    for text in model.glob("*.txt"):
        text.unlink()


def _llff(folder):
    folder = folder / "capture"
    _images(folder / "images")
    table = np.zeros((6, 17))
    table[:, :15] = np.c_[np.eye(3), np.zeros(3), [SIDE[1], SIDE[0], 11]].ravel()
    table[:, 3], table[:, 15:] = np.arange(6), (1, 5)
    np.save(folder / "poses_bounds.npy", table)


def _rig(folder):
    folder = folder / "capture"
    for row in range(3):
        _images(folder / f"cam{row:02d}", count=2)
    table = np.zeros((3, 17))
    table[:, :15] = np.c_[np.eye(3), np.zeros(3), [SIDE[1], SIDE[0], 11]].ravel()
    table[:, 3], table[:, 15:] = np.arange(3), (1, 5)
    np.save(folder / "poses_bounds.npy", table)


def _photographs(folder):
    color = np.random.default_rng(9).integers(0, 256, (*SIDE[::-1], 4), np.uint8)
    exif = PIL.Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 28
    PIL.Image.fromarray(color[..., :3]).save(folder / "a.jpg", exif=exif)
    PIL.Image.fromarray(color).save(folder / "b.png", exif=exif)
    PIL.Image.fromarray(color).save(folder / "c.webp", exif=exif)
    PIL.Image.fromarray(color[..., 0].astype(np.uint16) * 257).save(folder / "d.tif")


def _read_photographs(folder):
    from nerfies_jax.capture import photographs

    for path in sorted(folder.iterdir()):
        photographs.read_upright(path)


def _times(folder):
    from nerfies_jax.capture.json_files import write_json

    times = {name: 0.1 * row for row, name in enumerate(_capture().ids)}
    write_json(folder / "a.json", times)
    rows = [f"images/{name}.png, {time}\n" for name, time in times.items()]
    (folder / "b.csv").write_text("name, seconds\n" + "".join(rows))
    rows = [
        f"2024-01-31 10:00:{10 * time:02.0f} {name}.png\n"
        for name, time in times.items()
    ]
    (folder / "c.txt").write_text("".join(rows))


def _read_times(folder):
    from nerfies_jax.capture import times_file

    for path in sorted(folder.iterdir()):
        times_file.with_times(_capture(), path)


def _image_files(folder):
    rng = np.random.default_rng(4)
    gray = rng.integers(0, 256, SIDE[::-1], np.uint8)
    color = rng.integers(0, 256, (*SIDE[::-1], 3), np.uint8)
    PIL.Image.fromarray(gray).save(folder / "gray.png")
    PIL.Image.fromarray((gray > 99) * np.uint8(255)).convert("1").save(
        folder / "bits.png"
    )
    PIL.Image.fromarray(color).save(folder / "color.jpg")
    PIL.Image.fromarray(color).save(folder / "color.tif")
    PIL.Image.fromarray(color).quantize(8).save(folder / "palette.png")
    PIL.Image.fromarray(gray.astype(np.uint16) * 257).save(folder / "deep.png")


def _read_images(folder):
    from nerfies_jax.capture import images

    for path in sorted(folder.iterdir()):
        images.read_pixels(path)


def _masks(folder):
    gray = np.zeros(SIDE[::-1], np.uint8)
    gray[2:5] = 255
    PIL.Image.fromarray(gray).save(folder / "a.png")
    PIL.Image.fromarray(gray // 255).save(folder / "b.png")
    PIL.Image.fromarray(np.dstack([gray] * 4)).save(folder / "c.png")


def _read_masks(folder):
    from nerfies_jax.capture import masks

    for path in sorted(folder.iterdir()):
        masks.read_mask(path)


def _exr(folder):
    from nerfies_jax.capture import exr

    pixels = np.random.default_rng(5).random((*SIDE[::-1], 3))
    exr.write_exr(folder / "a.exr", pixels, depth=pixels[..., 0], half=True)


def _read_exr(folder):
    from nerfies_jax.capture import images

    images.read_light(folder / "a.exr")


def _npy(folder):
    np.save(folder / "a.npy", np.arange(60, dtype=np.float32).reshape(5, 12))


def _read_npy(folder):
    from nerfies_jax.capture import npz_files

    npz_files.load_array(folder / "a.npy", 10**6)


def _npz(folder):
    rng = np.random.default_rng(6)
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = np.arange(6)
    np.savez_compressed(
        folder / "a.npz",
        images=rng.integers(0, 256, (6, *SIDE[::-1], 3), np.uint8),
        poses=poses,
        times=np.linspace(0, 1, 6),
        focal=np.array(11.0),
    )


def _read_npz(folder):
    from nerfies_jax.capture import npz_archive

    npz_archive.read_archive(folder / "a.npz")


def _points(folder):
    import plyfile

    kinds = [(axis, "f4") for axis in "xyz"]
    kinds += [(name, "u1") for name in ("red", "green", "blue")]
    table = np.zeros(9, kinds)
    table["x"] = np.arange(9)
    element = plyfile.PlyElement.describe(table, "vertex")
    for name, text in (("a", True), ("b", False)):
        plyfile.PlyData([element], text=text).write(str(folder / f"{name}.ply"))


def _read_points(folder):
    from nerfies_jax.capture import points

    for path in sorted(folder.iterdir()):
        points.read_ply(path)


def _splats(folder, name, **options):
    from gaussians_jax.io import files

    files.save(folder / name, _gaussians(), **options)


def _read_splats(folder):
    from gaussians_jax.io import files

    for path in folder.iterdir():
        files.load(path, drop_broken=True)


def _model(folder):
    from gaussians_jax.core.splats import Params
    from gaussians_jax.io import model_file

    about = {"step": 3, "name": "fuzz", "size": [12, 8]}
    params = Params({"splats": _gaussians(5)}, {"net": {"w": np.ones((2, 2))}})
    model_file.save(folder / "model.npz", params, about)


def _read_model(folder):
    from gaussians_jax.io import model_file

    model_file.load(folder / "model.npz")


def _path(folder):
    from nerfies_jax.capture.json_files import write_json

    pose = np.eye(4)
    pose[:3, 3] = 0, 0, 4
    entry = {"camera_to_world": pose.ravel().tolist(), "fov": 50.0, "aspect": 1.5}
    entries = [entry | {"render_time": row / 3} for row in range(4)]
    keyframes = [{"matrix": pose.ravel().tolist(), "fov": 50, "aspect": 1.5}] * 2
    table = {"camera_type": "perspective", "render_width": 12, "render_height": 8}
    table |= {"keyframes": keyframes, "camera_path": entries}
    write_json(folder / "path.json", table)


def _read_path(folder):
    from nerfies_jax.capture import path_files

    path_files.read_keyframes(folder / "path.json", _capture())


def _external(folder):
    from nerfies_jax.capture import exr

    capture, rng = _capture(), np.random.default_rng(7)
    count = len(capture.train)
    np.savez_compressed(
        folder / "tracks.npz",
        tracks=rng.uniform(1, 7, (5, count, 2)),
        visibles=np.ones((5, count), bool),
    )
    for name in ("masks", "depths", "flow/forward", "flow/backward"):
        (folder / name).mkdir(parents=True)
    for row in range(count):
        mask = np.zeros(SIDE[::-1], np.uint8)
        mask[: row + 1] = 255
        PIL.Image.fromarray(mask).save(folder / f"masks/{row}.png")
        np.save(folder / f"depths/{row}.npy", np.ones(SIDE[::-1], np.float32))
    exr.write_exr(folder / "depths/0.exr", depth=np.ones(SIDE[::-1]))
    (folder / "depths/0.npy").unlink()
    head = np.float32(202021.25).tobytes() + np.int32(SIDE).tobytes()
    for side in ("forward", "backward"):
        for row in range(count - 1):
            flow = np.zeros((*SIDE[::-1], 2), np.float32)
            (folder / f"flow/{side}/{row}.flo").write_bytes(head + flow.tobytes())


def _read_external(folder):
    from nerfies_jax.capture.external import ExternalFiles
    from nerfies_jax.preprocessing import external_files

    files = ExternalFiles(
        *(folder / n for n in ("tracks.npz", "masks", "depths", "flow"))
    )
    external_files.attached(_capture(), files)


def _video(folder):
    from nerfies_jax.capture import video

    rng = np.random.default_rng(8)
    frames = rng.integers(0, 256, (3, 16, 24, 3), np.uint8)
    video.write_video(folder / "a.mp4", frames)


def _read_video(folder):
    from nerfies_jax.capture import video

    for _ in video.read_video(folder / "a.mp4", damaged="skip"):
        pass


def _weights(folder):
    array = np.arange(6, dtype=np.float32)
    entry = {"dtype": "F32", "shape": [2, 3], "data_offsets": [0, 24]}
    head = json.dumps({"w": entry}).encode()
    content = len(head).to_bytes(8, "little") + head + array.tobytes()
    (folder / "a.safetensors").write_bytes(content)
    (folder / "c.ckpt").write_bytes(pickle.dumps({"w": {"kernel": array}}))
    buffer = io.BytesIO()
    pickle.Pickler(buffer, 2).dump({"w": 1, "b": (1, 2)})
    with zipfile.ZipFile(folder / "b.pth", "w") as archive:
        archive.writestr("b/data.pkl", buffer.getvalue())
        archive.writestr("b/data/0", array.tobytes())


def _read_weights(folder):
    from nerfies_jax.metrics import weight_files

    for path in sorted(folder.iterdir()):
        weight_files.read_tensors(path)


def _run(folder):
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.runs import representations, run
    from nerfies_jax.runs.config import RunConfig
    from nerfies_jax.training import specs

    config = RunConfig("splats-static")
    write_json(
        folder / "config.json",
        {
            "config": specs.as_json(config),
            "representation": representations.of_preset(config.preset).name,
            "spec": specs.as_json(run.scene_spec(config)),
        },
    )


def _read_run(folder):
    from nerfies_jax.runs import run

    run.read_settings(folder)


def _metrics(folder):
    from nerfies_jax.metrics import clock

    clock.write_metrics(folder / "metrics.json", [])
    content = json.loads((folder / "metrics.json").read_text())
    row = {"value": 1.5, "unit": "dB", "tolerance": 0.1, "direction": "higher"}
    content["metrics"] = {"psnr": row}
    (folder / "metrics.json").write_text(json.dumps(content))
    curve = {
        "evaluations": [{"seconds": 1.0, "step": 3, "psnr": 20.0, "ssim": 0.5}],
        "frames": ["a"],
        "compile_seconds": 2.0,
        "machine": {"cpu": "x"},
    }
    (folder / "curve.json").write_text(json.dumps(curve))


def _read_metrics(folder):
    from nerfies_jax.metrics import clock
    from nerfies_jax.runs import curves

    clock.read_metrics(folder / "metrics.json")
    curves.read(folder)


def _cache(folder):
    from nerfies_jax.capture import cache_files

    cache_files.write_arrays(folder / "a.npz", {"a": np.arange(9)}, "fuzz")
    cache_files.write_json(folder / "b.json", {"a": [1, 2]}, "fuzz")


def _read_cache(folder):
    """Never refused: what is damaged is made again."""
    from nerfies_jax.capture import cache_files
    from nerfies_jax.runtime import console

    cache_files._warnings.clear()
    warn, console.warn = console.warn, lambda words: None
    try:
        cache_files.read(
            folder / "a.npz", lambda path: cache_files.read_arrays(path, "fuzz")
        )
        cache_files.read(
            folder / "b.json", lambda path: cache_files.read_json(path, "fuzz")
        )
    finally:
        console.warn = warn


def _events(folder):
    lines = [{"kind": "step", "step": row, "loss": 0.5} for row in range(5)]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (folder / "events.jsonl").write_text(text)


def _read_events(folder):
    from nerfies_jax.runs import event_log

    event_log.read_events(folder)


TARGETS = {
    "Nerfies capture": Target(_nerfies, lambda f: _load(f / "capture"), 20),
    "transforms.json capture": Target(_transforms, lambda f: _load(f / "capture"), 20),
    "COLMAP capture, text": Target(_colmap, lambda f: _load(f / "capture"), 10),
    "COLMAP capture, binary": Target(
        _colmap_binary, lambda f: _load(f / "capture"), 10
    ),
    "LLFF capture": Target(_llff, lambda f: _load(f / "capture"), 10),
    "rig of cameras": Target(_rig, lambda f: _load(f / "capture"), 10),
    "frame times": Target(_times, _read_times, 200),
    "photographs": Target(_photographs, _read_photographs, 100),
    "images": Target(_image_files, _read_images, 200),
    "masks": Target(_masks, _read_masks, 100),
    "EXR": Target(_exr, _read_exr, 50),
    "npy": Target(_npy, _read_npy, 500),
    "npz of images and poses": Target(_npz, _read_npz, 200),
    "PLY points": Target(_points, _read_points, 200),
    "PLY splats": Target(lambda f: _splats(f, "a.ply"), _read_splats, 100),
    ".splat": Target(lambda f: _splats(f, "a.splat"), _read_splats, 200),
    "SPZ version 2": Target(
        lambda f: _splats(f, "a.spz", spz_version=2), _read_splats, 200
    ),
    "SPZ version 3": Target(
        lambda f: _splats(f, "a.spz", spz_version=3), _read_splats, 200
    ),
    "SPZ version 4": Target(
        lambda f: _splats(f, "a.spz", spz_version=4), _read_splats, 200
    ),
    "model.npz": Target(_model, _read_model, 100),
    "camera path": Target(_path, _read_path, 200),
    "external tracks, masks, depth, flow": Target(_external, _read_external, 20),
    "video": Target(_video, _read_video, 20),
    "weights": Target(_weights, _read_weights, 200),
    "settings of a run": Target(_run, _read_run, 50),
    "metrics and curve of a run": Target(_metrics, _read_metrics, 500),
    "events of a run": Target(_events, _read_events, 500),
    "caches": Target(_cache, _read_cache, 200),
}
