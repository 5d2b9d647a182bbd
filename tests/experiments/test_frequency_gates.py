"""The comparison of gates: what is trained, and what the table says of it."""

import json

import numpy as np
import pytest

from experiments import frequency_gates
from experiments.frequency_gates import Fitted, FrequencyGates, GateSetting

TINY = FrequencyGates(steps=20, seeds=2, most=(0.5,), pixels=8, width=4, bands=2)
NONE = GateSetting("none", None)


@pytest.mark.slow
def test_descent_shuts_the_gates_and_ascent_opens_them():
    falling = frequency_gates.fit(GateSetting("learned", 0.5), TINY)
    rising = frequency_gates.fit(GateSetting("ascent", 0.5), TINY)
    assert falling.opening.shape == (2, 2, 20)
    np.testing.assert_allclose(falling.opening[..., 0], 0.5, rtol=1e-6)
    np.testing.assert_allclose(rising.opening[..., 0], 0.5, rtol=1e-6)
    assert np.all(np.diff(falling.opening) < 0)
    assert np.all(np.diff(rising.opening) > 0)


@pytest.mark.full
def test_every_arm_starts_from_the_same_networks_and_without_a_loss_has_no_gate():
    plain = frequency_gates.fit(NONE, TINY)
    fixed = frequency_gates.fit(GateSetting("fixed", 0.5), TINY)
    assert plain.opening is None
    np.testing.assert_allclose(fixed.opening, 0.5, rtol=1e-6)
    np.testing.assert_allclose(plain.psnr[:, 0], fixed.psnr[:, 0], atol=1e-5)
    assert np.all(plain.psnr[:, -1] > plain.psnr[:, 0])
    assert np.all(plain.psnr[:, -1] != fixed.psnr[:, -1])


def planted():
    """Three seeds: no loss, a learned gate that helps, a fixed one that may."""
    steps = 21
    fall = np.linspace(0.5, 0.1, steps)
    opening = np.broadcast_to(np.stack([fall, fall / 2]), (3, 2, steps))
    still = np.full((3, 2, steps), 0.5)
    last = {
        "none": [20.0, 21, 22],
        "learned": [21.0, 22.1, 22.9],
        "fixed": [19, 23, 22],
    }
    psnr = {
        name: np.linspace(np.full(3, 10.0), np.array(ends, float), steps).T
        for name, ends in last.items()
    }
    return {
        NONE: Fitted(psnr["none"], None),
        GateSetting("learned", 0.1): Fitted(psnr["learned"], opening),
        GateSetting("fixed", 0.1): Fitted(psnr["fixed"], still),
    }


def test_gains_are_paired_by_seed():
    rows = frequency_gates.numbers(planted())
    assert rows["none"]["gain"] == rows["none"]["gain_error"] == 0
    learned = rows["learned 0.1"]
    assert learned["psnr"] == pytest.approx(22)
    assert learned["gain"] == pytest.approx(1)
    # Gains of 1, 1.1 and 0.9 deviate by 0.1; three seeds.
    assert learned["gain_error"] == pytest.approx(0.1 / 3**0.5)
    assert learned["wavelet_mid"] == pytest.approx(0.3)
    assert learned["fourier_end"] == pytest.approx(0.05)
    assert rows["none"]["wavelet_end"] is None


def test_the_sentences_follow_from_the_numbers():
    rows = frequency_gates.numbers(planted())
    text = frequency_gates.format_conclusions(rows)
    assert "learned 0.1: the gates only fall, to 0.200 (wavelet) and 0.200" in text
    assert "better than no spectral loss: learned 0.1." in text
    assert "within 2 standard errors of no spectral loss: fixed 0.1." in text
    assert "Highest PSNR: learned 0.1, 22.00 dB" in text
    rows["learned 0.1"]["wavelet_end"] = 0.4
    assert "DO NOT only fall" in frequency_gates.format_conclusions(rows)
    lines = frequency_gates.table(rows).splitlines()
    assert len(lines) == 4
    assert lines[2].split()[2:5] == ["22.00", "0.95", "+1.00"]


@pytest.mark.slow
def test_the_command_writes_what_it_prints(tmp_path, capsys):
    sizes = "--steps 10 --seeds 2 --most 0.5 --pixels 8 --width 4 --bands 2"
    frequency_gates.main([*sizes.split(), "--device", "cpu", "--out", str(tmp_path)])
    record = json.loads((tmp_path / "frequency_gates.json").read_text())
    assert len(record["rows"]) == 7
    printed = capsys.readouterr().out
    assert all(sentence in printed for sentence in record["said"])
    assert (tmp_path / "frequency_gates.png").exists()
    name, row = next(iter(record["rows"].items()))
    assert f"| {name} | {row['psnr']:.2f} |" in frequency_gates.page(record)
