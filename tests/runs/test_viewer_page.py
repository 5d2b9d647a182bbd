"""The viewer in a real browser: what it renders, and the controls of the scene."""

import contextlib
import re
import threading
import time

import numpy as np
import pytest

from nerfies_jax import evaluation
from nerfies_jax.evaluation import interactive
from nerfies_jax.runs import viewer, viewer_window
from nerfies_jax.training.model import View, in_default_precision
from tests.gaussians import browser as browsers
from tests.runs.test_viewer import a_run

pytest.importorskip("viser")
pytestmark = pytest.mark.slow
WINDOW = {"width": 960, "height": 600}
SCENE_PX = 600  # columns beside the panel
WAIT_MS = 120_000  # where other processes keep the machine busy


@pytest.fixture(scope="module")
def browser():
    yield from browsers.launched()


class Served:
    """A page of a run that is served in a thread, and the browser's tab of it."""

    def __init__(self, page, state, tab):
        self.page, self.state, self.tab = page, state, tab
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self):
        while not self._ended.is_set():
            self.page.serve(self.state, 25, 0.2)
            time.sleep(0.02)

    def end(self):
        self._ended.set()
        self._thread.join()

    def until(self, what, seconds=WAIT_MS / 1000):
        """Wait until `what()` is true of the server."""
        end = time.monotonic() + seconds
        while not what():
            assert time.monotonic() < end
            self.tab.wait_for_timeout(50)

    def settled(self):
        """The scene [height, width, 3] from 0 to 1 once it does not change any more."""
        before = None
        for _ in range(200):
            image = browsers.image_of(self.tab, "canvas >> nth=0")[:, :SCENE_PX]
            if before is not None and np.abs(image - before).max() < 0.02:
                return image
            before = image
            self.tab.wait_for_timeout(300)
        raise TimeoutError

    def changed(self, before, least=0.01):
        """Wait until the scene differs from an earlier image, and return it."""
        for _ in range(100):
            image = self.settled()
            if np.abs(image - before).mean() > least:
                return image
        raise TimeoutError

    def eye(self):
        """The browser's camera, as far as the server was told."""
        (client,) = self.page._server.get_clients().values()
        return viewer_window.eye_of(client.camera)

    def still_eye(self):
        """The camera once it has come to rest: the browser damps its motion."""
        eye, since = self.eye(), time.monotonic()
        while time.monotonic() - since < 1.5:
            self.tab.wait_for_timeout(100)
            if self.eye() != eye:
                eye, since = self.eye(), time.monotonic()
        return eye


@contextlib.contextmanager
def served(browser, tmp_path):
    # Little enough that what moves stays in the window.
    run, state = a_run("gaussians", 0.03)
    page = viewer.Viewer(run, (160, 120), 8380, tmp_path)
    tab = browser.new_page(viewport=WINDOW)
    tab.set_default_timeout(WAIT_MS)
    each = Served(page, state, tab)
    try:
        tab.goto(page.address)
        tab.get_by_text(re.compile(r"step 25")).wait_for()
        # It covers the scene.
        notice = tab.get_by_text("Software WebGL rendering detected")
        with contextlib.suppress(Exception):
            notice.wait_for(timeout=60000)
            tab.locator(".mantine-Notification-closeButton").first.click(timeout=60000)
            notice.wait_for(state="detached")
        yield each
    finally:
        each.end()
        tab.close()
        page.close()


def rendered(each, time, without=()):
    """What our renderer shows in the browser's window."""
    size = WINDOW["width"] // 2, WINDOW["height"] // 2
    model = each.page.screen.model(without)
    camera = interactive.camera_of(each.still_eye(), size)
    view = View(camera, np.float32(time), np.int32(0))
    renderer = evaluation.Renderer(model, size)
    return renderer(each.state, in_default_precision(view)).color.clip(0, 1)


def test_the_browser_renders_the_gaussians_at_every_time_and_without_effects(
    browser, tmp_path
):
    with served(browser, tmp_path) as each:

        def difference(time, without=()):
            shown = each.settled()[::2, ::2]
            expected = rendered(each, time, without)[:, : SCENE_PX // 2]
            behind = np.asarray(each.page.screen.run.capture.background)
            covered = np.abs(expected - behind).max(axis=-1) > 0.05
            assert covered.mean() > 0.02
            return np.abs(shown[: len(expected)] - expected)[covered].mean()

        start = float(each.page._time.value)
        first = each.settled()
        # viser cuts Gaussians off at 2 % of their opacity, and blurs by half as much
        # here, where pixels are half as large.
        assert difference(start) < 0.03
        each.tab.get_by_role("slider").first.focus()
        each.tab.keyboard.press("End")
        each.until(lambda: each.page._time.value == 1.0)
        last = each.changed(first)
        assert difference(1.0) < 0.03
        each.tab.get_by_label("motion", exact=True).uncheck()
        frozen = each.changed(last)
        assert difference(1.0, ("motion",)) < 0.03
        each.tab.get_by_label("motion", exact=True).check()
        each.changed(frozen)
        # Depth is rendered by the server, and takes the place of the Gaussians.
        each.tab.get_by_label("show", exact=True).click()
        each.tab.get_by_role("option", name="depth").click()
        each.tab.get_by_text("160x120, step 25").wait_for()
        depth = each.changed(last)
        each.tab.get_by_label("show", exact=True).click()
        each.tab.get_by_role("option", name="color").click()
        each.changed(depth)
        each.tab.get_by_label("cameras", exact=True).check()
        each.until(lambda: each.page._frusta.visible)
        each.tab.get_by_label("play", exact=True).check()
        times = set()
        each.until(lambda: times.add(each.page._time.value) or len(times) > 3)
