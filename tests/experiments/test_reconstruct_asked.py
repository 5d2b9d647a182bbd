"""What the main job is asked: wrong input, other settings, commands to paste."""

import json
import re
import shlex

import numpy as np
import pytest

from experiments import cli, reconstruct
from nerfies_jax import runs
from nerfies_jax.capture import nerfies_format
from nerfies_jax.runs import (
    commands,
    platform,
    reconstruction,
    representations,
)
from nerfies_jax.runs.config import CaptureSource, RunConfig
from tests import scenes
from tests.metrics.test_perceptual import state_dict
from tests.preprocessing import two_planes


@pytest.fixture
def captured(tmp_path):
    """A Nerfies directory that a test may damage."""
    nerfies_format.write(scenes.tiny_capture(), tmp_path / "capture")
    return tmp_path / "capture"


def refused(capsys, *arguments):
    """The one line that the main job prints when it refuses; checks the exit code."""
    with pytest.raises(SystemExit) as stop:
        reconstruct.main([str(argument) for argument in arguments])
    assert stop.value.code == 2
    # On a slow machine lines on progress come before it.
    lines = capsys.readouterr().err.splitlines(keepends=True)
    *progress, line = lines
    assert all(" ..." in each or " elapsed" in each for each in progress), lines
    assert line.startswith("error: ")
    return line


def test_a_broken_capture_is_refused_by_name(captured, tmp_path, capsys):
    camera = min((captured / "camera").iterdir())
    camera.write_text(camera.read_text().replace("focal_length", "focal_lenght"))
    line = refused(capsys, captured, "--out", tmp_path / "run")
    assert str(camera) in line
    assert not (tmp_path / "run").exists()


def test_frames_without_their_image_are_left_out_where_asked(
    captured, tmp_path, capsys
):
    lost = min((captured / "rgb/1x").iterdir())
    lost.unlink()
    assert "--missing skip" in refused(capsys, captured, "--out", tmp_path / "run")
    source = CaptureSource(captured, missing="skip")
    assert lost.stem not in runs.stored_capture(source).ids
    assert source.arguments == (str(captured), "--missing", "skip")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--set", "init.points=0"), "at least one initial Gaussian"),
        (("--set", "raster.capacity=1000000000000"), "GiB are free"),
        (("--preset", "splats-magic"), "splats-deformable-small"),
        (("--steps", "0"), "must be at least 1"),
        (("--heldout", "1"), "held"),
        (("--prepare.frames", "9"), "has cameras"),
        (("--checkpoint-every", "-1"), "--checkpoint-every -1"),
        (("--lpips-weights", "a.npz"), "a.npz: No such file"),
        (("--lpips-weights", "a.npz", "--lpips-network", "vgg"), "a.npz: No such file"),
    ],
)
def test_wrong_settings_are_refused(arguments, words, captured, capsys, tmp_path):
    assert words in refused(capsys, captured, "--out", tmp_path / "run", *arguments)
    assert not (tmp_path / "run").exists()


def test_images_that_are_too_small_for_lpips_are_refused(
    captured, capsys, tmp_path, rng
):
    weights = tmp_path / "alex.npz"
    np.savez(weights, **state_dict("alex", rng))
    options = "--out", tmp_path / "run", "--lpips-weights", weights
    assert "31 pixels on the shorter side" in refused(capsys, captured, *options)
    assert not (tmp_path / "run").exists()


