"""The report in a browser: on a phone, in the dark, and on paper."""

import numpy as np
import pytest

from nerfies_jax.capture.images import write_png
from nerfies_jax.metrics.metric_table import METRICS, metric
from nerfies_jax.runs import report
from tests.gaussians import browser as shared

pytestmark = pytest.mark.slow

WORDS = "a sentence that is long enough to be broken into lines on any screen " * 2
SHOWN = """selector => {
    const element = document.querySelector(selector);
    return element.checkVisibility({contentVisibilityAuto: true})
        && element.getBoundingClientRect().height > 0;
}"""


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """The page of a run with every metric, a broad image and a video."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "scene.mp4").write_bytes(b"not really a video")
    broad = np.zeros((90, report.WIDE_PX + 1, 3), np.uint8)
    for name, image in (("broad", broad), ("small", broad[:, :100])):
        write_png(folder / f"{name}.png", image)
    path = report.write(
        folder,
        "a run with a name that is longer than a phone is wide",
        [metric(key, 0.123456) for key in METRICS],
        {"spec": {"a_setting": "long/" * 40}},
        [
            report.Figure(folder / "small.png", WORDS, "player.html"),
            report.Figure(folder / "broad.png", WORDS),
        ],
        report.Video(folder / "scene.mp4", WORDS, broad[:60, :80]),
        {"project and blend": 30.0, "rest": 10.0},
        [WORDS],
        [report.Command("Go on:", f"nerfies render {'x' * 90}")],
    )
    return path.as_uri()


@pytest.fixture(scope="module")
def browser():
    yield from shared.launched()


def test_the_page_fits_a_phone(browser, address):
    """Sideways only what scrolls by itself does."""
    page = browser.new_page(viewport={"width": 390, "height": 844})
    page.goto(address)
    for shown in (False, True):
        if shown:
            page.click("summary")
        assert page.evaluate(SHOWN, "details table") == shown
        assert page.evaluate("document.documentElement.scrollWidth") == 390
    assert page.evaluate("document.querySelector('.wide').scrollWidth") > 390
    page.close()


def test_the_printed_page_is_light_and_complete(browser, address):
    """Opened, with a still for the video, whatever the screen looks like."""
    page = browser.new_page(color_scheme="dark")
    page.goto(address)
    ground = "getComputedStyle(document.body).backgroundColor"
    still = "img.print", "span.print"
    assert page.evaluate(ground) != "rgb(255, 255, 255)"
    assert page.evaluate(SHOWN, "video")
    assert not any(page.evaluate(SHOWN, one) for one in still)
    page.emulate_media(media="print")
    assert page.evaluate(ground) == "rgb(255, 255, 255)"
    assert not page.evaluate(SHOWN, "video")
    assert all(page.evaluate(SHOWN, one) for one in (*still, "details table", "pre"))
    words = page.inner_text("figure:has(video) figcaption")
    assert words.endswith("This is its first frame; the video is scene.mp4.")
    # Nothing is cut off at the right: paper does not scroll.
    cut = "[...document.querySelectorAll('pre, .wide')].filter(each => "
    cut += "each.scrollWidth > each.clientWidth + 1).length"
    assert page.evaluate(cut) == 0
    page.close()
