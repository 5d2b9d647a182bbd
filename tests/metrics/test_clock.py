"""Clock: known durations, known operation counts, and records that survive a file."""

import json
import math
import os
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.metrics import clock


def test_metrics_survive_a_file(tmp_path):
    metrics = [
        clock.Metric("heldout.psnr", 31.25, "dB", "higher", 0.1),
        clock.Metric("train.seconds", 12.5, "s", "lower", 2.0),
        clock.Metric("broken", math.inf, "", "equal"),
    ]
    path = tmp_path / "metrics.json"
    clock.write_metrics(path, metrics, {"seed": 3})
    stored = clock.read_metrics(path)
    assert stored["heldout.psnr"] == metrics[0]
    assert stored["train.seconds"] == metrics[1]
    assert math.isnan(stored["broken"].value)
    text = json.loads(path.read_text())  # strict JSON: no NaN, no Infinity
    assert text["about"] == {"seed": 3}
    assert text["metrics"]["broken"]["value"] is None
    assert os.listdir(tmp_path) == ["metrics.json"]


@pytest.mark.parametrize(
    ("direction", "value", "before", "holds"),
    [
        ("lower", 1.1, 1.0, True),
        ("lower", 1.3, 1.0, False),
        ("lower", 0.1, 1.0, True),
        ("higher", 0.9, 1.0, True),
        ("higher", 0.7, 1.0, False),
        ("higher", 5.0, 1.0, True),
        ("equal", 1.3, 1.0, False),
        ("equal", 0.9, 1.0, True),
        ("higher", math.nan, 1.0, False),
        ("lower", math.nan, 1.0, False),
        ("equal", math.nan, 1.0, False),
    ],
)
def test_a_metric_holds_up_to_its_tolerance(direction, value, before, holds):
    assert clock.Metric("x", value, "", direction, 0.2).holds(before) == holds


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (dict(key=""), "needs a key"),
        (dict(direction="up"), "one of lower, higher, equal, got 'up'"),
        (dict(tolerance=-1.0), "not negative, got -1.0"),
        (dict(tolerance=math.nan), "not negative, got nan"),
    ],
)
def test_nonsense_metrics_are_refused(settings, words):
    values = dict(key="x", value=1.0, unit="", direction="lower", tolerance=0.0)
    with pytest.raises(ValueError, match=words):
        clock.Metric(**(values | settings))


def test_a_key_twice_or_a_foreign_file_is_refused(tmp_path):
    metric = clock.Metric("x", 1.0, "", "lower")
    with pytest.raises(ValueError, match="metric x occurs twice"):
        clock.write_metrics(tmp_path / "a.json", [metric, metric])
    assert not list(tmp_path.iterdir())
    for text in (
        "{",
        "[]",
        '{"metrics": {"x": 3}}',
        '{"metrics": {"x": {"unit": ""}}}',
    ):
        (tmp_path / "b.json").write_text(text)
        with pytest.raises(ValueError, match=r"b\.json: "):
            clock.read_metrics(tmp_path / "b.json")


def test_wall_and_processor_time_are_told_apart():
    def sleep():
        time.sleep(0.03)

    def spin():
        end = time.process_time() + 0.03
        while time.process_time() < end:
            pass

    timings = clock.compare({"sleep": sleep, "spin": spin}, repeats=4, warm_up=0)
    assert timings["sleep"].median >= 0.03
    assert timings["sleep"].median_cpu < 0.02
    assert timings["spin"].median_cpu >= 0.03
    assert timings["spin"].wall.shape == (4,)


def test_timing_is_interleaved_and_warm():
    calls = []
    clock.compare(
        {"a": lambda: calls.append("a"), "b": lambda: calls.append("b")},
        repeats=3,
        warm_up=2,
    )
    assert "".join(calls) == "aabb" + "ab" * 3
    with pytest.raises(ValueError, match="repeats=0"):
        clock.measure(lambda: None, repeats=0)
    timing = clock.Timing(np.array([1.0, 2.0, 3.0, 4.0, 100.0]), np.zeros(5))
    assert timing.median == 3.0
    assert timing.spread == 1.0  # half the distance of the quartiles


@pytest.mark.full
def test_timing_waits_for_the_result():
    matrix = np.ones((900, 900), np.float32)
    chain = jax.jit(lambda x: jax.lax.fori_loop(0, 8, lambda _, y: x @ y * 1e-3, x))
    waited = clock.measure(lambda: chain(matrix), repeats=3)
    # 8 products of 900^3: 5.8 GFLOP, more than 1 ms on any processor there is.
    assert waited.median > 1e-3


def test_cost_counts_a_known_product():
    left, right = np.ones((64, 32), np.float32), np.ones((32, 48), np.float32)
    counted = clock.cost(lambda x, y: x @ y, left, right)
    assert counted.flops == pytest.approx(2 * 64 * 32 * 48, rel=0.05)
    assert counted.argument_bytes == 4 * (64 * 32 + 32 * 48)
    assert counted.output_bytes == 4 * 64 * 48
    assert counted.bytes_accessed >= counted.argument_bytes + counted.output_bytes
    assert counted.compile_seconds > 0
    # and of what is between
    twice = jax.jit(
        lambda x: jnp.sort(jnp.sort(x)[::-1] * jnp.arange(1.0 * x.size))[:3]
    )
    counted = clock.cost(twice, np.ones(50_000, np.float32))
    assert counted.temporary_bytes >= 4 * 50_000


@pytest.mark.full
def test_peak_memory_sees_a_large_array():
    code = (
        "from nerfies_jax.metrics import clock; import numpy as np;"
        "before = clock.peak_bytes(); x = np.ones(30_000_000); print("
        "before, clock.peak_bytes())"
    )
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    before, after = map(int, out.split())
    # 240 MB, less what imports had peaked above their rest; and not the memory of the
    # process that started this one.
    assert 180e6 < after - before < 260e6
    assert 20e6 < before < 600e6


def test_the_machine_describes_itself():
    machine = clock.machine()
    assert json.loads(json.dumps(machine)) == machine
    assert machine["jax"] == jax.__version__
    assert machine["cores"] >= 1
    assert machine["backend"] == jax.default_backend()
    assert machine["memory_bytes"] > 1e8
    assert machine["cpu"]
    peak = clock.device_peak_bytes()
    assert (peak is None) == (jax.devices()[0].memory_stats() is None)
