"""What frames far apart in time say of the depths of one."""

import dataclasses

import numpy as np

from nerfies_jax.evidence import depths, sweep, view_set
from nerfies_jax.evidence.optical_flow import StillFit
from tests.evidence import films


def fits_of(depth):
    ones = np.ones(depth.shape[1:])
    return [
        (view, StillFit(0 * ones, 9 * ones, 1 / one, 50 * ones), ones > 0, 0.1)
        for view, one in enumerate(depth)
    ]


def test_only_what_was_gone_at_other_times_is_looked_through():
    film = films.film(frames=4)
    views = view_set.in_time_order(dataclasses.replace(film, train=np.arange(4)))
    card = film.depths[0] < films.FAR
    there = depths.looked_through(views, fits_of(film.depths))
    assert not np.any(there)
    gone = film.depths.copy()
    gone[1:] = films.FAR
    through = depths.looked_through(views, fits_of(gone))[0]
    assert through[card].mean() > 0.9
    assert not through[~card].any()


def test_the_better_half_counts_what_is_known():
    cost = np.array([[3.0, np.nan, np.nan], [1.0, 5.0, np.nan], [8.0, np.nan, np.nan]])
    better = sweep._better_half(cost)
    np.testing.assert_array_equal(better, [2.0, 5.0, np.nan])
