"""Metrics of sessions, poses in a map, revisits, views, the machine; the Experience Metric and its logs."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from evaluation.metrics import exm
from evaluation.metrics.exm import EXM_MODES, ExmConfig, base_end, experience_metric
from evaluation.papers.fox2012.reproduction import LEAVE_DISTANCE, find_revisits, path_metrics
from evaluation.papers.maps.localisation_metrics import BUILDING, RIGHT, WRONG, MapSteps, pose_errors
from evaluation.papers.salman2016.protocols import direction_metrics, lap_of_step
from evaluation.studies import metrics
from evaluation.studies.machine import one_core, peak_memory, reset_peak_memory, watch_load
from evaluation.studies.metrics import ViewDifferences, image_difference, lap_ends, touch_metrics
from tactile.base.errors import InputError
from tactile.base.se2 import compose
from tests.helpers.laps import session, square

CHANGE = 0.3
VIEWS = arrays.arrays(float, (5, 3, 6, 1), elements=st.sampled_from([0.0, 0.02, 0.5, 1.0]))


@pytest.mark.parametrize("word", ["C", "CA", "CCCAAACACA"])
def test_laps_end_where_they_began(word):
    truth = square(word)
    assert lap_ends(truth).tolist() == [48 * (k + 1) for k in range(len(word))]
    assert np.bincount(lap_of_step(truth, len(word))).tolist() == [49, *[48] * (len(word) - 1)]
    assert len(lap_ends(truth[:40])) == 0


def test_a_perfect_map_has_no_energy_in_any_frame():
    truth = square("CC")
    moved = compose(np.array([3.0, -1.0, 2.0]), truth)
    trial = touch_metrics(session(truth, trajectory=moved, place=np.arange(97) % 48, node=moved[:48]))
    assert (trial.em, trial.em_experiences) == pytest.approx((0, 0), abs=1e-9)
    assert (trial.arcr, trial.arcr_chain_free) == (1, 1)
    assert trial.arr > 0.9  # the base set ends a few steps before the places begin again
    assert touch_metrics(session(truth)).arr == 0
    # A step lies where its experience does.
    spread = touch_metrics(session(truth, place=np.arange(97) // 4, node=truth[::4]))
    assert spread.em == 0 < spread.em_experiences
    # Closures are false from ten centimetres on.
    closures = np.array([[48, 0], [50, 2], [60, 8], [60, 30]])
    closed = touch_metrics(session(truth, closures=closures))
    assert (closed.closures, closed.false_closures) == (4, 2)


def test_laps_the_other_way_round_are_associated_by_experience_or_closures():
    truth = square("CA")

    def found(**given):
        return direction_metrics(session(truth, **given), "CA", CHANGE)

    new = found()
    assert (new["first_anticlockwise"], new["directions_apart"]) == (0, 0)
    nearest = np.array([int(np.argmin(np.hypot(*(truth[:49, :2] - p[:2]).T))) for p in truth])
    known = found(place=nearest)
    assert known["first_anticlockwise"] == known["associated_correct"] == 1
    wrong = found(place=np.where(np.arange(97) > 48, 24, nearest))
    assert wrong["first_anticlockwise"] == 1 > wrong["associated_correct"]
    assert wrong["first_anticlockwise_correct"] < 0.5
    half = found(closures=np.array([[k, nearest[k]] for k in range(49, 73)]))
    assert half["first_anticlockwise"] == half["first_anticlockwise_correct"] == pytest.approx(0.5)
    assert half["associated_correct"] == 1
    # The distance of the two directions is measured in the map.
    moved = truth + np.where(np.arange(97) > 48, 1, 0)[:, None] * [0.3, 0, 0]
    assert found(trajectory=moved)["directions_apart"] == pytest.approx(0.3)
    assert np.isnan(direction_metrics(session(truth), "CC", CHANGE)["directions_apart"])
    again = np.array([[k, k - 48] for k in range(97, 145)])
    first_lap = np.array([[k, 0] for k in range(49, 97)])
    none, every = (
        direction_metrics(session(square("CAA"), closures=closures), "CAA", CHANGE)
        for closures in (again, np.concatenate([first_lap, again]))
    )
    assert none["last_anticlockwise"] == 0
    assert every["last_anticlockwise"] == 1 > every["associated_correct"]
    closures = np.array([[90, 2], [100, 80], [30, 4], [44, 42]])
    across = direction_metrics(session(square("CCC"), closures=closures), "CCC", CHANGE)["across"]
    assert across == 2  # 145 steps: the change is at 43


def test_returns_are_found_as_revisits_and_closed_by_their_offset():
    def there_and_back(far):
        x = np.concatenate([np.linspace(0, far, 40), np.linspace(far, 0, 40)])
        return x[:, None] * [1, 0, 0]

    truth = there_and_back(1)
    later, earlier = find_revisits(truth).T
    assert (later >= 40).all()
    assert np.abs(truth[later, 0] - truth[earlier, 0]).max() < 0.02
    assert truth[later, 0].max() < 1 - LEAVE_DISTANCE / 2 + 0.03  # not near the turn
    assert len(find_revisits(truth[:40])) == len(find_revisits(there_and_back(LEAVE_DISTANCE))) == 0
    shifted = truth + [3.0, -4.0, 0.1]
    found = path_metrics(shifted, shifted, truth)
    known = {"online_error": 5, "final_error": 5, "revisit_gap": 0, "revisits_closed": 1}
    known |= {"online_heading_error_deg": np.degrees(0.1)}
    assert {name: found[name] for name in known} == pytest.approx(known, abs=1e-12)
    drifted = truth + np.column_stack([np.zeros(80), np.linspace(0, 1, 80), np.zeros(80)])
    assert path_metrics(truth, drifted, truth)["revisits_closed"] == 0
    assert path_metrics(truth[:9], truth[:9], truth[:9])["revisits_closed"] is None


STRAIGHT = np.column_stack([0.1 * np.arange(11), np.zeros((11, 2))])


def test_a_moved_map_has_no_error_and_a_bent_one_only_after_alignment():
    motion, bend = np.array([3.0, -2.0, 2.0]), np.array([0.3, 0.4, 0.5])
    steps = MapSteps.known(compose(motion, STRAIGHT), STRAIGHT)
    here = np.array([[0.43, 0.05, 0.3], [0.9, 0.0, -0.2]])
    np.testing.assert_allclose(steps.errors(compose(motion, here), here, 0.1), 0, atol=1e-12)
    np.testing.assert_allclose(pose_errors(steps.align(compose(motion, here)), here), 0, atol=1e-12)
    np.testing.assert_allclose(steps.true_places(compose(motion, here)[:, :2]), here[:, :2])
    bent = np.concatenate([STRAIGHT[:6], compose(bend, STRAIGHT[6:])])
    steps, here = MapSteps.known(bent, STRAIGHT), STRAIGHT[[8]] + [0.0, 0.02, 0.0]
    np.testing.assert_allclose(steps.errors(compose(bend, here), here, 0.1), 0, atol=1e-12)
    assert pose_errors(steps.align(compose(bend, here)), here)[0, 0] > 0.05


def test_a_wrong_place_is_an_error_of_its_distance_and_turn_where_the_truth_is_known():
    error = np.array([[0.09, 0.3], [0.1, 0.0], [0.19, 0.0], [0.0, 0.6]])
    assert RIGHT.holds(error).tolist() == [True, False, False, False]
    assert WRONG.exceeded(error).tolist() == [False, False, True, True]
    steps = MapSteps.known(STRAIGHT, STRAIGHT)
    error = steps.errors(np.array([[0.5, 0.1, np.pi - 0.1]]), np.array([[0.2, 0.1, -np.pi]]), 0.1)
    np.testing.assert_allclose(error, [[0.3, 0.1]], atol=1e-12)
    # A step is revisited with its heading.
    truth = np.array([[0.5, 1.9, 0.5], [0.5, 2.1, 0.0], [0.5, 0.0, np.pi]])
    assert steps.revisited(truth, BUILDING).tolist() == [True, False, False]
    # A step with the same heading is preferred if it is about as near.
    turned = np.array([[0.0, 0.0, np.pi], [0.05, 0.0, 0.0], [0.5, 0.0, 0.0]])
    steps = MapSteps.known(turned, turned)
    assert [steps.nearest(np.zeros((1, 3)), reach).tolist() for reach in (0.09, 0.04)] == [[1], [0]]
    truth = STRAIGHT.copy()
    truth[3] = np.nan
    steps = MapSteps.known(STRAIGHT, truth)
    assert len(steps.pose) == 10
    error = steps.errors(STRAIGHT, truth, 0.1)
    assert np.isnan(error[3]).all()
    assert not WRONG.exceeded(error)[3]
    assert RIGHT.holds(error).tolist() == [k != 3 for k in range(11)]


def compared(truth, views, step=10.0):
    time = step * np.arange(len(views))
    differences = lambda some, others: np.abs(some[:, None] - others[None])  # noqa: E731
    return metrics.compare_views(views, np.asarray(truth, float), time, differences, "made up")


def test_pairs_of_views_are_sorted_by_true_pose_and_time():
    truth = [[0, 0, 0], [1, 0, 0], [0.04, 0, 0.2], [0, 0, 2.0], [0.2, 0, 0], [0, 0, 0]]
    found = compared(truth, np.arange(6) / 10, step=40.0)
    # same: 0-2 and 0-5 and 2-5 (15 degrees, 5 cm, 60 s apart); other: all with row 1
    assert (found.same.sum(), found.other.sum()) == (3, 5)
    assert compared(truth, np.arange(6) / 10, step=20.0).same.sum() == 2  # 0-2 lie only 40 s apart
    with pytest.raises(InputError, match="two visits"):
        compared([[k, 0, 0] for k in range(5)], np.arange(5.0))
    with pytest.raises(InputError, match="one place"):
        compared(np.zeros((20, 3)), np.arange(20.0))
    views = ViewDifferences(np.linspace(0, 1, 11), np.eye(10, dtype=int)[1] * 8, np.ones(10, int), 0.9)
    assert views.quantile(views.same, 0.5) == pytest.approx(0.15)
    assert views.share_below(views.other, 0.15) == pytest.approx(0.15)


@given(VIEWS, VIEWS)
def test_images_differ_by_contacts_and_by_heights_where_both_touch(a, b):
    contact, height = image_difference(a, b, 0.05)
    assert image_difference(a, a, 0.05)[0] == 0
    assert contact == image_difference(b, a, 0.05)[0] == np.mean((a > 0) != (b > 0))
    both = (a > 0) & (b > 0)
    expected = 0.05 * np.abs(a - b)[both].mean() if both.any() else np.nan
    assert height == pytest.approx(expected, nan_ok=True)
    # The radial channel has no effect.
    deep = [np.concatenate([one, np.full_like(one, far)], axis=-1) for one, far in ((a, 0.0), (b, 0.7))]
    assert image_difference(*deep, 0.05) == pytest.approx((contact, height), nan_ok=True)


def test_memory_is_measured_for_one_piece_of_work_and_time_on_one_core():
    reset_peak_memory()
    before = peak_memory()
    large = bytearray(200 << 20)
    large[::4096] = b"x" * len(large[::4096])
    del large
    peak = peak_memory()
    reset_peak_memory()
    assert peak >= before > 0
    if Path("/proc/self/clear_refs").exists():
        assert peak - before > 150
        assert peak_memory() < peak - 100
    if not hasattr(os, "sched_getaffinity"):
        pytest.skip("this system does not say on which cores a process runs")
    cores, load = os.sched_getaffinity(0), watch_load()
    with one_core():
        (core,) = os.sched_getaffinity(0)
        assert core in cores
    assert os.sched_getaffinity(0) == cores
    found = load()
    assert found is None or found >= 0


def arcr(ids, truth, **config):
    return {mode: experience_metric(ids, truth, ExmConfig(mode=mode, **config)).arcr for mode in EXM_MODES}


@pytest.mark.parametrize("dwell", [1, 2, 4, 6, 9])
def test_a_perfect_loop_scores_one(square, dwell):
    ids, truth = square(2, dwell)
    result = experience_metric(ids, truth)
    assert (result.arr, result.arcr, result.base, result.note) == (1.0, 1.0, 8 * dwell, "")


def test_paper_reading_loses_places_as_wide_as_the_threshold(square):
    # a place of 6 steps is 0.10 m wide and entered 0.10 m from where it was last left, the threshold:
    # rounding decides which of the 8 places pass, and the verdict holds for the visit
    ids, truth = square(2, 6)
    assert arcr(ids, truth)["paper"] == 0.25
    assert arcr(ids, truth, position=0.099)["paper"] == 0.0
    assert arcr(ids, truth, position=0.101)["paper"] == 1.0
    assert arcr(ids, truth, position=0.099)["strict"] == 1.0


def test_mistaken_and_exchanged_places_and_values_that_mean_nothing(square):
    ids, truth = square(3, 4)
    ids[64:][ids[64:] == 3] = 7
    assert arcr(ids, truth) == {"strict": 60 / 64, "paper": 56 / 64, "or": 62 / 64, "literal": 0}
    ids, truth = square(2, 4)
    exchanged = np.concatenate([ids[:32], np.choose(ids[32:], [0, 1, 2, 7, 4, 5, 6, 3])])
    assert arcr(exchanged, truth) == {"strict": 24 / 32, "paper": 24 / 32, "or": 30 / 32, "literal": 0}
    result = experience_metric(ids, truth, ExmConfig(mode="literal"))
    assert (result.arr, result.arcr, result.note) == (1.0, 0.0, exm.LITERAL_WARNING)
    result = experience_metric(np.arange(64), truth)
    assert (result.arr, result.note) == (0.0, exm.NO_RELOCALISATION)
    assert np.isnan(result.arcr)


def test_new_experiences_are_valid_only_after_a_right_relocalisation():
    # 3 is new after a right visit of 0, 4 after a wrong visit of 1 (made at 7 m, where 1 is not)
    ids = np.array([0, 1, 2, 0, 3, 0, 3, 1, 4, 0, 4])
    at = np.array([0, 1, 2, 0, 5, 0, 5, 7, 6, 0, 6])
    truth = np.stack([at, 0 * at, 0 * at], axis=1)
    result = experience_metric(ids, truth, ExmConfig(base=3))
    assert ids[result.counted].tolist() == [0, 0, 3, 1, 0, 4]
    assert result.near[result.counted].tolist() == [True, True, True, False, True, True]
    assert result.right[result.counted].tolist() == [True, True, True, False, True, False]
    # in the listing the right visit of 0 makes valid what came just before it, which is 4
    paper = experience_metric(ids, truth, ExmConfig(mode="paper", base=3))
    assert paper.right[paper.counted].tolist() == [True, True, True, False, True, True]


def test_action_and_step_logs_differ_and_steps_without_an_experience_are_skipped(square):
    ids, truth = square(3, 4)
    ids[40:44] = 99  # a place made anew in the second lap, after which half of the third is new as well
    ids[80:96] = np.arange(100, 104).repeat(4)
    step, action = (experience_metric(ids, truth, ExmConfig(log=log)) for log in ("step", "action"))
    assert (step.entries, step.base, action.entries, action.base) == (64, 32, 16, 8)
    assert action.arr == experience_metric(ids[::4], truth[::4]).arr
    ids, truth = square(2, 4)
    padded = np.concatenate([[-1, -1], ids]), np.concatenate([truth[:1], truth[:1], truth])
    assert experience_metric(*padded)[:6] == experience_metric(ids, truth)[:6]
    assert exm.change_rows(np.array([-1, 4, 4, -1, 4, 2, 2, 4])).tolist() == [1, 5, 7]
    assert exm.change_rows(np.array([-1, -1])).tolist() == []


def test_turning_around_near_the_start_is_not_a_loop(square):
    _, truth = square(2, 4)
    about = np.array([[0, 0, 0], [0, 0, 1.5], [0.15, 0, 3.0], [0, 0, 0.0]])
    assert base_end(np.concatenate([about, truth[1:]])) == 32 + 3
    trembling = np.zeros((20, 3))
    trembling[::2, 0] = 0.05
    with pytest.raises(InputError, match=r"never returns within .* set `base`"):
        base_end(trembling)
    assert experience_metric(np.arange(30), truth[:30], ExmConfig(base=8)).base == 8


@pytest.mark.parametrize(("count", "truth", "base", "message"), [
    (3, np.zeros((2, 3)), 0, "shapes"),
    (0, np.zeros((0, 3)), 0, "shapes"),
    (3, np.full((3, 3), np.nan), 0, "row 0: .*remove such rows"),
    (3, np.zeros((3, 3)), 4, "i_base: 4; expected 0 to 3"),
])  # fmt: skip
def test_invalid_logs_are_refused(count, truth, base, message):
    with pytest.raises(InputError, match=message):
        experience_metric(np.zeros(count, int), truth, ExmConfig(base=base))


@st.composite
def walks(draw):
    """A log, true poses near a few spots, and an end of the base set."""
    ids = np.array(draw(st.lists(st.integers(0, 6), min_size=2, max_size=60)))
    spots = np.array(draw(st.lists(st.integers(0, 6), min_size=len(ids), max_size=len(ids))))
    truth = np.stack([0.07 * spots, np.zeros(len(ids)), np.pi + 0.2 * spots], axis=1)
    return ids, truth, draw(st.integers(1, len(ids)))


@given(walks(), st.permutations(range(7)), st.lists(st.integers(-3, 3), min_size=60, max_size=60))
def test_names_and_full_turns_have_no_effect(walk, names, turns):
    ids, truth, base = walk
    renamed = np.array(names)[ids] * 1000 - 7
    turned = truth + np.outer(turns[: len(ids)], [0, 0, 2 * np.pi])
    found = {}
    for mode in EXM_MODES:
        config = ExmConfig(mode=mode, base=base)
        before, after = experience_metric(ids, truth, config), experience_metric(renamed, truth, config)
        assert np.array_equal(before.counted, after.counted)
        assert np.array_equal(before.right, after.right)
        assert (before.right <= before.counted).all()
        if mode != "literal":
            assert np.array_equal(before.right, experience_metric(ids, turned, config).right)
        found[mode] = before
    assert found["literal"].correct == 0
    assert len({result.relocalisations for result in found.values()}) == 1


@given(walks())
def test_relocalisations_are_those_of_the_listing(walk):
    ids, _, base = walk
    found, listed = set(), []
    for i in range(base, len(ids)):
        again = ids[i] in ids[:i]
        if again and not (ids[i] == ids[i - 1] and ids[i - 1] not in found):
            found.add(ids[i])
        listed.append(ids[i] in found)
    assert exm.relocalisations(ids, base)[base:].tolist() == listed


ROWS = "0,7,0.1,0.2,3\n0.5,-1,0.1,0.2,-3\n"


@pytest.mark.parametrize("text", [
    ROWS,
    "t,id,x,y,th\n" + ROWS,
    "Time, Experience, X, Y, Heading\n" + ROWS,
    "# any\ntime,experience_id,x,y,theta\n" + ROWS,
    "heading,gain,y,x,id,t\n3,9,0.2,0.1,7,0\n-3,9,0.2,0.1,-1,0.5\n",  # in any order among others
])  # fmt: skip
def test_column_names_of_a_log_in_a_header(tmp_path, text):
    path = tmp_path / "log.csv"
    path.write_text(text)
    time, experience, truth = exm.read_experience_log(path)
    assert (time.tolist(), experience.tolist()) == ([0, 0.5], [7, -1])
    assert truth.tolist() == [[0.1, 0.2, 3], [0.1, 0.2, -3]]


@pytest.mark.parametrize(("text", "message"), [
    ("t,id,x,y\n0,1,2,3\n", ":1: no column theta"),
    ("t,id,x,y,th\n0,1,2,3,4\n1,2,3\n2,1,2,3,4\n", ":3: '1 2 3'; expected 5 finite numbers"),
    ("t,id,x,y,th\n0,1,2,3,4\n\n1,1.5,2,3,4\n", r":4: experience id 1\.5; expected a whole number"),
    ("t,id,x,y,th\n0,1,2,nan,4\n", ":2"),
    ("t,id,x,y,th\n0,1,2,,4\n", ":2"),
    ("t,id,x,y,th\n", ": no rows"),
    ("0,1,2", ": no rows"),
    (b"\xff\xfe\x00\x81", ": .*malformed"),
])  # fmt: skip
def test_malformed_logs_are_refused_with_their_line(tmp_path, text, message):
    path = tmp_path / "log.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=rf"log\.csv{message}"):
        exm.read_experience_log(path)
