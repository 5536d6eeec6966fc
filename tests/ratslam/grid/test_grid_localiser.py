"""A session in a finished grid map: its surfaces, what whiskers would meet there, and its states."""

import csv
from collections import namedtuple

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.core.estimates import Action, Estimate, GridDrawing, Localisation
from ratslam.grid.config import GridConfig
from ratslam.grid.expectation import CROSSINGS, TIPS, UNEXPLORED, Expectation, Surfaces, draw_surfaces
from ratslam.grid.localiser import CONTACT, FREE, UNEXPLAINED, GridLocaliser, counted_agreement
from ratslam.grid.map import contact_log
from tactile.base.se2 import compose
from tactile.base.types import MotionKind
from tests.helpers.grid_world import LENGTH, create, report
from tests.helpers.grid_world import TIPS as POINTS

CONFIG, SIDE = GridConfig(), 40
FEELERS = create()
COUNT = 12


def drive(start):
    """The surfaces of a drive ahead from a pose [3] that ends at a wall, which the second whisker meets."""
    ahead = np.column_stack([0.03 * np.arange(COUNT), np.zeros((COUNT, 2))])
    contact = np.zeros((COUNT, len(POINTS)), bool)
    contact[-1, 1] = True
    wall = np.full((COUNT, 2), np.nan)
    wall[-1] = [POINTS[1, 0], 0.0]  # straight ahead
    point = np.where(contact[:, :, None], POINTS, 0.0)
    log = contact_log(np.full(COUNT, MotionKind.FORWARD), contact, np.ones_like(contact), point, wall)
    path = compose(np.asarray(start, float), ahead)
    return draw_surfaces(CONFIG, FEELERS, SIDE, path, log), path


def test_a_contact_is_a_surface_and_the_driven_way_is_free():
    made, path = drive([-0.5, 0.1, 0.4])
    met = compose(path[-1], np.array([*POINTS[1], 0.0]))[:2]
    assert made.at(made.evidence, met) > 2
    assert (made.at(made.evidence, path[:, :2]) < -2).all()
    cosine, sine = (made.at(layer, met) for layer in made.direction)
    assert np.arctan2(sine, cosine) / 2 == pytest.approx(0.4 + np.pi / 2 - np.pi, abs=1e-6)


@given(st.tuples(st.integers(-8, 8), st.integers(-8, 8)))
def test_surfaces_move_with_the_path(cells):
    one, _ = drive([0.0, 0.0, 0.0])
    off = np.array(cells) * one.cell
    other, _ = drive([*off, 0.0])
    points = one.centres()[20:60, 20:60]
    np.testing.assert_allclose(
        one.at(one.evidence, points), other.at(other.evidence, points + off), atol=0.71
    )  # a point at the limit of two cells may fall into either


def wall_at(x):
    """Free space up to a wall at x, m, and nothing known beyond it."""
    empty = Surfaces(np.zeros((80, 80)), np.zeros((2, 80, 80)), 0.025)
    across = empty.centres()[..., 0]
    return empty._replace(evidence=np.where(across < x - 0.02, -4.0, np.where(across < x + 0.02, 6.0, 0.0)))


def classes(surfaces, pose):
    return np.asarray(Expectation(surfaces, FEELERS, CONFIG.body).whisker_classes(jnp.asarray([pose])))[0]


def test_a_nearer_wall_is_met_earlier_along_the_whisker():
    crossing = [classes(wall_at(0.13 + share * LENGTH), np.zeros(3))[1] // TIPS for share in (0.3, 0.7, 1.1)]
    assert crossing == sorted(crossing)
    assert len(set(crossing)) == 3
    assert classes(wall_at(0.6), np.zeros(3))[1] // TIPS == CROSSINGS - 1


def test_classes_turn_with_the_map():
    wall = wall_at(0.2)
    turned = wall._replace(evidence=np.rot90(wall.evidence, -1).copy())  # rows are y: turned to the left
    pose = np.array([0.01, 0.02, 0.1])
    left = np.array([-pose[1], pose[0], pose[2] + np.pi / 2])
    assert classes(wall, pose).tolist() == classes(turned, left).tolist()


def test_nothing_is_known_outside_the_map():
    assert (classes(wall_at(0.2), np.array([5.0, 0.0, 0.0])) == UNEXPLORED).all()


def test_contradictions_count_most():
    odds = counted_agreement()["odds"]
    nowhere = (CROSSINGS - 1) * TIPS
    assert odds[CONTACT, nowhere] < -3
    assert odds[:, TIPS:].max() < 3
    assert odds[CONTACT, TIPS + 2] > 0
    assert np.abs(odds[FREE]).max() < 1


NEEDED = 10.0
SAVED = GridDrawing(np.full((4, 4), 0.5), np.zeros(2), 0.1), np.zeros((3, 3))
BLANK = Estimate(*(np.float32(0) for _ in Estimate._fields))._replace(pose=np.zeros(3))
SEARCHING, FOUND, LOST, NOT_THIS_MAP = Localisation


REST = False, np.array([0.1, 0.2, 0.3]), np.diag([1e-4, 4e-4, 1e-2])
Planted = namedtuple("Planted", "share log_odds failed pose covariance", defaults=REST)
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
