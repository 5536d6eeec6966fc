"""Laws of the drawn map: eq. 3 and 4, neutral far away, and the footprint of each kind of contact."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit, logit

from ratslam.grid.config import DrawingConfig, GridConfig
from ratslam.grid.map import ContactLog, draw_occupancy
from tactile.base.se2 import compose
from tests.helpers.grid_world import TIPS, create

SIDE, MIDDLE = 51, 25
PAPER = DrawingConfig(contact=0.8, blob_sd=0.05, edge_sd=0.25, edge_sector=np.pi / 12)
CONFIG = GridConfig(body=0.0, drawing=PAPER)
PRIOR = CONFIG.prior


def marks(count, **some):
    """A log of reports of dead whiskers, with the given fields replaced."""
    plain = ContactLog(
        valid=np.ones(count, bool), contact=np.zeros((count, 4), bool), free=np.zeros((count, 4), bool),
        turning=np.zeros(count, bool), point=np.zeros((count, 4, 2)), wall=np.full((count, 2), np.nan),
    )  # fmt: skip
    return plain._replace(**some)


def touching(count, whisker, point):
    contact, points = np.zeros((count, 4), bool), np.zeros((count, 4, 2))
    contact[:, whisker], points[:, whisker] = True, point
    return {"contact": contact, "point": points}


def drawn(log, path=None, config=CONFIG, side=SIDE):
    count = len(log.valid)
    return draw_occupancy(
        config, create(), side, np.zeros((count, 3)) if path is None else np.asarray(path, float), log
    )


def test_without_contacts_the_map_is_the_prior():
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
def test_contacts_are_drawn_at_the_whisker_tip(pose):
    grid = drawn(marks(1, **touching(1, 2, TIPS[2])), [pose])
    place = compose(np.array(pose), np.array([*TIPS[2], 0.0]))[:2] / CONFIG.cell + MIDDLE
    row, column = np.unravel_index(grid.argmax(), grid.shape)
    assert np.hypot(column - place[0], row - place[1]) < 0.75  # the nearest cell; rows are y


def test_evidence_of_many_reports_adds_up_to_a_limit():
    log = marks(2, **touching(2, 0, [0.25, 0.0]))
    log.valid[1] = False
    twice = marks(3, **touching(3, 0, [0.25, 0.0]))
    twice.valid[1] = False
    once, both = (drawn(m)[MIDDLE, MIDDLE + 5] for m in (log, twice))
    assert logit(both) - logit(PRIOR) == pytest.approx(2 * (logit(once) - logit(PRIOR)))
    many = marks(100, **touching(100, 0, [0.25, 0.0]))
    many.valid[1::2] = False
    assert drawn(many).max() == pytest.approx(expit(CONFIG.drawing.max_log_odds + logit(PRIOR)))


def test_free_whiskers_and_the_body_clear_cells():
    free = marks(200, free=np.ones((200, 4), bool))
    grid = drawn(free)
    middle = np.rint(create().points(np.array([0.5]))[:, 0] / CONFIG.cell + MIDDLE).astype(int)
    assert (grid[middle[:, 1], middle[:, 0]] < 0.05).all()
    assert grid.min() == pytest.approx(expit(-CONFIG.drawing.max_log_odds + logit(PRIOR)))
    assert grid[:, : MIDDLE - 2] == pytest.approx(PRIOR)  # behind the robot the map is unexplored
    assert grid.max() <= PRIOR + 1e-12
    body = drawn(marks(1), config=GridConfig())
    assert np.unravel_index(body.argmin(), body.shape) == (MIDDLE, MIDDLE)
    assert body[MIDDLE, MIDDLE] == pytest.approx(expit(logit(CONFIG.drawing.body) + logit(PRIOR)))


def test_a_wall_is_found_after_many_free_reports():
    """Contacts at a place of 20 free reports: the clamp makes a few contacts sufficient."""
    count, tip = 20, create().points(np.array([0.5]))[0, 0]
    met = 10
    free = np.zeros((count + met, 4), bool)
    free[:count] = True
    log = marks(count + met, free=free, **touching(count + met, 0, tip))
    log.contact[:count] = False
    log.valid[count + 1 :: 2] = False
    row, column = np.rint(tip[::-1] / CONFIG.cell + MIDDLE).astype(int)
    assert drawn(ContactLog(*(rows[:count] for rows in log)))[row, column] < 0.05
    assert drawn(log)[row, column] > 0.5


@pytest.mark.parametrize("angle", np.radians([0, 30, 90, 200]))
def test_a_wall_is_drawn_both_ways_from_the_contact(angle):
    normal = np.array([np.cos(angle), np.sin(angle)])
    log = marks(1, wall=0.3 * normal[None], **touching(1, 1, 0.2 * normal))
    grid = logit(drawn(log)) - logit(PRIOR)
    right, up = np.arange(SIDE)[None] * CONFIG.cell, np.arange(SIDE)[:, None] * CONFIG.cell
    right, up = right - MIDDLE * CONFIG.cell - 0.3 * normal[0], up - MIDDLE * CONFIG.cell - 0.3 * normal[1]
    along, across = up * normal[0] - right * normal[1], right * normal[0] + up * normal[1]
    left, straight = (grid[(sign * along > 0.01) & (np.abs(across) < 0.2)].sum() for sign in (-1, 1))
    assert left == pytest.approx(straight, rel=0.02)
    spread = [(grid * part**2).sum() for part in (along, across)]
    assert spread[0] > 8 * spread[1]
    assert abs((grid * across).sum()) < 0.01 * grid.sum()
    assert grid.max() <= logit(CONFIG.drawing.contact) + 1e-9


def test_a_wall_replaces_the_blobs_of_its_contacts():
    """HIT1, then HIT2 with the wall: no blob is left at HIT1; after ABORT there is one."""
    log = marks(3, **touching(3, 1, TIPS[1]))
    log.valid[2] = False
    abort = drawn(log)
    assert abort.max() > 0.5
    log.contact[1, 2], log.point[1, 2] = True, TIPS[2]
    log.wall[1] = [TIPS[1, 0], 0.0]
    hit = drawn(log)
    alone = marks(1, wall=log.wall[1:2], contact=log.contact[1:2], point=log.point[1:2])
    assert hit == pytest.approx(drawn(alone))


def test_a_wall_keeps_the_blob_of_an_earlier_contact():
    """One that ended before, also where the robot never backs off."""
    log = marks(3, **touching(3, 1, TIPS[1]))
    log.contact[1] = False
    log.wall[2] = [0.25, 0.0]
    path = np.array([[-0.6, 0.0, 0.0], [-0.3, 0.0, 0.0], [0.2, 0.0, 0.0]])
    place = path[0, :2] + TIPS[1]
    column, row = np.rint(place / CONFIG.cell + MIDDLE).astype(int)
    assert drawn(log, path)[row, column] > 0.5


def test_continued_contacts_and_contacts_in_turns_leave_no_blob():
    held = marks(5, **touching(5, 0, [0.25, 0.1]))
    once = marks(1, **touching(1, 0, [0.25, 0.1]))
    assert drawn(held) == pytest.approx(drawn(once))
    turning = marks(5, turning=np.ones(5, bool), **touching(5, 0, [0.25, 0.1]))
    assert drawn(turning) == pytest.approx(PRIOR)


def test_invalid_reports_leave_the_map_unchanged():
    log = marks(4, free=np.ones((4, 4), bool), wall=np.full((4, 2), 0.2), **touching(4, 0, [0.25, 0.1]))
    assert drawn(log._replace(valid=np.zeros(4, bool)), config=GridConfig()) == pytest.approx(PRIOR)


@pytest.mark.parametrize("side", [1, 4, 50])
def test_contacts_outside_the_map_are_dropped(side):
    path = [[3.0, 0.0, 0.0], [-1e3, 1e3, 1.0], [1e9, 0.0, 0.0], [0.0, 0.0, 0.0]]
    log = marks(4, free=np.ones((4, 4), bool), wall=np.tile([0.3, 0.0], (4, 1)), **touching(4, 0, TIPS[0]))
    grid = drawn(log, path, side=side)
    assert grid.shape == (side, side)
    assert np.isfinite(grid).all()
    assert drawn(ContactLog(*(rows[:3] for rows in log)), path[:3], side=side) == pytest.approx(PRIOR)


@given(
    seed=st.integers(0, 1000),
    chances=st.tuples(*[st.floats(1e-6, 1 - 1e-6)] * 3),
    most=st.floats(0.1, 20.0),
    side=st.integers(1, 12),
)
def test_any_contacts_give_a_map_of_probabilities(seed, chances, most, side):
    random, count = np.random.default_rng(seed), 12
    log = ContactLog(
        random.random(count) < 0.8, random.random((count, 4)) < 0.3, random.random((count, 4)) < 0.6,
        random.random(count) < 0.2, random.normal(0, 0.2, (count, 4, 2)),
        np.where(random.random((count, 1)) < 0.5, np.nan, random.normal(0, 0.2, (count, 2))),
    )  # fmt: skip
    contact, free, body = chances
    some = {"contact": contact, "free": free, "body": body, "max_log_odds": most}
    config = GridConfig(body=0.12, drawing=PAPER.model_copy(update=some))
    grid = drawn(log, np.cumsum(random.normal(0, 0.1, (count, 3)), axis=0), config=config, side=side)
    assert ((grid > 0) & (grid < 1)).all()
