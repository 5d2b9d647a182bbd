"""The page of the player: its speed, motion, worker, resolution and layout."""

import itertools

import numpy as np
import pytest

from tests.gaussians import browser as shared
from tests.gaussians.browser import (
    DESKTOP,
    PHONE,
    check_image,
    drag,
    image_of,
    settle,
)

pytestmark = pytest.mark.slow


def test_the_background_is_what_was_chosen(opened):
    page = opened()
    page.locator("#background").evaluate(
        "(input) => { input.value = '#2040a0'; "
        "input.dispatchEvent(new Event('input', { bubbles: true })); }"
    )
    settle(page)
    corner = image_of(page)[2, 2] * 255
    np.testing.assert_allclose(corner, [0x20, 0x40, 0xA0], atol=1)


# Plays for ten frames and says how far the time went in how many seconds.
PLAYED = """async () => {
  const frame = () => new Promise(requestAnimationFrame);
  document.getElementById("play").click();
  await frame();
  await frame();
  const began = await frame();
  const first = player.time;
  for (let i = 0; i < 9; i++) await frame();
  const ended = await frame();
  document.getElementById("play").click();
  return [player.time - first, (ended - began) / 1000];
}"""


@pytest.mark.parametrize("speed", ["0.25", pytest.param("1", marks=pytest.mark.slow)])
def test_the_speed_is_that_of_the_clock(opened, speed):
    page = opened()
    page.get_by_label("Speed").select_option(speed)
    shown, seconds = page.evaluate(PLAYED)
    expected = float(speed) * seconds / shared.SECONDS
    assert shown == pytest.approx(expected % 1, rel=0.02, abs=1e-4)


def test_a_page_plays_by_itself_and_glides_unless_motion_is_reduced(opened):
    glide = """async () => {
      const views = [];
      window.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" }));
      for (let i = 0; i < 40; i++) {
        await new Promise(requestAnimationFrame);
        views.push(player.view.quaternion.join());
      }
      return new Set(views).size;
    }"""
    page = opened()
    assert page.evaluate(glide) > 5
    page = opened({**DESKTOP, "reduced_motion": "reduce"}, fragment="")
    assert not page.evaluate("player.playing")
    assert page.evaluate(glide) <= 2
    playing = opened(fragment="", wait=False)
    playing.wait_for_function("() => player.playing && player.time > 0")


def test_a_drag_passes_the_limits_a_little_and_returns(opened):
    page = opened()
    limit = shared.header()["limits"]["azimuth"][0]
    box = page.locator("#scene").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 390, middle[1], steps=6)
    settle(page)
    around = "(view) => Math.atan2(view.position[0], view.position[2])"
    held = page.evaluate(f"() => ({around})(player.view)")
    assert limit - 0.12 < held < limit - 0.02
    page.mouse.up()
    settle(page)
    back = page.evaluate(f"() => ({around})(player.view)")
    assert back == pytest.approx(limit, abs=1e-5)


@pytest.mark.parametrize(
    "broken",
    [
        "delete window.Worker",
        pytest.param(
            """window.Worker = class {
          constructor() { setTimeout(() => this.onerror?.()); }
          postMessage() {}
        }""",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["none", "fails"],
)
def test_sorting_is_in_a_worker_and_without_one_on_the_page(opened, broken):
    page = opened()
    assert page.evaluate("player.byWorker")
    alone = opened(script=broken)
    assert not alone.evaluate("player.byWorker")
    np.testing.assert_array_equal(image_of(alone), image_of(page))
    drag(alone, (40, 20))
    check_image(alone)


def test_slow_frames_have_fewer_pixels_and_rest_has_all(opened):
    page = opened()
    assert page.evaluate("player.resolution") == 1
    page.evaluate("""() => {
      window.requestAnimationFrame = (draw) =>
        setTimeout(() => draw(performance.now()), 70);
    }""")
    page.keyboard.press("Space")
    page.wait_for_function("() => player.resolution < 0.7", polling=50)
    page.keyboard.press("Space")
    page.wait_for_function("() => player.ready", polling=50)
    assert page.evaluate("player.resolution") == 1
    check_image(page, page.evaluate("player.time"))


def test_a_lost_drawing_is_told_and_comes_back(opened):
    page = opened()
    image = image_of(page)
    page.evaluate("""() => {
      window.losing = player.painter.gl.getExtension("WEBGL_lose_context");
      losing.loseContext();
    }""")
    page.wait_for_function("() => !document.getElementById('poster').hidden")
    assert "took the drawing away" in page.get_by_role("status").inner_text()
    page.evaluate("() => losing.restoreContext()")
    page.wait_for_function("() => document.getElementById('poster').hidden")
    settle(page)
    np.testing.assert_array_equal(image_of(page), image)
    assert page.get_by_role("status").inner_text() == ""


BOXES = """() => [...document.querySelectorAll(
  "button, select, label.color, #time, summary")].filter((one) => one.checkVisibility())
  .map((one) => {
    const { left, top, right, bottom } = one.getBoundingClientRect();
    return [one.id || one.tagName, left, top, right, bottom];
  })"""


@pytest.mark.parametrize("width", [390, pytest.param(360, marks=pytest.mark.slow)])
def test_everything_is_named_and_fits_on_a_phone(opened, width):
    phone = {**PHONE, "viewport": {"width": width, "height": 844}}
    page = opened(phone, fragment="#t=0.25")
    canvas = page.get_by_role("img", name="Blobs: a moving scene")
    assert canvas.evaluate("(one) => one.id") == "scene"
    slider = page.get_by_role("slider", name="Time")
    assert slider.get_attribute("aria-valuetext") == "0.50 s of 2.00 s"
    assert page.locator("#clock").inner_text() == "0.50 s / 2.00 s"
    boxes = page.evaluate(BOXES)
    assert len(boxes) == 10
    for name, left, top, right, bottom in boxes:
        assert right - left >= 40, name
        assert bottom - top >= 44, name
        assert left >= 0, name
        assert right <= width, name
        assert bottom <= 844, name
    for one, other in itertools.combinations(boxes, 2):
        apart = one[3] <= other[1] or other[3] <= one[1]
        assert apart or one[4] <= other[2] or other[4] <= one[2], (one, other)
    # Two rows of controls and the caption leave the rest to the scene.
    assert canvas.bounding_box()["height"] > 844 - 150
    assert not page.get_by_text("Four blobs.").is_visible()
    page.locator("summary").tap()
    assert page.get_by_text("Four blobs.").is_visible()
    settle(page)
    check_image(page, 0.25)
