"""Laws of the grid filter's map: what it keeps, draws, writes, eq. 3 and 4 in the drawn map; likelihoods and
footprints as formulas in NumPy, and consequences of printed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit, logit

from evaluation.papers.trial_sessions import distinct_cells
from ratslam.core.estimates import Estimate
from ratslam.grid import likelihoods, particles
from ratslam.grid.config import DrawingConfig, GridConfig, LikelihoodConfig
from ratslam.grid.contact_features import contact_features
from ratslam.grid.map import ContactLog, draw_occupancy
from ratslam.methods.grid import GridEvidence
from tactile.base.se2 import compose, wrap
from tactile.base.types import MotionKind
from tests.helpers.grid_world import TIPS, create, filter_of, report

COUNT = 5
BACKEND = filter_of(side=2.55, particles=COUNT)


def steady(pose):
    """Estimate and evidence of a filter with all particles at one pose."""
    weights = np.full(COUNT, 1 / COUNT)
    proof = GridEvidence(np.arange(COUNT, dtype=np.int32), np.tile(pose, (COUNT, 1)), weights, COUNT, 0)
    return Estimate(np.asarray(pose, float), np.zeros(3), -1, -1, 0, False), proof


def random_steps(count, seed=0):
    stream = np.random.default_rng(seed)
    for k in range(count):
        poses, weights = stream.normal(0, 0.3, (COUNT, 3)), stream.dirichlet(np.ones(COUNT))
        ancestor = np.sort(stream.integers(0, COUNT, COUNT)).astype(np.int32)
        estimate = Estimate(weights @ poses, np.zeros(3), -1, -1, 0, False)
        touching = np.flatnonzero(stream.random(4) < 0.4)
        wall = (0.3, 0.2) if len(touching) > 1 else None
        dead = [3] if k % 7 == 0 else []
        seen = report(stream.choice([0.05, -0.05]), touching=touching, wall=wall, dead=dead)
        yield seen, estimate, GridEvidence(ancestor, poses, weights, 1 / (weights**2).sum(), 0)


def map_of_steps(steps, grid=None):
    grid = grid or BACKEND.new_map()
    for step in steps:
        grid.update(*step)
    return grid


def map_of(*reports, pose=(0.0, 0.0, 0.0)):
    return map_of_steps((o, *steady(np.array(pose))) for o in reports)


def test_an_empty_map_is_the_prior():
    grid = BACKEND.new_map()
    assert grid.trajectory().shape == grid.online_trajectory().shape == (0, 3)
    assert grid.closures().shape == (0, 2)
    assert len(grid.graph()) == 0
    assert grid.occupancy() == pytest.approx(BACKEND.config.prior)
    assert grid.occupancy().shape == (51, 51)
    assert grid.feedback() is None


def test_reports_without_evidence_are_not_drawn():
    plain = map_of(report(0.05)).occupancy()
    for silent in (
        report(-0.05, touching=[0, 1], wall=(0.3, 0.0)),
        report(0.05, touching=[0, 1, 2, 3], dead=[0, 1, 2, 3], motion=MotionKind.BACK),
    ):
        assert np.array_equal(map_of(report(0.05), silent).occupancy(), plain)
    for one, same in (
        (report(0.05, touching=[0], dead=[0]), report(0.05, dead=[0])),
        (report(turn=0.1, touching=[0]), report(turn=0.1, dead=[0])),
    ):
        assert np.array_equal(map_of(one).occupancy(), map_of(same).occupancy())


def test_values_that_are_not_finite_are_not_drawn():
    plain = report(0.05, touching=[0, 1], wall=(0.3, 0.1))
    without = report(0.05, touching=[0, 1])
    for odd, same in (
        (plain._replace(point=np.full((4, 2), np.nan)), report(0.05, dead=[0, 1])),
        (plain._replace(wall_point=np.full(2, np.nan)), without),
        (plain._replace(wall_point=np.zeros(2)), without),
    ):
        assert map_of(odd).occupancy() == pytest.approx(map_of(same).occupancy())


def test_the_map_is_drawn_along_the_surviving_paths():
    off = np.tile([0.8, 0.8, 0.0], (COUNT, 1))
    off[2] = [-0.5, 0.0, 0.0]
    estimate, proof = steady(np.zeros(3))
    survivor = proof._replace(poses=off, ancestor=np.full(COUNT, 2, np.int32))
    grid = map_of_steps([(report(0.05, touching=[1]), estimate, survivor), (report(0.05), estimate, proof)])
    assert grid.trajectory()[0] == pytest.approx([-0.5, 0, 0])
    x, y = TIPS[1] + [-0.5, 0]
    probability = grid.occupancy()
    assert probability[round(y / 0.05) + 25, round(x / 0.05) + 25] > 0.45
    assert probability[25 + 10 :, 25 + 10 :] == pytest.approx(BACKEND.config.prior)


def test_files_hold_the_map_and_its_origin(tmp_path):
    grid = map_of(report(0.05, touching=[1, 2]))
    assert grid.occupancy().max() > 0.5
    for name, write in grid.files().items():
        write(tmp_path / name)
    with np.load(tmp_path / "grid.npz") as stored:
        assert set(stored.files) == {"probability", "origin", "cell"}
        probability, origin, cell = stored["probability"], stored["origin"], float(stored["cell"])
    assert np.array_equal(probability, grid.occupancy())
    assert cell == 0.05
    assert origin == pytest.approx(-51 * 0.05 / 2)
    row, column = np.unravel_index(probability.argmax(), probability.shape)
    x, y = origin + (np.array([column, row]) + 0.5) * cell
    assert np.hypot(*(TIPS[1:3] - [x, y]).T).min() < 0.05


@pytest.mark.parametrize("levels", [8 * COUNT, 10**6])
@pytest.mark.parametrize("stop", [0, 1, 30])
def test_a_restored_map_continues_bit_for_bit(monkeypatch, levels, stop):
    monkeypatch.setattr(particles, "MAX_POSES", levels)
    steps = list(random_steps(50))
    whole, second = map_of_steps(steps), map_of_steps(random_steps(3, seed=7))
    second.restore({name: value.copy() for name, value in map_of_steps(steps[:stop]).arrays().items()})
    map_of_steps(steps[stop:], second)
    np.testing.assert_equal(second.arrays(), whole.arrays())
    assert np.array_equal(second.trajectory(), whole.trajectory())
    assert np.array_equal(second.occupancy(), whole.occupancy())
    assert whole.trajectory().shape == (50, 3)


SIDE, MIDDLE = 51, 25
PAPER = DrawingConfig(contact=0.8, blob_sd=0.05, edge_sd=0.25, edge_sector=np.pi / 12)
CONFIG = GridConfig(body=0.0, drawing=PAPER)
PRIOR = CONFIG.prior


def marks(count, whisker=(), tip=0.0, **some):
    """A log of reports of dead whiskers, of which one may touch a point, with the given fields replaced."""
    plain = ContactLog(
        valid=np.ones(count, bool), contact=np.zeros((count, 4), bool), free=np.zeros((count, 4), bool),
        turning=np.zeros(count, bool), point=np.zeros((count, 4, 2)), wall=np.full((count, 2), np.nan),
    )  # fmt: skip
    plain.contact[:, whisker], plain.point[:, whisker] = True, tip
    return plain._replace(**some)


def drawn(log, path=None, config=CONFIG, side=SIDE):
    path = np.zeros((len(log.valid), 3)) if path is None else np.asarray(path, float)
    return draw_occupancy(config, create(), side, path, log)


def test_a_blob_fades_into_the_prior():
    """A chance of 0.8 on a prior of 0.3, of a standard deviation of one cell: 0.632, 0.479, 0.335 at 0, 1
    and 2 cells, and 0.300 far away, where eq. 3 as printed would erase the map."""
    grid = drawn(marks(1, 0, [0.25, 0.1]))
    row, column = MIDDLE + 2, MIDDLE + 5
    assert grid[row, column : column + 3] == pytest.approx([0.632, 0.479, 0.335], abs=5e-4)
    assert grid[row : row + 3, column] == pytest.approx([0.632, 0.479, 0.335], abs=5e-4)
    assert grid[row, column - 2] == pytest.approx(0.335, abs=5e-4)
    far = np.hypot(*np.mgrid[:SIDE, :SIDE] - np.array([row, column])[:, None, None]) > 4.5
    assert grid[far] == pytest.approx(0.3)


@pytest.mark.parametrize("pose", [[0.4, -0.3, 0.0], [0.2, 0.2, 2.0], [-0.5, 0.4, -np.pi / 2]])
def test_contacts_are_drawn_at_the_whisker_tip(pose):
    grid = drawn(marks(1, 2, TIPS[2]), [pose])
    place = compose(np.array(pose), np.array([*TIPS[2], 0.0]))[:2] / CONFIG.cell + MIDDLE
    row, column = np.unravel_index(grid.argmax(), grid.shape)
    assert np.hypot(column - place[0], row - place[1]) < 0.75  # the nearest cell; rows are y


def test_evidence_of_many_reports_adds_up_to_a_limit():
    def after(count):
        log = marks(count, 0, [0.25, 0.0])
        log.valid[1::2] = False
        return logit(drawn(log)[MIDDLE, MIDDLE + 5]) - logit(PRIOR)

    assert after(3) == pytest.approx(2 * after(2))
    assert after(100) == pytest.approx(CONFIG.drawing.max_log_odds)


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


@pytest.mark.parametrize("angle", np.radians([0, 30, 90, 200]))
def test_a_wall_is_drawn_both_ways_from_the_contact(angle):
    normal = np.array([np.cos(angle), np.sin(angle)])
    log = marks(1, 1, 0.2 * normal, wall=0.3 * normal[None])
    at = (np.arange(SIDE) - MIDDLE) * CONFIG.cell
    right, up = at[None] - 0.3 * normal[0], at[:, None] - 0.3 * normal[1]
    off = np.mod(np.arctan2(up, right) - angle, np.pi) - np.pi / 2  # from the wall, in either direction
    away = right**2 + up**2
    shape = np.exp(-away / (2 * 0.25**2) - np.where(away > 1e-12, off, 0.0) ** 2 / (2 * (np.pi / 12) ** 2))
    near = (np.abs(right) <= 0.75 + 1e-9) & (np.abs(up) <= 0.75 + 1e-9)  # three standard deviations
    expected = expit(logit(0.5 + 0.3 * shape * near) + logit(PRIOR))
    assert drawn(log) == pytest.approx(expected, abs=1e-9)


def test_a_wall_replaces_the_blobs_of_its_contacts():
    """HIT1, then HIT2 with the wall: no blob is left at HIT1; after ABORT there is one."""
    log = marks(3, 1, TIPS[1])
    log.valid[2] = False
    abort = drawn(log)
    assert abort.max() > 0.5
    log.contact[1, 2], log.point[1, 2] = True, TIPS[2]
    log.wall[1] = [TIPS[1, 0], 0.0]
    hit = drawn(log)
    alone = marks(1, wall=log.wall[1:2], contact=log.contact[1:2], point=log.point[1:2])
    assert hit == pytest.approx(drawn(alone))


def test_a_wall_keeps_the_blob_of_an_earlier_contact():
    log = marks(3, 1, TIPS[1])
    log.contact[1] = False
    log.wall[2] = [0.25, 0.0]
    path = np.array([[-0.6, 0.0, 0.0], [-0.3, 0.0, 0.0], [0.2, 0.0, 0.0]])
    place = path[0, :2] + TIPS[1]
    column, row = np.rint(place / CONFIG.cell + MIDDLE).astype(int)
    assert drawn(log, path)[row, column] > 0.5


def test_continued_contacts_and_contacts_in_turns_leave_no_blob():
    held = marks(5, 0, [0.25, 0.1])
    once = marks(1, 0, [0.25, 0.1])
    assert drawn(held) == pytest.approx(drawn(once))
    turning = marks(5, 0, [0.25, 0.1], turning=np.ones(5, bool))
    assert drawn(turning) == pytest.approx(PRIOR)


@pytest.mark.parametrize(("motion", "new"), [(MotionKind.FORWARD, False), (MotionKind.OTHER, True)])
def test_a_whisker_that_stays_in_contact_touches_anew_only_when_it_whisks(motion, new):
    touched = np.array([False, True, False, False])
    seen = report(0.1, touching=(0, 1), motion=motion)
    assert contact_features(seen, touched, np.dtype(float))[1].new.tolist() == [True, new, False, False]


@pytest.mark.parametrize("side", [1, 4, 50])
def test_contacts_outside_the_map_are_dropped(side):
    path = [[3.0, 0.0, 0.0], [-1e3, 1e3, 1.0], [1e9, 0.0, 0.0]]
    log = marks(3, 0, TIPS[0], free=np.ones((3, 4), bool), wall=np.tile([0.3, 0.0], (3, 1)))
    assert drawn(log, path, side=side) == pytest.approx(np.full((side, side), PRIOR))


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
    some = dict(zip(("contact", "free", "body"), chances, strict=True)) | {"max_log_odds": most}
    config = GridConfig(body=0.12, drawing=PAPER.model_copy(update=some))
    path = np.cumsum(random.normal(0, 0.1, (count, 3)), axis=0)
    grid = drawn(log, path, config=config, side=side)
    assert grid.shape == (side, side)
    assert ((grid > 0) & (grid < 1)).all()
    invalid = log._replace(valid=np.zeros(count, bool))
    assert drawn(invalid, path, config=config, side=side) == pytest.approx(PRIOR)


LIKELY = LikelihoodConfig()
SEGMENTS = 5
MODELS = {"literal": lambda cell, hits: np.ones(cell.shape[:-1], bool), "distinct": distinct_cells}
EVIDENCE = st.lists(st.floats(-30, 30), min_size=4, max_size=4)
AMONG = st.lists(st.booleans(), min_size=4, max_size=4)

free = jax.jit(likelihoods.free_space, static_argnums=0)
contact = jax.jit(likelihoods.contact, static_argnums=0)
direction = jax.jit(likelihoods.wall_direction, static_argnums=0)
weighing = jax.jit(likelihoods.printed_likelihood, static_argnums=0)


def printed(model, evidence, cell, hits, alive=None):
    """[N] log-likelihoods; all whiskers report unless `alive` is given."""
    alive = np.ones_like(hits) if alive is None else alive
    return weighing(PRIOR, evidence, hits, MODELS[model](cell, hits) & alive[None, :, None])


def by_loops(model, evidence, cell, hits, alive):
    """Eq. 1 and 2 of one particle, written out."""
    chance = expit(evidence + logit(PRIOR))
    product = 1.0
    for whisker in np.flatnonzero(alive):
        ends = tuple(cell[whisker, -1])
        points = range(SEGMENTS)
        if hits[whisker]:
            product *= chance[whisker, -1]
            if model != "literal":
                points = range(SEGMENTS - 1)
        passed = set()
        for k in points:
            here = tuple(cell[whisker, k])
            if model == "distinct" and (here in passed or (hits[whisker] and here == ends)):
                continue
            passed.add(here)
            product *= 1 - chance[whisker, k]
    return product


@pytest.mark.parametrize("model", MODELS)
@given(st.integers(0, 2**32 - 1))
def test_printed_likelihoods_are_the_products_of_eq_1_and_2(model, seed):
    stream = np.random.default_rng(seed)
    evidence = stream.normal(0, 2, (2, 3, SEGMENTS))
    cell = np.cumsum(stream.integers(0, 2, (2, 3, SEGMENTS, 2)), axis=2).astype(float)
    for k, c in np.ndindex(2, 3):  # the same cell, the same evidence
        _, index = np.unique(cell[k, c], axis=0, return_inverse=True)
        evidence[k, c] = evidence[k, c][index.ravel()]
    alive = stream.random(3) < 0.8
    hits = (stream.random(3) < 0.5) & alive
    logs = printed(model, evidence, cell, hits, alive)
    expected = [by_loops(model, evidence[k], cell[k], hits, alive) for k in range(2)]
    assert np.exp(logs) == pytest.approx(expected)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_certain_cells_leave_printed_likelihoods_finite(model, dtype):
    cell = np.arange(SEGMENTS, dtype=dtype)[None, None, :, None].repeat(2, 3)
    for sign in (-1, 1):
        for hits in (False, True):
            logs = printed(model, np.full((1, 1, SEGMENTS), sign * 1e4, dtype), cell, np.array([hits]))
            assert logs.dtype == dtype
            assert np.isfinite(logs).all()


@given(EVIDENCE, AMONG)
def test_points_multiply_chances_of_no_obstacle_and_contacts_those_of_one_or_of_a_surprise(evidence, among):
    chance = expit(np.array(evidence) + logit(LIKELY.unexplored))
    expected = LIKELY.free * np.log1p(-chance) @ np.array(among)
    assert free(LIKELY, np.array([evidence]), np.array(among)) == pytest.approx(expected, rel=1e-6, abs=1e-9)
    surprise = LIKELY.surprise
    expected = LIKELY.contact * np.log(surprise + (1 - surprise) * chance) @ np.array(among)
    found = contact(LIKELY, np.array([evidence]), np.array(among))
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_unexplored_space_carries_almost_no_evidence():
    assert -0.03 < free(LIKELY, np.zeros((1, 17)), np.ones(17, bool))[0] < 0
    assert free(LIKELY, np.zeros((1, 0)), np.zeros(0, bool)) == 0
    assert contact(LIKELY, np.zeros((1, 0)), np.zeros(0, bool)) == 0


@given(st.floats(0, 100), st.floats(-10, 10), st.floats(-10, 10), st.floats(0.01, 9))
def test_a_direction_is_as_likely_as_its_density_and_weight_say(length, at, angle, precision):
    """Von Mises' density, with the weight of the walls."""
    field = length * np.array([[np.cos(at), np.sin(at)]])
    known = length / (length + 0.5)
    density = np.sqrt(2 * np.pi * max(precision, 0.16)) * np.exp(precision * (np.cos(angle - at) - 1))
    expected = np.log(1 - LIKELY.wall * known + LIKELY.wall * known * density)
    found = direction(LIKELY, field, np.array([angle]), jnp.asarray(precision))
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-9)


