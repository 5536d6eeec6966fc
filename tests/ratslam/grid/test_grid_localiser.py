"""The states of a session in a finished grid map, from planted evidence."""

from __future__ import annotations

import csv
from typing import NamedTuple

import numpy as np
import pytest

from ratslam.core.estimates import Action, Estimate, GridDrawing, Localisation
from ratslam.grid.localiser import UNEXPLAINED, GridLocaliser
from tests.helpers.grid_world import report

NEEDED = 10.0
SAVED = GridDrawing(np.full((4, 4), 0.5), np.zeros(2), 0.1), np.zeros((3, 3))
BLANK = Estimate(*(np.float32(0) for _ in Estimate._fields))._replace(pose=np.zeros(3))
SEARCHING, FOUND, LOST, NOT_THIS_MAP = Localisation


class Planted(NamedTuple):
    share: float
    log_odds: float
    failed: bool = False
    pose: np.ndarray = np.array([0.1, 0.2, 0.3])
    covariance: np.ndarray = np.diag([1e-4, 4e-4, 1e-2])


SURE, TORN, WEAK, FAILED = Planted(1.0, 11.0), Planted(0.9, 11.0), Planted(1.0, 4.0), Planted(1.0, -6.0, True)


def states(*planted, known=False):
    localiser = GridLocaliser(*SAVED, NEEDED, known)
    for evidence in planted:
        localiser.update(report(0.05), BLANK, evidence)
    return localiser, localiser.states().tolist()


@pytest.mark.parametrize(
    ("planted", "expected"),
    [
        ([WEAK, SURE, WEAK], [SEARCHING, FOUND, FOUND]),
        ([TORN], [SEARCHING]),  # another pose is nearly as likely
        ([SURE, Planted(0.3, 12.0), SURE], [FOUND, LOST, FOUND]),
        ([SURE, FAILED, WEAK], [FOUND, LOST, LOST]),
        ([FAILED] * UNEXPLAINED, [SEARCHING] * (UNEXPLAINED - 1) + [NOT_THIS_MAP]),
        ([FAILED] * UNEXPLAINED + [Planted(1.0, 6.0)], [SEARCHING] * 3 + [NOT_THIS_MAP, SEARCHING]),
        ([FAILED] * 3 + [SURE] + [FAILED] * 3, [SEARCHING] * 3 + [FOUND] + [LOST] * 3),
    ],
)
def test_states(planted, expected):
    assert states(*planted)[1] == expected


def test_a_known_start_is_believed_until_it_is_contradicted():
    assert states(WEAK, FAILED, known=True)[1] == [FOUND, LOST]


def test_the_mass_is_a_probability_and_half_where_evidence_just_suffices():
    localiser, _ = states(Planted(1.0, NEEDED))
    assert localiser.localisation().mass == 0.5
    for share, odds in ((0.0, 1e9), (1.0, -1e9), (1.0, 1e9)):
        assert 0 <= states(Planted(share, odds))[0].localisation().mass <= 1


def test_the_estimate_is_that_of_the_map():
    localiser = GridLocaliser(*SAVED, NEEDED)
    found = localiser.update(report(0.05), BLANK, SURE)
    assert found.pose.tolist() == SURE.pose.tolist()
    assert found.spread.tolist() == pytest.approx([0.01, 0.02, 0.1])
    assert (bool(found.lost), int(found.place), int(found.action)) == (False, -1, Action.NONE)


def test_a_restored_session_is_the_same_and_only_in_its_own_map(tmp_path):
    localiser, _ = states(WEAK, SURE, FAILED)
    again = GridLocaliser(*SAVED, NEEDED)
    again.restore(localiser.arrays())
    for one in (localiser, again):
        one.update(report(0.05), BLANK, SURE)
        one.files()["localisation.csv"](tmp_path / f"{one is again}.csv")
    assert (tmp_path / "True.csv").read_bytes() == (tmp_path / "False.csv").read_bytes()
    with (tmp_path / "True.csv").open() as file:
        assert [row["state"] for row in csv.DictReader(file)] == ["searching", "found", "lost", "found"]
    with pytest.raises(ValueError, match="another map"):
        GridLocaliser(SAVED[0], np.ones((3, 3)), NEEDED).restore(localiser.arrays())
