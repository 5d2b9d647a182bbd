"""The ablation's protocol against closed forms; the command on a tiny scene."""

import dataclasses
import json
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from experiments import (
    ablate,
    ablate_arms,
    ablate_picture,
    ablate_protocol,
    representations,
    settings,
)
from experiments.ablate_arms import ARMS, CLAIMS, MEASURES
from experiments.ablate_protocol import Followed
from nerfies_jax import scene
from nerfies_jax.capture import synthetic
from nerfies_jax.effects.effect import Effect
from nerfies_jax.measure import clock
from nerfies_jax.training.model import Rendering
from tests import scenes

SHIFT = np.float32([0.012, 0.0, 0.016])  # 0.02 long


@pytest.fixture(scope="module")
def filmed():
    film = dataclasses.replace(scenes.TINY_FILM, heldout_every=2)
    capture, truth = synthetic.make(film)
    return capture, truth, ablate_protocol.known(capture, truth, 2, 5)


def test_the_known_paths_are_those_of_points_seen_at_the_start(filmed):
    capture, truth, known = filmed
    assert known.path.shape == (5, len(capture.train), 3)
    assert len(known.rows) == 2
    assert set(known.rows) <= set(capture.heldout)
    assert np.all(np.diff(capture.times[known.moments]) > 0)
    assert known.start == len(known.moments) // 2
    assert known.seen[:, known.start].all()
    for point, seen in zip(known.path, known.seen, strict=True):
        (track,) = np.flatnonzero((truth.track_canonical == point[0]).all(axis=1))
        np.testing.assert_array_equal(point, truth.track_world[track])
        np.testing.assert_array_equal(seen, truth.track_seen[track][known.moments])


def test_a_scaled_capture_has_its_paths_in_scene_units(filmed):
    capture, truth, known = filmed
    other = dataclasses.replace(capture, scale=2.0, centre=(0.1, 0.2, -0.3))
    found = ablate_protocol.known(other, truth, 2, 5)
    expected = 2 * (known.path - np.float32([0.1, 0.2, -0.3]))
    np.testing.assert_allclose(found.path, expected, atol=1e-6)


def test_the_truth_of_another_capture_is_refused(filmed):
    capture, truth, _ = filmed
    with pytest.raises(ValueError, match="other frames than the capture"):
        ablate_protocol.known(capture, truth._replace(ids=truth.ids[1:]), 2, 5)


def test_tracks_are_scored_by_their_distance_at_all_instants_but_the_start(filmed):
    known = filmed[2]._replace(seen=np.ones_like(filmed[2].seen))
    found = np.ones(known.seen.shape, bool)
    found[0, 4:6] = False
    right = Followed(known.path, found, 0.1, 0.2)
    later = found[:, 1:].size  # all but one column
    numbers = ablate_protocol.score_tracks(known, right)
    assert numbers["track_error"] == 0
    assert numbers["track_correct"] == 1
    assert numbers["track_lost"] == pytest.approx(2 / later)
    assert (numbers["drift"], numbers["strain"]) == (0.1, 0.2)
    wrong = right._replace(path=known.path + SHIFT)
    numbers = ablate_protocol.score_tracks(known, wrong)
    assert numbers["track_error"] == pytest.approx(0.02, rel=1e-4)
    assert numbers["track_correct"] == 0
    # What cannot be seen is not scored.
    half = known.seen.copy()
    half[:, ::2] = False
    wrong.path[:, ::2] = 9.0
    numbers = ablate_protocol.score_tracks(known._replace(seen=half), wrong)
    assert numbers["track_error"] == pytest.approx(0.02, rel=1e-4)
    away = np.linalg.norm(known.path - known.path[:, 3:4], axis=-1)
    away = np.delete(away, 3, axis=1)
    assert ablate_protocol.still_error(known) == pytest.approx(away.mean(), rel=1e-5)
    assert away.mean() > 1e-3
    nothing = ablate_protocol.score_tracks(known, None)
    assert np.isnan(list(nothing.values())).all()


