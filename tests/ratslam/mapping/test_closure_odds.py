"""Acceptance of closure sequences by their odds; scan, vote and null of scores equal slow sums."""

from functools import cache
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping import acceptance, odometry_scan
from ratslam.mapping.acceptance import MIN_LOG_ODDS, AcceptByEvidence
from ratslam.mapping.appearance import ViewAppearance
from ratslam.mapping.config import KeyframeMapConfig
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.mapping.optimizer import CalibrationPrior
from tactile.base.se2 import compose, correct_heading, integrate, wrap
from tests.ratslam.mapping import map_cases as cases
from tests.ratslam.mapping.map_cases import CELL, LAP, TRUE, add, drive, new_graph, new_map, same, sequence

FALSE = sequence(LAP - 20, 0, 4, 4.0)
"""The beginning of the lap, seen too early: within the reach of the heading bias, and wrong."""
BOTH, DECOYS = FALSE | TRUE, {}
for start in range(50, 185, 7):  # each finds the place of 40 keyframes before, where odometry never leads
    DECOYS |= sequence(start, start - 40, 4, 4.0)
OPEN, ACCEPTED = Verdict.OPEN, Verdict.ACCEPTED


@cache
def loop_map():
    """The map of the true sequence; tests share it and do not change it."""
    return drive(new_map(), TRUE)


def verdicts(map):
    """Verdict and log odds of every sequence."""
    return {int(row[5]): (Verdict(int(row[7])), float(row[9])) for row in map.candidates()}


def outcome(map):
    return [verdict for verdict, _ in verdicts(map).values()]


def test_an_alias_that_the_covariance_allows_is_refused():
    """Evidence and covariance accept the alias, and then refuse the true sequence that contradicts it."""
    after = drive(new_map(), BOTH)
    assert outcome(drive(new_map(lambda graph: AcceptByEvidence()), BOTH)) == [ACCEPTED, OPEN]
    assert outcome(after) == [OPEN, ACCEPTED]
    assert np.hypot(*(after.trajectory()[LAP + 5] - after.trajectory()[5])[:2]) < CELL


def test_false_sequences_raise_the_evidence_that_is_needed():
    strong, longer = sequence(LAP + 2, 2, 12, 2.0), sequence(LAP + 2, 2, 30, 4.0)
    alone, among = drive(new_map(), strong), drive(new_map(), DECOYS | strong)
    assert outcome(alone) == [ACCEPTED]
    assert set(outcome(among)) == {OPEN}
    assert len(among.closures()) == 0
    (_, before), *_, (_, after) = *verdicts(alone).values(), *verdicts(among).values()
    assert after < min(before, MIN_LOG_ODDS)
    *refused, last = outcome(drive(new_map(), DECOYS | longer))
    assert (set(refused), last) == ({OPEN}, ACCEPTED)


def test_a_pending_verdict_has_its_odds_in_the_table():
    table = drive(new_map(), sequence(LAP + 2, 2, 6, 0.5) | {190: (90, 5.0)}).candidates()
    single, pending = table[table[:, 5] == 0], table[table[:, 5] == 1]
    assert np.isnan(single[:, 9]).all()  # never judged: a sequence has two members or more
    assert (pending[:, 7] == OPEN).all()
    assert len(set(pending[:, 9])) == 1
    assert -np.inf < pending[0, 9] < MIN_LOG_ODDS
    accepted = loop_map().candidates()
    assert len(loop_map().closures()) == len(TRUE)
    assert (accepted[:, 7] == ACCEPTED).all()
    assert (accepted[:, 9] >= MIN_LOG_ODDS).all()
    by_evidence = drive(new_map(lambda graph: AcceptByEvidence()), TRUE)
    assert np.isnan(by_evidence.candidates()[:, 9]).all()


CARRIED = {"may_be_carried": True, "break_length": 8, "break_score": 30.0}
CONTRADICTION = sequence(130, 20, 14, 5.0)
CASES = {
    "loop": (DECOYS | BOTH, {}),
    "carried": (DECOYS | BOTH | CONTRADICTION, CARRIED),
    "selected": (BOTH | CONTRADICTION, {"may_be_carried": True, "select_every": 25}),
}


