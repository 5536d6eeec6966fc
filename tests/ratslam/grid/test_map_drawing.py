"""Laws of the map as it is drawn: eq. 3 and 4, neutral far away, which contacts are drawn as what, and how
marks are fused."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit, logit

from ratslam.grid.config import DrawingConfig, GridConfig
from ratslam.grid.map_drawing import FUSIONS, Marks, draw
from tactile.base.se2 import compose
from tests.helpers.grid_world import TIPS, create

SIDE, MIDDLE = 51, 25
PAPER = DrawingConfig(contact=0.8, blob_sd=0.05, edge_sd=0.25, edge_fan=np.pi / 12)
CONFIG = GridConfig(body=0.0, drawing=PAPER)
PRIOR = CONFIG.prior


def marks(count, **some):
    """Reports of whiskers that are all dead, but for what is said."""
    plain = Marks(
        told=np.ones(count, bool), contact=np.zeros((count, 4), bool), free=np.zeros((count, 4), bool),
        turning=np.zeros(count, bool), point=np.zeros((count, 4, 2)), wall=np.full((count, 2), np.nan),
    )  # fmt: skip
    return plain._replace(**some)


def touching(count, whisker, point):
    contact, points = np.zeros((count, 4), bool), np.zeros((count, 4, 2))
    contact[:, whisker], points[:, whisker] = True, point
    return {"contact": contact, "point": points}


def drawn(told, path=None, config=CONFIG, side=SIDE):
    count = len(told.told)
    return draw(
        config, create(), side, np.zeros((count, 3)) if path is None else np.asarray(path, float), told
    )


def test_nothing_felt_is_the_prior():
    assert drawn(marks(0)) == pytest.approx(PRIOR)
    assert drawn(marks(3)) == pytest.approx(PRIOR)


def test_a_blob_fades_into_the_prior():
    """A chance of 0.8 on a prior of 0.3, of a standard deviation of one cell: 0.632, 0.479, 0.335 at 0, 1
    and 2 cells, and 0.300 far away, where eq. 3 as printed would erase the map."""
    grid = drawn(marks(1, **touching(1, 0, [0.25, 0.1])))
    row, column = MIDDLE + 2, MIDDLE + 5
    assert grid[row, column : column + 3] == pytest.approx([0.632, 0.479, 0.335], abs=5e-4)
    assert grid[row : row + 3, column] == pytest.approx([0.632, 0.479, 0.335], abs=5e-4)
    assert grid[row, column - 2] == pytest.approx(0.335, abs=5e-4)
    far = np.hypot(*np.mgrid[:SIDE, :SIDE] - np.array([row, column])[:, None, None]) > 4.5
    assert grid[far] == pytest.approx(0.3)


@pytest.mark.parametrize("pose", [[0.4, -0.3, 0.0], [0.2, 0.2, 2.0], [-0.5, 0.4, -np.pi / 2]])
def test_contacts_lie_where_the_robot_felt_them(pose):
    grid = drawn(marks(1, **touching(1, 2, TIPS[2])), [pose])
    place = compose(np.array(pose), np.array([*TIPS[2], 0.0]))[:2] / CONFIG.cell + MIDDLE
    row, column = np.unravel_index(grid.argmax(), grid.shape)
    assert np.hypot(column - place[0], row - place[1]) < 0.75  # the nearest cell; rows are y


def test_evidence_of_many_reports_adds_up_to_a_limit():
    told = marks(2, **touching(2, 0, [0.25, 0.0]))
    told.told[1] = False
    twice = marks(3, **touching(3, 0, [0.25, 0.0]))
    twice.told[1] = False
    once, both = (drawn(m)[MIDDLE, MIDDLE + 5] for m in (told, twice))
    assert logit(both) - logit(PRIOR) == pytest.approx(2 * (logit(once) - logit(PRIOR)))
    many = marks(100, **touching(100, 0, [0.25, 0.0]))
    many.told[1::2] = False
    assert drawn(many).max() == pytest.approx(expit(CONFIG.drawing.most + logit(PRIOR)))


def test_free_whiskers_and_the_body_are_found_empty():
    free = marks(200, free=np.ones((200, 4), bool))
    grid = drawn(free)
    middle = np.rint(create().points(np.array([0.5]))[:, 0] / CONFIG.cell + MIDDLE).astype(int)
    assert (grid[middle[:, 1], middle[:, 0]] < 0.05).all()
    assert grid.min() == pytest.approx(expit(-CONFIG.drawing.most + logit(PRIOR)))
    assert grid[:, : MIDDLE - 2] == pytest.approx(PRIOR)  # behind the robot nothing is known
    assert grid.max() <= PRIOR + 1e-12
    body = drawn(marks(1), config=GridConfig())
    assert np.unravel_index(body.argmin(), body.shape) == (MIDDLE, MIDDLE)
    assert body[MIDDLE, MIDDLE] == pytest.approx(expit(logit(CONFIG.drawing.body) + logit(PRIOR)))


def test_a_wall_is_found_after_much_that_was_free():
    """Contacts where 20 reports found nothing: the clamp lets few of them win."""
    count, tip = 20, create().points(np.array([0.5]))[0, 0]
    met = 10
    free = np.zeros((count + met, 4), bool)
    free[:count] = True
    told = marks(count + met, free=free, **touching(count + met, 0, tip))
    told.contact[:count] = False
    told.told[count + 1 :: 2] = False
    row, column = np.rint(tip[::-1] / CONFIG.cell + MIDDLE).astype(int)
    assert drawn(Marks(*(rows[:count] for rows in told)))[row, column] < 0.05
    assert drawn(told)[row, column] > 0.5


@pytest.mark.parametrize("angle", np.radians([0, 30, 90, 200]))
def test_a_wall_is_drawn_both_ways_from_the_contact(angle):
    normal = np.array([np.cos(angle), np.sin(angle)])
    told = marks(1, wall=0.3 * normal[None], **touching(1, 1, 0.2 * normal))
    grid = logit(drawn(told)) - logit(PRIOR)
    right, up = np.arange(SIDE)[None] * CONFIG.cell, np.arange(SIDE)[:, None] * CONFIG.cell
    right, up = right - MIDDLE * CONFIG.cell - 0.3 * normal[0], up - MIDDLE * CONFIG.cell - 0.3 * normal[1]
    along, across = up * normal[0] - right * normal[1], right * normal[0] + up * normal[1]
    left, straight = (grid[(sign * along > 0.01) & (np.abs(across) < 0.2)].sum() for sign in (-1, 1))
    assert left == pytest.approx(straight, rel=0.02)
    spread = [(grid * part**2).sum() for part in (along, across)]
    assert spread[0] > 8 * spread[1]
    assert abs((grid * across).sum()) < 0.01 * grid.sum()
    assert grid.max() <= logit(CONFIG.drawing.contact) + 1e-9


def test_a_wall_takes_the_place_of_the_blobs_that_told_of_it():
    """HIT1, then HIT2 with the wall: no blob is left at HIT1; after ABORT there is one."""
    told = marks(3, **touching(3, 1, TIPS[1]))
    told.told[2] = False
    abort = drawn(told)
    assert abort.max() > 0.5
    told.contact[1, 2], told.point[1, 2] = True, TIPS[2]
    told.wall[1] = [TIPS[1, 0], 0.0]
    hit = drawn(told)
    alone = marks(1, wall=told.wall[1:2], contact=told.contact[1:2], point=told.point[1:2])
    assert hit == pytest.approx(drawn(alone))


def test_a_wall_takes_no_blob_of_an_earlier_touch():
    """One that ended before, also where the robot never backs off."""
    told = marks(3, **touching(3, 1, TIPS[1]))
    told.contact[1] = False
    told.wall[2] = [0.25, 0.0]
    path = np.array([[-0.6, 0.0, 0.0], [-0.3, 0.0, 0.0], [0.2, 0.0, 0.0]])
    place = path[0, :2] + TIPS[1]
    column, row = np.rint(place / CONFIG.cell + MIDDLE).astype(int)
    assert drawn(told, path)[row, column] > 0.5


def test_old_contacts_and_those_while_turning_leave_no_blob():
    held = marks(5, **touching(5, 0, [0.25, 0.1]))
    once = marks(1, **touching(1, 0, [0.25, 0.1]))
    assert drawn(held) == pytest.approx(drawn(once))
    turning = marks(5, turning=np.ones(5, bool), **touching(5, 0, [0.25, 0.1]))
    assert drawn(turning) == pytest.approx(PRIOR)


def test_reports_that_tell_nothing_leave_nothing():
    told = marks(4, free=np.ones((4, 4), bool), wall=np.full((4, 2), 0.2), **touching(4, 0, [0.25, 0.1]))
    assert drawn(told._replace(told=np.zeros(4, bool)), config=GridConfig()) == pytest.approx(PRIOR)


@pytest.mark.parametrize("side", [1, 4, 50])
def test_what_lies_outside_is_forgotten(side):
    path = [[3.0, 0.0, 0.0], [-1e3, 1e3, 1.0], [1e9, 0.0, 0.0], [0.0, 0.0, 0.0]]
    told = marks(4, free=np.ones((4, 4), bool), wall=np.tile([0.3, 0.0], (4, 1)), **touching(4, 0, TIPS[0]))
    grid = drawn(told, path, side=side)
    assert grid.shape == (side, side)
    assert np.isfinite(grid).all()
    assert drawn(Marks(*(rows[:3] for rows in told)), path[:3], side=side) == pytest.approx(PRIOR)


# Fusions

MOST = CONFIG.drawing.most
EVIDENCE = st.lists(st.floats(-MOST, MOST), min_size=1, max_size=9).map(np.array)
CHANCE = st.floats(1e-6, 1 - 1e-6)


def fused(name, there, *chances):
    """Evidence, log-odds beyond the prior, after marks of so many chances."""
    for chance in chances:
        there = FUSIONS[name].fuse(there, np.asarray(chance), CONFIG)
    return there


def by(fusion, **some):
    return GridConfig(body=some.pop("body", 0.0), drawing=PAPER.model_copy(update={"fusion": fusion, **some}))


def test_every_fusion_that_can_be_asked_for_is_there():
    assert set(get_args(DrawingConfig.model_fields["fusion"].annotation)) == set(FUSIONS)


@pytest.mark.parametrize("name", ["log_odds", "max"])
@given(there=EVIDENCE, chance=CHANCE)
def test_neutral_marks_change_nothing_and_others_pull_their_way(name, there, chance):
    assert np.array_equal(fused(name, there, 0.5), there)
    moved = fused(name, there, chance) - there
    assert (moved * np.sign(chance - 0.5) >= 0).all()


@given(there=st.floats(0.02, 0.9), chance=st.floats(0.04, 0.96))
def test_fusions_are_what_they_say_of_probabilities(there, chance):
    prior = logit(PRIOR)
    evidence, alone = logit(there) - prior, expit(logit(chance) + prior)

    def after(name):
        return expit(fused(name, np.array([evidence]), chance)[0] + prior)

    product = there * chance / (there * chance + (1 - there) * (1 - chance))
    assert after("literal") == pytest.approx(np.clip(product, 1e-3, 1 - 1e-3), abs=1e-12)
    assert after("average") == pytest.approx((there + alone) / 2, abs=1e-12)
    assert after("max") == pytest.approx(alone if abs(logit(chance)) > abs(evidence) else there, abs=1e-12)


@given(st.lists(st.floats(0.3, 0.7), min_size=2, max_size=4), st.randoms(use_true_random=False))
def test_added_evidence_knows_no_order(chances, random):
    shuffled = random.sample(chances, len(chances))
    there = np.zeros(1)
    assert fused("log_odds", there, *chances) == pytest.approx(fused("log_odds", there, *shuffled), abs=1e-12)
    assert np.abs(fused("log_odds", there, *chances)).max() < MOST  # else the limit makes an order


@given(EVIDENCE, st.lists(st.floats(0.04, 0.96), min_size=1, max_size=5))
def test_the_strongest_evidence_stays_and_counts_once(there, chances):
    strong = fused("max", there, *chances)
    assert np.array_equal(fused("max", strong, *chances), strong)
    most = np.maximum(np.abs(there), np.abs(logit(np.array(chances))).max())
    assert np.abs(strong) == pytest.approx(most)


@pytest.mark.parametrize("name", FUSIONS)
@given(
    seed=st.integers(0, 1000),
    chances=st.tuples(CHANCE, CHANCE, CHANCE),
    most=st.floats(0.1, 20.0),
    side=st.integers(1, 12),
)
def test_whatever_is_felt_and_fused_is_a_map_of_chances(name, seed, chances, most, side):
    random, count = np.random.default_rng(seed), 12
    told = Marks(
        random.random(count) < 0.8, random.random((count, 4)) < 0.3, random.random((count, 4)) < 0.6,
        random.random(count) < 0.2, random.normal(0, 0.2, (count, 4, 2)),
        np.where(random.random((count, 1)) < 0.5, np.nan, random.normal(0, 0.2, (count, 2))),
    )  # fmt: skip
    contact, free, body = chances
    config = by(name, contact=contact, free=free, most=most)
    config = config.model_copy(
        update={"body": 0.12, "drawing": config.drawing.model_copy(update={"body": body})}
    )
    grid = drawn(told, np.cumsum(random.normal(0, 0.1, (count, 3)), axis=0), config=config, side=side)
    assert ((grid > 0) & (grid < 1)).all()


@pytest.mark.parametrize("wall", [np.nan, 0.2])
def test_eq_3_and_4_as_printed_erase_the_map(wall):
    """One contact takes all of it to nothing but its own place; every other fusion leaves what is far."""
    told = marks(1, wall=np.array([[wall, 0.0]]), **touching(1, 0, [0.2, 0.0]))
    row, column = MIDDLE, MIDDLE + 4
    far = np.hypot(*np.mgrid[:SIDE, :SIDE] - np.array([row, column])[:, None, None]) > 24
    printed = drawn(told, config=by("literal"))
    assert printed[far].max() <= 0.005
    assert printed[row, column] == pytest.approx(expit(logit(0.8) + logit(PRIOR)))
    for name in FUSIONS.keys() - {"literal"}:
        assert drawn(told, config=by(name))[far] == pytest.approx(PRIOR)
        assert drawn(told, config=by(name))[row, column] > PRIOR


def test_fusions_differ_by_how_marks_of_one_place_count():
    told = marks(9, **touching(9, 0, [0.2, 0.0]))
    told.told[1::2] = False
    chances = {name: drawn(told, config=by(name))[MIDDLE, MIDDLE + 4] for name in FUSIONS}
    once = expit(logit(0.8) + logit(PRIOR))
    assert chances["max"] == pytest.approx(once)
    assert chances["average"] == pytest.approx(once + (PRIOR - once) / 2**5)
    assert chances["log_odds"] == pytest.approx(expit(MOST + logit(PRIOR)))
    assert chances["literal"] == pytest.approx(expit(5 * logit(0.8) + logit(PRIOR)))
