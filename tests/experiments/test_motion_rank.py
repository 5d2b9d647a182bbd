"""Motion models at equal rank: the floors, that nothing passes below, a tiny run."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.motion_rank import __main__ as motion_rank
from experiments.motion_rank import report
from experiments.motion_rank import tracks as motion_tracks
from experiments.motion_rank.__main__ import MotionRank, RankResult

TINY = dict(kinds=("rigid",), counts=(2,), seeds=1, steps=30, points=8, times=12)


def test_the_floors_by_hand():
    """Two points on two lines: 3 and 4 long, at right angles, moving out of step."""
    moved = np.zeros((2, 2, 3))
    moved[0, 0, 0] = 3.0  # the first moves at the first time along x
    moved[1, 1, 1] = 4.0  # the second at the second along y
    # Both matrices have the singular values 4 and 3; K = 1 keeps the 4, and the 9 is
    # spread over two points and two times.
    for floor in (motion_rank.time_floor, motion_rank.separable_floor):
        assert floor(moved, 1) == pytest.approx(1.5, rel=1e-12)
        assert floor(moved, 2) == pytest.approx(0, abs=1e-12)
        assert floor(moved, 5) == 0
    # One direction, two lengths and signs: rank one either way.
    moved = np.outer([1.0, -2.0], np.arange(3.0))[..., None] * [1.0, 2.0, 0.0]
    assert motion_rank.time_floor(moved, 1) == pytest.approx(0, abs=1e-12)
    # A circle is one trajectory, but needs two functions of time.
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)[None]
    assert motion_rank.time_floor(circle, 1) == pytest.approx(0, abs=1e-12)
    assert motion_rank.separable_floor(circle, 1) == pytest.approx(0.5**0.5, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("model", list(motion_rank.FLOORS))
def test_no_factorization_passes_below_its_floor_and_a_fit_comes_close(model):
    """The floor is of all values of the factors, the fits are of some."""
    args = MotionRank(**TINY | {"counts": (3,), "steps": 300})
    for count in args.counts:
        tracks = motion_tracks.make("cloth", 8, 12, seed=3)
        row = motion_rank.one_row(args, {}, "cloth", model, count, [tracks])
        assert row.learned[0] > row.floor[0] * (1 - 1e-5)
        if model == "time basis":  # its factors are free numbers, and a network of t
            assert row.learned[0] < 1.2 * row.floor[0] + 0.02
        rng = np.random.default_rng(0)
        anywhere = jnp.asarray(rng.normal(size=(8, 3)), jnp.float32)
        chosen = motion_rank.model_of(model, count)
        params = chosen.init(jax.random.key(1), 8)
        some = chosen.apply(params, anywhere, jnp.linspace(0.0, 1.0, 12))
        some = np.asarray(some, np.float64)
        # What a model says has its own rank: its own floor at K is nothing.
        assert motion_rank.FLOORS[model](some, count) < 1e-5 * np.abs(some).max()


@pytest.mark.parametrize("kind", [k for k in motion_tracks.KINDS if k != "scene"])
def test_tracks_are_reproducible_and_of_one_size(kind):
    tracks = motion_tracks.make(kind, 17, 9, seed=5)
    again = motion_tracks.make(kind, 17, 9, seed=5)
    np.testing.assert_array_equal(tracks.moved, again.moved)
    assert not np.array_equal(
        tracks.moved, motion_tracks.make(kind, 17, 9, seed=6).moved
    )
    assert tracks.rest.shape == (17, 3)
    assert tracks.moved.shape == (17, 9, 3)
    length_sq = np.sum(tracks.moved**2, axis=-1)
    assert np.sqrt(length_sq.mean()) == pytest.approx(0.5, rel=1e-9)
    assert np.abs(tracks.rest).max() <= 1.0


def test_rigid_groups_keep_their_shape():
    rng = np.random.default_rng(0)
    rest, path = motion_tracks.rigid(rng, 12, np.linspace(0, 1, 7))
    for group in np.array_split(np.arange(12), motion_tracks.BLOBS):
        apart = np.linalg.norm(rest[group][:, None] - rest[group], axis=-1)
        for instant in range(7):
            between = path[group][:, None, instant] - path[group][None, :, instant]
            np.testing.assert_allclose(
                np.linalg.norm(between, axis=-1), apart, atol=1e-12
            )


@pytest.mark.slow
def test_a_tiny_run_prints_and_keeps_everything(tmp_path, capsys):
    sizes = "--kinds rigid --counts 4 --seeds 2 --steps 4 --points 8 --times 8"
    words = [*sizes.split(), "--out", str(tmp_path / "out")]
    rows = [motion_rank.RankResult(**row) for row in motion_rank.main(words)["rows"]]
    assert [(row.model, row.count) for row in rows] == [
        *(("time basis", 4), ("separable", 4)),
        *(("moving basis", 4), ("residual", None)),
    ]
    for row in rows:
        assert len(row.learned) == len(row.held_out) == 2
        assert np.isfinite(row.learned + row.held_out).all()
        assert (row.floor is not None) == (row.model in motion_rank.FLOORS)
    printed = capsys.readouterr().out
    assert "without a basis" in printed.lower()
    assert "K=4: the moving basis has" in printed
    record = json.loads((tmp_path / "out" / "motion_rank.json").read_text())
    assert len(record["rows"]) == len(rows)
    assert record["said"]
    assert (tmp_path / "out" / "motion_rank.png").stat().st_size > 10_000
    page = report.page(record)
    of = rows[2].held_out
    assert f"| {np.mean(of):.4f} ± {np.std(of, ddof=1):.4f} |" in page
    assert page.count("\n| rigid | ") == len(rows)


def rows_of(**errors):
    names = {"time": "time basis", "moving": "moving basis", "residual": "residual"}
    return [
        RankResult("k", names[m], None if m == "residual" else 4, [e], [e], None, 0.1)
        for m, e in errors.items()
    ]


def test_the_sentences_follow_the_numbers():
    """Also where they contradict the paper."""
    text = report.format_conclusions(rows_of(time=1.0, moving=0.4, residual=0.3))
    assert "0.40 of the time basis' error" in text
    assert "0.5 shows" in text
    assert "0.75 of the moving basis' error" in text
    assert "the basis is not what helps" in text
    text = report.format_conclusions(rows_of(time=1.0, moving=0.9, residual=1.8))
    assert "0.5 DOES NOT SHOW" in text
    assert "better one" not in text
    assert "better one, on held-out times, at K=4." in report.format_conclusions(
        rows_of(time=0.1, moving=0.9)
    )
    assert "2.00 of the moving basis' error" in text
    assert "the basis helps" in text
