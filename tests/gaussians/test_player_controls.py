"""Every control of the player, operated in a real browser.

The camera is read from the page, and the image is held against it: each blob must be
where a pinhole with that camera shows it.
"""

import contextlib

import numpy as np
import pytest

from tests.gaussians import browser as shared
from tests.gaussians.browser import BLOBS, MOVED, image_of, place_of, projected

DESKTOP = {"viewport": {"width": 1280, "height": 800}}
PHONE = {
    "viewport": {"width": 390, "height": 844},
    "has_touch": True,
    "is_mobile": True,
}


@pytest.fixture(scope="module")
def browser():
    yield from shared.launched()


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    path = tmp_path_factory.mktemp("controls") / "player.html"
    shared.write_blobs(path)
    return path.as_uri()


@pytest.fixture
def opened(browser, address):
    """A function that opens the page, stopped at its start, and reports its errors."""
    with contextlib.ExitStack() as stack:
        errors = []

        def open_page(options=DESKTOP, fragment="#t=0"):
            context = browser.new_context(**options)
            stack.callback(context.close)
            page = context.new_page()
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.on(
                "console",
                lambda line: line.type == "error" and errors.append(line.text),
            )
            page.goto(address + fragment)
            settle(page)
            return page

        yield open_page
        assert not errors


def settle(page):
    """Wait until the page has drawn what it is to show."""
    page.wait_for_function("() => player && player.ready")
    page.evaluate(
        "new Promise((done) => requestAnimationFrame(() => setTimeout(done)))"
    )
    page.wait_for_function("() => player.ready")


def state(page):
    """Return the view as arrays, with its offset from the target."""
    view = page.evaluate("player.view")
    view["offset"] = np.subtract(view["position"], view["target"])
    return view


def check_image(page, time=0.0):
    """Assert that the blobs are where the page's camera sees them."""
    image, view = image_of(page), state(page)
    ratio = page.evaluate("window.devicePixelRatio")
    height, width = np.array(image.shape[:2]) / ratio
    seen = 0
    for name, point in BLOBS.items():
        point = np.add(point, np.multiply(time, MOVED)) if name == "magenta" else point
        expected = projected(view, point, width, height)
        if (expected < 20).any() or (expected > (width - 20, height - 20)).any():
            continue
        place = place_of(image, name)[0] / ratio
        # 0.5 px of the pixel grid; a blob's projection is not quite symmetric.
        np.testing.assert_allclose(place, expected, atol=1.5)
        seen += 1
    assert seen >= 2
    return image


def drag(page, by, button="left", keys=()):
    """Drag with the mouse from the middle of the canvas."""
    box = page.locator("#scene").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for key in keys:
        page.keyboard.down(key)
    page.mouse.move(x, y)
    page.mouse.down(button=button)
    page.mouse.move(x + by[0], y + by[1], steps=4)
    page.mouse.up(button=button)
    for key in keys:
        page.keyboard.up(key)
    settle(page)


def touch(page, *paths):
    """Move one finger along each path, [(x, y), ...] from the middle of the canvas."""
    box = page.locator("#scene").bounding_box()
    middle = np.array([box["x"] + box["width"] / 2, box["y"] + box["height"] / 2])
    session = page.context.new_cdp_session(page)
    kinds = ["touchStart"] + ["touchMove"] * (len(paths[0]) - 1)
    for kind, places in zip(kinds, zip(*paths, strict=True), strict=True):
        points = [
            {"x": float(middle[0] + x), "y": float(middle[1] + y), "id": number}
            for number, (x, y) in enumerate(places)
        ]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    session.detach()
    settle(page)


def test_a_mouse_orbits_about_the_target_and_reset_returns(opened):
    page = opened()
    before, image = state(page), check_image(page)
    drag(page, (40, 20))
    after = state(page)
    np.testing.assert_allclose(after["target"], before["target"], atol=1e-9)
    lengths = [np.linalg.norm(view["offset"]) for view in (before, after)]
    assert lengths[1] == pytest.approx(lengths[0])
    # The scene follows the hand: to the right, so the camera goes to the left, and up.
    assert after["offset"][0] < before["offset"][0] - 0.1
    assert after["offset"][1] > before["offset"][1] + 0.05
    check_image(page)
    page.get_by_role("button", name="First view").click()
    settle(page)
    np.testing.assert_array_equal(image_of(page), image)


def test_a_finger_orbits_and_two_fingers_pan_and_zoom(opened):
    page = opened(PHONE)
    before = state(page)
    check_image(page)
    touch(page, [(0, 0), (-15, 10), (-40, 20)])
    after = state(page)
    np.testing.assert_allclose(after["target"], before["target"], atol=1e-9)
    assert after["offset"][0] > before["offset"][0] + 0.1
    assert after["offset"][1] > before["offset"][1] + 0.05
    check_image(page)
    touch(page, [(-50, 0), (-60, 0), (-75, 0)], [(50, 0), (60, 0), (75, 0)])
    nearer = state(page)
    factor = np.linalg.norm(nearer["offset"]) / np.linalg.norm(after["offset"])
    assert factor == pytest.approx(100 / 150, rel=0.05)
    np.testing.assert_allclose(nearer["target"], after["target"], atol=0.02)
    check_image(page)
    touch(page, [(-50, 0), (-50, 15), (-50, 30)], [(50, 0), (50, 15), (50, 30)])
    moved = state(page)
    np.testing.assert_allclose(moved["offset"], nearer["offset"], rtol=0.02, atol=0.02)
    assert moved["target"][1] > nearer["target"][1] + 0.05
    check_image(page)


@pytest.mark.parametrize("way", ["shift", "right button"])
def test_a_mouse_pans_the_target_under_the_pointer(opened, way):
    page = opened()
    before, start = state(page), place_of(image_of(page), "red")[0]
    options = {"keys": ["Shift"]} if way == "shift" else {"button": "right"}
    drag(page, (60, -30), **options)
    after = state(page)
    np.testing.assert_allclose(after["offset"], before["offset"], atol=1e-9)
    place = place_of(check_image(page), "red")[0]
    # The red blob is in the plane of the target, which follows the hand.
    np.testing.assert_allclose(place - start, (60, -30), atol=2)


def test_the_wheel_zooms_about_the_target(opened):
    page = opened()
    before, (start, area) = state(page), place_of(image_of(page), "red")
    box = page.locator("#scene").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.wheel(0, -200)
    settle(page)
    after = state(page)
    factor = np.linalg.norm(after["offset"]) / np.linalg.norm(before["offset"])
    assert factor == pytest.approx(np.exp(-0.2), rel=0.01)
    place, larger = place_of(check_image(page), "red")
    np.testing.assert_allclose(place, start, atol=1)
    assert larger / area == pytest.approx(factor**-2, rel=0.05)


def test_the_time_is_played_paused_and_scrubbed(opened):
    page = opened()
    check_image(page)
    play = page.get_by_role("button", name="Play")
    play.click()
    page.wait_for_function("() => player.time > 0.1")
    page.get_by_role("button", name="Pause").click()
    settle(page)
    time = page.evaluate("player.time")
    assert time > 0.1
    check_image(page, time)
    page.get_by_role("slider").fill("0.8")
    settle(page)
    scrubbed = check_image(page, 0.8)
    np.testing.assert_array_equal(image_of(opened(fragment="#t=0.8")), scrubbed)
