"""What an ablation's numbers say, against SciPy's own test."""

import math

import numpy as np
import pytest
import scipy.stats

from experiments.ablate import measures, suites, verdicts
from experiments.ablate.arms import FIELDS
from experiments.ablate.measures import MEASURES


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
    judged = verdicts.verdicts(numbers, FIELDS.claims)
    assert {verdict.claim.worse for verdict in judged} == {"translation"}
    # A lower error and a higher PSNR are both a gain.
    by_measure = {verdict.measure: verdict for verdict in judged}
    for name in ("track_error", "moving_psnr"):
        assert by_measure[name].says.startswith(says)
    verdict = by_measure["track_error"]
    gains = np.subtract(translation, nerfies)
    np.testing.assert_allclose(verdict.gain, gains.mean(), rtol=1e-12)
    if len(gains) > 1 and np.isfinite(gains).all():
        interval = scipy.stats.ttest_1samp(gains, 0).confidence_interval(0.95)
        width = (interval.high - interval.low) / 2
        assert verdict.half_width == pytest.approx(width, rel=1e-9)
    assert says in verdicts.claims_text(judged)


def test_only_seeds_that_both_arms_have_are_compared():
    numbers = numbers_of(nerfies=[0.01, 0.01, 0.5], translation=[0.02, 0.03])
    verdict = verdicts.verdicts(numbers, FIELDS.claims)[0]
    assert verdict.gain == pytest.approx(0.015)


def test_the_table_has_a_row_for_each_arm_and_says_what_still_points_score():
    numbers = numbers_of(nerfies=[0.01, 0.03], static=[np.nan])
    text = verdicts.table(numbers, 0.0272)
    lines = text.splitlines()
    assert lines[1].startswith("nerfies")
    assert "0.0200" in lines[1]
    assert "0.0141" in lines[2]  # the standard deviation
    assert lines[3].startswith("static")
    assert " still " in lines[3]
    assert lines[4] == "still: 0.0272 scene units"


def test_columns_without_numbers_are_left_out_with_their_legend():
    numbers = numbers_of(nerfies=[0.01], static=[0.02])
    names = ("depth_median", "moving_psnr", "strain", "gaussians")
    for row in numbers.values():
        row |= dict.fromkeys(names, math.nan)
    text = verdicts.table(numbers, math.nan)
    for heading in ("depth", "strain", "Gauss.", "still"):
        assert heading not in text
    assert "PSNR" in text
    shown = measures.shown(numbers)
    assert not set(names) & set(shown)
    legend = measures.legend(shown)
    assert "strain" not in legend
    assert "scikit-image" in legend


@pytest.mark.parametrize("name", suites.KEPT)
def test_claims_are_about_arms_and_measures_that_there_are(name):
    suite = suites.named(name)
    for claim in suite.claims:
        assert {claim.better, claim.worse} <= set(suite.arms)
        assert set(claim.measures) <= set(MEASURES)
    assert set(suite.pictured) <= set(suite.arms)
    # Every arm is part of a claim, but those that only stand beside.
    judged = {arm for claim in suite.claims for arm in (claim.better, claim.worse)}
    if suite.claims:  # of the presets nothing is claimed
        assert set(suite.arms) - judged <= {"d-nerf", "static"}


def test_depths_that_are_estimated_of_a_real_capture_judge_nothing():
    scores = dict.fromkeys(measures.KEYS.values(), 1.0)
    exact = measures.quality(scores, exact=True)
    assert exact == dict.fromkeys(measures.KEYS, 1.0)
    estimated = measures.quality(scores, exact=False)
    known = {name for name, value in estimated.items() if value == 1}
    assert set(measures.KEYS) - known == {n for n in measures.KEYS if "depth" in n}
    assert set(measures.quality({}, exact=True)) == set(measures.KEYS) <= set(MEASURES)
