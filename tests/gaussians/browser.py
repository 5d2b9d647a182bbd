"""A browser for the tests of the player, and a page whose image is known in advance."""

import contextlib
import functools
import io
import json
import os
import pathlib
import shutil
import subprocess

import numpy as np
import PIL.Image
import pytest

from gaussians_jax.io.keyframes import Keyframes
from gaussians_jax.player import packing
from gaussians_jax.player import page as player_page
from gaussians_jax.splatting.raster_spec import RasterSpec
from nerfies_jax.capture.capture import Capture
from nerfies_jax.geometry import camera as cameras

NAMES = ("chromium", "google-chrome", "chromium-browser")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
needs_node = pytest.mark.skipif(not shutil.which("node"), reason="no node here")
# Software rendering, which every machine has. Root has no sandbox.
ARGUMENTS = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    "--disable-dev-shm-usage",
)
DESKTOP = {"viewport": {"width": 800, "height": 600}}  # software draws every pixel
PHONE = {
    "viewport": {"width": 390, "height": 844},
    "has_touch": True,
    "is_mobile": True,
}
# Static blobs of one color each, by position. The last one moves, see MOVED.
BLOBS = {
    "red": (0.0, 0.0, 0.0),
    "green": (0.45, 0.0, 0.0),
    "blue": (0.0, 0.35, 0.3),
    "magenta": (-0.45, -0.3, 0.0),
}
COLORS = {"red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1), "magenta": (1, 0, 1)}
MOVED = (0.5, 0.0, 0.0)  # of the magenta blob, from time 0 to time 1
SECONDS = 2.0  # that the capture plays
SIZE, FOCAL_PX, DISTANCE = (64, 48), 70.0, 2.0


def by_node(program, *inputs):
    """Run a program in node on inputs that it reads as JSON; return what it prints."""
    run = functools.partial(subprocess.run, capture_output=True, text=True, check=True)
    return json.loads(run(["node", "-e", program], input=json.dumps(inputs)).stdout)


def program_of(name):
    """Return the source of one file of the player."""
    return pathlib.Path(player_page.__file__).with_name(name).read_text()


def launched():
    """Yield a running browser; skip, or fail where CI has installed one."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        sync_playwright = None
    if CHROMIUM is None or sync_playwright is None:
        reason = "these tests need Chromium and the Python package playwright"
        (pytest.fail if os.environ.get("BROWSER_TESTS") else pytest.skip)(reason)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=list(ARGUMENTS)
        )
        yield browser
        browser.close()


@functools.cache
def capture():
    """Cameras on an arc about the origin, at one distance, y up."""
    angles = np.linspace(-0.5, 0.5, 9)
    heights = 0.1 + 0.2 * np.arange(9) % 0.4
    positions = DISTANCE * np.stack(
        [
            np.sin(angles) * np.cos(heights),
            np.sin(heights),
            np.cos(angles) * np.cos(heights),
        ],
        axis=1,
    )
    # The first view is the middle one.
    positions = np.roll(positions, 5, axis=0)
    poses = [
        cameras.look_at(place, (0, 0, 0), (0, 1, 0), FOCAL_PX, SIZE)
        for place in positions
    ]
    count = np.arange(9, dtype=np.int32)
    return Capture(
        name="blobs",
        source="test",
        ids=tuple(f"{i}" for i in count),
        images=np.zeros((9, SIZE[1], SIZE[0], 3), np.uint8),
        cameras=cameras.stack(poses),
        times=np.linspace(0, 1, 9, dtype=np.float32),
        train=count,
        heldout=count[:0],
        near=0.5,
        far=4.0,
        warp_ids=count,
        appearance_ids=count,
        camera_ids=0 * count,
        background=(0.0, 0.0, 0.0),
        up=(0.0, 1.0, 0.0),
        frames_per_second=9 / SECONDS,
    )


def packed_blobs():
    """The blobs as a page stores them."""
    count, steps = len(BLOBS), np.linspace(0, 1, 24)
    mean = np.tile(np.float32(list(BLOBS.values())), (len(steps), 1, 1))
    mean[:, -1] += steps[:, None] * MOVED
    keyframes = Keyframes(
        mean=mean,
        quaternion=np.tile(np.float32([1, 0, 0, 0]), (len(steps), count, 1)),
        log_scale=np.full((len(steps), count, 3), np.log(0.04), np.float32),
        opacity=np.full((len(steps), count), 0.95, np.float32),
        color=np.float32(list(COLORS.values())),
        left_out=0,
    )
    return packing.pack(keyframes, np.full(count, 1e-4))


def header():
    """The header of the page of the blobs."""
    return player_page.header(packed_blobs(), RasterSpec(), capture())


def write_blobs(path):
    """Write the player page of the blobs."""
    poster = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    player_page.compose(
        path, "Blobs", packed_blobs(), "Four blobs.", RasterSpec(), capture(), poster
    )


def image_of(page, selector="#scene"):
    """Return what the page shows of an element, [height, width, 3] from 0 to 1."""
    content = page.locator(selector).screenshot()
    return np.asarray(PIL.Image.open(io.BytesIO(content)).convert("RGB")) / 255


def place_of(image, name):
    """Return the centroid (x, y) of the blob of one color in px, and its area."""
    color = np.array(COLORS[name])
    lit = image[..., color == 1].min(axis=-1)
    unlit = image[..., color == 0].max(axis=-1)
    weight = np.clip(lit - unlit, 0, 1)
    weight = np.where(weight > 0.1, weight, 0)
    total = weight.sum()
    assert total > 0, f"the {name} blob is not to be seen"
    rows, columns = np.indices(weight.shape) + 0.5
    return np.array([(weight * columns).sum(), (weight * rows).sum()]) / total, total


def projected(view, point, width, height):
    """Where a view shows a point, px from the upper left corner of the canvas."""
    enlarged = min(width / view["size"][0], height / view["size"][1])
    x, y, z = np.reshape(view["rotation"], (3, 3)) @ np.subtract(
        point, view["position"]
    )
    offset = view["focal"] * enlarged * np.array([x, y * view["aspect"]]) / z
    center = np.subtract(view["center"], np.divide(view["size"], 2)) * enlarged
    return offset + center + (width / 2, height / 2)


@contextlib.contextmanager
def opener(browser, address):
    """Yield a function that opens the page; afterwards assert that it met no error.

    The page stands still at its start; `script` runs before its own programs.
    """
    with contextlib.ExitStack() as stack:
        errors = []

        def open_page(options=DESKTOP, fragment="#t=0", script=None, wait=True):
            context = browser.new_context(**options)
            stack.callback(context.close)
            page = context.new_page()
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.on(
                "console",
                lambda line: line.type == "error" and errors.append(line.text),
            )
            if script is not None:
                page.add_init_script(script)
            page.goto(address + fragment)
            if wait:
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
