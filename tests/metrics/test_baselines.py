"""What got worse since an earlier run."""

import math

from nerfies_jax.metrics import baselines
from nerfies_jax.metrics.clock import Metric


def test_what_got_worse_is_named_and_what_is_new_is_not():
    def metric(key, value, direction):
        return Metric(key, value, "", direction, 0.5)

    before = {
        "a.psnr": metric("a.psnr", 20.0, "higher"),
        "a.train_cpu_seconds": metric("a.train_cpu_seconds", 5.0, "lower"),
        "a.track_error": metric("a.track_error", math.nan, "lower"),
    }
    now = [
        metric("a.psnr", 19.4, "higher"),
        metric("a.train_cpu_seconds", 5.4, "lower"),
        metric("a.track_error", 9.0, "lower"),
        metric("b.psnr", 1.0, "higher"),
    ]
    (line,) = baselines.changes(now, before)
    assert "a.psnr" in line
    assert "19.4" in line