SIZE = 31
PLACE = st.tuples(*[st.floats(10, 20)] * 2)
ANGLE = st.floats(-10, 10)
FAN = np.pi / 12

blobs = jax.jit(likelihoods.gaussian_blobs, static_argnums=(2, 3))
disc = jax.jit(likelihoods.disc, static_argnums=2)
edge = jax.jit(lambda place, angle: likelihoods.wall_edge(place, angle, 4.0, 1.2, SIZE))
sector = jax.jit(lambda place, angle: likelihoods.wall_sector(place, angle, 5.0, FAN, SIZE))


def offsets(place):
    """To the right [1, SIZE] and up [SIZE, 1] of a place, cells."""
    at = np.arange(SIZE)
    return at[None] - place[0], at[:, None] - place[1]


@given(st.lists(PLACE, min_size=3, max_size=3), st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_blobs_are_sums_of_round_gaussians(places, amounts):
    expected = np.zeros((SIZE, SIZE))
    for place, amount in zip(places, amounts, strict=True):
        right, up = offsets(place)
        expected += amount * np.exp(-(right**2 + up**2) / (2 * 1.5**2))
    found = np.asarray(blobs(np.array([places, places[::-1]]), np.array(amounts), 1.5, SIZE))
    assert found[0] == pytest.approx(expected, abs=1e-12)
    assert not np.any(blobs(np.zeros((4, 0, 2)), np.zeros(0), 1.0, SIZE))


@given(PLACE, st.floats(1.0, 6.0))
def test_a_disc_is_full_inside_and_falls_over_a_cell_at_its_rim(place, radius):
    away = np.hypot(*offsets(place))
    found = disc(np.array([place]), radius, SIZE)[0]
    assert found == pytest.approx(np.clip(radius + 0.5 - away, 0, 1), abs=1e-12)


@given(PLACE, ANGLE)
def test_an_edge_is_a_gaussian_along_the_wall(place, angle):
    right, up = offsets(place)
    along, across = np.cos(angle) * right + np.sin(angle) * up, np.cos(angle) * up - np.sin(angle) * right
    expected = np.exp(-(along**2) / (2 * 4.0**2) - across**2 / (2 * 1.2**2))
    assert edge(np.array([place]), np.array([angle]))[0] == pytest.approx(expected, abs=1e-12)


@given(st.one_of(PLACE, st.just((15.0, 15.0))), ANGLE)
def test_eq_4_draws_the_edge_both_ways(place, angle):
    right, up = offsets(place)
    away, seen = np.hypot(right, up), np.arctan2(up, right)
    off = np.minimum(np.abs(wrap(seen - angle)), np.abs(wrap(seen - angle + np.pi)))
    expected = np.exp(-(away**2) / (2 * 5.0**2) - np.where(away > 0, off, 0.0) ** 2 / (2 * FAN**2))
    assert sector(np.array([place]), np.array([angle]))[0] == pytest.approx(expected, abs=1e-9)
