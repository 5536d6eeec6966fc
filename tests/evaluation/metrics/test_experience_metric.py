"""The Experience Metric: known values in its four modes, invariants, and logs from CSV files."""

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
    read_experience_log,
    relocalisations,
)
from tactile.base.errors import InputError


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


def test_mistaken_and_exchanged_places(square):
    ids, truth = square(3, 4)
    ids[64:][ids[64:] == 3] = 7
    assert arcr(ids, truth) == {"strict": 60 / 64, "paper": 56 / 64, "or": 62 / 64, "literal": 0}
    ids, truth = square(2, 4)
    ids[32:] = np.choose(ids[32:], [0, 1, 2, 7, 4, 5, 6, 3])
    assert arcr(ids, truth) == {"strict": 24 / 32, "paper": 24 / 32, "or": 30 / 32, "literal": 0}


def test_values_that_mean_nothing_are_noted(square):
    ids, truth = square(2, 4)
    result = experience_metric(ids, truth, ExmConfig(mode="literal"))
    assert (result.arr, result.arcr, result.note) == (1.0, 0.0, LITERAL_WARNING)
    result = experience_metric(np.arange(64), truth)
    assert (result.arr, result.note) == (0.0, NO_RELOCALISATION)
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
    assert change_rows(np.array([-1, 4, 4, -1, 4, 2, 2, 4])).tolist() == [1, 5, 7]
    assert change_rows(np.array([-1, -1])).tolist() == []


def test_turning_around_near_the_start_is_not_a_loop(square):
    _, truth = square(2, 4)
    about = np.array([[0, 0, 0], [0, 0, 1.5], [0.15, 0, 3.0], [0, 0, 0.0]])
    assert base_end(np.concatenate([about, truth[1:]])) == 32 + 3
    trembling = np.zeros((20, 3))
    trembling[::2, 0] = 0.05
    with pytest.raises(InputError, match=r"never returns within .* set `base`"):
        base_end(trembling)
    assert experience_metric(np.arange(30), truth[:30], ExmConfig(base=8)).base == 8


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
@given(walks(), st.permutations(range(7)), st.lists(st.integers(-3, 3), min_size=60, max_size=60))
def test_names_and_full_turns_have_no_effect(walk, names, turns):
    ids, truth, base = walk
    renamed = np.array(names)[ids] * 1000 - 7
    turned = truth + np.outer(turns[: len(ids)], [0, 0, 2 * np.pi])
    results = []
    for mode in EXM_MODES:
        config = ExmConfig(mode=mode, base=base)
        before, after = experience_metric(ids, truth, config), experience_metric(renamed, truth, config)
        assert np.array_equal(before.counted, after.counted)
        assert np.array_equal(before.right, after.right)
        assert (before.right <= before.counted).all()
        if mode != "literal":
            assert np.array_equal(before.right, experience_metric(ids, turned, config).right)
        results.append(before)
    assert results[EXM_MODES.index("literal")].correct == 0
    assert len({result.relocalisations for result in results}) == 1


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


@pytest.mark.parametrize(
    "head",
    ["", "t,id,x,y,th\n", "Time, Experience, X, Y, Heading\n", "# any\ntime,experience_id,x,y,theta\n"],
)
def test_column_names_of_a_log_in_a_header(tmp_path, head):
    path = tmp_path / "log.csv"
    path.write_text(head + "0,7,0.1,0.2,3\n0.5,-1,0.1,0.2,-3\n")
    time, experience, truth = read_experience_log(path)
    assert (time.tolist(), experience.tolist()) == ([0, 0.5], [7, -1])
    assert truth.tolist() == [[0.1, 0.2, 3], [0.1, 0.2, -3]]
    path.write_text("heading,gain,y,x,id,t\n3,9,0.2,0.1,7,0\n")  # in any order among others
    time, experience, truth = read_experience_log(path)
    assert (time[0], experience[0], truth[0].tolist()) == (0, 7, [0.1, 0.2, 3])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,id,x,y\n0,1,2,3\n", ":1: no column theta"),
        ("t,id,x,y,th\n0,1,2,3,4\n1,2,3\n2,1,2,3,4\n", ":3: '1 2 3'; expected 5 finite numbers"),
        ("t,id,x,y,th\n0,1,2,3,4\n\n1,1.5,2,3,4\n", r":4: experience id 1\.5; expected a whole number"),
        ("t,id,x,y,th\n0,1,2,nan,4\n", ":2"),
        ("t,id,x,y,th\n0,1,2,,4\n", ":2"),
        ("t,id,x,y,th\n", ": no rows"),
        ("0,1,2", ": no rows"),
        (b"\xff\xfe\x00\x81", ": .*malformed"),
    ],
)
def test_malformed_logs_are_refused_with_their_line(tmp_path, text, message):
    path = tmp_path / "log.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=rf"log\.csv{message}"):
        read_experience_log(path)
