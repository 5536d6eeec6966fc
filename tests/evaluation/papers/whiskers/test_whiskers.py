"""Real whiskers and Creates: signals and marks, contacts, the walk over real images, figures, their page."""

from collections.abc import Iterator
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from evaluation.papers import figure as figures_of_papers
from evaluation.papers.figure import REAL, Figure, write_page
from evaluation.papers.tables.recordings import REACH, UNPROVEN, require_recordings
from evaluation.papers.whiskers import drift, walk_source
from evaluation.papers.whiskers.bumps import wall_distances
from evaluation.papers.whiskers.contact import baseline_of, read_annotators, score_contacts
from evaluation.papers.whiskers.create import true_revisits
from evaluation.papers.whiskers.drift import score_stream
from evaluation.papers.whiskers.walk import continue_path, draw_energies, last_before_reversal
from ratslam.mapping.appearance import ViewAppearance
from ratslam.mapping.config import FULL, KeyframeMapConfig
from ratslam.mapping.map_state import MapState
from robot.recordings.real_whiskers import WHISKERS, ReachConfig, read_reach
from robot.simulation.head.baseline import HALL_BASELINE, BaselineConfig
from robot.simulation.head.odometry_errors import OdometryConfig
from robot.world.maze import CELL_SIDE
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.samples import true_runs
from tactile.base.se2 import between, compose, integrate, wrap
from tactile.calibration import calibrate_free
from tactile.contact_stream import Touch, find_contacts, find_fixed_contacts, start_stream
from tests.evaluation.papers.shown import table_of
from tests.helpers.commands import ROOT

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


@pytest.mark.parametrize(("old", "new", "match"), [
    (HEADER, "whisker,row,label\n", "columns"),
    ("left0,6,8", "left0,6,7", "row 7 of left0"),
    ("left0,6,8", "left0,5,8", ":3: rows 5 to 8"),
    ("right0,0,10", "right0,0,11", ":5: rows 0 to 11"),
    ("unclear", "maybe", ":4: .*maybe"),
    ("right0", "right7", ":5: .*right7"),
    (MARKS, "left0,0\n", ":2: "),
])  # fmt: skip
def test_damaged_marks_are_refused(tmp_path: Path, old: str, new: str, match: str) -> None:
    (tmp_path / "one.csv").write_text((HEADER + MARKS).replace(old, new))
    with pytest.raises(InputError, match=match):
        read_annotators(tmp_path, MARKED, 10)


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


def test_the_baseline_goes_straight_across_a_contact_and_unclear_rows_have_their_own_scores() -> None:
    line = np.linspace(0, 20, 2000)
    contact = (np.arange(2000) >= 800) & (np.arange(2000) < 1200)
    found = baseline_of((line + 1000 * contact)[:, None], contact)
    np.testing.assert_allclose(found[200:1800, 0], line[200:1800], atol=0.01)
    marks = np.array([1, 1, 1, 1, 0, 0, 0, 2, 2, 2])
    contact = np.array([1, 1, 1, 0, 1, 0, 0, 1, 0, 0], bool)
    assert score_contacts(contact, marks) == pytest.approx((3 / 4, 3 / 4, 3 / 5, 3 / 6, 0.3))
    assert np.isnan(score_contacts(np.zeros(4, bool), np.zeros(4, np.int8))[:2]).all()


MODEL = np.repeat([[2.0], [0.45], [0.1]], 3, axis=1)
SNIPPET = np.concatenate([np.zeros((10, 3)), np.full((40, 3), 500.0), np.zeros((10, 3))]), slice(10, 50)


def blocks(seed: int = 0, count: int = 20):
    return drift.simulate_stream(MODEL, [SNIPPET], 4, count, 300, seed)


