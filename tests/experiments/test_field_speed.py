"""Which cells are measured, and what their table says; nothing is trained."""

import json

from experiments import field_speed

NUMBERS = {
    "steps": [9, 19],
    "spent": [1.2, 2.0],
    "skipped_ms": 30.0,
    "full_ms": 90.0,
    "survey_ms": 8.0,
}


def test_only_seeds_that_are_missing_are_measured_and_all_are_in_the_table(
    tmp_path, monkeypatch
):
    asked = []

    def measured(capture, preset, seconds, size, seed):
        asked.append((preset, seed))
        moving = [18.0 + seed, None]
        scores = {"psnr": [20 + seed, 22 + 2 * seed], "moving_psnr": moving}
        scores["ssim"] = [0.7 + 0.01 * seed, 0.8]
        return scores | {"alike_db": 60.0} | NUMBERS

    monkeypatch.setattr(field_speed, "measured", measured)
    monkeypatch.setattr(field_speed, "_captures", lambda *_: {"one": None})
    out = tmp_path / "out.json"
    presets = ["nerf-small", "nerf-grid-small+tracks"]
    for seeds in (1, 2, 2):
        command = f"--seconds 1 2 --seeds {seeds} --out {out} --presets"
        field_speed.main([*command.split(), *presets])
    assert asked == [(preset, seed) for seed in (0, 1) for preset in presets]
    page = field_speed.page(json.loads(out.read_text())).splitlines()
    first = "| one | nerf-small | 1 | 2 | 9 | 1 | 20.50 ± 0.71 | 0.705 ± 0.007 |"
    assert page[2] == first + " 18.50 ± 0.71 |  |  |  |  |"
    last = "| one | nerf-grid-small+tracks | 2 | 2 | 19 | 2 | 23.00 ± 1.41 |"
    assert page[5] == last + " 0.800 ± 0.000 |  | 30 | 90 | 8 | 60.0 |"
