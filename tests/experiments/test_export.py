"""A finished run through the command line into the files of other programs."""

import dataclasses
import json
import re

import jax
import numpy as np
import OpenEXR
import plyfile
import pytest

from experiments import cli, export
from gaussians_jax.io import splatv
from nerfies_jax import runs
from nerfies_jax.capture import camera_paths, exr, load, nerfies_format
from nerfies_jax.evaluation import exr_series
from nerfies_jax.runs import train
from nerfies_jax.runs.config import CaptureSource, RunConfig
from tests import scenes

CENTER = (1.0, -2.0, 3.0)  # of the world, which is twice as large as the scene
SPLATS = ("sh_degree=1", "strategy=none", "init.extra_random=0")
SPLATS += ("motion.width=8", "motion.depth=2", "motion.skips=")
FIELD = ("elastic=none", "background=none", "rays=32", "template.skips=")
FIELD += ("template.depth=1", "template.width=8", "template.color_width=8")
FIELD += ("sampling.coarse=4", "sampling.fine=4")
FIELD += ("warp.skips=", "warp.depth=1", "warp.width=8")


def saved(folder, preset, overrides, shaken):
    """A run of the tiny capture that was saved before it learned anything.

    `shaken` are the networks whose numbers are drawn anew, so that something moves.
    """
    capture = dataclasses.replace(scenes.tiny_capture(), scale=0.5, center=CENTER)
    nerfies_format.write(capture, folder / "capture")
    source = CaptureSource(capture=folder / "capture")
    run = runs.new_run(RunConfig(preset, source, steps=12, overrides=overrides))
    state, rng = runs.initial_state(run), np.random.default_rng(0)

    def shake(leaf):
        return leaf + np.asarray(0.1 * rng.normal(size=leaf.shape), leaf.dtype)

    state = state._replace(params=shaken(state.params, shake))
    out = folder / "run"
    out.mkdir()
    runs.save_config(out, run)
    with train.open_checkpoints(out, run, None) as checkpoints:
        checkpoints.save(state, 0, {})
    return out


@pytest.fixture(scope="module")
def splats(tmp_path_factory):
    def shaken(params, shake):
        return params._replace(nets=jax.tree.map(shake, params.nets))

    folder = tmp_path_factory.mktemp("splats")
    return saved(folder, "splats-deformable-small", SPLATS, shaken)


def main(*words):
    """Run the command; its exit code."""
    try:
        export.main([str(word) for word in words])
    except SystemExit as stop:
        return stop.code
    return 0


def test_cameras_leave_with_images_in_three_layouts(splats, tmp_path, capsys):
    capture = scenes.tiny_capture()
    for layout in ("transforms", "colmap", "nerfies"):
        assert main(splats, layout) == 0
        read = load(splats / "exports" / layout)
        images = sorted(image.tobytes() for image in read.images)
        assert images == sorted(image.tobytes() for image in capture.images)
    # The same folder once more, and the cameras of the world
    assert main(splats, "transforms", "--units", "world", "--overwrite") == 0
    table = (splats / "exports" / "transforms" / "transforms.json").read_text()
    pose = np.array(json.loads(table)["frames"][2]["transform_matrix"])
    place = 2 * capture.cameras.position[2] + CENTER
    np.testing.assert_allclose(pose[:3, 3], place, rtol=1e-6)
    assert main(splats, "colmap", "--time", 0.5) == 2
    assert "--time is not for colmap, but for ply, splat" in capsys.readouterr().err


def test_a_path_leaves_with_its_times(splats, capsys):
    assert cli.PATHS == camera_paths.KINDS
    assert main(splats, "path", "--path", "stabilized", "--frames", 5) == 0
    path = splats / "exports" / "path-stabilized.json"
    times = [
        each["render_time"] for each in json.loads(path.read_text())["camera_path"]
    ]
    times_of_capture = scenes.tiny_capture().times[scenes.tiny_capture().train]
    np.testing.assert_allclose(
        times, np.linspace(times_of_capture.min(), times_of_capture.max(), 5), 1e-6
    )
    # In the one form and out in the other; and the times of a path that has none.
    assert main(splats, "nerfies-path", "--path", path) == 0
    (folder,) = (splats / "exports").glob("nerfies-path-path-stabilized-????????")
    again = [json.loads(place.read_text()) for place in sorted(folder.iterdir())]
    assert [each["time"] for each in again] == times
    assert main(splats, "path", "--frames", 4) == 0
    table = json.loads((splats / "exports" / "path.json").read_text())
    assert [e["render_time"] for e in table["camera_path"]] == [0, 0.5, 1, 0.5]
    # nerfstudio's viewer edits the keyframes, and takes no fov for one of their own.
    assert [e["render_time"] for e in table["keyframes"]] == [0, 0.5, 1, 0.5]
    assert {e["fov"] for e in table["keyframes"]} == {table["default_fov"]}
    assert table["keyframes"][1]["matrix"] == table["camera_path"][1]["camera_to_world"]
    assert main(splats, "path", "--path", path, "--frames", 4) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "own number of frames" in error