def test_the_fit_finds_the_model_and_the_creep_of_a_signal() -> None:
    whites = stream(0, "fit").standard_normal((40_000, 1, 3))
    noise = 2.0 * np.sqrt(1 - 0.45**2) * lfilter([1.0], [1.0, -0.45], whites, axis=0)
    walk = np.cumsum(0.1 * stream(1, "fit").standard_normal(noise.shape), axis=0)
    found = drift.fit_free_model(noise + walk)
    for row, (expected, within) in zip(found, ((2.0, 0.2), (0.45, 0.1), (0.1, 0.035)), strict=True):
        np.testing.assert_allclose(row, expected, atol=within)
    time = np.arange(2400) / drift.RATE
    held = (time > 3) & (time < 5)
    since = np.maximum(time - 5, 0)
    offset = 400 * 0.05 * (1 - np.exp(-2 / 0.8)) * np.exp(-since / 0.8) * (time >= 5)
    signal = stream(0, "noise").standard_normal((2400, 3, 3))
    signal[..., 1] += np.where(held, 400.0, offset)[:, None]
    found, shares, _ = drift.creep_figures(signal, None)
    assert np.median(shares) == pytest.approx(0.05, rel=0.1)
    assert found == pytest.approx(0.8, rel=0.15)
    signal[..., 1] = np.where(held[:, None], 400.0, stream(1, "noise").standard_normal((2400, 3)))
    assert np.abs(drift.creep_figures(signal, 0.8)[1]).max() < 0.005


def test_a_stream_follows_from_its_seed_without_jumps_and_its_scores_add_up() -> None:
    first, again, other = ([samples for samples, _ in blocks(seed, 5)] for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[0], other[0])
    assert max(np.abs(b[0] - a[-1]).max() for a, b in pairwise(first)) < 20
    rules = {
        "always": lambda samples: np.ones(samples.shape[:2], bool),
        "never": lambda samples: np.zeros(samples.shape[:2], bool),
        "true": lambda samples: (np.abs(samples) > 200).any(axis=-1),
    }
    scores, free = score_stream(rules, blocks()), 20 * 4 * (300 - 60)
    assert scores["never"].tolist() == [80, 80, 0, 0, free]
    assert scores["true"].tolist() == [80, 0, 0, 0, free]
    contacts, missed, false, *wrong = scores["always"].tolist()
    assert (contacts, missed, wrong, false >= 80) == (80, 0, [free, free], True)
    rule, made = {"low": lambda samples: (np.abs(samples) > 6).any(axis=-1)}, blocks()
    parts = [score_stream(rule, islice(made, count))["low"] for count in (5, 15)]
    np.testing.assert_array_equal(sum(parts), score_stream(rule, blocks())["low"])


@pytest.mark.parametrize(("rate", "time"), [(0.5, 0.01), (2.0, 0.004)])
def test_colour_and_drift_of_a_signal_are_found(rate: float, time: float) -> None:
    config = BaselineConfig(colour=1.0, colour_time=time, drift=rate)
    signals = (drift.simulate_free(each, 2000).reshape(2000, -1) for each in (config, BaselineConfig()))
    found, white = (drift.free_figures(signal, drift.RATE) for signal in signals)
    assert found.time == pytest.approx(time, rel=0.2)
    assert found.drift == pytest.approx(rate, abs=0.15)
    assert white.time is None
    assert white.drift < 0.15


def test_the_simulator_has_the_noise_drift_and_creep_of_the_fitted_whiskers(reference_data, tmp_path) -> None:
    free, crept = found = drift.FIGURE.measure(reference_data)
    fitted, (creep_time, creep, _) = free["fitted"], crept["fitted"]
    assert fitted.time == pytest.approx(HALL_BASELINE.colour_time, rel=0.15)
    assert fitted.drift == pytest.approx(HALL_BASELINE.drift, rel=0.1)
    assert np.median(creep) == pytest.approx(HALL_BASELINE.creep, rel=0.15)
    assert creep_time == pytest.approx(HALL_BASELINE.creep_time, rel=0.1)
    assert not set(drift.FIT[0] + drift.FIT[1]) & set(drift.CHECK[0] + drift.CHECK[1])
    assert free["checked"].drift == pytest.approx(fitted.drift, rel=0.3)
    for control in ("control: white noise", "camera"):
        assert free[control].drift < 0.2 * fitted.drift
    assert sum(line.startswith("|") for line in table_of(drift.FIGURE, found, tmp_path)) == 2 + len(free)