def moments():
    """Cases and keyframes at which a map is restored; most for the soak."""
    often = ("loop", LAP + 7), ("carried", LAP + 7), ("carried", 136)
    every = product(CASES, (60, 136, 155, LAP - 18, LAP + 7))
    return [pytest.param(*one, marks=() if one in often else pytest.mark.soak) for one in every]


@pytest.mark.parametrize(("case", "at"), moments())
def test_a_restored_map_continues_bit_for_bit_and_asking_for_the_final_map_changes_nothing(case, at):
    recalled, settings = CASES[case]
    whole = drive(new_map(**settings), recalled, last=at)
    again = new_map(**settings)
    again.restore(whole.arrays())
    assert same(whole, again)
    for last in (LAP + 15, LAP + 60):
        drive(whole, recalled, first=whole.state.unmerged.count, last=last)
        drive(again, recalled, first=again.state.unmerged.count, last=last)
        again.trajectory(), again.closures(), again.files()
        assert same(whole, again)
    assert np.array_equal(whole.trajectory(), again.trajectory())
    assert np.array_equal(whole.candidates(), again.candidates(), equal_nan=True)


def test_a_long_contradiction_cuts_the_odometry_of_a_robot_that_may_be_carried_and_no_evidence_joins_it():
    carried, never = (drive(new_map(**settings), CONTRADICTION, last=150) for settings in (CARRIED, {}))
    assert np.flatnonzero(carried.arrays()["graph/cut"] >= 0).size == 1
    assert outcome(carried) == [ACCEPTED]
    assert (never.arrays()["graph/cut"] < 0).all()
    # Without cuts, it would be accepted of a robot that is never carried, if it had evidence enough.
    for (at, length), carried in product([(130, 14), (110, 30)], [False, True]):
        map = new_map(may_be_carried=carried, break_length=99)
        assert outcome(drive(map, sequence(at, 20, length, 20.0))) == [OPEN if carried else ACCEPTED]


def test_an_undone_sequence_stays_undone():
    found = new_map()
    found.restore(loop_map().arrays())
    found.undo(0)
    assert len(found.closures()) == 0
    assert verdicts(found)[0][0] == Verdict.UNDONE
    drive(found, TRUE | sequence(LAP + 60, 60, 12, 4.0), first=LAP + 60, last=LAP + 80)
    assert outcome(found) == [Verdict.UNDONE, ACCEPTED]


def test_recall_gets_the_calibration_of_the_map_and_poses_follow_it_until_a_closure_fixes_them():
    found, without = loop_map(), drive(new_map(turn_error_sd=0.0), TRUE)
    for map in (found, without):
        graph = map.state.unmerged
        assert map.feedback()[1:3] == (graph.bias, graph.turn_error)
    assert found.feedback().turn_error != 0.0 == without.feedback().turn_error
    graph, log = drive(new_map(), {}, last=50).state.unmerged, ClosureLog()
    belief = CalibrationPrior(0.05, 0.01, -0.2, 0.02)
    moved = correct_heading(graph.motion.rows[1:], graph.length.rows[1:], belief.bias, belief.turn_error)
    for now in (belief, belief._replace(bias=0.0, turn_error=0.0)):
        cases.with_log(graph, log).adopt_prior(now)
        assert (graph.bias, graph.turn_error) == (belief.bias, belief.turn_error)
        assert graph.pose.rows[1:] == pytest.approx(integrate(moved, graph.pose.rows[0]), abs=1e-9)
        log.judge(log.add(Candidate(40, 3, 0, 1.0, 5.0), False), ACCEPTED)
    assert graph.prior.turn_error == 0.0


