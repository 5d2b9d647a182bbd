"""The report stands alone, says everything once, and runs nothing."""

import ast
import base64
import html.parser
import io
import pathlib
import re

import numpy as np
import PIL.Image
import pytest

from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.images import write_png
from nerfies_jax.evaluation import heldout
from nerfies_jax.metrics.clock import Metric
from nerfies_jax.metrics.metric_table import GROUPS, METRICS, metric
from nerfies_jax.runs import commands, relative_paths, report
from nerfies_jax.runs.config import CaptureSource, RunConfig

MEASURED = (
    Metric("heldout.psnr", 30.937, "dB", "higher", 0.2),
    Metric("memory.peak_bytes", 1.5 * 2**30, "bytes", "lower", 1e8),
    Metric("heldout.ssim", float("nan"), "", "higher", 0.005),
)


class Page(html.parser.HTMLParser):
    """Tags with attributes, text, and whether every tag that opened also closed."""

    VOID = frozenset({"meta", "img", "br"})

    def __init__(self, path):
        super().__init__()
        self.tags, self.open, self.words = [], [], []
        self.feed(path.read_text(encoding="utf-8"))
        self.text = " ".join(self.words)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    def find(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]


@pytest.fixture
def image(tmp_path, rng):
    path = tmp_path / "heldout.png"
    write_png(path, rng.integers(0, 256, (8, 9, 3), dtype=np.uint8))
    return path


def test_the_page_holds_everything_and_fetches_nothing(tmp_path, image):
    file = tmp_path / "orbit.mp4"
    file.write_bytes(b"not really a video")
    video = report.Video(file, "The scene.", np.zeros((6, 8, 3), np.uint8))
    path = report.write(
        tmp_path,
        "a run",
        MEASURED,
        {"seed": 3, "spec": {"motion": {"width": 128}, "extras": {}}},
        [report.Figure(image, "held-out frames", "player.html")],
        video,
        {"field": 30.0, "rasterizer": 10.0},
        ["LPIPS is not computed, because there are no weights"],
        [report.Command("Go on", "nerfies render run")],
    )
    page = Page(path)
    shown, still = page.find("img")
    assert shown["alt"] == "held-out frames"
    assert (shown["width"], shown["height"]) == ("9", "8")
    assert base64.b64decode(shown["src"].split(",")[1]) == image.read_bytes()
    (played,) = page.find("video")
    assert base64.b64decode(played["src"].split(",")[1]) == file.read_bytes()
    # A printed page shows the poster in its place, and the name of the file.
    assert still["src"] == played["poster"]
    assert still["class"] == "print"
    with PIL.Image.open(
        io.BytesIO(base64.b64decode(still["src"].split(",")[1]))
    ) as one:
        assert (one.format, one.size) == ("JPEG", (8, 6))
    # Metrics go by names, with a sentence each; the key is in a tooltip.
    assert {"title": "heldout.psnr", "scope": "row"} in page.find("th")
    assert "heldout.psnr" not in page.text
    for words in (
        "30.94 dB",
        "PSNR",
        "Mean peak signal-to-noise ratio",
        "Quality",
        "orbit.mp4",
        "1.5 GiB",
        "not available",
        "spec.motion.width",
        "75 %",
        "40 ms",
        "LPIPS is not computed",
        "nerfies render run",
    ):
        assert words in page.text, words
    assert not page.find("script")
    assert not page.find("link")
    assert page.find("a") == 2 * [{"href": "player.html"}]
    assert all(a["src"].startswith("data:") for _, a in page.tags if "src" in a)
    assert "url(" not in path.read_text()
    assert "@import" not in path.read_text()


def test_the_first_number_of_a_model_with_codes_is_of_fitted_ones(tmp_path):
    fitted = metric("heldout.fitted_psnr", 17.72)
    page = Page(report.write(tmp_path, "a run", [*MEASURED, fitted], {}))
    first, unfitted = page.text.index("17.72 dB"), page.text.index("30.94 dB")
    assert first < unfitted
    assert "PSNR, NeRF-W protocol" in page.text[:unfitted]
    assert "PSNR, without fitting" in page.text[first:unfitted]


def test_what_was_written_by_others_cannot_become_markup(tmp_path, image):
    evil = '"><script>alert(1)</script>&'
    path = report.write(
        tmp_path,
        evil,
        [Metric(evil, 1.0, evil, "equal", 0.0)],
        {evil: evil},
        [report.Figure(image, evil)],
        notes=[evil],
        step_ms={evil: 1.0},
        commands=[report.Command(evil, evil)],
    )
    page = Page(path)
    assert not page.find("script")
    assert page.text.count("<script>alert(1)</script>&") == 11


def test_a_long_video_stays_beside_the_page(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "EMBEDDED_VIDEO_BYTES", 3)
    file = tmp_path / "renders" / "orbit.mp4"
    file.parent.mkdir()
    file.write_bytes(b"long")
    video = report.Video(file, "The scene.", np.zeros((6, 8, 3), np.uint8))
    page = Page(report.write(tmp_path, "a run", MEASURED, {}, video=video))
    (played,) = page.find("video")
    assert played["src"] == "renders/orbit.mp4"


def test_an_empty_run_still_makes_a_page(tmp_path):
    page = Page(report.write(tmp_path, "nothing", [], {}))
    assert page.text.split() == ["nothing", *report.STYLE.split(), "nothing"]


