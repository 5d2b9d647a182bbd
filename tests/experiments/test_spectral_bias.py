"""Errors by frequency, sizes of networks, and how rates and times are shared out."""

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.spectral_bias import __main__ as spectral_bias
from experiments.spectral_bias import report
from experiments.spectral_bias.__main__ import Result, Signal, SpectralBias

LABELS = ["1-D", pytest.param("2-D", marks=pytest.mark.full)]
SMALL = Signal(np.array([[1.0], [3.0]]), np.array([0.3, 1.1]), 60, 2)


def errors(apply, signal):
    return jax.jit(lambda: spectral_bias.errors(apply, signal))()


@pytest.mark.parametrize("label", LABELS)
def test_planted_errors_are_found_at_their_frequencies(label):
    signal = spectral_bias.SIGNALS[label]
    waves, amplitude = signal.waves, signal.amplitude
    planted = np.linspace(0.0, 0.4, len(waves))
    x = np.asarray(spectral_bias.grid(waves.shape[1]), np.float64)
    off = sum(
        share * amplitude * np.sin(np.pi * x @ wave + 0.9 * index)
        for index, (share, wave) in enumerate(zip(planted, waves, strict=True))
    )
    off = np.float32(off + 0.2 * np.cos(np.pi * x @ (waves[-1] + 1)))
    rmse, missing = errors(lambda points: signal(points) + off, signal)
    np.testing.assert_allclose(missing, planted, atol=1e-5)
    # Each sinusoid has its share of the signal's power of one; the stray one has 0.02.
    exact = math.sqrt(np.mean(planted**2) + 0.02)
    assert float(rmse) == pytest.approx(exact, rel=1e-5)
    row = result(rmse=[float(rmse)], missing=[np.asarray(missing).tolist()])
    assert report.other(row) == pytest.approx(0.02**0.5, rel=1e-4)


@pytest.mark.parametrize("label", ["1-D", "2-D"])
@pytest.mark.parametrize("kind", spectral_bias.KINDS)
@pytest.mark.parametrize("encoded", [False, True])
def test_networks_have_about_the_same_number_of_parameters(label, kind, encoded):
    signal = spectral_bias.SIGNALS[label]
    network = spectral_bias.network(kind, encoded, signal)
    assert network.parameters == pytest.approx(signal.parameters, rel=0.05)
    dimensions = signal.waves.shape[1]
    n = dimensions * (2 * signal.bands + 1) if encoded else dimensions
    w = network.width
    if kind == "kan":  # eight kernels and a base for each edge
        exact = 9 * (n * w + w * w + w) + 2 * w + 1
    else:
        exact = (n * w + w) + 2 * (w * w + w) + (w + 1)
    assert network.parameters == exact


@pytest.mark.full
def test_sine_networks_start_as_the_paper_says():
    signal = spectral_bias.SIGNALS["2-D"]
    network = spectral_bias.network("sine", False, signal)
    params = network.init(jax.random.key(0))
    bounds = [15.0] + 2 * [math.sqrt(6 / network.width)]
    for layer, bound in zip(params.hidden, bounds, strict=True):
        largest = float(jnp.max(jnp.abs(layer.weight)))
        assert 0.9 * bound < largest <= bound
    # What the paper designs for: values of every layer spread alike.
    points = jax.random.uniform(jax.random.key(1), (500, 2), minval=-1, maxval=1)
    assert 0.1 < float(jnp.std(network.apply(params, points))) < 2


@pytest.mark.full
def test_the_rate_is_the_best_one_and_time_is_shared_out(monkeypatch):
    monkeypatch.setitem(spectral_bias.SIGNALS, "1-D", SMALL)
    args = SpectralBias(steps=80, seeds=2, rates=(1e-7, 1e-2), batch=16)
    first, second = spectral_bias.measure(args, "1-D", "relu", True, 0.5)
    assert first.rate == second.rate == pytest.approx(1e-2)
    assert first.network == "relu + encoding"
    assert len(first.rmse) == len(second.rmse) == 2
    assert first.steps == 80
    assert second.steps == round(80 * 0.5 / first.seconds)
    assert np.mean(first.rmse) < 1


def result(**given):
    plain = dict(
        signal="2-D",
        network="kan",
        parameters=100,
        rate=0.01,
        steps=10,
        seconds=1.0,
        rmse=[0.1, 0.3],
        missing=[[0.1, 0.2], [0.3, 0.4]],
    )
    return Result(**plain | given)


def planted(kan, relu):
    rows = [
        result(rmse=[kan, kan]),
        result(network="relu + encoding", rmse=[relu, relu]),
        result(network="sine", rmse=[0.5, 0.5]),
    ]
    return {"equal steps": rows, "equal time": rows}


def test_the_sentences_follow_from_the_numbers():
    text = report.format_conclusions(planted(0.1, 0.3))
    assert (
        "2-D, equal steps: best is kan (0.1000), then relu + encoding (0.3000)" in text
    )
    assert "has 0.33 of the error" in text
    assert "2-D signal: holds" in text
    text = report.format_conclusions(planted(0.2, 0.3))
    assert "has 0.67 of the error" in text
    assert "DOES NOT HOLD" in text
    text = report.format_conclusions(planted(0.6, 0.3))
    assert "of relu + encoding, the best of encoded MLPs: worse" in text
    assert "of sine, the best of networks of sines: worse" in text


@pytest.mark.slow
def test_the_command_writes_what_it_prints(tmp_path, capsys):
    sizes = "--signals 1-D --kinds kan relu --steps 20 --seeds 2 --batch 32"
    spectral_bias.main([*sizes.split(), "--out", str(tmp_path)])
    record = json.loads((tmp_path / "spectral_bias.json").read_text())
    assert [row["network"] for row in record["results"]["equal time"]] == [
        *("kan", "kan + encoding", "relu", "relu + encoding")
    ]
    printed = capsys.readouterr().out
    assert all(sentence in printed for sentence in record["said"])
    assert (tmp_path / "spectral_bias.png").exists()
    page = report.page(record)
    assert page.count("\n| relu + encoding | ") == 2
    assert f"- {record['said'][0].strip()}" in page