def test_pictures_are_scored_as_a_whole_and_where_things_move(filmed):
    capture, _, known = filmed

    def renderer(_, view):
        row = int(np.argmin(abs(capture.times[known.rows] - float(view.time))))
        row = known.rows[row]
        still = ~capture.moving[row]
        colour = capture.images[row].astype(np.float32) / 255
        # A fifth away from the truth, on the side where it is not clipped.
        away = np.where(colour > 0.5, -0.2, 0.2)
        colour = np.where(still[..., None], colour + away, colour)
        depth = capture.depths[row] + 0.125 * still
        return Rendering(np.float32(colour), still, np.float32(depth))

    _, numbers = ablate_protocol.score_pictures(renderer, None, capture, known)
    share = 1 - capture.moving[known.rows].mean(axis=(1, 2))
    psnr = -10 * np.log10(share * 0.2**2)
    assert numbers["psnr"] == pytest.approx(psnr.mean(), abs=1e-3)
    assert numbers["moving_psnr"] == 100  # the cap of equal pictures
    assert numbers["ssim"] < 0.99
    assert numbers["depth_median"] == pytest.approx(0.125, abs=1e-6)
    rmse = 0.125 * np.sqrt((~capture.moving[known.rows]).mean())
    assert numbers["depth_rmse"] == pytest.approx(rmse, rel=1e-4)
    assert numbers["moving_depth_median"] == numbers["moving_depth_rmse"] == 0


@pytest.mark.parametrize("lost_at", [None, 2])
def test_points_are_followed_through_a_warp_in_closed_form(
    filmed, monkeypatch, lost_at
):
    """x + d(x) = x / s(t) - v t: a point is scaled by s and moved, in field units."""
    capture, _, known = filmed
    facts = types.SimpleNamespace(centre=(0.1, -0.2, 0.3), scale=4.0)
    times = capture.times[known.moments]
    velocity = jnp.asarray([0.3, 0.1, -0.2])

    def displace(params, point, moment):
        moved = point / (1 + moment.time) - params * moment.time - point
        if lost_at is None:
            return moved
        return jnp.where(abs(moment.time - times[lost_at]) < 1e-3, jnp.nan, moved)

    made = types.SimpleNamespace(
        effects=(Effect("warp", displace=displace),),
        codes_at=lambda params, view: {},
        displace=displace,
    )
    monkeypatch.setattr(scene, "field", lambda spec, facts: made)
    state = types.SimpleNamespace(params=velocity, step=jnp.int32(5))
    followed = ablate_protocol.follow_fields(None, facts, state, capture, known)

    start = 4.0 * (known.path[:, 3] - np.float32(facts.centre))
    template = start / (1 + times[3]) - np.asarray(velocity) * times[3]
    for column, time in enumerate(times):
        place = (template + np.asarray(velocity) * time) * (1 + time)
        place = place / 4.0 + np.float32(facts.centre)
        if column == lost_at:
            place = known.path[:, 3]
        np.testing.assert_allclose(followed.path[:, column], place, atol=3e-6)
        assert followed.found[:, column].all() == (column != lost_at)
    if lost_at is None:
        stretch = np.sqrt(np.mean(3 * np.log(1 / (1 + times)) ** 2))
        assert followed.strain == pytest.approx(stretch, rel=1e-4)
        still = 4.0 * (capture.points.position - np.float32(facts.centre))
        moved = still / (1 + times[:, None, None]) - still
        moved = moved - np.asarray(velocity) * times[:, None, None]
        drift = np.linalg.norm(moved - moved.mean(0), axis=-1).mean() / 4.0
        assert followed.drift == pytest.approx(drift, rel=1e-4)


def test_a_field_without_a_warp_follows_nothing(filmed):
    capture, _, known = filmed
    kind = representations.of_preset("t-nerf-small")
    spec = kind.presets["t-nerf-small"]
    facts = kind.facts_of(capture, spec)
    assert ablate_protocol.follow_fields(spec, facts, None, capture, known) is None


