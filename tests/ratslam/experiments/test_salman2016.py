"""The paper's figures made again: laps, controls, verdicts, batches, and a tiny reproduction end to end."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import ratslam.experiments.salman2016
from ratslam.cli import main
from ratslam.cli.reproduce import NAMES
from ratslam.config.run_config import RunConfig
from ratslam.experiments.salman2016 import jobs_of, matched, reproduce
from ratslam.experiments.salman2016.claims import Row, column, table, verdict
from ratslam.experiments.salman2016.direction_metrics import across, directions, lap_of
from ratslam.experiments.salman2016.protocols import PROTOCOLS, THRESHOLDS, Claim
from ratslam.experiments.trials.controls import controlled
from ratslam.experiments.trials.threshold_sweep import classics, mapped
from ratslam.experiments.trials.touch_trial import (
    Played,
    figures,
    first,
    lap_ends,
    play,
    room_for,
    session_log,
)
from tactile.base.errors import InputError
from tactile.base.se2 import compose

TINY = (
    "simulation.maze.columns=2",
    "simulation.maze.rows=2",
    "simulation.maze.loop=4",
    "simulation.path.circuits=CCA",
    "simulation.kidnaps.ahead=2.0",
)
RISES = Claim("a rises", "arr", "rises", "a", "b")


def square(word, side=12):
    """True poses of laps around a square of 0.36 m, 3 cm a step; C clockwise, A anticlockwise."""
    way = np.linspace(0, 1, side, endpoint=False)
    zero, one = np.zeros(side), np.ones(side)
    x = 0.36 * np.concatenate([way, one, 1 - way, zero])
    y = 0.36 * np.concatenate([zero, way, one, 1 - way])
    heading = np.repeat([0, np.pi / 2, np.pi, -np.pi / 2], side)
    lap = np.column_stack([x, y, heading])
    back = np.roll(lap[::-1], 1, axis=0) + [0, 0, np.pi]
    laps = [lap if letter == "A" else back for letter in word]
    return np.concatenate([*laps, laps[-1][:1]])


def session(truth, **given):
    still = {
        "truth": truth,
        "odometry": truth,
        "trajectory": truth,
        "place": np.arange(len(truth)),
        "node": truth,
        "closures": np.zeros((0, 2), int),
    }
    return Played(**{**still, **given})


@pytest.fixture(scope="module")
def tiny():
    data = {"path": {"circuits": "CCA"}, "maze": {"columns": 2, "rows": 2, "loop": 4}}
    return session_log(RunConfig.model_validate({"simulation": data, "backend": "classic"}))


# Laps and sessions


@pytest.mark.parametrize("word", ["C", "CA", "CCCAAACACA"])
def test_laps_end_where_they_began(word):
    truth = square(word)
    ends = lap_ends(truth)
    assert ends.tolist() == [48 * (k + 1) for k in range(len(word))]
    assert np.bincount(lap_of(truth, len(word))).tolist() == [49, *[48] * (len(word) - 1)]


def test_a_path_that_never_returns_has_no_laps():
    assert len(lap_ends(square("C")[:40])) == 0


def test_a_perfect_map_has_no_energy_wherever_it_lies():
    truth = square("CC")
    moved = compose(np.array([3.0, -1.0, 2.0]), truth)
    place = np.arange(len(truth)) % 48
    perfect = session(truth, trajectory=moved, place=place, node=moved[:48])
    trial = figures(perfect)
    assert trial.em == pytest.approx(0, abs=1e-9)
    assert trial.em_places == pytest.approx(0, abs=1e-9)
    assert (trial.arcr, trial.near) == (1, 1)
    assert trial.arr > 0.9  # the base set ends a few steps before the places begin again
    assert figures(session(truth)).arr == 0


def test_closures_are_false_from_ten_centimetres_on():
    truth = square("CC")
    closures = np.array([[48, 0], [50, 2], [60, 8], [60, 30]])
    trial = figures(session(truth, closures=closures))
    assert (trial.closures, trial.false) == (4, 2)


def test_a_step_lies_where_its_experience_does():
    truth = square("CC")
    spread = session(truth, place=np.arange(len(truth)) // 4, node=truth[::4])
    trial = figures(spread)
    assert trial.em == 0 < trial.em_places


def test_sessions_in_one_engine_do_not_know_of_each_other(tiny):
    config, log = tiny
    once = play(config, log)
    play(config, first(log, 50))
    again = play(config, log)
    assert all(np.array_equal(a, b) for a, b in zip(once, again, strict=True))
    assert len(once.truth) == log.length


@given(st.integers(1, 5000))
def test_rooms_are_powers_of_two_that_suffice(steps):
    room = room_for(steps)
    assert room >= steps
    assert room & (room - 1) == 0
    assert room < 2 * steps + 512


def test_a_batch_of_thresholds_is_what_single_sessions_give(tiny):
    config, log = tiny
    batch = classics(config, log, np.array([0.01, config.templates.threshold]))
    assert len(np.unique(batch.place[0])) != len(np.unique(batch.place[1]))
    alone, folded = play(config, log), mapped(config, log, batch, 1)
    assert np.array_equal(batch.place[1], alone.place)
    assert np.allclose(folded.trajectory, alone.trajectory, atol=1e-9)
    assert np.array_equal(folded.closures, alone.closures)


def test_thresholds_are_the_classic_matchers(tiny):
    config, log = tiny
    with pytest.raises(ValueError, match="classic"):
        classics(config.model_copy(update={"backend": "recall"}), log, np.array([0.1]))


# Controls


@pytest.mark.parametrize("control", ["shuffled", "blank", "ideal"])
def test_controls_change_views_and_nothing_else(tiny, control):
    log = tiny[1]
    changed = controlled(log, control, 1)
    assert changed.views.shape == log.views.shape
    assert not np.array_equal(changed.views, log.views)
    assert np.array_equal(changed.motion, log.motion)
    assert np.array_equal(changed.truth, log.truth)
    assert np.array_equal(changed.views, controlled(log, control, 1).views)
    assert 0 <= changed.views.min() <= changed.views.max() <= 1
    assert controlled(log, "as felt", 1) is log


def test_shuffled_views_are_the_same_views(tiny):
    log = tiny[1]
    views, shuffled = (np.sort(x.views.reshape(-1)) for x in (log, controlled(log, "shuffled", 0)))
    assert np.array_equal(views, shuffled)
    assert not controlled(log, "blank", 0).views.any()


def test_ideal_views_tell_spot_and_sector(tiny):
    log = tiny[1]
    views = controlled(log, "ideal", 0).views.reshape(log.length, -1)
    x, y, heading = np.asarray(log.truth).T
    spot = np.stack([np.round(x / 0.06), np.round(y / 0.06), np.round(heading / (np.pi / 4)) % 8], axis=1)
    same = (spot[:, None] == spot[None]).all(axis=2)
    alike = (views[:, None] == views[None]).all(axis=2)
    assert np.array_equal(same, alike)
    assert same.sum() > log.length


# What single figures measure


def test_laps_the_other_way_round_are_associated_by_experience_or_closure():
    word, truth = "CA", square("CA")
    new = directions(session(truth), word)
    assert (new["first_anticlockwise"], new["apart"]) == (0, 0)
    nearest = [int(np.argmin(np.hypot(*(truth[:49, :2] - p[:2]).T))) for p in truth]
    known = directions(session(truth, place=np.array(nearest)), word)
    assert known["first_anticlockwise"] == known["rightly"] == 1
    wrong = directions(session(truth, place=np.where(np.arange(len(truth)) > 48, 24, nearest)), word)
    assert wrong["first_anticlockwise"] == 1 > wrong["rightly"]
    closures = np.array([[k, nearest[k]] for k in range(49, 73)])
    half = directions(session(truth, closures=closures), word)
    assert half["first_anticlockwise"] == half["counterparts"] == pytest.approx(0.5)
    assert half["rightly"] == 1
    assert wrong["counterparts"] < 0.5


def test_what_joins_an_associated_step_is_associated_too():
    word, truth = "CAA", square("CAA")
    again = np.array([[k, k - 48] for k in range(97, 145)])
    none = directions(session(truth, closures=again), word)
    assert none["last_anticlockwise"] == 0
    first_lap = np.array([[k, 0] for k in range(49, 97)])
    all_of_it = directions(session(truth, closures=np.concatenate([first_lap, again])), word)
    assert all_of_it["last_anticlockwise"] == 1 > all_of_it["rightly"]


def test_directions_lie_apart_as_far_as_the_map_puts_them():
    truth = square("CA")
    moved = truth + np.where(np.arange(len(truth)) > 48, 1, 0)[:, None] * [0.3, 0, 0]
    assert directions(session(truth, trajectory=moved), "CA")["apart"] == pytest.approx(0.3)
    assert np.isnan(directions(session(truth), "CC")["apart"])


def test_closures_across_the_change_are_counted():
    truth = square("CCC")
    closures = np.array([[90, 2], [100, 80], [30, 4], [44, 42]])
    assert across(session(truth, closures=closures))["across"] == 2  # 145 steps: the change is at 43


# Verdicts


def test_claims_are_confirmed_refuted_or_neither():
    low, high = np.array([0.1, 0.2, 0.3]), np.array([0.3, 0.4, 0.6])
    assert verdict(RISES, low, high).word == "confirmed"
    assert verdict(RISES, high, low).word == "refuted"
    assert verdict(RISES, low, low).word == "refuted"
    assert verdict(RISES, low, low[::-1]).word == "not decided"
    assert verdict(RISES, low, np.array([0.2, np.nan, np.nan])).word == "cannot be told"
    alike = RISES._replace(kind="alike")
    assert verdict(alike, low, low + 0.01).word == "confirmed"
    assert verdict(alike, low, high).word == "refuted"
    small = RISES._replace(kind="small")
    assert verdict(small, low / 10, high).word == "confirmed"
    assert verdict(small, high, low).word == "refuted"


@given(st.lists(st.tuples(st.floats(0.01, 10), st.floats(0.01, 10)), min_size=2, max_size=6))
def test_the_opposite_claim_gets_no_confirmation_too(pairs):
    here, there = np.array(pairs).T
    for claim in (RISES, RISES._replace(quantity="em")):
        forth, back = verdict(claim, here, there), verdict(claim, there, here)
        assert {forth.word, back.word} != {"confirmed"}
        if forth.word == "confirmed":
            assert back.word == "refuted"
        slack = 1e-9 * (1 + abs(forth.found))
        assert forth.low - slack <= forth.found <= forth.high + slack


def test_energies_are_compared_by_ratio():
    em = RISES._replace(quantity="em")
    found = verdict(em, np.array([0.01, 1.0]), np.array([0.02, 2.0]))
    assert found.found == pytest.approx(2)
    assert found.word == "confirmed"


def test_sets_stay_paired_where_one_is_missing():
    rows = [Row("a", "ours", "as felt", k, k, {"arr": k / 10}) for k in (0, 2)]
    assert np.array_equal(column(rows, "a", "ours", "as felt", "arr"), [0, np.nan, 0.2], equal_nan=True)


@pytest.mark.parametrize(("sets", "said"), [(1, False), (3, True), (6, False)])
def test_a_table_says_how_little_few_sets_prove(sets, said):
    protocol = PROTOCOLS["fig6"]
    rows = [
        Row(condition.name, "ours", "as felt", k, k, {"arr": 0.1 * k + number / 10})
        for k in range(sets)
        for number, condition in enumerate(protocol.conditions)
    ]
    text = table(protocol, rows, sets)
    assert ("in 25% of cases" in text) == said
    assert ("CONFIRMED: difference 0.1" in text) == (sets > 1)
    assert "0.1765" in text


def test_matched_thresholds_reach_what_all_conditions_reach():
    def row(name, arcr, arr):
        return Row(name, "classic", "sweep", 0, 0, {"arcr": arcr, "arr": arr, "threshold": arr})

    rows = [
        row("a", 0.9, 0.1),
        row("a", 0.8, 0.3),
        row("a", 0.5, 0.6),
        row("b", 0.7, 0.2),
        row("b", 0.6, 0.4),
    ]
    found = matched([*rows, row("c", np.nan, 0.0)], ["a", "b", "c"])
    assert {name: r.values["arr"] for name, r in found.items()} == {"a": 0.3, "b": 0.2}
    assert matched([], ["a"]) == {}


# The reproductions themselves


def test_the_program_knows_them_all():
    assert set(NAMES) == set(PROTOCOLS)


@pytest.mark.parametrize("name", NAMES)
def test_every_condition_can_be_configured_and_sees_the_same_sets(name):
    protocol = PROTOCOLS[name]
    jobs = jobs_of(protocol, 2, 0)
    seeds = [{job.task.config.simulation.seed for job in jobs if job.number == n} for n in (0, 1)]
    assert [len(each) for each in seeds] == [1, 1]
    assert seeds[0] != seeds[1]
    names = {condition.name for condition in protocol.conditions}
    assert all({claim.here, claim.there} <= names | {""} for claim in protocol.claims)
    assert {condition for condition, _ in protocol.paper} <= names
    for job in jobs:
        if job.method == "classic":
            transform = job.task.config.touch.image.transform
            assert job.task.config.templates.threshold == THRESHOLDS[transform]
            assert job.task.config.templates.energy == 0.05


def test_a_tiny_reproduction_leaves_table_rows_and_figure(tmp_path, capsys):
    sets = [part for assignment in TINY for part in ("--set", assignment)]
    arguments = ["reproduce", "fig6", "--sets", "1", "--workers", "1", "-o", str(tmp_path), *sets]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert "0.1765" in text
    assert "0.2257" in text
    assert "claim: RCP raises ARR" in text
    with (tmp_path / "fig6.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * (2 + 3)
    ours = [row for row in rows if row["method"] == "ours" and row["control"] != "as felt"]
    assert all(row["closures"] == "0" and float(row["ratio"]) == pytest.approx(1, abs=0.05) for row in ours)
    assert (tmp_path / "fig6.png").read_bytes().startswith(b"\x89PNG")
    assert main(arguments) == 2
    assert "exists" in capsys.readouterr().err


def test_an_interrupt_leaves_what_was_finished(tmp_path, monkeypatch):
    def interrupted(function, tasks, workers):
        yield from (session(square("CCC")) for _ in tasks[:2])
        raise KeyboardInterrupt

    monkeypatch.setattr(ratslam.experiments.salman2016, "shared_out", interrupted)
    text, stopped = reproduce("fig2", tmp_path, sets=1, workers=1, assignments=TINY)
    assert stopped
    assert "Odometry drift" in text
    assert len((tmp_path / "fig2.csv").read_text().splitlines()) == 3
    assert not (tmp_path / "fig2.png").exists()


def test_what_cannot_be_run_is_refused_before_anything_is_written(tmp_path, capsys):
    assert main(["reproduce", "fig6", "-o", str(tmp_path / "a"), "--set", "recall.reach=-1"]) == 2
    assert "recall.reach" in capsys.readouterr().err
    assert main(["reproduce", "fig6", "-o", str(tmp_path / "a"), "--seed", "-1"]) == 2
    assert not (tmp_path / "a").exists()
    with pytest.raises(SystemExit) as stopped:
        main(["reproduce", "fig9"])
    assert stopped.value.code == 2
    with pytest.raises(InputError, match="fig9"):
        reproduce("fig9", tmp_path)


@pytest.mark.soak
@pytest.mark.parametrize("name", NAMES)
def test_reproductions_run_to_their_end(name, tmp_path):
    text, stopped = reproduce(name, tmp_path, sets=2, workers=4, assignments=TINY)
    assert not stopped
    assert PROTOCOLS[name].title in text
    assert (tmp_path / f"{name}.png").exists()