def test_a_contact_counts_once_and_true_revisits_are_of_the_same_place_and_heading() -> None:
    position = np.array([[2.0, 1.0], [2.0, 0.2], [2.0, 0.3], [2.0, 1.5], [3.9, 1.5], [5.0, 4.0]])
    room = np.array([[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0]], float)
    contact = wall_distances(position, np.array([0, 1, 1, 0, 1, 0], bool), room)
    np.testing.assert_allclose(contact, [0.2, 0.1])
    # A lap of 30 keyframes driven twice, the second time 0.1 rad to the left.
    angle = 2 * np.pi * np.arange(60) / 30
    truth = np.stack([2 * np.cos(angle), 2 * np.sin(angle), angle + np.pi / 2], axis=1)
    truth[30:, 2] += 0.1
    graph = MapState(KeyframeMapConfig(), 0.3, ViewAppearance(9, -1.2), 20, FULL)
    found = [(one.keyframe, one.match, one.shift) for one in true_revisits(graph, truth)]
    assert found == [(k, k - 30, 1) for k in range(30, 60)]


def real_page(places: dict[str, str], data: Path, output: Path) -> Iterator[str]:
    return write_page(output / "real.md", places, places, lambda _, one: ((), one.measure(data)), [UNPROVEN])


def test_the_page_holds_what_was_measured_before_an_error(tmp_path: Path, monkeypatch) -> None:
    def measure(data: Path) -> str:
        require_recordings(data, "touch.csv")
        return "7 whiskers"

    def draw(result: str, picture: Path) -> None:
        picture.write_text(result)

    figures = {
        "good": Figure("Whiskers", lambda data: "7 whiskers", lambda result: [f"| {result} |"], draw),
        "bad": Figure("Fingers", measure, lambda result: [], draw),
    }
    monkeypatch.setattr(figures_of_papers, "find_figure", figures.__getitem__)
    output, lines = tmp_path / "new" / "page", list[str]()
    with pytest.raises(InputError, match=r"touch\.csv"):
        lines.extend(real_page(dict(zip(figures, figures, strict=True)), tmp_path, output))
    page = (output / "real.md").read_text(encoding="utf-8")
    assert page.endswith(UNPROVEN)
    assert lines == page.removesuffix(UNPROVEN).split("\n")[: len(lines)]
    assert {"| 7 whiskers |", "![Whiskers](good.png)"} <= set(lines)
    assert sorted(path.name for path in output.iterdir()) == ["good.png", "real.md"]


@pytest.mark.parametrize(("name", "file"), [("drift", "reaching_take20"), ("bumps", "create_lab_odometry")])
def test_nothing_is_left_where_a_recording_is_missing(tmp_path: Path, name: str, file: str) -> None:
    with pytest.raises(InputError, match=file):
        list(real_page({name: REAL[name]}, tmp_path, tmp_path / "page"))
    assert not (tmp_path / "page").exists()


def along(cells, heading=0.0, whisks=6):
    x = (np.repeat(cells, whisks) + 0.5) * CELL_SIDE
    return np.column_stack([x, np.full(len(x), 0.5 * CELL_SIDE), np.full(len(x), heading)])