def test_a_path_leaves_as_training_found_the_cameras(splats, tmp_path, monkeypatch):
    def refine(params, capture):
        cameras = capture.cameras
        moved = cameras._replace(position=cameras.position + np.float32([0.25, 0, 0]))
        return dataclasses.replace(capture, cameras=moved)

    def positions(name):
        words = ("path", "--path", "captured", "--out", tmp_path / f"{name}.json")
        assert main(splats, *words) == 0
        table = json.loads((tmp_path / f"{name}.json").read_text())["camera_path"]
        return np.array([each["camera_to_world"] for each in table])[:, 3:12:4]

    before, run = positions("before"), runs.saved_run(splats)
    refined = run._replace(model=run.model._replace(apply_to_capture=refine))
    monkeypatch.setattr(runs, "saved_run", lambda folder, **_: refined)
    moved = positions("after") - before
    np.testing.assert_allclose(np.abs(moved).max(axis=1), 0.25, rtol=1e-5)


def test_gaussians_leave_at_an_instant_and_as_a_sequence(splats, tmp_path, capsys):
    assert main(splats, "ply", "--time", "0.4") == 0
    path = splats / "exports" / "at-0.4.ply"
    assert str(path) in capsys.readouterr().out
    x = plyfile.PlyData.read(path)["vertex"]["x"]
    assert main(splats, "splat", "--frames", 2, "--out", tmp_path / "two") == 0
    first, last = (
        np.fromfile(tmp_path / "two" / f"frame_000{number}.splat", "<f4").reshape(-1, 8)
        for number in range(2)
    )
    assert len(first) == len(x)
    # Other places of the same Gaussians
    assert np.abs(np.sort(first[:, 0]) - np.sort(last[:, 0])).max() > 1e-3
    before = path.read_bytes()
    assert main(splats, "ply", "--time", "0.4") == 2
    assert "already there" in capsys.readouterr().err
    assert path.read_bytes() == before
    assert main(splats, "ply", "--time", "0.4", "--overwrite", "--units", "world") == 0
    in_world = plyfile.PlyData.read(path)["vertex"]["x"]
    np.testing.assert_allclose(in_world, 2 * x + CENTER[0], rtol=1e-6)


