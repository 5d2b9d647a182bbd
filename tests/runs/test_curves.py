"""The curve of a run: written, read, and when it reached a quality."""

import numpy as np
import pytest

from nerfies_jax.runs import curves
from nerfies_jax.training.loop import History


def curve(seconds, psnr):
    count = len(seconds)
    return curves.Curve(
        tuple(map(float, seconds)),
        tuple(range(count)),
        tuple(psnr),
        (0.5,) * count,
        ("a",),
        1.0,
        {},
    )


def test_time_to_a_quality_is_read_off_the_curve():
    rising = curve([1, 3, 5], [10, 20, 20])
    assert curves.seconds_to(rising, 15) == pytest.approx(2)
    assert curves.seconds_to(rising, 20) == pytest.approx(3)
    assert curves.seconds_to(rising, 5) == 1
    assert curves.seconds_to(rising, 20.1) is None
    assert curves.seconds_to(curve([], []), 5) is None


def test_a_quality_that_was_lost_again_counts_from_the_last_crossing():
    assert curves.seconds_to(curve([0, 1, 2, 3], [21, 22, 18, 22]), 20) == 2.5
    assert curves.seconds_to(curve([0, 1], [21, 19]), 20) is None
    assert curves.seconds_to(curve([0, 1], [np.nan, 22]), 20) == 1


def test_a_curve_comes_back_as_it_was_written(tmp_path):
    rows = tuple(
        {"hook": "held out", "step": step, "seconds": at, "psnr": dB, "ssim": 0.5}
        for step, at, dB in ((0, 1.0, 12.5), (1, 3.0, np.nan))
    )
    rows[1]["cpu_seconds"] = 5.0  # an earlier version did not measure the first row's
    # Training frames that were left out are other frames, and have no SSIM.
    other = {"hook": "validation", "step": 1, "seconds": 2.0, "psnr": 40.0}
    training = ({"step": 1, "seconds": 1.0, "loss": 0.1},)
    history = History(training, (*rows, other), 3.0, 2.0)
    curves.write(tmp_path, history, ["frame 3"])
    stored = curves.read(tmp_path)
    assert stored.seconds == (1.0, 3.0)
    assert stored.psnr[0] == 12.5
    assert np.isnan(stored.psnr[1])
    np.testing.assert_array_equal(stored.cpu_seconds, [np.nan, 5.0])
    assert stored.frames == ("frame 3",)
    assert stored.compile_seconds == 2.0
    assert "jax" in stored.machine