def test_a_place_is_a_cell_and_a_facing_and_a_visit_ends_after_long_enough_elsewhere():
    there, back = along(np.arange(40)), along(np.arange(40), heading=np.pi)
    thing, later = walk_source.plan_visits(np.concatenate([there, back, there]), 10, seed=1)
    first, turned, again = thing.reshape(3, 40, 6)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal((first, turned), np.stack([first, turned])[:, :, :1].repeat(6, axis=2))
    assert (first != turned).mean() > 0.5
    np.testing.assert_array_equal(later, np.arange(720) >= 480)
    for away, again in ((walk_source.AWAY - 1, 0), (walk_source.AWAY, 6)):
        path = np.concatenate([along([0]), along([1], whisks=away), along([0])])
        assert walk_source.plan_visits(path, 10, 0)[1].sum() == again


def test_rows_come_from_the_half_of_the_visit_never_twice_and_too_few_are_refused(tmp_path):
    number = np.arange(60.0).reshape(3, 20, 1, 1)
    records = [np.broadcast_to(one, (20, 8, 16)).copy() for one in number]
    random = np.random.default_rng(2)
    thing, later = random.integers(3, size=24), random.random(24) < 0.5
    number = walk_source.draw_by_place(records, (thing, later), seed=3)[:, 0, 0]
    assert len(set(number)) == 24
    np.testing.assert_array_equal(number // 20, thing)
    np.testing.assert_array_equal(number % 20 >= 10, later)
    visits = np.zeros(11, int), np.zeros(11, bool)
    assert walk_source.most_needed(visits) == 11
    with pytest.raises(InputError, match="object 0 is felt 11 times"):
        walk_source.draw_by_place(records, visits, seed=0)
    some = ROOT / "tests" / "data" / "real_touch" / "purdue"
    for folder, named in ((tmp_path, "no CSV files"), (some, "choose another seed")):
        config = walk_source.WalkConfig(folder=folder, simulation=walk_source.walk_simulation(31200))
        with pytest.raises(InputError, match=named):
            walk_source.open_walk(config)


def test_the_reckoned_path_is_true_up_to_its_start_and_a_reversal_is_the_largest_turn():
    motion = np.random.default_rng(0).normal(size=(10, 3))
    truth = integrate(np.random.default_rng(1).normal(size=(10, 3)))
    path = continue_path(truth, motion, 3)
    np.testing.assert_array_equal(path[:4], truth[:4])
    np.testing.assert_allclose(between(path[3:-1], path[4:])[:, :2], motion[4:, :2], atol=1e-9)
    turns = np.zeros(40)
    turns[5:9], turns[20:27], turns[30:34] = 0.4, -0.45, 0.4
    heading = 3.0 + np.cumsum(turns)
    truth = np.column_stack([np.zeros((40, 2)), wrap(heading)])
    assert last_before_reversal(truth) == 19
    with pytest.raises(ValueError, match="empty"):
        last_before_reversal(np.zeros((5, 3)))


def test_drawn_energies_are_those_of_the_noise_and_of_the_path():
    """Along a line and, after a turn, back."""
    x = np.concatenate([np.arange(20), np.full(7, 19), np.arange(19, -1, -1)]) * 0.05
    heading = wrap(np.concatenate([np.zeros(20), np.arange(1, 8) * np.pi / 7, np.full(20, np.pi)]))
    truth, time = np.column_stack([x, np.zeros(len(x)), heading]), np.arange(len(x), dtype=float)

    def energies_of(paths, noise):
        config, last = OdometryConfig(noise=noise), last_before_reversal(truth)
        return draw_energies(paths, truth, time, last, config, seed=3, draws=5)

    moved = compose(np.array([2.0, -1.0, 0.7]), truth)
    bent = truth + np.linspace(0, 0.4, len(truth))[:, None] * [0, 0, 1.0]
    np.testing.assert_allclose(energies_of((truth, moved), "none"), 0, atol=1e-12)
    drawn = energies_of((truth, moved, bent), "gated")
    np.testing.assert_allclose(drawn[0], drawn[1], rtol=1e-6)
    assert drawn[0].min() > 0
    assert len(np.unique(drawn[0])) == 5
    assert (drawn[2] != drawn[0]).all()
    np.testing.assert_array_equal(drawn[0], energies_of((truth,), "gated")[0])
