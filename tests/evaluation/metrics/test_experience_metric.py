"""The Experience Metric: known values in its four modes, and invariants."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.metrics.exm import (
    EXM_MODES,
    LITERAL_WARNING,
    NO_RELOCALISATION,
    ExmConfig,
    base_end,
    change_rows,
    experience_metric,
    relocalisations,
)
from evaluation.metrics.statistics import bootstrap
from tactile.base.errors import InputError
from tactile.base.se2 import wrap


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


def test_one_place_mistaken_for_another(square):
    ids, truth = square(3, 4)
    ids[64:][ids[64:] == 3] = 7
    scores = arcr(ids, truth)
    assert scores["strict"] == 60 / 64
    assert scores["paper"] == 56 / 64
    assert scores["or"] == 62 / 64


def test_or_mode_accepts_two_exchanged_places(square):
    ids, truth = square(2, 4)
    ids[32:] = np.choose(ids[32:], [0, 1, 2, 7, 4, 5, 6, 3])
    scores = arcr(ids, truth)
    assert scores["paper"] == scores["strict"] == 24 / 32
    assert scores["or"] == 30 / 32


def test_headings_are_compared_across_half_a_turn(square):
    ids, truth = square(4, 6)
    noise = np.random.default_rng(0).normal(0.0, np.radians(2), len(truth))
    truth[:, 2] = wrap(truth[:, 2] + noise)
    wrapped, printed = (
        experience_metric(ids, truth, ExmConfig(mode=mode, position=0.2)) for mode in ("paper", "literal")
    )
    assert (wrapped.entries, wrapped.arcr) == (144, 1.0)
    assert wrapped.near[wrapped.counted].all()
    assert 9 <= np.sum(wrapped.near & ~printed.near & wrapped.counted) <= 27  # half of 36, about


def test_literal_mode_notes_that_it_is_zero_by_construction(square):
    result = experience_metric(*square(2, 4), ExmConfig(mode="literal"))
    assert (result.arr, result.arcr, result.note) == (1.0, 0.0, LITERAL_WARNING)


def test_no_relocalisation_has_no_rate(square):
    _, truth = square(2, 4)
    result = experience_metric(np.arange(64), truth)
    assert result.arr == 0.0
    assert np.isnan(result.arcr)
    assert result.note == NO_RELOCALISATION


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


def test_action_and_step_logs_differ(square):
    ids, truth = square(3, 4)
    ids[40:44] = 99  # a place made anew in the second lap, after which half of the third is new as well
    ids[80:96] = np.arange(100, 104).repeat(4)
    step, action = (experience_metric(ids, truth, ExmConfig(log=log)) for log in ("step", "action"))
    assert (step.entries, step.base) == (64, 32)
    assert (action.entries, action.base) == (16, 8)
    assert action.arr == experience_metric(ids[::4], truth[::4]).arr


def test_steps_without_an_experience_are_skipped(square):
    ids, truth = square(2, 4)
    padded = np.concatenate([[-1, -1], ids]), np.concatenate([truth[:1], truth[:1], truth])
    assert experience_metric(*padded)[:6] == experience_metric(ids, truth)[:6]


def test_turning_around_near_the_start_is_not_a_loop(square):
    _, truth = square(2, 4)
    about = np.array([[0, 0, 0], [0, 0, 1.5], [0.15, 0, 3.0], [0, 0, 0.0]])
    assert base_end(np.concatenate([about, truth[1:]])) == 32 + 3
    trembling = np.zeros((20, 3))
    trembling[::2, 0] = 0.05
    with pytest.raises(InputError, match="never returns"):
        base_end(trembling)


def test_a_run_that_never_returns_needs_a_base_set(square):
    ids, truth = square(2, 4)
    with pytest.raises(InputError, match=r"never returns within .* set `base`, the end of the base set"):
        experience_metric(ids[:30], truth[:30])
    assert experience_metric(ids[:30], truth[:30], ExmConfig(base=8)).base == 8


@pytest.mark.parametrize(
    ("ids", "truth", "base", "message"),
    [
        (np.zeros(3, int), np.zeros((2, 3)), 0, "shapes"),
        (np.zeros(0, int), np.zeros((0, 3)), 0, "shapes"),
        (np.zeros(3, int), np.full((3, 3), np.nan), 0, "row 0: .*remove such rows"),
        (np.zeros(3, int), np.zeros((3, 3)), 4, "i_base: 4; expected 0 to 3"),
    ],
)
def test_invalid_logs_are_refused(ids, truth, base, message):
    with pytest.raises(InputError, match=message):
        experience_metric(ids, truth, ExmConfig(base=base))


def test_changes_skip_steps_without_an_experience():
    assert change_rows(np.array([-1, 4, 4, -1, 4, 2, 2, 4])).tolist() == [1, 5, 7]
    assert change_rows(np.array([-1, -1])).tolist() == []


def test_bootstrap_is_fixed_by_seed_and_name():
    values = np.random.default_rng(1).normal(size=30)
    low, high = bootstrap(values, "a")
    assert (low, high) == bootstrap(values, "a")
    assert (low, high) != bootstrap(values, "b")
    assert (low, high) != bootstrap(values, "a", seed=1)
    assert low < values.mean() < high
    # of the normal approximation, within a tenth
    assert high - low == pytest.approx(2 * 1.96 * values.std() / np.sqrt(30), rel=0.1)
    assert np.isnan(bootstrap(np.zeros(0), "a")).all()


logs = st.lists(st.integers(0, 6), min_size=2, max_size=60)


@st.composite
def walks(draw):
    """A log, true poses near a few spots, and an end of the base set."""
    ids = np.array(draw(logs))
    spots = np.array(draw(st.lists(st.integers(0, 6), min_size=len(ids), max_size=len(ids))))
    truth = np.stack([0.07 * spots, np.zeros(len(ids)), np.pi + 0.2 * spots], axis=1)
    return ids, truth, draw(st.integers(1, len(ids)))


law = settings(derandomize=True, deadline=None)


@law
@given(walks(), st.permutations(range(7)))
def test_renumbering_experiences_has_no_effect(walk, names):
    ids, truth, base = walk
    renamed = np.array(names)[ids] * 1000 - 7
    for mode in EXM_MODES:
        config = ExmConfig(mode=mode, base=base)
        before, after = experience_metric(ids, truth, config), experience_metric(renamed, truth, config)
        assert np.array_equal(before.counted, after.counted)
        assert np.array_equal(before.right, after.right)


@law
@given(walks())
def test_literal_arcr_is_zero_and_arr_is_the_same_in_all_modes(walk):
    ids, truth, base = walk
    results = [experience_metric(ids, truth, ExmConfig(mode=mode, base=base)) for mode in EXM_MODES]
    assert results[EXM_MODES.index("literal")].correct == 0
    assert len({result.relocalisations for result in results}) == 1
    assert all((result.right <= result.counted).all() for result in results)


@law
@given(walks())
def test_relocalisations_are_those_of_the_listing(walk):
    ids, _, base = walk
    found, listed = set(), []
    for i in range(base, len(ids)):
        again = ids[i] in ids[:i]
        if again and not (ids[i] == ids[i - 1] and ids[i - 1] not in found):
            found.add(ids[i])
        listed.append(ids[i] in found)
    assert relocalisations(ids, base)[base:].tolist() == listed


@law
@given(walks(), st.data())
def test_repeating_the_last_lap_does_not_lower_arr(walk, data):
    ids, truth, base = walk
    lap = data.draw(st.integers(1, len(ids)))
    if ids[-lap] == ids[-1] or base == len(ids):
        return  # not a lap: it would begin with a dwell
    before = experience_metric(ids, truth, ExmConfig(base=base))
    longer = np.append(ids, ids[-lap:]), np.append(truth, truth[-lap:], axis=0)
    assert experience_metric(*longer, ExmConfig(base=base)).arr >= before.arr


@law
@given(walks(), st.lists(st.integers(-3, 3), min_size=60, max_size=60))
def test_full_turns_of_the_heading_have_no_effect(walk, turns):
    ids, truth, base = walk
    turned = truth + np.outer(turns[: len(ids)], [0, 0, 2 * np.pi])
    for mode in ("strict", "paper", "or"):
        before, after = (experience_metric(ids, p, ExmConfig(mode=mode, base=base)) for p in (truth, turned))
        assert np.array_equal(before.right, after.right)


def test_a_hundred_thousand_entries_take_about_a_second():
    random = np.random.default_rng(3)
    ids, truth = random.integers(0, 3000, 25_000).repeat(4), random.normal(size=(100_000, 3))
    assert experience_metric(ids, truth, ExmConfig(base=5000)).entries == 95_000
