"""Selection of closures of the least cost, with cuts and afresh; several maps find what one alone cannot."""

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.maps.scenarios import ten_circuits
from evaluation.papers.maps.stored_maps import store_map
from ratslam.mapping import closure_selection
from ratslam.mapping.closure_selection import CUT, MapHypotheses, Selection, SelectionProblem, select_closures
from ratslam.mapping.map_solution import reselect
from ratslam.mapping.odometry_calibration import HeadingNoise
from ratslam.mapping.optimizer import CalibrationPrior, MapFit, MapProblem, OdometryChain, System, solve
from tactile.base.se2 import compose, integrate, wrap
from tests.ratslam.mapping.selection_cases import LAP, NOISE, PRIOR, World, closures_of, off, world


def select(made: World, present: MapFit | None = None, earlier=()) -> Selection:
    """The selection with cuts that starts from this map, by default the present one, and the hypotheses."""
    starts = [made.present() if present is None else present, *made.hypotheses()]
    return closure_selection.select_closures_and_cuts(made.case, starts, made.find_cut, earlier)


def assert_right(made: World, judged: Selection, *cuts: int) -> None:
    """True sequences are accepted, false ones refused, the odometry is cut there, and the map is true."""
    assert_accepts(judged.fit, ~made.false)
    assert sorted(frame for frame, _ in judged.cuts) == list(cuts)
    assert off(judged.fit, made.truth) < 0.1


def assert_accepts(fit: MapFit, sequences: np.ndarray) -> None:
    np.testing.assert_array_equal(fit.weights > closure_selection.ACCEPTED_WEIGHT, sequences)


@pytest.mark.parametrize("seed", range(2))
def test_true_sequences_are_all_accepted(seed):
    made = world(seed)
    judged, limits = select(made), (closure_selection.STEPS, closure_selection.FINE)
    plain = solve(made.present(), made.case.measurements, *limits)
    assert_right(made, judged)
    assert np.allclose(judged.fit.weights, plain.weights, atol=1e-4)
    assert off(judged.fit, compose(np.array([1.0, 2.0, 0.5]), plain.poses)) < 1e-3
    assert judged.cost == pytest.approx(System(made.case.measurements).robust_cost(plain), rel=1e-6)
    assert off(made.reckoned(), made.truth) > 2 * off(judged.fit, made.truth)
    again = select(made, earlier=((150, 4),))  # a useless cut is removed
    assert again.cuts == ()
    assert again.cost == pytest.approx(judged.cost, rel=1e-3)


@pytest.mark.parametrize(("seed", "false"), [(0, 20), (1, 20), (2, 40), (3, 40), (4, 20), (5, 40), (0, 50)])
def test_a_false_sequence_is_refused_also_where_it_has_bent_the_present_map(seed, false):
    """The present map is not the only start of the search."""
    made = world(seed, false=false)
    assert_right(made, select(made))
    if false == 40:
        bent = believing(made, made.case)
        judged = select(made, bent)
        assert off(bent, made.truth) > 2 * off(judged.fit, made.truth)
        assert_right(made, judged)


def believing(made: World, case: SelectionProblem) -> MapFit:
    """A map that believes the false sequence alone."""
    closures = case.measurements.closures._replace(scale=np.where(made.false, 1e12, 1e-3))
    return solve(made.reckoned(), case.measurements._replace(closures=closures), 40)


def test_a_sequence_with_more_evidence_may_strain_the_map_more():
    made, weights, problem = world(0), [], world(0).case.measurements
    for by in (0.1, 1, 10):
        closures = problem.closures._replace(scale=problem.closures.scale * by)
        case = made.case._replace(measurements=problem._replace(closures=closures))
        weights.append(select(made._replace(case=case)).fit.weights)
    assert (np.diff(weights, axis=0) > 0).all()


