"""The report stands alone, says everything once, and runs nothing."""

import base64
import html.parser

import numpy as np
import pytest

from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.evaluation import pictures
from nerfies_jax.measure.clock import Metric
from nerfies_jax.runs import report

METRICS = (
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
def picture(tmp_path, rng):
    path = tmp_path / "heldout.png"
    pictures.save(rng.integers(0, 256, (8, 9, 3), dtype=np.uint8), path)
    return path


def test_the_page_holds_everything_and_fetches_nothing(tmp_path, picture):
    film = tmp_path / "orbit.mp4"
    film.write_bytes(b"not really a film")
    path = report.write(
        tmp_path,
        "a run",
        METRICS,
        {"seed": 3, "spec": {"motion": {"width": 128}, "extras": {}}},
        [report.Figure(picture, "held-out frames", "player.html")],
        film,
        {"field": 30.0, "rasterizer": 10.0},
        ["LPIPS is not computed, because there are no weights"],
        [report.Command("Go on", "nerfies render run")],
    )
    page = Page(path)
    (shown,) = page.find("img")
    assert shown["alt"] == "held-out frames"
    assert (shown["width"], shown["height"]) == ("9", "8")
    assert base64.b64decode(shown["src"].split(",")[1]) == picture.read_bytes()
    (played,) = page.find("video")
    assert base64.b64decode(played["src"].split(",")[1]) == film.read_bytes()
    for words in (
        "30.94 dB",
        "1.5 GiB",
        "not a number",
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


def test_what_was_written_by_others_cannot_become_markup(tmp_path, picture):
    evil = '"><script>alert(1)</script>&'
    path = report.write(
        tmp_path,
        evil,
        [Metric(evil, 1.0, evil, "equal", 0.0)],
        {evil: evil},
        [report.Figure(picture, evil)],
        notes=[evil],
        step_ms={evil: 1.0},
        commands=[report.Command(evil, evil)],
    )
    page = Page(path)
    assert not page.find("script")
    assert page.text.count("<script>alert(1)</script>&") == 11


def test_a_long_film_stays_beside_the_page(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "EMBEDDED_FILM_BYTES", 3)
    film = tmp_path / "renders" / "orbit.mp4"
    film.parent.mkdir()
    film.write_bytes(b"long")
    (played,) = Page(report.write(tmp_path, "a run", METRICS, {}, film=film)).find(
        "video"
    )
    assert played["src"] == "renders/orbit.mp4"


def test_an_empty_run_still_makes_a_page(tmp_path):
    page = Page(report.write(tmp_path, "nothing", [], {}))
    assert page.text.split() == ["nothing", *report.STYLE.split(), "nothing"]


def test_a_missing_picture_is_named_and_nothing_is_left(tmp_path):
    figure = report.Figure(tmp_path / "gone.png", "gone")
    with pytest.raises(CaptureError, match=r"gone\.png"):
        report.write(tmp_path, "a run", METRICS, {}, [figure])
    with pytest.raises(ValueError, match=r"a\.exr: a report shows PNG and JPEG"):
        report.write(
            tmp_path, "run", METRICS, {}, [figure._replace(path=tmp_path / "a.exr")]
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
        (float("inf"), "s", "not a number"),
    ],
)
def test_values_read_as_a_person_writes_them(value, unit, words):
    assert report.readable(value, unit) == words