SIDE, GUARD, ANGLE, TURN_SD = 0.2, 5, 0.15, 0.08
CONFIG, STRAIGHT = KeyframeMapConfig(turn_error_sd=TURN_SD), KeyframeMapConfig(turn_error_sd=0.0)
BIASES = np.linspace(-odometry_scan.BIAS_SPAN, odometry_scan.BIAS_SPAN, odometry_scan.BIAS_STEPS) / SIDE
TURNS = np.linspace(-odometry_scan.TURN_SPAN, odometry_scan.TURN_SPAN, odometry_scan.TURN_STEPS) * TURN_SD
ALL = np.arange(odometry_scan.BIAS_STEPS * odometry_scan.TURN_STEPS)
seeds = st.integers(0, 1000)


def path(seed, count):
    """[count] rows of motion (3), length and turn; length and turn are at least those of the motion."""
    stream = np.random.default_rng(seed)
    motion = stream.normal([0.3 * SIDE, 0, 0.05], [0.1 * SIDE, 0.05 * SIDE, 0.3], (count, 3))
    motion[0] = 0
    more = stream.uniform(1, 1.3, (count, 2))
    return np.column_stack([motion, np.hypot(*motion[:, :2].T) * more[:, 0], abs(motion[:, 2]) * more[:, 1]])


def graph_of(rows, cut=None, config=CONFIG):
    graph = new_graph(SIDE, GUARD, ViewAppearance(6, 6 * ANGLE), turn_error_sd=config.turn_error_sd)
    extend(graph, rows)
    if cut is not None:
        graph.cut.rows[cut] = 0
    return graph


def extend(graph, rows):
    for row in rows:
        add(graph, row[:3], np.zeros(3), row[3], row[4])


def scanned(graph, *member):
    """[G] log ratios at all points of the grid."""
    return odometry_scan.OdometryScan(graph).log_ratios(graph, np.array(member), ALL)


def reckoned(graph, calibration):
    """[N, 3] the path with this bias and turn error, one motion after another."""
    poses = [np.zeros(3)]
    for motion, length in zip(graph.motion.rows[1:], graph.length.rows[1:], strict=True):
        poses.append(compose(poses[-1], correct_heading(motion, length, *calibration)))
    return np.array(poses)


def propagated(graph, poses, i, j):
    """[3, 3] covariance of the motion from i to j in the frame of the path, step by step."""
    covariance = np.zeros((3, 3))
    for k in range(i + 1, j + 1):
        dx, dy = (poses[k] - poses[k - 1])[:2]
        onwards = np.array([[1, 0, -dy], [0, 1, dx], [0, 0, 1.0]])
        covariance = onwards @ covariance @ onwards.T + np.diag(graph.variances()[k])
    return covariance


def slow_log_ratio(graph, member, calibration):
    j, i, shift = member
    poses = reckoned(graph, calibration)
    gate = np.diag([CONFIG.gate_sd * SIDE, CONFIG.gate_sd * SIDE, CONFIG.gate_heading]) ** 2
    information = np.linalg.inv(propagated(graph, poses, i, j) + gate)
    error = poses[: max(j - GUARD, 1)] + [0, 0, -shift * ANGLE] - poses[j]
    error[:, 2] = wrap(error[:, 2])
    density = -np.einsum("na,ab,nb->n", error, information, error) / 2
    total = np.log(max(np.exp(density).sum(), 1.0))
    return max(np.log(len(density)) + density[i] - total, odometry_scan.UNLIKELY)


def test_the_grid_holds_every_pair_of_bias_and_turn_error_if_turns_may_err():
    grid = odometry_scan.OdometryScan(graph_of(path(0, 3))).grid
    pairs = sorted(product(BIASES, TURNS))
    assert sorted(map(tuple, grid.tolist())) == [pytest.approx(pair) for pair in pairs]
    straight = odometry_scan.OdometryScan(graph_of(path(0, 3), config=STRAIGHT)).grid
    assert np.array_equal(straight, np.stack([BIASES, np.zeros(odometry_scan.BIAS_STEPS)], axis=1))


