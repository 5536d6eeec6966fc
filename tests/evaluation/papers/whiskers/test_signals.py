"""Signals of real whiskers: contacts, marks of annotators, spliced streams, noise, drift and creep."""

from __future__ import annotations

from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from evaluation.papers.tables.recordings import REACH
from evaluation.papers.whiskers.contact import baseline_of, read_annotators, score_contacts
from evaluation.papers.whiskers.drift import (
    CHECK,
    FIGURE,
    FIT,
    RATE,
    creep_figures,
    fit_free_model,
    free_figures,
    score_stream,
    simulate_free,
    simulate_stream,
)
from robot.recordings.real_whiskers import WHISKERS, ReachConfig, read_reach
from robot.simulation.head.baseline import HALL_BASELINE, BaselineConfig
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.samples import true_runs
from tactile.calibration import calibrate_free
from tactile.contact_stream import Touch, find_contacts, find_fixed_contacts, start_stream
from tests.evaluation.papers.shown import table_of

MARKED = ("left0", "right0")
HEADER = "whisker,start_row,end_row,label\n"
MARKS = "left0,0,6,free\nleft0,6,8,contact\nleft0,8,10,unclear\nright0,0,10,free\n"


def test_every_row_gets_the_labels_of_its_annotators(tmp_path: Path) -> None:
    assert read_annotators(tmp_path / "nowhere", MARKED, 10) == {}
    for name in ("two", "one"):
        (tmp_path / f"{name}.csv").write_text(HEADER + MARKS)
    found = read_annotators(tmp_path, MARKED, 10)
    assert list(found) == ["one", "two"]
    assert found["one"].T.tolist() == [[0] * 6 + [1] * 2 + [2] * 2, [0] * 10]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("whisker,row,label\n", "columns"),
        (HEADER + MARKS.replace("left0,6,8", "left0,6,7"), "row 7 of left0"),
        (HEADER + MARKS.replace("left0,6,8", "left0,5,8"), ":3: rows 5 to 8"),
        (HEADER + MARKS.replace("right0,0,10", "right0,0,11"), ":5: rows 0 to 11"),
        (HEADER + MARKS.replace("unclear", "maybe"), ":4: .*maybe"),
        (HEADER + MARKS.replace("right0", "right7"), ":5: .*right7"),
        (HEADER + "left0,0\n", ":2: "),
    ],
)
def test_damaged_marks_are_refused(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / "one.csv").write_text(text)
    with pytest.raises(InputError, match=match):
        read_annotators(tmp_path, MARKED, 10)


def test_scores_without_and_with_unclear_rows() -> None:
    marks = np.array([1, 1, 1, 1, 0, 0, 0, 2, 2, 2])
    contact = np.array([1, 1, 1, 0, 1, 0, 0, 1, 0, 0], bool)
    assert score_contacts(contact, marks) == pytest.approx((3 / 4, 3 / 4, 3 / 5, 3 / 6, 0.3))
    assert np.isnan(score_contacts(np.zeros(4, bool), np.zeros(4, np.int8))[:2]).all()


def test_four_whiskers_of_the_reach_never_touch_and_the_others_a_few_times(reference_data: Path) -> None:
    config, signal = ReachConfig(file=Path("reach.csv")), read_reach(reference_data / REACH).signal
    free = calibrate_free(config.free, signal[: config.free_rows])
    assert [WHISKERS[whisker] for whisker in free.dirty] == ["right5"]
    touch = find_contacts(*start_stream(config.contact, free, config.rate), signal)[1]
    counts = [len(true_runs(whisker)) for whisker in (touch == Touch.CONTACT).T]
    assert counts[4:8] == [0, 0, 0, 0]
    assert all(1 <= count <= 6 for count in counts[:4] + counts[8:])
    fixed = find_fixed_contacts(signal[:100], signal)
    assert len(true_runs(fixed[:, 0])) > 5 * counts[0]  # a whisker that rings crosses again and again
    assert not fixed[:, 13].any()  # the dirty one is silenced


def test_the_baseline_goes_straight_across_a_contact() -> None:
    line = np.linspace(0, 20, 2000)
    contact = (np.arange(2000) >= 800) & (np.arange(2000) < 1200)
    found = baseline_of((line + 1000 * contact)[:, None], contact)
    np.testing.assert_allclose(found[200:1800, 0], line[200:1800], atol=0.01)


MODEL = np.repeat([[2.0], [0.45], [0.1]], 3, axis=1)
SNIPPET = np.concatenate([np.zeros((10, 3)), np.full((40, 3), 500.0), np.zeros((10, 3))]), slice(10, 50)


