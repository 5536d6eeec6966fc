"""Metrics of sessions on made-up laps, of poses in a map, of revisits and views, and of the machine."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from evaluation.papers.fox2012.reproduction import LEAVE_DISTANCE, find_revisits, path_metrics
from evaluation.papers.maps.localisation_metrics import BUILDING, RIGHT, WRONG, MapSteps, pose_errors
from evaluation.papers.salman2016.protocols import direction_metrics, lap_of_step
from evaluation.studies.machine import one_core, peak_memory, reset_peak_memory, watch_load
from evaluation.studies.metrics import (
    ViewDifferences,
    compare_views,
    image_difference,
    lap_ends,
    touch_metrics,
)
from tactile.base.errors import InputError
from tactile.base.se2 import compose
from tests.helpers.laps import session, square

CHANGE = 0.3
VIEWS = arrays.arrays(float, (5, 3, 6, 1), elements=st.sampled_from([0.0, 0.02, 0.5, 1.0]))
VALUES = st.lists(st.integers(0, 5), min_size=1, max_size=9)


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


def test_laps_the_other_way_round_are_associated_by_experience_or_closure():
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


def test_closures_associate_by_way_of_other_steps_and_are_counted_across_the_change():
    again, first_lap = (
        np.array([[k, k - 48] for k in range(97, 145)]),
        np.array([[k, 0] for k in range(49, 97)]),
    )
    none, every = (
        direction_metrics(session(square("CAA"), closures=closures), "CAA", CHANGE)
        for closures in (again, np.concatenate([first_lap, again]))
    )
    assert none["last_anticlockwise"] == 0
    assert every["last_anticlockwise"] == 1 > every["associated_correct"]
    closures = np.array([[90, 2], [100, 80], [30, 4], [44, 42]])
    across = direction_metrics(session(square("CCC"), closures=closures), "CCC", CHANGE)["across"]
    assert across == 2  # 145 steps: the change is at 43


def there_and_back(far: float = 1.0) -> np.ndarray:
    x = np.concatenate([np.linspace(0, far, 40), np.linspace(far, 0, 40)])
    return np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])


def test_returns_are_found_as_revisits_and_closed_by_their_offset():
    truth = there_and_back()
    later, earlier = find_revisits(truth).T
    assert (later >= 40).all()
    assert np.abs(truth[later, 0] - truth[earlier, 0]).max() < 0.02
    assert truth[later, 0].max() < 1 - LEAVE_DISTANCE / 2 + 0.03  # not near the turn
    assert len(find_revisits(truth[:40])) == len(find_revisits(there_and_back(LEAVE_DISTANCE))) == 0
    shifted = truth + [3.0, -4.0, 0.1]
    found = path_metrics(shifted, shifted, truth)
    assert found["online_error"] == found["final_error"] == pytest.approx(5)
    assert found["revisit_gap"] == pytest.approx(0, abs=1e-12)
    assert found["revisits_closed"] == 1
    assert found["online_heading_error_deg"] == pytest.approx(np.degrees(0.1))
    drifted = truth + np.column_stack([np.zeros(80), np.linspace(0, 1, 80), np.zeros(80)])
    assert path_metrics(truth, drifted, truth)["revisits_closed"] == 0
    assert path_metrics(truth[:9], truth[:9], truth[:9])["revisits_closed"] is None


STRAIGHT = np.column_stack([0.1 * np.arange(11), np.zeros((11, 2))])
"""Steps of 0.1 m along x."""


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


def test_a_wrong_place_is_an_error_of_its_distance_and_turn():
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


def test_steps_without_truth_are_left_out():
    truth = STRAIGHT.copy()
    truth[3] = np.nan
    steps = MapSteps.known(STRAIGHT, truth)
    assert len(steps.pose) == 10
    error = steps.errors(STRAIGHT, truth, 0.1)
    assert np.isnan(error[3]).all()
    assert not WRONG.exceeded(error)[3]
    assert RIGHT.holds(error).tolist() == [k != 3 for k in range(11)]


def test_between_right_and_wrong_is_neither():
    error = np.array([[0.09, 0.3], [0.1, 0.0], [0.19, 0.0], [0.0, 0.6]])
    assert RIGHT.holds(error).tolist() == [True, False, False, False]
    assert WRONG.exceeded(error).tolist() == [False, False, True, True]


def compared(truth, views, step=10.0):
    """Views of one number each, `step` seconds apart."""
    time = step * np.arange(len(views))
    differences = lambda some, others: np.abs(some[:, None] - others[None])  # noqa: E731
    return compare_views(views, np.asarray(truth, float), time, differences, "made up")


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


def test_memory_is_measured_for_one_piece_of_work():
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


def test_measuring_uses_one_core_and_releases_it():
    if not hasattr(os, "sched_getaffinity"):
        pytest.skip("this system does not say on which cores a process runs")
    cores, load = os.sched_getaffinity(0), watch_load()
    with one_core():
        assert len(os.sched_getaffinity(0)) == 1
        assert os.sched_getaffinity(0) <= cores
    assert os.sched_getaffinity(0) == cores
    found = load()
    assert found is None or found >= 0
