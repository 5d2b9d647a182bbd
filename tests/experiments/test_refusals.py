"""What a command cannot do is said in words, with exit code two."""

import importlib
import pathlib
import re

import pytest

from nerfies_jax.capture import synthetic
from nerfies_jax.runs import platform
from tests import scenes

# OUT is a folder that is not there.
TABLE = [
    ("benchmark", "OUT --out OUT", "OUT: no such file or folder"),
    ("benchmark", "--suite moba --methods nerfies", "there are full, no-basis"),
    ("benchmark", "--methods nerfies", "name one with --suite"),
    ("benchmark", "--suite moba --preset nerfies", "has presets of its own"),
    ("benchmark", "--seeds 0", "at least 1"),
    ("benchmark", "--seconds 0", "above 0"),
    ("benchmark", "--suite fields --set color=red --out OUT", "no field 'color'"),
    ("compare", "OUT", "two or more"),
    ("speed", "effects --presets nerf", "no effect to be measured"),
    ("speed", "effects --presets nothing", "no such preset"),
    ("speed", "effects --at 1", "--at"),
    ("speed", "effects --repeats 0", "--repeats"),
    ("speed", "effects --rays 0", "--rays"),
    ("preprocess", "OUT", "OUT"),
    ("preprocess", "OUT --scene fast", "OUT and --scene fast: name a folder or"),
    ("preprocess", "--scene tiny --masks OUT", "no such folder of masks"),
    ("reconstruct", "--scene tiny --tracks OUT", "OUT: No such file or directory"),
    ("render", "OUT --max-side 0", "--max-side 0: draw at least one pixel"),
    ("export", "nowhere ply", "not a run folder"),
    ("export", "nowhere ply --frames 1", "a sequence has at least two"),
    ("export", "nowhere ply --frames 2 --time 0.5", "exclude each other"),
    ("export", "nowhere splat --time 2", "runs from 0 to 1"),
    ("export", "nowhere spz --out OUT.ply", "such a file ends in .spz"),
    ("export", "nowhere tracks --points 0", "track at least one"),
    ("export", "nowhere exr --path spiral --frames 2", "has its own number of frames"),
    ("export", "nowhere colmap --path sway", "--path is not for colmap, but for path"),
    ("hard_cases", "--topics kitchen", "choose from rotations"),
    ("hard_cases", "--cases nothing", "no such case; there are screw"),
    ("hard_cases", "--numbers 0", "at least 1"),
    ("hard_cases", "--document nowhere.md", "no such file, or not both"),
    ("inspect_scene", "OUT", "OUT"),
    ("make_scene", "OUT --frames 1", "frames=1 must be at least 2"),
    ("make_scene", "OUT --set color=red", "no field 'color'"),
    ("prepare", "video a.mp4 OUT --fps nan", "fps=nan must be positive"),
    ("prepare", "video a.mp4 OUT --frames 2", "frames=2 must be at least 3"),
    ("reconstruct", "--out OUT --factor 2", "make_scene"),
    ("reconstruct", "--out OUT --max-side 2", "make_scene"),
    ("reconstruct", "--out OUT --heldout 2", "make_scene"),
    ("reconstruct", "--quality best --seconds 9", "short for --seconds 1200"),
    ("reconstruct", "--resume", "--out"),
    ("reconstruct", "--resume --out OUT", "not a run folder"),
    ("render", "nowhere --interpolation cubic", "is for --knots"),
    ("render", "nowhere --still-below -1", "not negative"),
    ("render", "nowhere --frames 5", "--path heldout has its own number of frames"),
    ("render", "nowhere --path orbit --frames 0", "render at least one"),
    ("results", "nothing", "no page 'nothing'"),
    ("results", "--measured a.json", "name that page"),
    ("speed", "raster many", "GAUSSIANS@WIDTHxHEIGHT"),
    ("speed", "raster --reference OUT", "OUT: no such file"),
]
ROOM = pathlib.Path(__file__).resolve().parents[2] / "experiments"


@pytest.mark.parametrize(("name", "words", "refusal"), TABLE)
def test_what_cannot_be_is_refused(name, words, refusal, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(platform, "start_jax", lambda *_, **__: None)
    monkeypatch.setattr(platform, "CACHE", tmp_path / "cache")
    monkeypatch.setitem(synthetic.PRESETS, "tiny", scenes.TINY_SCENE)
    monkeypatch.chdir(tmp_path)
    module = f"experiments.{name}{'.__main__' * (ROOM / name).is_dir()}"
    out = str(tmp_path / "out")
    with pytest.raises(SystemExit) as stop:
        importlib.import_module(module).main(words.replace("OUT", out).split())
    assert stop.value.code == 2
    error = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert refusal.replace("OUT", out) in error
    assert "Traceback" not in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("compare a b", "--out FOLDER"),
        ("preprocess --scene fast", "--out FOLDER"),
        *(("inspect_scene", f"--{name} FILE") for name in ("image", "findings")),
    ],
)
def test_results_of_earlier_measurements_are_kept(
    name, words, tmp_path, monkeypatch, capsys
):
    """Before anything is measured; none of these commands adds to what is there."""
    from experiments import compare

    monkeypatch.setattr(platform, "start_jax", lambda *_, **__: None)
    monkeypatch.setattr(compare, "read", lambda *_: None)
    chart = tmp_path / "earlier" / "numbers.png"
    chart.parent.mkdir()
    chart.write_text("measured for hours")
    words = words.replace("FILE", str(chart)).replace("FOLDER", str(chart.parent))
    name, *more = name.split()
    module = f"experiments.{name}{'.__main__' * (ROOM / name).is_dir()}"
    with pytest.raises(SystemExit) as stop:
        importlib.import_module(module).main([*more, *words.split()])
    assert stop.value.code == 2
    error = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert re.search("already there|not empty", error)
    assert [path.read_text() for path in chart.parent.iterdir()] == [
        "measured for hours"
    ]