def blocks(seed: int = 0, count: int = 20):
    return simulate_stream(MODEL, [SNIPPET], 4, count, 300, seed)


def test_the_fit_finds_the_model_of_its_own_stream() -> None:
    whites = stream(0, "fit").standard_normal((40_000, 1, 3))
    noise = 2.0 * np.sqrt(1 - 0.45**2) * lfilter([1.0], [1.0, -0.45], whites, axis=0)
    found = fit_free_model(noise + np.cumsum(0.1 * stream(1, "fit").standard_normal(noise.shape), axis=0))
    for row, (expected, within) in zip(found, ((2.0, 0.2), (0.45, 0.1), (0.1, 0.035)), strict=True):
        np.testing.assert_allclose(row, expected, atol=within)


def test_a_stream_follows_from_its_seed_and_does_not_jump_between_blocks() -> None:
    first, again, other = ([samples for samples, _ in blocks(seed, 5)] for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[0], other[0])
    assert max(np.abs(b[0] - a[-1]).max() for a, b in pairwise(first)) < 20


def test_scores_count_false_and_missed_contacts_and_parts_add_up() -> None:
    rules = {
        "always": lambda samples: np.ones(samples.shape[:2], bool),
        "never": lambda samples: np.zeros(samples.shape[:2], bool),
        "true": lambda samples: (np.abs(samples) > 200).any(axis=-1),
    }
    scores, free = score_stream(rules, blocks()), 20 * 4 * (300 - 60)
    assert scores["never"].tolist() == [80, 80, 0, 0, free]
    assert scores["true"].tolist() == [80, 0, 0, 0, free]
    contacts, missed, false, *wrong = scores["always"].tolist()
    assert (contacts, missed, wrong) == (80, 0, [free, free])
    assert false >= 80
    rule, made = {"low": lambda samples: (np.abs(samples) > 6).any(axis=-1)}, blocks()
    parts = [score_stream(rule, islice(made, count))["low"] for count in (5, 15)]
    np.testing.assert_array_equal(sum(parts), score_stream(rule, blocks())["low"])


@pytest.mark.parametrize(("drift", "time"), [(0.5, 0.01), (2.0, 0.004)])
def test_colour_and_drift_of_a_signal_are_found(drift: float, time: float) -> None:
    config = BaselineConfig(colour=1.0, colour_time=time, drift=drift)
    found, white = (
        free_figures(simulate_free(each, 2000).reshape(2000, -1), RATE) for each in (config, BaselineConfig())
    )
    assert found.time == pytest.approx(time, rel=0.2)
    assert found.drift == pytest.approx(drift, abs=0.15)
    assert white.time is None
    assert white.drift < 0.15


def test_the_creep_of_a_signal_is_found() -> None:
    time = np.arange(2400) / RATE
    held = (time > 3) & (time < 5)
    since = np.maximum(time - 5, 0)
    offset = 400 * 0.05 * (1 - np.exp(-2 / 0.8)) * np.exp(-since / 0.8) * (time >= 5)
    signal = stream(0, "noise").standard_normal((2400, 3, 3))
    signal[..., 1] += np.where(held, 400.0, offset)[:, None]
    found, shares, _ = creep_figures(signal, None)
    assert np.median(shares) == pytest.approx(0.05, rel=0.1)
    assert found == pytest.approx(0.8, rel=0.15)
    signal[..., 1] = np.where(held[:, None], 400.0, stream(1, "noise").standard_normal((2400, 3)))
    assert np.abs(creep_figures(signal, 0.8)[1]).max() < 0.005


def test_the_simulator_has_the_noise_drift_and_creep_of_the_fitted_whiskers(
    reference_data: Path, tmp_path: Path
) -> None:
    free, crept = found = FIGURE.measure(reference_data)
    fitted, (creep_time, creep, _) = free["fitted"], crept["fitted"]
    assert fitted.time == pytest.approx(HALL_BASELINE.colour_time, rel=0.15)
    assert fitted.drift == pytest.approx(HALL_BASELINE.drift, rel=0.1)
    assert np.median(creep) == pytest.approx(HALL_BASELINE.creep, rel=0.15)
    assert creep_time == pytest.approx(HALL_BASELINE.creep_time, rel=0.1)
    assert not set(FIT[0] + FIT[1]) & set(CHECK[0] + CHECK[1])
    assert free["checked"].drift == pytest.approx(fitted.drift, rel=0.3)
    for control in ("control: white noise", "camera"):
        assert free[control].drift < 0.2 * fitted.drift
    lines = table_of(FIGURE, found, tmp_path)
    assert sum(line.startswith("|") for line in lines) == 2 + len(free)