@settings(max_examples=15)
@given(seeds, st.integers(GUARD + 2, 80), st.booleans(), st.sampled_from([CONFIG, STRAIGHT]))
def test_ratios_equal_explicit_dead_reckoning(seed, count, broken, config):
    stream = np.random.default_rng(seed)
    graph = graph_of(path(seed, count), int(stream.integers(1, count)) if broken else None, config)
    grid, j = odometry_scan.OdometryScan(graph).grid, int(stream.integers(GUARD + 1, count))
    member = j, int(stream.integers(0, j - GUARD)), int(stream.integers(-3, 4))
    found = odometry_scan.OdometryScan(graph).log_ratios(graph, np.array(member), np.arange(len(grid)))
    for at in [0, len(found) - 1, *stream.integers(0, len(found), 4)]:
        # Positions are kept in single precision.
        assert found[at] == pytest.approx(slow_log_ratio(graph, member, grid[at]), rel=1e-4, abs=1e-4)


@settings(max_examples=6)
@given(seeds, st.lists(st.integers(1, 90), max_size=12))
def test_any_chunks_give_the_same_bits_as_all_at_once(seed, ends):
    rows = path(seed, 300)
    member, early = np.array([290, 40, 1]), np.array([8, 1, 0])
    at_once, graph = scanned(graph_of(rows), *member), graph_of(rows[:10])
    scan = odometry_scan.OdometryScan(graph)
    first = scan.log_ratios(graph, early, ALL)
    done = 10
    for end in [*np.cumsum([10, *ends]).tolist(), 300]:
        extend(graph, rows[done : min(end, 300)])
        done = max(done, min(end, 300))
        assert np.array_equal(scan.log_ratios(graph, early, ALL), first)
    assert np.array_equal(scan.log_ratios(graph, member, ALL), at_once)
    scan.clear()
    assert np.array_equal(scan.log_ratios(graph, member, ALL), at_once)


def test_a_cut_counts_from_the_next_question_on():
    graph, member = graph_of(path(1, 80)), np.array([70, 10, 0])
    scan = odometry_scan.OdometryScan(graph)
    whole = scan.log_ratios(graph, member, ALL)
    graph.cut.rows[40] = 0
    cut = scan.log_ratios(graph, member, ALL)
    assert np.array_equal(cut, scanned(graph, *member))
    assert not np.array_equal(cut, whole)
    assert cut == pytest.approx(np.zeros(len(ALL)), abs=0.01)  # odometry says nothing across the cut
    graph.cut.rows[40] = -1
    assert np.array_equal(scan.log_ratios(graph, member, ALL), whole)


@given(st.floats(-0.4, 0.4), st.floats(1e-6, 0.2), st.sampled_from([0.01, 0.05, 0.5]), st.booleans())
@settings(max_examples=40)
def test_what_lies_beyond_the_reach_is_left_out(mean, sd, turn_sd, turning):
    """Bias and turn error together, except that three biases always stay."""
    graph, member = graph_of(path(2, 60), config=CONFIG if turning else STRAIGHT), np.array([50, 12, 0])
    scan = odometry_scan.OdometryScan(graph)
    prior = CalibrationPrior(mean, sd, 0.01, turn_sd) if turning else CalibrationPrior(mean, sd)
    near, wide = scan.near(prior), scan.near(prior, 5.0)
    widest = sorted(abs(BIASES - mean))[2]
    for at, (bias, turn_error) in enumerate(scan.grid.tolist()):
        off = ((bias - mean) / max(sd, widest / odometry_scan.REACH)) ** 2
        off += ((turn_error - 0.01) / turn_sd) ** 2 if turning else 0.0
        if abs(off - odometry_scan.REACH**2) > 1e-6:
            assert (at in near) == (off < odometry_scan.REACH**2)
    assert np.isin(near, wide).all()
    assert turning or len(near) >= 3
    found = scan.log_ratios(graph, member, near)
    every = scan.log_ratios(graph, member, np.arange(len(scan.grid)))
    assert found[near] == pytest.approx(every[near], rel=1e-9, abs=1e-9)
    assert np.isnan(np.delete(found, near)).all()


LEAST = 1e-3


