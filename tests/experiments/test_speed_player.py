"""The work of a frame is counted right, and the page says what was measured."""

import math

import pytest

from experiments.speed import player
from experiments.speed.__main__ import Player
from tests.gaussians.browser import launched, write_blobs


@pytest.fixture(scope="module")
def browser():
    yield from launched()


@pytest.mark.slow
def test_frames_are_timed_and_their_fragments_counted(browser, tmp_path):
    path = tmp_path / "player.html"
    write_blobs(path)
    args = Player((path,), size=64, frames=2, rounds=3, time=0.0)
    row = player.measure_page(browser, path, args)
    assert (row["gaussians"], row["moving"], row["size"]) == (4, 1, 64)
    assert len(row["ours_ms"]) == 3
    assert min(row["ours_ms"]) > 0
    assert sum(row["ours_cpu_ms"]) > 0
    work = row["work"]
    assert work["drawn"] == 4
    # A quad is the square around the circle where 0.95 exp(-r^2 / 2) is 1/255.
    assert work["shaded"] / work["blended"] == pytest.approx(4 / math.pi, rel=0.02)
    # Three blobs of 0.04 are 2 away, one 1.67; the focal length is 70 px in 48.
    enlarged = 1080 / 48
    variances = [(0.04 / z * 70 * enlarged) ** 2 for z in (2, 2, 2, 1.67)]
    area = sum(variances) + 4 * 0.3 * enlarged**2  # the dilation grows along
    expected = math.pi * 2 * math.log(0.95 * 255) * area
    assert work["blended"] == pytest.approx(expected, rel=0.03)
    stored = {"machine": {"cpu": "one", "cores": 2, "browser": "B"}, "rows": [row]}
    assert "| 16 |" in player.page(stored)


def test_a_ratio_is_of_the_same_round():
    work = dict.fromkeys(("drawn", "shaded", "blended", "sort_ms"), 1e6)
    row = {"page": "scene", "size": 600, "gaussians": 10_000, "moving": 10}
    row |= {"ours_ms": [100.0, 200.0, 400.0], "gsplat_ms": [150.0, 400.0, 400.0]}
    row |= {"ours_cpu_ms": [80.0] * 3, "gsplat_cpu_ms": [60.0] * 3}
    row |= {"alike_db": 33.0, "work": work | {"large_sort_ms": 90.0}}
    stored = {"machine": {"cpu": "one", "cores": 2, "browser": "B"}, "rows": [row]}
    page = player.page(stored)
    assert "| 200 | 400 | 1.50 (1.00 to 2.00) | 80 | 60 | 0.75 (0.75 to 0.75) |" in page
