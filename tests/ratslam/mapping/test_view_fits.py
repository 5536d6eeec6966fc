"""How well views fit at other keyframes, and the odds that are learned from it."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.mapping.appearance import SAME_ID_LOG_ODDS
from ratslam.mapping.carried_solution import learn_odds, view_fits
from tests.ratslam.mapping.map_cases import LAP, drive, new_map
from tests.ratslam.mapping.track_cases import FIT, laps, places


def test_every_view_is_compared_with_all_but_those_of_nearly_the_same_time():
    graph = drive(new_map(), {}, last=LAP).keyframes()
    fits, time = view_fits(graph), np.arange(LAP)
    assert fits.shape == (LAP, 1, LAP)
    near = np.abs(time[:, None] - time) <= graph.guard
    assert np.array_equal(np.isneginf(fits[:, 0]), near)
    assert (fits[:, 0][~near] == -SAME_ID_LOG_ODDS).all()  # every id is seen once


@pytest.mark.parametrize("told", [FIT, 0.0])
def test_odds_are_as_large_as_the_views_tell(told):
    """Views that fit at their places and not elsewhere tell much; views that are alike everywhere nothing."""
    ground = laps(places(None, 0))
    fits = np.where(np.isfinite(ground.fits), np.sign(ground.fits) * told, -np.inf)
    odds = learn_odds(ground._replace(fits=fits.astype(np.float32)))
    assert (odds.of(told) - odds.of(-told) > 2) == (told > 0)
    assert (np.diff(odds.odds) >= 0).all()
    assert (odds.expected > 0.5) == (told > 0)