def random_case(seed):
    """Biases and turn errors [G, 2], a prior, log ratios [R, G] and log odds [R]."""
    stream = np.random.default_rng(seed)
    count, grid = int(stream.integers(0, 6)), stream.uniform(-0.1, 0.1, (5, 2))
    turn_sd = float(stream.uniform(0.01, 0.1)) if stream.random() < 0.7 else 0.0
    prior = CalibrationPrior(*stream.uniform([-0.08, 0.01, -0.08], [0.08, 0.1, 0.08]).tolist(), turn_sd)
    if turn_sd == 0:
        grid[:, 1] = prior.turn_error
    ratios = np.maximum(stream.normal(-2, 5, (count, 5)), -60)
    return grid, prior, ratios, stream.normal(-1, 2, count)


@given(seeds)
def test_means_and_odds_equal_the_sum_over_all_assignments(seed):
    grid, prior, ratios, odds = random_case(seed)
    off = (grid - prior[::2]) / (prior.bias_sd, prior.turn_error_sd or 1.0)
    total, of_true, of_false = np.zeros(len(grid)), np.zeros(len(odds)), np.zeros(len(odds))
    for assignment in product([False, True], repeat=len(odds)):  # which of the sequences are true
        true = np.array(assignment, bool)
        weight = np.exp((odds[:, None] + ratios)[true].sum(axis=0) - np.square(off).sum(axis=1) / 2)
        total += weight
        of_true += true * weight.sum()
        of_false += ~true * weight.sum()
    share = total / total.sum()
    mean = share @ grid
    found, means, found_odds = acceptance.vote(grid, prior, ratios, odds, LEAST)
    assert means[::2] == pytest.approx(mean, abs=1e-9)
    assert found_odds == pytest.approx(np.log(of_true) - np.log(of_false), rel=1e-6, abs=1e-6)
    spread = np.sqrt(share @ (grid - mean) ** 2)
    wide = np.maximum(np.hypot(spread, mean - found[::2]), (LEAST, acceptance.LEAST_TURN_ERROR))
    assert found[1::2] == pytest.approx(wide * (1, prior.turn_error_sd > 0), rel=1e-6)
    off = mean - prior[::2]
    shrunk = off * np.maximum(1 - (acceptance.SHRINK * spread / np.where(off, off, np.inf)) ** 2, 0)
    assert found[::2] - np.array(prior[::2]) == pytest.approx(shrunk, rel=1e-6, abs=1e-9)


nulls = st.tuples(st.floats(0.05, 500), st.floats(0.5, 0.9 * acceptance.TRUE_MEAN))


@given(st.lists(st.floats(-20, 200), min_size=1, max_size=40).map(np.array), st.integers(1, 3000), seeds)
def test_the_null_of_a_sequence_follows_from_the_others_above_the_least_score(scores, keyframes, seed):
    scores[0] = acceptance.LEAST_SCORE if seed % 3 else scores[0]
    false = np.random.default_rng(seed).uniform(0, 1, len(scores))
    found = acceptance.estimate_null(scores, false, keyframes)
    for k in range(len(scores)):
        others = (np.arange(len(scores)) != k) & (scores >= acceptance.LEAST_SCORE)
        count, above = false[others].sum(), false[others] @ (scores[others] - acceptance.LEAST_SCORE)
        mean = (above + acceptance.PRIOR_COUNT * acceptance.PRIOR_EXCESS) / (count + acceptance.PRIOR_COUNT)
        rate = (acceptance.PRIOR_SEQUENCES + count) / (acceptance.PRIOR_KEYFRAMES + keyframes)
        assert found[0][k] == pytest.approx(keyframes * rate, rel=1e-9)
        assert found[1][k] == pytest.approx(min(mean, acceptance.TRUE_MEAN), rel=1e-9, abs=1e-9)


@given(st.floats(0, 100), nulls, st.floats(0, 500))
def test_odds_are_true_over_false_sequences_per_score(score, null, known):
    true = max(known, acceptance.MIN_TRUE) * np.exp(-score / acceptance.TRUE_MEAN) / acceptance.TRUE_MEAN
    false = null[0] * np.exp(-(score - acceptance.LEAST_SCORE) / null[1]) / null[1]
    expected = np.log(true) - np.log(false)
    assert acceptance.log_odds(np.array([score]), *null, known)[0] == pytest.approx(expected, abs=1e-9)