def test_a_program_decides_format_axes_and_crop(splats, tmp_path, capsys):
    assert main(splats, "--for", "usd") == 0
    assert re.search(r", y up, without \d+ that no camera saw", capsys.readouterr().out)
    (path,) = (splats / "exports").glob("*.usda")
    assert 'upAxis = "Y"' in path.read_text()
    plain, turned = tmp_path / "a.ply", tmp_path / "b.ply"
    assert main(splats, "ply", "--out", plain) == 0
    assert main(splats, "ply", "--up", "z", "--out", turned) == 0
    before, after = (
        np.stack([plyfile.PlyData.read(path)["vertex"][axis] for axis in "xyz"], -1)
        for path in (plain, turned)
    )
    capture = scenes.tiny_capture()
    up = -capture.cameras.camera_from_world[capture.train, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    np.testing.assert_allclose(after[:, 2], before @ up, atol=1e-4)
    capsys.readouterr()
    assert main(splats) == 2
    assert "name a format (ply, " in capsys.readouterr().err
    assert main(splats, "--for", "usd", "--up", "x") == 2
    assert "OpenUSD has y or z up" in capsys.readouterr().err
    assert main(splats, "glb", "--up", "z") == 2
    assert "--up z: glTF has y up" in capsys.readouterr().err
    assert main(splats, "transforms", "--keep", "seen") == 2
    assert "--keep is not for transforms, but for ply" in capsys.readouterr().err


@pytest.mark.full
def test_a_mesh_leaves_in_world_units(splats, capsys):
    assert main(splats, "mesh", "--voxels", 24) == 0
    assert main(splats, "mesh", "--voxels", 24, "--units", "world", "--overwrite") == 0
    assert "triangles at time 0" in capsys.readouterr().out
    ply = plyfile.PlyData.read(splats / "exports" / "mesh-at-0.ply")
    place = np.stack([ply["vertex"][axis] for axis in "xyz"], -1)
    assert np.abs(place.mean(0) - CENTER).max() < 8  # and not around the origin


@pytest.mark.full
def test_a_scene_leaves_with_all_its_motion_and_how_far_it_is_off(splats, capsys):
    assert main(splats, "splatv") == 0
    printed = capsys.readouterr().out
    path = splats / "exports" / "splatv.splatv"
    assert str(path) in printed
    errors = re.search(r"RMS error (\S+) scene units.* of the run (\S+) dB", printed)
    assert 0 < float(errors[1]) < 0.1
    assert 20 < float(errors[2]) < 100
    assert len(splatv.decode(path.read_bytes()).position) > 100
    assert main(splats, "splatv", "--frames", 2) == 2
    assert "--frames is not for splatv" in capsys.readouterr().err


@pytest.mark.full
def test_images_leave_with_their_camera_and_motion(splats, capsys, monkeypatch):
    path = ("--path", "captured", "--frames", 3)
    assert main(splats, "exr", *path) == 0
    assert "and flow" in capsys.readouterr().out
    images = sorted((splats / "exports" / "exr-captured").iterdir())
    assert [image.name for image in images] == [
        "0000.exr",
        "0001.exr",
        "0002.exr",
    ]
    # What a person put there is named before anything is rendered again.
    (images[0].parent / "notes.txt").write_text("mine")
    monkeypatch.setattr(exr_series, "write_frame", None)
    assert main(splats, "exr", *path, "--overwrite") == 2
    assert "holds notes.txt, which would be lost" in capsys.readouterr().err
    first, _, last = (exr.read_exr(image) for image in images)
    capture = scenes.tiny_capture()
    assert first.depth.shape == capture.images.shape[1:3]
    assert first.finite.all()
    known = first.extra["flow.A"] == 1
    assert known.any()
    assert np.abs(first.extra["flow.x"][known]).max() > 0.1
    # Nothing follows the last: to rounding, it stands still.
    assert np.abs([last.extra["flow.x"], last.extra["flow.y"]]).max() < 1e-3
    with OpenEXR.File(str(images[0]), header_only=True) as file:
        header = dict(file.header())
    row = capture.train[np.argmin(capture.times[capture.train])]
    assert header["sceneTime"] == capture.times[row]
    place = np.append(capture.cameras.position[row], 1) @ header["worldToCamera"]
    np.testing.assert_allclose(place, [0, 0, 0, 1], atol=1e-6)


@pytest.mark.full
def test_tracks_leave_in_the_units_that_are_wanted(splats, capsys):
    assert main(splats, "tracks", "--points", 30, "--frames", 3) == 0
    with np.load(splats / "exports" / "tracks.npz") as stored:
        tracks = dict(stored)
    assert {name: array.shape for name, array in tracks.items()} == {
        "positions": (30, 3, 3),
        "visible": (30, 3),
        "times": (3,),
        "pixels": (30, 3, 2),
        "frames": (3,),
    }
    assert tracks["visible"].any()
    assert np.abs(np.diff(tracks["positions"], axis=1)).max() > 1e-3
    words = ("--points", 30, "--frames", 3, "--units", "world", "--overwrite")
    assert main(splats, "tracks", *words) == 0
    with np.load(splats / "exports" / "tracks.npz") as stored:
        world = 2 * tracks["positions"] + CENTER
        np.testing.assert_allclose(stored["positions"], world, atol=1e-5)


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    def shaken(params, shake):
        return params | {"warp": jax.tree.map(shake, params["warp"])}

    folder = tmp_path_factory.mktemp("field")
    return saved(folder, "nerfies", FIELD, shaken)


@pytest.mark.slow
def test_a_field_leaves_as_images_tracks_and_cameras_alone(field, capsys):
    assert main(field, "exr", "--frames", 2) == 0
    image = exr.read_exr(field / "exports" / "exr" / "0000.exr")
    assert {"flow.x", "flow.y", "flow.A"} == {*image.extra}
    assert main(field, "path") == 0
    assert main(field, "transforms") == 0
    assert main(field, "tracks", "--points", 5, "--frames", 2) == 0
    capsys.readouterr()
    assert main(field, "ply") == 2
    error = capsys.readouterr().err
    assert "a radiance field has none" in error
    assert error.count("\n") == 1
