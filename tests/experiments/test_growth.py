"""Exponents of growth, the page of a stored result, and one measured point."""

import math

import pytest

from experiments.growth import page
from experiments.growth.axes import AXES, fit
from tests import scenes


def points(sizes, exponent, frames=0):
    """Measurements whose time is a power of the size."""
    rest = {"flops": 1e6, "bytes_accessed": 1e6, "temporary_bytes": 10**9}
    rest["input_bytes"] = frames
    return {str(n): {"cpu_seconds": 1e-6 * n**exponent, **rest} for n in sizes}


def test_the_exponent_of_a_power_law_is_found():
    law = fit(points((10, 100, 4_000), 1.25), "cpu_seconds")
    assert law.exponent == pytest.approx(1.25)
    assert law.error == pytest.approx(0, abs=1e-6)
    assert law.steepest == pytest.approx(1.25)
    assert math.isnan(fit(points((10,), 1), "cpu_seconds").exponent)
    assert math.isnan(fit(points((10, 20), 1), "pairs").exponent)


def test_the_page_names_the_first_limit_of_each_goal():
    axes = {name: points(axis.sizes, 0.5) for name, axis in AXES.items()}
    axes["rays"] = points(AXES["rays"].sizes, 1.07)
    axes["Gaussians"]["1000000"]["temporary_bytes"] = 10**10
    stored = {"machine": {"memory_bytes": 8e9}, "axes": axes}
    stored |= {"job_seconds": 120.0, "train_seconds": 30.0}
    text = page.page(stored)
    assert text.startswith("Time grows fastest with rays: its exponent is at most 1.07")
    memory = "memory: the measured machine has 8 GB"
    assert "| five minutes of 1920x1080 | time of a step | 0.00144 | 0 | 1.0 |" in text
    many = "1,000,000 Gaussians, 352x264 pixels"
    assert f"| {many} | {memory} | 0.001 | 0 | 10.0 |" in text
    assert "| time, of which training is 25 % |  | 33 |" in text
    assert "| rays | `nerf-small` | 128 to 2,048 | 1.07 ± 0.00 | 1.07 |" in text


@pytest.mark.full
def test_a_point_is_measured(monkeypatch):
    """On an image of another size than that of the frames, with repeated frames."""
    from experiments.growth import measure

    assert AXES.keys() == measure.BUILDERS.keys()
    pixels = AXES["pixels, 10,000 Gaussians"].sizes
    assert pixels == tuple(measure.IMAGES)
    monkeypatch.setattr(measure, "_capture", scenes.tiny_capture)
    monkeypatch.setattr(measure, "LARGE", (60, 45))
    point = measure.point("Gaussians", 64)
    assert 64 < point["pairs"] < 64 * 48  # tiles of the image
    assert point["cpu_seconds"] > 0
    assert point["input_bytes"] > 8 * 60 * 45 * 3  # the frames
