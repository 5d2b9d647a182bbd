"""Every control of the player, operated in a real browser.

The camera is read from the page, and the image is held against it: each blob must be
where a pinhole with that camera shows it.
"""

import numpy as np
import pytest

from tests.gaussians.browser import (
    PHONE,
    check_image,
    drag,
    image_of,
    place_of,
    settle,
    state,
)


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


@pytest.mark.full
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


@pytest.mark.parametrize(
    "way", ["shift", pytest.param("right button", marks=pytest.mark.slow)]
)
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


@pytest.mark.full
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


def angle_about_up(before, after):
    """The angle (rad) by which the camera went around the y axis, to its right."""
    one, other = (np.arctan2(v["offset"][0], v["offset"][2]) for v in (before, after))
    return other - one


@pytest.mark.full
def test_keys_orbit_pan_zoom_and_reset(opened):
    page = opened()
    start, image = state(page), image_of(page)

    def after(key):
        before = state(page)
        page.keyboard.press(key)
        settle(page)
        return before, state(page)

    before, now = after("ArrowRight")
    assert angle_about_up(before, now) == pytest.approx(np.radians(5), abs=1e-5)
    before, now = after("ArrowLeft")
    assert angle_about_up(before, now) == pytest.approx(-np.radians(5), abs=1e-5)
    before, now = after("ArrowUp")
    assert now["offset"][1] - before["offset"][1] == pytest.approx(0.173, abs=0.01)
    before, now = after("ArrowDown")
    np.testing.assert_allclose(now["offset"], start["offset"], atol=1e-5)
    before, now = after("Shift+ArrowRight")
    move = np.subtract(now["target"], before["target"])
    np.testing.assert_allclose(move, [2 * np.radians(5), 0, 0], atol=1e-5)
    before, now = after("+")
    assert now["distance"] == pytest.approx(before["distance"] / 1.1, rel=1e-5)
    before, now = after("-")
    assert now["distance"] == pytest.approx(before["distance"] * 1.1, rel=1e-5)
    check_image(page)
    after("Home")
    np.testing.assert_array_equal(image_of(page), image)


def test_keys_play_step_and_show_help(opened):
    page = opened()
    last = 23  # keyframes of the page
    page.keyboard.press(".")
    page.keyboard.press(".")
    page.keyboard.press(",")
    settle(page)
    assert page.evaluate("player.time") == pytest.approx(1 / last, abs=1e-6)
    check_image(page, 1 / last)
    slider = page.get_by_role("slider")
    slider.focus()
    page.keyboard.press("ArrowRight")
    settle(page)
    assert page.evaluate("player.time") == pytest.approx(2 / last, abs=1e-6)
    page.get_by_role("button", name="Next frame").click()
    page.get_by_role("button", name="Previous frame").click()
    assert page.evaluate("player.time") == pytest.approx(2 / last, abs=1e-6)
    page.keyboard.press("Tab")  # to the speed, whose keys are its own
    page.locator("#scene").focus()
    page.keyboard.press("Space")
    assert page.evaluate("player.playing")
    page.keyboard.press("Space")
    assert not page.evaluate("player.playing")
    dialog = page.get_by_role("dialog")
    page.keyboard.press("?")
    assert dialog.is_visible()
    page.keyboard.press("Escape")
    assert not dialog.is_visible()
    page.get_by_role("button", name="Controls").click()
    dialog.get_by_role("button", name="Close").click()
    assert not dialog.is_visible()


@pytest.mark.full
def test_full_screen_by_key_and_button(opened):
    page = opened()
    full = "() => document.fullscreenElement !== null"
    page.keyboard.press("f")
    page.wait_for_function(full)
    page.get_by_role("button", name="Full screen").click()
    page.wait_for_function("() => document.fullscreenElement === null")
    page.get_by_role("button", name="Full screen").click()
    page.wait_for_function(full)
    settle(page)
    check_image(page)


def test_a_link_holds_the_time_and_the_view(opened):
    page = opened()
    first = image_of(page)
    drag(page, (50, 30))
    drag(page, (20, -40), keys=["Shift"])
    page.get_by_role("slider").fill("0.3")
    settle(page)
    page.wait_for_function("() => location.hash.includes('t=0.3&view=')")
    image, fragment = image_of(page), "#" + page.url.split("#")[1]
    assert (image != first).any()
    other = opened(fragment=fragment)
    assert not other.evaluate("player.playing")
    np.testing.assert_array_equal(image_of(other), image)
    other.evaluate("() => { location.hash = 't=0'; }")  # as a link in the page would
    other.wait_for_function("() => player.time === 0")
    settle(other)
    check_image(other)