def test_a_run_folder_that_cannot_be_written_is_refused(captured, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert "--out" in refused(capsys, captured, "--out", tmp_path / "file" / "run")


def started(folder, config):
    """A run folder with its settings and nothing else."""
    kind = representations.of_preset(config.preset)
    spec = runs.scene_spec(config)
    runs.save_config(folder, runs.Run(config, None, None, kind, spec, None, None))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["elsewhere"], "capture: saved"),
        (["--factor", "2"], "factor: saved 4, now 2"),
        (["--max-side", "9"], "max-side: saved None, now 9"),
        (["--heldout", "5"], "heldout: saved 8, now 5"),
        (["--scene", "wheel"], "scene: saved default, now wheel"),
        (["--preset", "nerf"], "preset: saved splats-static, now nerf"),
        (["--seed", "0"], "seed: saved 3, now 0"),
        (["--missing", "skip"], "missing: saved refuse, now skip"),
        (["--steps", "70"], "spec.steps: saved 60, now 70"),
        (["--set", "sh_degree=2"], "spec.sh_degree: saved 1, now 2"),
        (["--effects", "auto"], "--effects auto"),
        (["--prepare.frames", "9"], "--prepare"),
    ],
)
def test_a_run_is_not_continued_as_another_one(arguments, words, tmp_path, capsys):
    source = CaptureSource(tmp_path / "capture", factor=4, heldout="8")
    config = RunConfig("splats-static", source, 60, ("sh_degree=1",), seed=3)
    started(tmp_path, config)
    line = refused(capsys, *arguments, "--resume", "--out", tmp_path)
    assert words in line


def test_a_run_is_found_by_its_capture(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    clip = tmp_path / "clip.mp4"
    record = {"source": str(clip.resolve())}
    for name in ("clip-capture", "other"):  # the second is of something else
        (tmp_path / name).mkdir()
        (tmp_path / name / "prepared.json").write_text(json.dumps(record))
        record = {"source": "elsewhere"}
        (tmp_path / "runs" / name).mkdir(parents=True)
        config = RunConfig("splats-static", CaptureSource(tmp_path / name), 60)
        started(tmp_path / "runs" / name, config)
    # Found by the clip, and taken for that run's: what differs is the seed alone.
    line = refused(capsys, clip, "--resume", "--seed", 7)
    assert "runs/clip-capture: the run was started" in line
    assert "seed: saved 0, now 7;" in line
    assert "capture" not in line.partition("settings: ")[2]
    assert "runs contains no run of it" in refused(capsys, tmp_path / "new", "--resume")


@pytest.mark.parametrize(
    "source",
    [
        CaptureSource(scene="wheel"),
        CaptureSource("a $(b) 'c'", factor=4, max_side=90, heldout="8"),
    ],
)
def test_a_command_that_is_printed_keeps_all_options(source):
    overrides = ("sh_degree=1", "strategy=none")
    config = RunConfig("splats-static", source, 60, overrides, seed=3)
    words = shlex.split(commands.reconstruct(config))
    assert words[:2] == ["nerfies", "reconstruct"]
    args = cli.parse(reconstruct.Reconstruct, words[2:])
    assert cli.plain(args.source) == source
    settings = (args.preset, args.steps, args.set, args.seed)
    assert settings == (config.preset, config.steps, config.overrides, config.seed)


def test_help_names_the_presets(capsys):
    with pytest.raises(SystemExit) as stop:
        reconstruct.main(["--help"])
    assert stop.value.code == 0
    page = re.sub(r"[\s│]", "", capsys.readouterr().out)  # as if it were one line
    for kind in representations.installed().values():
        for preset in kind.presets:
            assert preset.removesuffix("-small") in page


@pytest.mark.full
def test_effects_auto_takes_the_advice_and_the_users_word_comes_last(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(platform, "start_jax", lambda *_, **__: None)
    nerfies_format.write(two_planes.make(), tmp_path / "capture")
    call = {}

    def caught(config, stored):
        call["config"] = config
        raise ValueError("caught")

    monkeypatch.setattr(reconstruction, "new_run", caught)
    with pytest.raises(SystemExit):
        reconstruct.main(
            [
                *(str(tmp_path / "capture"), "--preset", "splats-deformable-small"),
                *("--effects", "auto", "--set", "sh_degree=0"),
            ]
        )
    assert call["config"].preset == "splats-static-small"
    assert call["config"].overrides[-1] == "sh_degree=0"
    assert "effects: --preset splats-static-small" in capsys.readouterr().out
