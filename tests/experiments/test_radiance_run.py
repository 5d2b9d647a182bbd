"""A radiance field through the command line: from a capture to its renders."""

import json

import numpy as np
import pytest

from experiments import reconstruct, render
from nerfies_jax.capture import exr, images, nerfies_format, video
from nerfies_jax.runs import budget
from tests import scenes

TINY = (
    "elastic=none",
    "background=none",
    "rays=32",
    "sampling.coarse=4",
    "sampling.fine=4",
    "template.skips=",
    "template.depth=1",
    "template.width=8",
    "template.color_width=8",
    "warp.skips=",
    "warp.depth=1",
    "warp.width=8",
)
pytestmark = pytest.mark.slow


def main(job, *arguments):
    """Run a job of the command line; its exit code."""
    try:
        job.main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return stop.code
    return 0


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("radiance")
    nerfies_format.write(scenes.tiny_capture(), folder / "capture")
    return folder / "capture"


@pytest.fixture(scope="module")
def run(captured):
    """A short run of a field with appearance codes and a warp."""
    out = captured.parent / "run"
    common = ("--preset", "nerfies", "--steps", "12", "--step-profile", "--out", out)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(budget, "MAX_VIDEO_FRAMES", budget.MIN_VIDEO_FRAMES)
        assert main(reconstruct, captured, *common, "--set", *TINY) == 0
    return out


def read_images(folder):
    return [images.read_image(path)[0] for path in sorted(folder.glob("*.png"))]


def test_a_field_leaves_the_files_and_metrics_of_a_run_and_no_gaussians(run):
    left = {path.name for path in run.iterdir()}
    assert {"report.html", "scene.mp4", "comparison.png", "curve.json"} <= left
    assert not {"gaussians.ply", "model.npz"} & left
    assert json.loads((run / "config.json").read_text())["representation"] == "radiance"
    metrics = json.loads((run / "metrics.json").read_text())
    assert "gaussians" not in metrics
    wanted = ["heldout.psnr", "heldout.ssim", "heldout.fitted_psnr", "parameters"]
    wanted += ["heldout.fitted_ssim", "train.seconds", "render.ms_per_frame"]
    assert all(np.isfinite(metrics[key]) for key in wanted)
    assert metrics["train.steps"] == 12
    # The curve follows the same protocol, with the scores without fitting next to it.
    *_, last = json.loads((run / "curve.json").read_text())["evaluations"]
    assert {"psnr", "ssim", "unfitted_psnr", "unfitted_ssim"} <= set(last)
    assert last["psnr"] != last["unfitted_psnr"]
    page = (run / "report.html").read_text()
    assert "codes fitted to the left halves" in page
    assert "backward" in page
    capture = scenes.tiny_capture()
    image = exr.read_exr(next((run / "depth").glob("*.exr")))
    seen = image.alpha > 0.1  # twelve steps leave it thin
    assert seen.mean() > 0.5
    inside = (image.depth > 0.9 * capture.near) & (image.depth < 1.1 * capture.far)
    assert inside[seen].all()


def test_the_canonical_view_is_rendered(run, tmp_path):
    path = ("--path", "sway", "--frames", "2", "--max-side", "20")
    for name, more in (("all", ()), ("canonical", ("--without", "warp"))):
        assert main(render, run, *path, *more, "--out", tmp_path / name) == 0
        assert len(list(video.read_video(tmp_path / name / "video.mp4"))) == 2
    whole, canonical = (read_images(tmp_path / name) for name in ("all", "canonical"))
    assert canonical[0].shape == (15, 20, 3)
    assert not np.array_equal(whole, canonical)


def test_the_appearance_goes_from_one_frame_to_another(run, tmp_path):
    capture = scenes.tiny_capture()
    names = [capture.ids[row] for row in capture.train[[0, -1]]]
    path = ("--path", "captured", "--frames", "3", "--formats", "exr")
    still = ("--freeze", "0.5", "--max-side", "20")
    for folder, ends in (
        ("there", names),
        ("back", names[::-1]),
        ("at", names[:1] * 2),
    ):
        more = ("--appearance", *ends, "--out", tmp_path / folder)
        assert main(render, run, *path, *still, *more) == 0
    there, back, at = (
        [exr.read_exr(tmp_path / folder / f"{n:04d}.exr").color for n in range(3)]
        for folder in ("there", "back", "at")
    )
    np.testing.assert_array_equal(there[0], at[0])
    np.testing.assert_array_equal(back[2], at[2])
    np.testing.assert_allclose(there[1], back[1], atol=1e-6)
    assert not np.array_equal(there[2], at[2])