def test_a_missing_image_is_named_and_nothing_is_left(tmp_path):
    figure = report.Figure(tmp_path / "gone.png", "gone")
    with pytest.raises(CaptureError, match=r"gone\.png"):
        report.write(tmp_path, "a run", MEASURED, {}, [figure])
    with pytest.raises(
        ValueError, match=r"a\.exr: images of a report must be PNG or JPEG"
    ):
        report.write(
            tmp_path, "run", MEASURED, {}, [figure._replace(path=tmp_path / "a.exr")]
        )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("value", "unit", "words"),
    [
        (30.937, "dB", "30.94 dB"),
        (0.91234, "", "0.9123"),
        (48211, "", "48,211"),
        (123456.7, "s", "123,457 s"),
        (0.0, "ms", "0 ms"),
        (-0.00012345, "", "-1.234e-04"),
        (0.0012345, "s", "0.001234 s"),
        (999, "bytes", "999 bytes"),
        (2**20, "bytes", "1 MiB"),
        (float("inf"), "s", "not available"),
    ],
)
def test_values_read_as_a_person_writes_them(value, unit, words):
    assert report.readable(value, unit) == words


@pytest.mark.parametrize("inside", [True, False])
def test_no_path_of_the_machine_is_on_the_page(
    inside, tmp_path, image, monkeypatch, rng
):
    """Settings, commands and notes name files by paths that can be followed."""
    folder = tmp_path / "runs" / "first run"
    folder.mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path if inside else tmp_path / "elsewhere")
    capture = tmp_path / "captures" / "a clip"
    config = {"config": {"source": {"capture": str(capture)}, "files": [str(capture)]}}
    config["made by"] = {"python": "3.12"}
    base = relative_paths.base_of(folder)
    lines = [commands.render(folder, (), base), commands.resume(folder, (), base)]
    source = CaptureSource(capture=capture)
    lines.append(commands.reconstruct(RunConfig("nerf", source), base))
    path = report.write(
        folder,
        "a run",
        MEASURED,
        config,
        [report.Figure(image, f"From {image}.")],
        notes=[f"saved in {folder}/checkpoints", "OSError: '/usr/lib/libx.so'; 3 dB/s"],
        commands=[report.Command("Go on:", line) for line in lines],
    )
    text = Page(path).text
    assert str(tmp_path) not in path.read_text()
    assert not re.search(r"(?<![\w.])/(usr|tmp|home|root)/", text)
    way = "" if inside else "../../"
    run = "'runs/first run'" if inside else "."
    for words in (
        f"nerfies render {run} --path orbit",
        f"--out {run} --resume",
        f"reconstruct '{way}captures/a clip' --preset nerf",
        f"{way}captures/a clip",
        "From heldout.png." if not inside else "From ./heldout.png.",
        f"Saved in {'runs/first run' if inside else '.'}/checkpoints",
        "OSError: 'libx.so'; 3 dB/s",
    ):
        assert words in text, words
    words = "the folder that contains" if inside else "the folder of this page"
    assert f"Paths on this page are relative to {words}" in text


ROOT = pathlib.Path(report.__file__).parents[2]


def emitted():
    """Every key that a run can write into metrics.json, from the code that does."""
    keys = set()
    files = [*ROOT.glob("nerfies_jax/**/*.py"), *ROOT.glob("gaussians_jax/**/*.py")]
    for path in files:
        if path.name == "metric_table.py":
            continue
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            called = isinstance(node, ast.Call) and node.args
            name = getattr(node.func, "id", "") if called else ""
            if name in ("metric", "Metric") and isinstance(node.args[0], ast.Constant):
                keys.add(node.args[0].value)
            counts = getattr(node, "name", "") in ("count_rows", "count_parameters")
            for part in ast.walk(node) if counts else ():
                if isinstance(part, ast.Dict):
                    keys |= {key.value for key in part.keys}
                if isinstance(part, ast.Subscript):
                    named = getattr(part.value, "id", "") == "counts"
                    keys |= {part.slice.value} if named else set()
    return keys | {*heldout.TOLERANCES}


def test_every_metric_has_a_name_and_a_sentence():
    keys = emitted()
    assert {"heldout.psnr", "rows", "parameters", "file.bytes", "tracks.epe"} <= keys
    assert keys == METRICS.keys()
    page = (ROOT / "docs/formats.md").read_text()
    for key, entry in METRICS.items():
        assert entry.group in GROUPS, key
        assert re.fullmatch(r"[A-Z0-9].+\.", entry.explanation), key
        assert entry.name not in METRICS, key
        assert f"`{key}`" in page, key
    assert len({entry.name for entry in METRICS.values()}) == len(METRICS)
    assert metric("train.steps", 7).direction == "equal"
    with pytest.raises(ValueError, match=r"tracks\.size: not in metric_table"):
        metric("tracks.size", 1)


@pytest.mark.parametrize(
    ("note", "expected"),
    [
        ("completed 20 steps", "Completed 20 steps"),
        ("gaussians.ply holds the Gaussians", "gaussians.ply holds the Gaussians"),
        ("./checkpoints: full", "./checkpoints: full"),
    ],
)
def test_a_note_begins_in_upper_case_unless_with_a_name(note, expected, tmp_path):
    path = report.write(tmp_path, "title", (), {}, notes=(note,))
    assert expected in Page(path).words