def numbers_of(**pairs):
    """{(arm, seed): numbers} with the given values of one arm for each seed."""
    blank = dict.fromkeys(MEASURES, 0.0)
    return {
        (arm.replace("_", "-"), seed): blank | {"track_error": x, "moving_psnr": -x}
        for arm, values in pairs.items()
        for seed, x in enumerate(values)
    }


@pytest.mark.parametrize(
    ("nerfies", "translation", "says"),
    [
        ([0.010, 0.012, 0.011], [0.020, 0.023, 0.020], "shows"),
        ([0.020, 0.023, 0.020], [0.010, 0.012, 0.011], "the opposite shows"),
        ([0.010, 0.030, 0.011], [0.020, 0.013, 0.020], "no effect beyond the spread"),
        ([0.010], [0.020], "for, but one seed"),
        ([0.030], [0.020], "against, but one seed"),
        ([0.010, np.nan], [0.020, 0.030], "not measured"),
    ],
)
def test_a_claim_is_held_against_the_spread_over_seeds(nerfies, translation, says):
    numbers = numbers_of(nerfies=nerfies, translation=translation)
    found = ablate_arms.verdicts(numbers)
    assert {verdict.claim.worse for verdict in found} == {"translation"}
    # A lower error and a higher PSNR are both a gain.
    by_measure = {verdict.measure: verdict for verdict in found}
    for name in ("track_error", "moving_psnr"):
        assert by_measure[name].says.startswith(says)
    verdict = by_measure["track_error"]
    gains = np.subtract(translation, nerfies)
    np.testing.assert_allclose(verdict.gain, gains.mean(), rtol=1e-12)
    if len(gains) > 1 and np.isfinite(gains).all():
        interval = scipy.stats.ttest_1samp(gains, 0).confidence_interval(0.95)
        width = (interval.high - interval.low) / 2
        assert verdict.half_width == pytest.approx(width, rel=1e-9)
    assert says in ablate_arms.claims_text(found)


def test_only_seeds_that_both_arms_have_are_compared():
    numbers = numbers_of(nerfies=[0.01, 0.01, 0.5], translation=[0.02, 0.03])
    verdict = ablate_arms.verdicts(numbers)[0]
    assert verdict.gain == pytest.approx(0.015)


def test_the_table_has_a_row_for_each_arm_and_says_what_still_points_score():
    numbers = numbers_of(nerfies=[0.01, 0.03], static=[np.nan])
    text = ablate_arms.table(numbers, 0.0272)
    lines = text.splitlines()
    assert lines[1].startswith("nerfies")
    assert "0.0200" in lines[1]
    assert "0.0141" in lines[2]  # the standard deviation
    assert lines[3].startswith("static")
    assert " still " in lines[3]
    assert lines[-1] == "still: 0.0272 scene units"


def test_arms_differ_from_nerfies_only_in_what_their_name_says():
    job = types.SimpleNamespace(asked=ablate.Ablate(steps=600))
    specs = {name: ablate.Job.spec(job, arm) for name, arm in ARMS.items()}
    whole = specs["nerfies"]
    assert None not in (whole.elastic, whole.background, whole.warp)
    assert (specs["static"].warp, specs["t-nerf"].warp) == (None, None)
    changed = {
        "no-elastic": {"elastic": None},
        "no-background": {"background": None},
        "coarse-to-fine": {"warp": dataclasses.replace(whole.warp, anneal_steps=300)},
        "translation": {"warp": dataclasses.replace(whole.warp, kind="translation")},
    }
    for name, fields in changed.items():
        assert specs[name] == dataclasses.replace(whole, **fields)
    shared = ("steps", "rays", "sampling", "template", "coarse", "extent", "rate")
    for spec in specs.values():
        assert all(getattr(spec, x) == getattr(whole, x) for x in shared)
    for claim in CLAIMS:
        assert {claim.better, claim.worse} <= set(ARMS)
        assert set(claim.measures) <= set(MEASURES)


