"""The comparison with and without appearance codes or a transient."""

import dataclasses
import json

import numpy as np
import PIL.Image
import pytest

from experiments import appearance_codes
from nerfies_jax import held_out_codes
from nerfies_jax.capture import synthetic


def test_each_scene_varies_in_one_thing_only():
    exposed = appearance_codes.filmed("exposure", (44, 33))
    passed = appearance_codes.filmed("transient", (44, 33))
    for film in (exposed, passed):
        assert not any(thing.moves() for thing in film.things)
        assert film.size == (44, 33)
    assert exposed.exposure is not None
    assert exposed.transient is None
    assert passed.transient is not None
    assert passed.exposure is None


def test_scored_exposures_are_never_learned_from():
    film = appearance_codes.filmed("exposure", (16, 12))
    small = dataclasses.replace(film, frames=9, supersampling=1)
    capture, _ = synthetic.make(small, 0)
    rows = capture.heldout[capture.camera_ids[capture.heldout] == 1]
    learned = set(capture.appearance_ids[capture.train])
    assert len(rows) == 2
    assert not learned & set(capture.appearance_ids[rows])


def test_psnr_is_of_the_chosen_pixels_of_all_frames():
    truth = np.zeros((2, 4, 5, 3), np.uint8)
    color = np.zeros((2, 4, 5, 3), np.float32)
    where = np.zeros((2, 4, 5), bool)
    where[0, :2, 0] = True
    color[0, 0, 0] = 0.2  # one of two chosen pixels
    color[1] = 1.0  # not chosen
    expected = -10 * np.log10(0.2**2 / 2)
    assert abs(appearance_codes._psnr(color, truth, where) - expected) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "keys"),
    [
        (
            "exposure",
            {
                "without codes: PSNR (dB)",
                "codes of neighbors: PSNR (dB)",
                "codes fitted to the left half: PSNR (dB)",
            },
        ),
        (
            "transient",
            {
                "static part: PSNR where it stood (dB)",
                "without the effect: PSNR elsewhere (dB)",
                "static part: PSNR held out (dB)",
            },
        ),
    ],
)
def test_a_short_run_writes_figures_and_a_picture(scene, keys, tmp_path, monkeypatch):
    monkeypatch.setattr(held_out_codes, "MOST_STEPS", 2)  # of each code
    whole = appearance_codes.filmed

    def short(*of):
        return dataclasses.replace(whole(*of), frames=12, supersampling=1)

    monkeypatch.setattr(appearance_codes, "filmed", short)
    out = tmp_path / "out"
    arguments = ["--scene", scene, "--steps", "3", "--size", "24", "18"]
    appearance_codes.main([*arguments, "--out", str(out)])
    record = json.loads((out / "figures.json").read_text())
    assert record["scene"] == scene
    assert record["steps"] == 3
    assert keys <= set(record["figures"])
    assert np.isfinite(list(record["figures"].values())).all()
    page = appearance_codes.page(record)
    for name, (value,) in record["figures"].items():
        assert f"| {name} | {value:.2f} |" in page
    record["figures"] = {name: [1.0, 2.0, 3.0] for name in keys}
    assert f"| {min(keys)} | 2.00 ± 1.00 |" in appearance_codes.page(record)
    with PIL.Image.open(out / "picture.png") as picture:
        assert min(picture.size) > 240