@pytest.mark.parametrize("seed", range(4))
def test_the_cost_is_never_above_that_of_the_present_map(seed):
    made = world(seed, jumps=((150, 25),) if seed % 2 else (), false=40.0 * (seed % 3))
    case, present = made.case, made.present()
    noise = np.random.default_rng(seed).normal(0, 0.02, present.poses.shape) * [1, 1, 0.2]
    present = present._replace(poses=present.poses + noise)
    judged = select(made, present)
    assert judged.cost <= System(case.measurements).robust_cost(present)
    again = select(made, judged.fit, judged.cuts)
    assert again.cost <= judged.cost + 0.5  # solver steps, not another map
    whole = System(case.measurements.cut_at([frame for frame, _ in judged.cuts])).robust_cost(judged.fit)
    assert judged.cost == pytest.approx(whole + CUT * len(judged.cuts), rel=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_a_robot_that_is_never_carried_keeps_its_odometry(seed):
    """Without cuts, the selection is that of the same search; where a robot was carried, it costs more."""
    made = world(seed, jumps=((2 * LAP + 10, 25),) if seed else (), false=40.0)
    plain, cut = select_closures(made.case, made.starts()), select(made)
    assert plain.cuts == ()
    assert plain.cost == System(made.case.measurements).robust_cost(plain.fit)
    assert cut.cost < plain.cost if seed else cut.cost == plain.cost
    assert np.array_equal(cut.fit.poses, plain.fit.poses) == (not seed)


@pytest.mark.parametrize("seed", range(5))
def test_the_odometry_is_cut_where_the_robot_was_carried(seed):
    stream = np.random.default_rng(seed)
    jump = int(stream.integers(2 * LAP + 5, 3 * LAP)), int(stream.integers(15, 45))
    made = world(seed, jumps=(jump,))
    judged = select(made)
    assert_right(made, judged, jump[0])
    assert made.case.first[judged.cuts[0][1]] >= jump[0]
    again = select(made, judged.fit, judged.cuts)
    assert again.cuts == judged.cuts
    assert np.allclose(again.fit.poses, judged.fit.poses, atol=0.01)


@pytest.mark.parametrize("seed", range(5))
def test_two_cuts_are_made_for_a_robot_carried_away_and_back(seed):
    """The visit alone contradicts the other sequences, which agree."""
    stream = np.random.default_rng(seed)
    away, stay, places = 2 * LAP + 5 + 20 * int(stream.integers(3)), 60, int(stream.integers(15, 45))
    made = world(seed, laps=5, jumps=((away, places), (away + stay, -places)), least=35.0)
    assert_right(made, select(made), away, away + stay)


MORE = 100.0
"""Factor on the variance of headings in a map that needs too much of it."""


def learned(factor: float) -> HeadingNoise:
    return HeadingNoise(float(np.log(factor)), 0.1)


@pytest.mark.parametrize("seed", range(2))
def test_a_map_bent_by_a_false_sequence_gives_way(seed: int) -> None:
    """With its noise the bent map is the cheapest."""
    made = world(seed, false=60.0)
    case = made.case._replace(measurements=made.case.measurements.with_heading_noise(MORE))
    found = select_closures(case, [believing(made, case)])
    assert (found.fit.weights[made.false] > closure_selection.ACCEPTED_WEIGHT).all()
    assert off(found.fit, made.truth) > 0.5
    assert_right(made, reselect(case, found, made.reckoned(), learned(MORE), learned(1.0)))


@pytest.mark.parametrize(("noise", "seed"), [(2.0, 0), (5.0, 2)])
def test_odometry_that_is_noisier_than_at_the_start_keeps_its_closures(noise: float, seed: int) -> None:
    """Refusing all of them would explain it with little noise."""
    made = world(seed, noise=noise)
    found = select_closures(made.case, [made.present()])
    again = reselect(made.case, found, made.reckoned(), learned(1.0), learned(noise**-2))
    assert_accepts(again.fit, found.fit.weights > closure_selection.ACCEPTED_WEIGHT)
    assert off(again.fit, made.truth) < 1.1 * off(found.fit, made.truth)


@pytest.mark.soak
def test_two_halves_of_a_maze_that_look_alike_stay_two(tmp_path: Path) -> None:
    """This maze is the same after half a turn: the first half of a circuit fits the second one."""
    assert store_map(ten_circuits(31009), tmp_path).arrays.em < 0.05


TRAPS = [(1, -6, LAP + 2), (3, -6, LAP + 2), (5, -6, LAP + 2), (1, -8, LAP + 12), (2, -8, LAP + 12)]
"""Seed of a world, and how many places its early sequence is wrong, from which frame on."""
MANY = TRAPS[2:]
"""Those in which several maps are left at the end."""


def trap(seed: int, wrong: int, at: int) -> World:
    """A world of bad odometry that begins with a false sequence of much evidence."""
    return world(seed, laps=3, false=60.0, false_at=(at, wrong), noise=3.0)


def part(case: SelectionProblem, sequences: np.ndarray, count: int | None = None) -> SelectionProblem:
    """The problem with only the sequences marked in [R] bool, and the first keyframes up to `count`."""
    chain = OdometryChain(*(rows[: count and count - 1] for rows in case.measurements.chain))
    closures = case.measurements.closures.of_sequences(sequences)
    fewer = case.measurements._replace(chain=chain, closures=closures)
    return SelectionProblem(fewer, *(rows[sequences] for rows in case[1:4]), case.views_cost)


def numbers(case: SelectionProblem) -> np.ndarray:
    return np.arange(len(case.evidence))


def total(case: SelectionProblem, fit: MapFit) -> float:
    return System(case.measurements).robust_cost(fit) + case.views_cost(fit.poses)


def state(fits: list[MapFit]) -> list[tuple]:
    return [(fit.poses.tolist(), fit.bias, fit.turn_error) for fit in fits]


@pytest.mark.parametrize("at", TRAPS)
def test_the_beam_escapes_from_a_false_early_sequence(at):
    made = trap(*at)
    trapped = made.case.with_cuts(made.reckoned(), ())
    assert (trapped.fit.weights[made.false] > closure_selection.ACCEPTED_WEIGHT).all()
    assert off(trapped.fit, made.truth) > 0.15
    found = select_closures(made.case, made.starts())
    assert found.cost < trapped.cost
    assert_right(made, found)


@pytest.mark.parametrize("kept", [1, 2, closure_selection.KEPT])
def test_no_more_maps_are_kept_than_wanted(kept, monkeypatch):
    monkeypatch.setattr(closure_selection, "KEPT", kept)
    monkeypatch.setattr(closure_selection, "DOUBTS", 0)
    case, hypotheses = trap(1, -8, LAP + 12).case, MapHypotheses()
    steps = [(part(case, numbers(case) <= known), np.arange(known + 1)) for known in numbers(case)]
    assert max(len(hypotheses.follow(*step)) for step in steps) == kept


def test_a_dear_map_is_kept_if_it_refuses_what_all_cheaper_ones_accept():
    """Weak sequences, taken or left, fill the places of the cheapest; the last map alone refuses the first
    sequence."""
    taken = [[1, a, b, c] for a in (1, 0) for b in (1, 0) for c in (1, 0)] + [[0, 1, 1, 1]]
    maps = [MapFit(np.full((1, 3), float(k)), 0.0, np.array(row, float)) for k, row in enumerate(taken)]
    kept = closure_selection.with_doubts(maps)
    assert [fit.poses[0, 0] for fit in kept] == [0, 1, 2, 3, 4, 8]  # 4 refuses the second sequence


@pytest.mark.parametrize(("at", "views"), [(MANY[0], 200.0), (MANY[1], 0.0), (MANY[2], 200.0)])
def test_the_maps_differ_and_are_sorted_by_their_cost_with_the_views(at, views):
    made = trap(*at)
    seen = made.case._replace(views_cost=lambda poses: views * float(np.hypot(*poses[-1, :2])))
    fits = MapHypotheses().follow(seen, numbers(seen))
    costs = [total(seen, fit) for fit in fits]
    assert len(costs) > 1
    assert costs == sorted(costs)
    for k, fit in enumerate(fits):
        for other in fits[:k]:
            apart = np.column_stack([(fit.poses - other.poses)[:, :2], wrap(fit.poses - other.poses)[:, 2]])
            deviation = (apart**2 / made.case.measurements.closures.variance).sum(axis=1).max()
            assert deviation >= closure_selection.ALIKE**2


OUT, TURN = 20, 0.6
"""Keyframes that the robot drives out, and back again; how far it has turned, rad."""


def fork(evidence: tuple[float, float], prefer: float = 0.0) -> SelectionProblem:
    """A robot that drives straight out and backwards home. One sequence claims that it has turned left on the
    way, another that it has turned right: with the same evidence, the two maps mirror each other. The views
    prefer the left turn by a chi-square of `prefer`."""
    motion = np.zeros((2 * OUT, 3))
    motion[:, 0] = np.repeat([0.05, -0.05], OUT)
    chain = OdometryChain(motion, np.abs(motion[:, 0]), np.tile((3 * NOISE) ** 2, (len(motion), 1)))
    frames = np.arange(2 * OUT - 8, 2 * OUT - 2)
    closures = closures_of([frames] * 2, [2 * OUT - frames] * 2, np.array(evidence))
    problem = MapProblem(chain, closures._replace(turn=np.repeat([TURN, -TURN], len(frames))), PRIOR)
    ends = np.array(evidence), frames[[0, 0]], frames[[-1, -1]]
    return SelectionProblem(problem, *ends, lambda poses: -prefer / 2 * float(np.sign(poses[-1, 2])))


def turned(fit: MapFit) -> float:
    return float(wrap(fit.poses[-5, 2] - fit.poses[5, 2]))


@pytest.mark.parametrize("side", [1, -1])
def test_the_views_decide_between_maps_of_equal_cost(side):
    case = fork((40.0, 40.0), prefer=5.0 * side)
    fits = MapHypotheses().follow(case, np.arange(2))
    left, right = (next(fit for fit in fits if way * turned(fit) > TURN / 2) for way in (1, -1))
    assert turned(left) == pytest.approx(-turned(right), abs=0.01)  # both are kept
    assert total(case, left) + 5.0 * side == pytest.approx(total(case, right), abs=0.05)
    assert turned(fits[0]) == pytest.approx(side * TURN, abs=0.1)
    best = select_closures(case, fits)
    assert turned(best.fit) == pytest.approx(side * TURN, abs=0.1)
    assert best.cost == pytest.approx(System(case.measurements).robust_cost(best.fit) - 2.5)


def test_only_force_finds_the_other_map(monkeypatch):
    case = fork((40.0, 60.0))
    fits = MapHypotheses().follow(case, np.arange(2))
    monkeypatch.setattr(closure_selection, "FITS", 0.0)
    unforced = MapHypotheses().follow(case, np.arange(2))
    assert turned(fits[0]) < 0 < turned(unforced[0])
    assert total(case, fits[0]) < total(case, unforced[0])


@pytest.mark.parametrize(("at", "known"), [(TRAPS[0], 1), (TRAPS[2], 3), (TRAPS[4], 6)])
def test_two_calls_follow_as_one_also_of_restored_hypotheses(at, known):
    made = trap(*at)
    hypotheses, restored = MapHypotheses(), MapHypotheses()
    hypotheses.follow(part(made.case, numbers(made.case) < known), np.arange(known))
    restored.restore(hypotheses.arrays())
    for one in (hypotheses, hypotheses, restored):
        assert state(one.follow(made.case, numbers(made.case))) == state(made.hypotheses())


def test_sequences_are_known_by_their_numbers():
    """Sequences of other numbers are new, even if there are as many."""
    made, hypotheses = trap(3, -6, LAP + 2), MapHypotheses()
    chosen = made.false | (numbers(made.case) > 3)
    hypotheses.follow(part(made.case, numbers(made.case) < 2), np.array([0, 1]))
    fits = hypotheses.follow(part(made.case, chosen), np.flatnonzero(chosen))
    assert all(len(fit.weights) == chosen.sum() for fit in fits)
    assert state(fits) != state(hypotheses.follow(made.case, numbers(made.case)))


def test_maps_go_on_by_corrected_odometry():
    case, hypotheses, count = trap(3, -6, LAP + 2).case, MapHypotheses(), LAP + 40
    early = case.last < count
    before = hypotheses.follow(part(case, early, count), np.flatnonzero(early))
    after = hypotheses.follow(part(case, early), np.flatnonzero(early))
    assert len(before) == len(after) > 1
    for one, two in zip(before, after, strict=True):
        assert np.array_equal(two.poses[:count], one.poses)
        onwards = one.corrected(case.measurements.chain)[count - 1 :]
        assert two.poses[count:] == pytest.approx(integrate(onwards, one.poses[-1]))
        assert two.bias == one.bias != 0


def test_the_first_map_is_odometry_with_the_means_of_the_calibration():
    made = world(2).case
    nothing = part(made, np.zeros(len(made.evidence), bool))
    measured = nothing.measurements._replace(prior=CalibrationPrior(0.3, 0.02, 0.1, 0.05))
    (fit,) = MapHypotheses().follow(nothing._replace(measurements=measured), np.zeros(0, int))
    assert (fit.bias, fit.turn_error) == (0.3, 0.1)
    assert fit.poses == pytest.approx(np.vstack([np.zeros(3), integrate(fit.corrected(measured.chain))]))