def test_the_picture_shows_how_far_points_are_from_where_they_should_be(filmed):
    capture, _, known = filmed
    shown = ablate_picture.shown_row(known, capture)
    row = known.rows[shown]
    colour = {"a": capture.images[row]}

    def apart(path):
        picture = ablate_picture.draw(
            capture,
            known,
            colour,
            {"a": capture.depths[row]},
            {"a": path},
            {"a": ""},
            shown,
        )
        assert picture.shape[1] > 4 * ablate_picture.WIDTH
        return np.sum(np.all(picture == ablate_picture.APART, axis=-1))

    assert apart(known.path) == 0
    near, far = apart(known.path + SHIFT), apart(known.path + 4 * SHIFT)
    assert 0 < near < far
    assert apart(None) == apart(np.repeat(known.path[:, 3:4], known.path.shape[1], 1))


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """The command on the tiny scene, with nothing global changed by it."""
    monkeypatch.setattr(settings, "start_jax", lambda *_: None)
    monkeypatch.setattr(settings, "CACHE", tmp_path / "cache")
    monkeypatch.setitem(synthetic.PRESETS, "tiny", scenes.TINY_FILM)
    monkeypatch.setattr(ablate, "_measure_compiling", lambda: None)
    return ["--scene", "tiny", "--out", str(tmp_path / "out"), "--frames", "1"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--arms", "nerfy"], "there are static, t-nerf"),
        (["--seeds", "0"], "positive"),
        (["--budget", "-1"], "positive"),
        (["--scene", "moon"], "no such built-in scene"),
        (["--set", "colour=red"], "no field 'colour'"),
    ],
)
def test_a_wrong_setting_is_one_line_and_exit_code_two(tiny, capsys, arguments, words):
    with pytest.raises(SystemExit) as stop:
        ablate.main([*tiny, *arguments])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


@pytest.mark.slow
def test_the_command_measures_arms_and_goes_on_where_it_stopped(
    tiny, tmp_path, capsys, monkeypatch
):
    small = "rays=8 sampling.coarse=4 sampling.fine=0 template.depth=1 template.width=8"
    tiny += ["--steps", "3", "--set", *small.split()]
    out = tmp_path / "out"
    ablate.main([*tiny, "--arms", "static"])
    ablate.main([*tiny, "--arms", "static", "nerfies"])
    assert "[1/2]" not in capsys.readouterr().err.split("[1/1]")[1]
    metrics = clock.read_metrics(out / "ablation.json")
    assert np.isnan(metrics["static.track_error"].value)
    for name in MEASURES:
        assert np.isfinite(metrics[f"nerfies.{name}"].value), name
    # Three steps move nothing.
    still = metrics["still.track_error"].value
    assert metrics["nerfies.track_error"].value == pytest.approx(still, rel=0.05)
    about = json.loads((out / "ablation.json").read_text())["about"]
    assert about["claims"][0]["says"].endswith("no spread to hold it against")
    assert (out / "ablation.png").stat().st_size > 1000

    def no_training(*_):
        raise AssertionError("trained an arm that was finished")

    monkeypatch.setattr(ablate.Job, "_train", no_training)
    ablate.main([*tiny, "--arms", "static", "nerfies"])
    assert "A static field cannot show" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stop:
        ablate.main([*tiny, "--arms", "static", "--steps", "4"])
    assert stop.value.code == 2
    assert "made with other settings" in capsys.readouterr().err
    (out / "static-0.npz").unlink()
    with pytest.raises(SystemExit):
        ablate.main([*tiny, "--arms", "static"])
    assert "remove it to run it again" in capsys.readouterr().err
    # With no time left nothing is begun, and what is finished is reported.
    monkeypatch.setattr(ablate.Job, "_over", lambda *_: True)
    ablate.main([*tiny, "--arms", "nerfies", "d-nerf"])
    assert "1 arms are left" in capsys.readouterr().out
    assert jax.config.jax_enable_compilation_cache
