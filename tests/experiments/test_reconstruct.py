"""The main job from the command line to its files, and on from where it was cut."""

import errno
import json
import os
import pathlib
import re
import shutil

import jax
import numpy as np
import pytest
from matplotlib import colormaps

from experiments import compare, export, reconstruct, render
from gaussians_jax.scene import step_time
from nerfies_jax import runs
from nerfies_jax.capture import exr, images, nerfies_format, video
from nerfies_jax.evaluation import baseline_images, representation
from nerfies_jax.metrics import part_time
from nerfies_jax.runs import (
    products,
    quality,
    reconstruction,
    representations,
    run_folder,
    train,
)
from nerfies_jax.runs.run_folder import CHECKPOINTS
from nerfies_jax.training import rate, specs
from nerfies_jax.visualization import panels
from tests import event_checks, scenes

QUICK = (
    "strategy.refine_every=4",
    "strategy.refine_start_iter=4",
    "strategy.refine_stop_iter=10",
    "strategy.cap_max=300",
    "motion.width=8",
    "motion.depth=2",
    "motion.skips=",
    "sh_degree=0",
    "init.extra_random=0",
)


def ended(*arguments):
    """Exit code of the main job."""
    with pytest.raises(SystemExit) as stop:
        reconstruct.main([str(argument) for argument in arguments])
    return stop.value.code


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short run on a tiny capture, from the command line to its files."""
    folder = tmp_path_factory.mktemp("main job")
    nerfies_format.write(scenes.tiny_capture(), folder / "capture")
    words = (folder / "capture", "--preset", "splats-deformable-small")
    words = (*words, "--steps", 12, "--out", folder / "run")
    assert ended(*words, "--set", *QUICK) == 0
    return folder / "run"


PRODUCTS = (
    "config.json",
    "capture.npz",
    "metrics.json",
    "comparison.png",
    "psnr_over_time.png",
    "curve.json",
    "scene.mp4",
    "gaussians.ply",
    "model.npz",
    "player.html",
    "report.html",
)


def test_a_capture_becomes_splats_and_a_report(tmp_path, monkeypatch, capsys):
    # The run below times the parts of a step, half of all there is to compile.
    monkeypatch.setattr(step_time, "part", jax.eval_shape)
    monkeypatch.setattr(part_time, "parts_ms", lambda parts: dict.fromkeys(parts, 1.0))
    monkeypatch.setattr(quality, "CACHE", tmp_path / "cache")
    nerfies_format.write(scenes.tiny_capture(), tmp_path / "capture")
    out = tmp_path / "run"
    # Two steps are what the seconds allow.
    monkeypatch.setattr(rate, "step_time", lambda *_: rate.StepTime(100.0, 0.0))
    # A first state may take a fit of ten seconds: the one that is measured is trained.
    states, initial_state = [], reconstruction.initial_state

    def counted(run):
        states.append(initial_state(run))
        return states[-1]

    monkeypatch.setattr(reconstruction, "initial_state", counted)
    words = (tmp_path / "capture", "--preset", "splats-static-small", "--seconds", 250)
    quick = ("strategy=none", "sh_degree=0", "init.extra_random=0")
    words = (*words, "--step-profile", "--out", out, "--json")
    with event_checks.programs_in_stages():
        assert ended(*words, "--set", *quick) == 0
    assert len(states) == 1
    assert {path.name for path in out.iterdir()} >= {*PRODUCTS}
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["train.steps"] == runs.saved_run(out).config.steps == 2
    assert 0 < metrics["heldout.psnr"] < 60
    # Nothing moves in it, so its renders over time are all one image.
    assert metrics["motion.gain"] == 0
    np.testing.assert_allclose(
        metrics["baseline.static"], metrics["heldout.psnr"], atol=1e-4
    )
    capture = scenes.tiny_capture()
    means = baseline_images.neighbor_means(capture, capture.heldout).color
    error = np.square(
        np.round(255 * means) / 255 - capture.images[capture.heldout] / 255
    )
    exact = np.mean(-10 * np.log10(error.mean(axis=(1, 2, 3))))
    np.testing.assert_allclose(metrics["baseline.neighbor_mean"], exact, atol=1e-3)
    assert metrics["heldout.psnr"] < exact  # two steps
    document, printed = capsys.readouterr()
    assert json.loads(document)["metrics"] == metrics
    assert json.loads(document)["folder"] == str(out)
    page = (out / "report.html").read_text()
    assert "a training step" in page
    for words in ("is below the", f"{exact:.2f} dB", "player.html"):
        assert words in page
        assert words in printed
    assert "player could not be created" not in page
    assert "plan: 2 steps in 250 s of training" in printed
    assert "motion:     +0.00 dB compared with" in printed
    events = runs.read_events(out)
    names = event_checks.ended_stages(events)
    order = ["reading images", "initializing the scene", "training"]
    order += ["rendering the video", "measuring quality", "writing the report"]
    assert [name for name in dict.fromkeys(names) if name in order] == order
    assert events[-1]["stopped_by"] == "steps"
    curve = json.loads((out / "curve.json").read_text())
    scores = [one["metrics"] for one in events if one["kind"] == "evaluation"]
    assert [row["psnr"] for row in curve["evaluations"]] == [x["psnr"] for x in scores]
    assert curve["training"][-1]["step"] == 2
    # While another process is at work in it, it is not resumed.
    with run_folder.owned(out):
        assert ended("--out", out, "--resume") == 2
    refusal = f"process {os.getpid()} on .* is using this run folder"
    assert re.search(refusal, capsys.readouterr().err)


@pytest.mark.full
def test_a_representation_needs_six_fields_only(tmp_path, monkeypatch, capsys):
    ours = representations.named("gaussians")
    spec = specs.override(
        ours.presets["splats-static-small"],
        ("strategy=none", "sh_degree=0", "init.extra_random=0"),
    )
    other = representation.Representation(
        "other",
        ours.spec_type,
        {"other-small": spec},
        ours.with_steps,
        ours.metadata_of,
        ours.build,
    )
    monkeypatch.setattr(representations, "installed", lambda: {"other": other})
    monkeypatch.setattr(quality, "CACHE", tmp_path / "cache")
    nerfies_format.write(scenes.tiny_capture(), tmp_path / "input")
    words = (tmp_path / "input", "--preset", "other-small", "--steps", 2)
    assert ended(*words, "--out", tmp_path / "run", "--json") == 0
    assert json.loads(capsys.readouterr().out)["metrics"]["train.steps"] == 2
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert names >= {"metrics.json", "scene.mp4", "report.html"}
    assert not names & {"model.npz", "gaussians.ply", "player.html"}


@pytest.mark.slow
def test_runs_are_drawn_beside_each_other(run, tmp_path, monkeypatch, capsys):
    """A run beside a copy of itself: the truth, twice the same image and error."""
    shutil.copytree(run, tmp_path / "again")
    laid, sheet = {}, panels.contact_sheet

    def caught(panels, captions, columns):
        laid.update(panels=panels, captions=captions, columns=columns)
        return sheet(panels, captions, columns)

    monkeypatch.setattr(panels, "contact_sheet", caught)
    out = tmp_path / "beside"
    folders = [str(run), str(tmp_path / "again")]
    compare.main([*folders, "--frames", "1", "--out", str(out)])
    printed = capsys.readouterr().out
    assert str(out) in printed
    truth, one, other, _, error, same = laid["panels"]
    assert laid["columns"] == 3
    capture = scenes.tiny_capture()
    np.testing.assert_array_equal(truth, capture.images[capture.heldout[0]])
    np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(error, same)
    assert np.abs(one.astype(float) - truth).mean() < 60  # it is of this scene
    psnr = json.loads((run / "metrics.json").read_text())["heldout.psnr"]
    assert f": {psnr:.2f} dB" in laid["captions"][1]
    for name in ("frames.png", "curves.png", "compare.json"):
        assert (out / name).stat().st_size > 300, name


@pytest.mark.slow
def test_a_run_leaves_its_metrics_depth_and_report(run):
    metrics = json.loads((run / "metrics.json").read_text())
    wanted = "heldout.ssim train.seconds train.compile_seconds memory.peak_bytes"
    wanted += " gaussians parameters"
    assert all(np.isfinite(metrics[key]) for key in wanted.split())
    assert (metrics["train.steps"], metrics["heldout.frames"]) == (12, 1)
    assert metrics["file.bytes"] == (run / "model.npz").stat().st_size
    speed = metrics["render.fps"] * metrics["render.ms_per_frame"]
    np.testing.assert_allclose(speed, 1000)
    capture = scenes.tiny_capture()
    (depth,) = (run / "depth").glob("*.exr")
    image = exr.read_exr(depth)
    seen = image.alpha > 0.05  # twelve steps leave it thin
    assert seen.mean() > 0.5
    inside = (image.depth > 0.3 * capture.near) & (image.depth < 3 * capture.far)
    assert inside[seen].mean() > 0.95
    page = (run / "report.html").read_text()
    for words in ("data:image/png;base64", "data:video/mp4;base64"):
        assert words in page
    assert "a training step" not in page  # measured on request only
    assert "http://" not in page.replace("http://www.w3.org", "")


@pytest.mark.slow
def test_a_run_is_rendered_at_other_times_and_places(run, tmp_path):
    path = tmp_path / "path.json"
    words = ["path", "--path", "orbit", "--frames", "3", "--out", str(path)]
    export.main([str(run), *words])
    table = json.loads(path.read_text())
    table |= {"render_width": 64, "render_height": 32}  # not the size of the capture
    path.write_text(json.dumps(table))
    arguments = [str(run), "--path", str(path), "--freeze", "0.5"]
    formats = ["--formats", "png", "mp4", "exr", "--max-side", "32"]
    out = tmp_path / "images"
    out.mkdir()
    mine = out / "0000.png"
    mine.write_text("not a render's")
    with pytest.raises(SystemExit, match="2"):
        render.main([*arguments, *formats, "--out", str(out)])
    assert mine.read_text() == "not a render's"
    render.main([*arguments, *formats, "--out", str(out), "--overwrite"])
    assert sorted(path.name for path in out.glob("*.png")) == [
        f"{number:04d}.png" for number in range(3)
    ]
    image, _ = images.read_image(out / "0000.png")
    assert image.shape == (16, 32, 3)
    assert len(list(video.read_video(out / "video.mp4"))) == 3
    assert exr.read_exr(out / "0001.exr").depth.shape == (16, 32)


@pytest.mark.slow
def test_the_canonical_scene_and_its_depth_are_rendered(run, tmp_path):
    arguments = [str(run), "--without", "motion", "--formats", "png"]
    folder = run / "renders" / "heldout-without-motion-depth-png"
    render.main([*arguments, "--show", "depth"])
    (image,) = folder.glob("*.png")
    image, _ = images.read_image(image)
    near, far = (255 * np.array(colormaps["viridis"](end)[:3]) for end in (1.0, 0.0))
    known = image[(image != 128).any(axis=-1)].astype(float)
    assert np.abs(known - near).max(axis=1).min() < 20
    assert np.abs(known - far).max(axis=1).min() < 20


@pytest.mark.slow
def test_the_flow_from_image_to_image_is_drawn(run, tmp_path):
    arguments = ["--path", "sway", "--frames", "2", "--formats", "png"]
    render.main([str(run), *arguments, "--show", "flow", "--out", str(tmp_path)])
    first, last = (images.read_image(tmp_path / f"000{n}.png")[0] for n in range(2))
    still, unknown = (np.all(last == level, axis=-1) for level in (255, 128))
    assert still.any()
    assert (still | unknown).all()  # nothing follows the last
    assert (np.ptp(first, axis=-1) > 50).any()  # the camera moves: a full hue


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--without", "warp"], "effects that can be: motion"),
        (["--appearance", "0", "1"], "no appearance codes"),
        (["--knots", "1"], "reads 2 knots at once"),
        (["--still-below", "1e9"], "nothing in this run moves"),
        (["--knots", "8", "--without", "motion"], "nothing in this run moves"),
    ],
)
def test_a_render_that_a_run_cannot_give_is_refused(run, capsys, arguments, words):
    with pytest.raises(SystemExit) as stop:
        render.main([str(run), *arguments])
    assert stop.value.code == 2
    line = capsys.readouterr().err
    assert words in line
    assert line.count("\n") == 1


@pytest.mark.slow
def test_a_motion_is_rendered_from_knots(run, capsys):
    for arguments in ([], ["--knots", "6", "--interpolation", "cubic"]):
        render.main([str(run), "--formats", "png", *arguments])
    assert "6 knots, cubic" in capsys.readouterr().out
    rendered, exact = (
        [images.read_image(path)[0].astype(int) for path in sorted(where.glob("*.png"))]
        for where in (
            run / "renders" / "heldout-knots-6-cubic-png",
            run / "renders/heldout-png",
        )
    )
    assert np.abs(np.subtract(rendered, exact)).max() <= 2
    capture = scenes.tiny_capture()
    names = {pathlib.Path(capture.ids[row]).name for row in capture.heldout}
    assert {path.stem for path in (run / "renders/heldout-png").glob("*.png")} == names


def last_bits(folder):
    """Checksums of every array of the last checkpoint, by name."""
    path = folder / CHECKPOINTS / "12" / "about.json"
    return {
        name: note["crc32"]
        for name, note in json.loads(path.read_text())["leaves"].items()
    }


@pytest.mark.slow
@pytest.mark.parametrize("left", ["no state", "all steps"])
def test_a_killed_run_resumes_to_the_same_bits(left, run, tmp_path, capsys):
    """In the middle of writing its first checkpoint, and after the last."""
    folder = tmp_path / "killed"
    shutil.copytree(run, folder)
    saved = folder / CHECKPOINTS
    for name in ("metrics.json", "report.html", "model.npz"):
        (folder / name).unlink()
    if left == "no state":
        shutil.rmtree(saved / "12")
        (saved / "0").rename(saved / "0.unfinished")
    assert ended("--out", folder, "--resume") == 0
    assert last_bits(folder) == last_bits(run)
    assert not list(saved.glob("*.unfinished"))
    whole, resumed = (
        json.loads((path / "metrics.json").read_text()) for path in (run, folder)
    )
    for key in ("train.steps", "heldout.psnr", "gaussians"):
        assert resumed[key] == whole[key]
    assert (folder / "model.npz").is_file()


@pytest.mark.slow
def test_a_run_that_cannot_be_drawn_or_kept_says_so_and_ends(
    run, tmp_path, capsys, monkeypatch
):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    shutil.rmtree(folder / CHECKPOINTS / "12")
    before = {name: (folder / name).read_bytes() for name in PRODUCTS}
    with monkeypatch.context() as patch:
        patch.setattr(products, "save_video", full)
        assert ended("--out", folder, "--resume") == 1
    words = f"could not be written: {folder}: cannot be written (No space left"
    assert words in capsys.readouterr().err
    # The products of before stay together, though the player was there already.
    assert {name: (folder / name).read_bytes() for name in PRODUCTS} == before
    assert not list(folder.glob(".*.partial"))
    # Of a run without products, all but the one that cannot be written are there.
    shutil.rmtree(folder / CHECKPOINTS / "12")
    for name in set(PRODUCTS) - {"config.json", "capture.npz"}:
        (folder / name).unlink()
    with monkeypatch.context() as patch:
        patch.setattr(products, "save_video", full)
        assert ended("--out", folder, "--resume") == 1
    assert "could not be written: [Errno 28] No space left" in capsys.readouterr().err
    assert {n for n in PRODUCTS if not (folder / n).exists()} == {"scene.mp4"}
    shutil.rmtree(folder / CHECKPOINTS / "12")
    trained = train.train

    def losing(*arguments):
        shutil.rmtree(folder)
        return trained(*arguments)

    monkeypatch.setattr(train, "train", losing)
    assert ended("--out", folder, "--resume") == 1
    output = capsys.readouterr()
    assert (
        f"error: the last state is not saved: cannot write checkpoints to {folder}"
        in (output.err)
    )
    assert "saved in" not in output.err
