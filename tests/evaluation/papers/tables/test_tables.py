"""The tables of results: rows, regressions, files of sessions, two runs compared, batches and cycles."""

import csv
import json
import re
import sys
from functools import cache
from pathlib import Path
from types import ModuleType

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.papers.tables import buildings, closures, comparison, cycles, health, recordings
from evaluation.papers.tables import grid_table as grid
from evaluation.papers.tables import touch_table as touch
from evaluation.papers.tables.batches import Recording, RecordingSession, SessionBatch
from evaluation.papers.tables.closures import closures_table, fit_weights
from evaluation.papers.tables.comparison import Measured, Record, SessionLog, read_sessions
from evaluation.papers.tables.markdown import markdown_header, markdown_row, select_rows
from evaluation.papers.trial_sessions import ClosureClaims
from evaluation.studies import machine
from evaluation.studies.metrics import TouchMetrics
from ratslam.mapping.closure_judge import KINDS, WEIGHTS, SequenceEvidence, shipped_weights
from tactile.base.errors import InputError
from tests.evaluation.papers.shown import rows_of
from tests.helpers.commands import refused
from tests.ratslam.runs.touch_walks import empty_merging_session, simulate_walk

ROWS = ("clean", "main")

METRICS = TouchMetrics(
    em=0.01, em_experiences=0.02, em_odometry=2.0, arr=0.5, arcr=0.9, arcr_chain_free=0.95,
    relocalisations=90, closures=100, false_closures=3, experiences=50, steps=200,
)  # fmt: skip
TOLD = {"revisits_closed": 0.8, "em_live": 0.04, "em_pieces": 0.008, "unjoined": 0.1, "across": 40}


def touched(whisks=(), **changed):
    """A touch session with other figures than the usual ones."""
    return Measured(METRICS._asdict() | TOLD | {"kidnaps": len(whisks)} | changed, {"whisks": whisks})


def stub_sessions(monkeypatch, result):
    """Replaces the sessions of a table; returns the tasks that it asks for."""
    tasks = []

    def run_tasks(function, requested, workers):
        tasks.extend(requested)
        return (result(task) for task in requested)

    monkeypatch.setattr(comparison, "run_tasks", run_tasks)
    return tasks


def test_rows_are_markdown_and_unknown_ones_are_refused_with_a_list(capsys):
    assert markdown_row(["a", 1]) == "| a | 1 |"
    assert markdown_header(["a", "b"]) == "| a | b |\n|---|---|"
    assert select_rows(None, {"a": 1, "b": 2}, ["b"]) == ["b"]
    assert select_rows(["a"], {"a": 1, "b": 2}, ["b"]) == ["a"]
    assert "main; clean" in refused(capsys, "reproduce", "tables", "touch", "--rows", "mian")


CONFIGS = [(lambda row: touch.task_config(touch.TouchTask(row, 31103)), row) for row in touch.ROWS]
CONFIGS += [(lambda row: grid.task_config("A", row, 3), row) for row in grid.ROWS]
CONFIGS += [(lambda row: health.task_config(row, 3)[0], row) for row in health.TOUCH]


@pytest.mark.parametrize(("config_of", "row"), CONFIGS)
def test_rows_are_valid_configurations(config_of, row):
    config = config_of(row)
    simulation = config.simulation or config.create_simulation
    assert simulation.seed == 3
    assert config.simulation is None or simulation.maze.seed == 31103 or row in health.TOUCH


def test_a_touch_row_gives_medians_worst_values_sums_and_kidnaps(monkeypatch):
    worse = touched(em=5.0, arcr=0.1)
    tasks = stub_sessions(monkeypatch, lambda task: worse if task.maze == 31002 else touched())
    _, row = touch.touch_table(["clean"], first=31000, sessions=4)
    assert [(task.maze, task.seed) for task in tasks] == [(31000, 0), (31001, 1), (31002, 2), (31003, 3)]
    assert row == (
        "| clean: 2 mm / 0.5 deg | 0.010 (5.00) | 0.040 | 2.00 | 1 of 4 [5-70 %] | 1 of 4 [5-70 %] (2.50) "
        "| 0.020 | 0.500 | 0.900 (0.10), 0.950 | 0.80 | 12 / 400 |"
    )
    missing = touched(arcr=np.nan, arcr_chain_free=0.0, closures=0, false_closures=0)
    stub_sessions(monkeypatch, lambda task: missing)
    _, row = touch.touch_table(["control: shuffled"], sessions=1)
    assert row.endswith("| 0.500 | - | 0.80 | 0 / 0 |")
    stub_sessions(monkeypatch, lambda task: touched((10, 20, 90)))
    text = "\n".join(touch.touch_table(["kidnaps", "control: other maze"], sessions=1))
    pieces = "kidnaps: EM within pieces of the map, median 0.008 (0.01)"
    outside = "outside the largest piece, median 10% (10%)"
    for said in ("40 of 100 closures", "median 20; within 45: 67%", pieces, outside):
        assert said in text


def test_a_grid_row_compares_with_dead_reckoning(monkeypatch):
    found = 0.02, 0.2, np.radians([1.0, 20.0]), 4, [0.9, 0.4, 0.3, 0.04, 0.05]
    tasks = stub_sessions(monkeypatch, lambda task: found)
    _, row = grid.grid_table(["bias"], ["A"], arenas=2, first=7)
    assert tasks == [("A", "bias", 7), ("A", "bias", 8)]
    assert "| 0.200 m | 0.020 | 0.10 | 2, 2 of 2 | 10.5 degrees, 50%, 50% |" in row


def test_all_rows_without_data_are_named(monkeypatch, tmp_path):
    monkeypatch.delenv(recordings.DATA, raising=False)
    stub_sessions(monkeypatch, lambda task: pytest.fail("a session without a recording"))
    monkeypatch.chdir(tmp_path)
    rows = buildings.buildings_rows()
    for names, table in ((buildings.ROWS, buildings.laser_table()), (rows, buildings.buildings_table())):
        text = "\n".join(table)
        assert all(f"Left out: {row}: " in text for row in names)
        assert "set RATSLAM_DATA" in text


def test_closures_are_false_by_distance_or_claimed_turn_and_counted_in_a_row_of_buildings(monkeypatch):
    claims = ClosureClaims(
        np.repeat([0, 2], 3), accepted=np.repeat([True, False], 3), log_odds=np.repeat([1.0, -2.0], 3),
        distance=np.array([0, 1.9, 2.1, 0, 0, 0]), turn=np.radians([0, 0, 0, 31.0, 31.0, 0]),
    )  # fmt: skip
    false, sequences, odds = buildings.judge_claims(claims)
    assert false.tolist() == [0, 0, 1, 1, 1, 0]
    assert sequences.tolist() == [[True, False], [False, True]]
    assert odds.tolist() == [1.0, -2.0]
    unknown = claims._replace(distance=np.array([0.0, np.nan, 2.1, 0.0, 0.0, 0.0]))
    np.testing.assert_equal(buildings.judge_claims(unknown)[2], [np.nan, -2.0])
    rows = {
        name: buildings.BuildingsRow(recordings.Recording(name, "configs/square.yaml"), section, copies)
        for name, copies, section in (("lab", "miscalibrated", "buildings"), ("ids", "ids lost", "ids"))
    }
    odds = {"calibration": np.array([[4.0, False], [np.nan, True], [-4.0, True]])}
    harmless = Measured({"odometry": 10.0, "final": 1.0, "live": 10.8} | COUNTS, odds)
    harmed = Measured({"odometry": 2.0, "final": 2.5, "live": 2.0} | COUNTS, odds)
    tasks = stub_sessions(monkeypatch, lambda task: harmed if task[2] == 2 else harmless)
    monkeypatch.setattr(buildings, "buildings_rows", lambda: rows)
    _, lab, ids, _, total, note = buildings.buildings_table(copies=2)
    assert [task[1:] for task in tasks[:3]] == [("miscalibrated", seed) for seed in range(3)]
    assert lab == (
        "| lab | 10.00 | 1.00 | 10.80 | 1.75, 2.50 | 6.40, 10.80 | 1.25 | 1, 0 of 3 | 1 / 2 | 3 / 6 | 3 / 6 |"
    )
    assert ids.startswith("| ids | 10.00 |")
    runs = "3 runs: false / closures 3 / 6 (50.0%)"
    assert all(said in total for said in (runs, "final 33.3%, live 0.0%", "of the odds of 6 sequences 0.018"))
    assert note == "ids lost: worst copy 2.50 times the ATE as is."


COUNTS = {"closures": 2, "false_closures": 1, "sequences": 2, "false_sequences": 1}
FIT, CONTRADICT = 3, 0


def session(seed, count=60):
    """Sequences that are true where many views fit, but for some chance; contradictions go with true ones."""
    random = np.random.default_rng(seed)
    true = random.random(count) < 0.4
    counts = random.poisson(3.0, (count, 2, 2, KINDS)).astype(float)
    counts[..., FIT] += 6 * true[:, None, None]
    counts[..., CONTRADICT] += 2 * true[:, None, None]
    evidence = SequenceEvidence(random.normal(2.0 * true - 1, 2.0), counts)
    return true, random.random(count), random.random(count) < 0.5, (evidence,) * 3


def test_the_regression_finds_the_views_that_tell_and_is_tested_on_other_sessions(monkeypatch, tmp_path):
    weights = fit_weights([session(seed) for seed in range(5)])
    within = weights[:, 3 : 3 + KINDS]
    assert np.all(within[:, FIT] > 0.1)
    assert np.all(within.argmax(axis=1) == FIT)
    assert np.all(weights[:, [3, 4, 3 + KINDS, 4 + KINDS]] <= 0)
    monkeypatch.setattr(closures, "run_tasks", lambda _, tasks, workers: map(session, range(len(tasks))))
    _, *lines, fitted = closures_table(sessions=2, output=tmp_path)
    assert [line.split(" | ")[0] for line in lines] == [f"| {row}" for row in (*closures.ROWS, "all")]
    assert set(closures.ROWS) <= set(touch.ROWS)
    assert float(lines[-1].split(" | ")[6]) > 0.9
    held = json.loads((tmp_path / WEIGHTS).read_text(encoding="utf-8"))
    assert held == json.loads(fitted.strip().removeprefix("```json").removesuffix("```"))
    assert np.shape(held["weights"]) == shipped_weights().shape
    # Nothing said is not counted.
    one = session(0)
    one[3][0].odometry_ratio[:10] = np.nan
    odds = one[3][0].log_odds(fit_weights([one, session(1)]))
    assert np.isnan(odds[:10]).all()
    assert np.isfinite(odds[10:]).all()


def judged(seed, count=80):
    """Maps that are bad where their first feature is low, but for some chance."""
    random = np.random.default_rng(seed)
    features = random.normal(size=(count, 5))
    bad = features[:, 0] + 0.3 * random.normal(size=count) < -0.5
    return np.column_stack([features, np.where(bad, 2.0, 0.5), bad, random.integers(1, 50, count)])


def test_every_second_session_tests_the_regression_of_health(monkeypatch):
    monkeypatch.setattr(health, "real_recordings", lambda: None)
    monkeypatch.setattr(health, "run_tasks", lambda function, tasks, workers: map(judged, range(len(tasks))))
    _, *lines, fitted = health.health_table(sessions=2)
    rows = (*health.TOUCH, "all", "even, fitted on these", "odd, fitted on even ones")
    assert [line.split(" | ")[0] for line in lines] == [f"| {row}" for row in rows]
    assert float(lines[-1].split(" | ")[3]) > 0.9
    assert len(fitted.split(": ")[1].split(", ")) == 6


def figures(em: float, live: float = 1.0, odometry: float = 2.0, closed: float = 0.5) -> Record:
    counts = {"false_closures": 1, "closures": 10}
    return {"em": em, "em_live": live, "em_odometry": odometry, "revisits_closed": closed} | counts


Sessions = dict[tuple[str, str], Record]


def text_of(sessions: Sessions, code: str = "code") -> str:
    return comparison.sessions_text({key: (code, record) for key, record in sessions.items()})


def write(folder: Path, sessions: Sessions, name: str = "touch.csv") -> Path:
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(text_of(sessions))
    return folder


def logged(folder: Path, old: Sessions, new: Sessions, name: str = "touch") -> SessionLog:
    rows = {row: [session for own, session in new if own == row] for row, _ in new}
    log = SessionLog(name, None, write(folder / "old", old, f"{name}.csv"), rows)
    for (row, session), record in new.items():
        log.add(row, session, record)
    return log


def compared(folder: Path, old: Sessions, new: Sessions) -> list[str]:
    _, _, _, _, *lines = comparison.compare_runs(touch.COMPARED, logged(folder, old, new), ROWS)
    return [line for line in lines if line]


def stub_errors(monkeypatch: pytest.MonkeyPatch, em: dict[int, float]) -> None:
    told = {"em_live": 0.4, "arcr": np.nan}
    stub_sessions(monkeypatch, lambda task: touched((10, 20, 90), em=em[task.maze], **told))


def test_each_touch_session_is_in_the_file_as_soon_as_it_is_done(tmp_path: Path, monkeypatch) -> None:
    stub_errors(monkeypatch, {1: 0.1, 2: 0.2})  # the third one fails
    with pytest.raises(KeyError):
        list(touch.touch_table(["clean"], 1, 3, output=tmp_path / "new" / "run"))
    one, two = csv.DictReader((tmp_path / "new" / "run" / "touch.csv").read_text().splitlines())
    told = [[row[name] for name in ("row", "session", "em")] for row in (one, two)]
    assert told == [["clean", "1", "0.1"], ["clean", "2", "0.2"]]
    assert one["code"].endswith(" recall")
    assert {*TouchMetrics._fields, *TOLD} <= set(one)
    assert (one["arcr"], one["kidnaps"], one["steps"]) == ("", "3", "200")


def test_buildings_write_each_run_and_compare_maps_worse_than_odometry(tmp_path: Path, monkeypatch) -> None:
    def runs(final: float, **folder: Path) -> list[str]:
        found = {"odometry": 1.0, "final": final, "live": 1.2} | COUNTS
        stub_sessions(monkeypatch, lambda task: Measured(found, {"calibration": np.zeros((3, 2))}))
        return list(buildings.buildings_table(copies=6, **folder))

    lab = recordings.Recording("lab", "configs/square.yaml")
    rows = {"lab": buildings.BuildingsRow(lab, "buildings", "miscalibrated")}
    monkeypatch.setattr(buildings, "buildings_rows", lambda: rows)
    runs(0.5, output=tmp_path)
    first, *others = csv.DictReader((tmp_path / "buildings.csv").read_text().splitlines())
    assert [one["session"] for one in others] == list("123456")
    assert list(first.values())[3:] == ["1.0", "0.5", "1.2", "2", "1", "2", "1"]
    *_, line, _, failures, _ = runs(1.5, against=tmp_path)
    assert line == (
        "| lab | 7 | 3.000 [3.000-3.000] | 1.000 [1.000-1.000] | 0.500, 1.500 | 0, 7 | 0, 0 "
        "| 7 / 14, 7 / 14 | 7 / 14, 7 / 14 | 0, 7 | 0, 7 (0.016) |"
    )
    assert failures == f"New failures: {', '.join(f'lab {seed}' for seed in range(7))}."


def test_medians_intervals_and_sign_tests_of_what_both_runs_know(tmp_path: Path) -> None:
    before = {("clean", str(k)): figures(0.1, odometry=0.2) for k in range(1, 10)}
    after = {("clean", str(k)): figures(0.1 * k, 2.0, 0.2, 0.7) for k in range(1, 10)}
    clean, _, _, new, _ = compared(tmp_path, before, after)
    assert clean == (
        "| clean | 9 | 5.000 [2.000-8.000] | 2.000 [2.000-2.000] | 0.500, 2.500 | 0, 7 | 9, 9 "
        "| 0.500, 0.700 | 9 / 90, 9 / 90 | 0, 7 | 0, 7 (0.016) |"
    )
    assert new.startswith("New failures: clean 3, clean 4, ")
    nan = figures(0.1, closed=np.nan)
    old: Sessions = {("clean", "1"): nan, ("clean", "2"): figures(0.1), ("clean", "3"): figures(0.1)}
    old |= {("rough", "1"): figures(0.1)}
    new: Sessions = {("clean", "1"): figures(0.3), ("clean", "2"): figures(0.2), ("main", "4"): nan}
    clean, empty, both, failures, alone, _ = compared(tmp_path, old, new)
    assert all("| 0.500, 0.500 of 1 |" in line for line in (clean, both))
    assert clean.startswith("| clean | 2 | 2.500 [-] |")
    assert empty.startswith("| main | 0 | - |")
    assert failures == "New failures: clean 1."
    assert alone.endswith("sessions: clean 1 before, 0 now; main 0 before, 1 now.")


def test_figures_of_any_name_are_compared_and_ratios_of_zero_infinity_and_nan_known(tmp_path: Path) -> None:
    old: Sessions = {("a", "1"): {"missed": False, "error": 2.0}, ("a", "2"): {"missed": True, "error": 1.0}}
    new: Sessions = {("a", "1"): {"missed": True, "error": np.nan}, ("a", "2"): {"missed": False, "error": 3}}
    log = logged(tmp_path, old, new, "maps")
    *_, missed, error, _, failures, _ = comparison.compare_figures(log, ["a"])
    assert missed == "| a | missed | 2 | 1 | 1 | - | 1, 1 (1) |"
    assert error == "| a | error | 1 of 2 | 1.000 | 3.000 | 3.000 [-] | - |"
    assert failures == "New failures: missed: a 1."
    old = np.array([0, 0, 2, np.inf, np.inf, 1, np.nan, 1])
    new = np.array([0, 3, 0, np.inf, 1, np.inf, 1, np.nan])
    ratios = comparison.paired_ratios(old, new)
    np.testing.assert_array_equal(ratios, [1, np.inf, 0, 1, 0, np.inf, np.nan, np.nan])


def test_other_code_has_another_digest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = ModuleType("planted")
    package.__file__ = str(tmp_path / "__init__.py")
    monkeypatch.setitem(sys.modules, "planted", package)
    monkeypatch.setattr(machine, "PACKAGES", ("planted",))
    digests = []
    for text in ("x = 1", "x = 2", "x = 1"):
        (tmp_path / "module.py").write_text(text)
        digests.append(machine.code_digest.__wrapped__())
    assert digests[0] == digests[2] != digests[1]


VALUES = st.booleans() | st.integers() | st.floats(allow_nan=False)
KEYS = st.tuples(st.sampled_from(["clean", "3 % faults, max"]), st.integers(1, 5).map(str))


@given(st.dictionaries(KEYS, st.dictionaries(st.sampled_from(["a", "b", "c"]), VALUES), min_size=1))
def test_a_file_is_read_as_it_was_written(tmp_path_factory, sessions: Sessions) -> None:
    path = tmp_path_factory.mktemp("run") / "touch.csv"
    path.write_text(text_of(sessions, "abc classic"))
    read = read_sessions(path)
    assert read == {key: ("abc classic", figures) for key, figures in sessions.items()}
    for key, (_, figures) in read.items():
        assert all(type(value) is type(sessions[key][name]) for name, value in figures.items())


def test_a_file_keeps_other_sessions_with_the_code_that_measured_them(tmp_path: Path, monkeypatch) -> None:
    def add(row: str, em: float, settings: str) -> dict[str, tuple[str, object]]:
        log = SessionLog("touch", tmp_path, None, {row: ["1"]}, settings)
        log.add(row, "1", {"em": em})
        read = read_sessions(tmp_path / "touch.csv")
        return {key[0]: (code, figures["em"]) for key, (code, figures) in read.items()}

    monkeypatch.setattr(comparison, "code_digest", lambda: "a")
    assert add("clean", 0.1, "recall") == {"clean": ("a recall", 0.1)}
    assert add("main", 0.2, "classic") == {"clean": ("a recall", 0.1), "main": ("a classic", 0.2)}
    monkeypatch.setattr(comparison, "code_digest", lambda: "b")
    assert add("clean", 0.3, "") == {"clean": ("b", 0.3), "main": ("a classic", 0.2)}


@pytest.mark.parametrize(("text", "said"), [
    (None, "no touch.csv in it"),
    ("", "clean 31100.* no session"),
    ("row,session,code,em\nclean,31101,c,1.0\n", "clean 31100.* but clean 31101"),
    ("t,x\n1,2\n", "touch.csv:2: malformed"),
    ("row,session,code,em\nclean,31100,c,high\n", "touch.csv:2: malformed"),
    ("row,session,code,em\nclean,31100\n", "touch.csv:2: malformed"),
    ("row,session,code\nclean,31100,c\nclean,31100,c\n", "touch.csv:3: malformed"),
])  # fmt: skip
def test_a_folder_that_cannot_be_compared_is_refused(text, said, tmp_path: Path, capsys, monkeypatch) -> None:
    stub_sessions(monkeypatch, lambda task: pytest.fail("work"))
    command = ["reproduce", "tables", "touch", "--rows", "clean", "--sessions", "1", "--against"]
    if text is not None:
        (tmp_path / "touch.csv").write_text(text)
    assert re.search(said, refused(capsys, *command, tmp_path))
    assert "none: no such folder" in refused(capsys, *command, tmp_path / "none")


def test_a_file_of_an_earlier_run_or_of_others_is_not_written_over(tmp_path: Path, monkeypatch) -> None:
    stub_errors(monkeypatch, {1: 0.1})
    file = write(tmp_path, {("clean", "1"): figures(0.3)}) / "touch.csv"
    before = file.read_bytes()
    with pytest.raises(InputError, match="is the folder of -o too"):
        next(touch.touch_table(["clean"], 1, 1, output=tmp_path, against=tmp_path))
    assert file.read_bytes() == before
    file.write_text("theirs\n1\n")
    with pytest.raises(InputError, match="without 'row'"):
        next(touch.touch_table(["clean"], 1, 1, output=tmp_path))
    assert file.read_text() == "theirs\n1\n"


STEPS = 420
"""Not a whole number of chunks; keyframes are merged before."""


@cache
def recorded(seed: int) -> tuple[RecordingSession, Recording]:
    made = empty_merging_session(1)
    session = RecordingSession(made.backend, reserve=made.reserve)
    return session, session.record(simulate_walk(seed, path={"circuits": "CCCCCC"}).readings[:STEPS])


def gap(found, expected) -> float:
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    return max(float(np.abs(np.asarray(a, float) - np.asarray(b, float)).max(initial=0.0)) for a, b in pairs)


@pytest.mark.parametrize("at_once", [False, pytest.param(True, marks=pytest.mark.soak)])
def test_each_session_of_a_batch_ends_as_by_itself(at_once: bool) -> None:
    recordings = [recorded(seed)[1] for seed in (0, 1, 0)]
    chunks = recordings[0].chunks
    assert sum(chunk[-1] for chunk in chunks) == STEPS
    assert sum(chunk[0] is not None for chunk in chunks) > 1
    assert gap(recordings[0].state, recordings[1].state) > 0.01
    batch = SessionBatch(recorded(0)[0].backend, at_once)
    states = batch.replay(recordings)
    for k, recording in enumerate(recordings):
        assert gap(jax.tree.map(lambda rows, k=k: rows[k], states), recording.state) < 1e-9
    short = recordings[0]._replace(chunks=[(*chunks[0][:-1], chunks[0][-1] - 3), *chunks[1:]])
    with pytest.raises(ValueError, match="same numbers of steps"):
        batch.replay([recordings[0], short])


def test_the_parts_of_a_cycle_add_up_and_library_functions_count_for_their_callers():
    _, *rows = rows_of(list(cycles.profile_table(["square"])))
    assert [name for name, *_ in rows] == [*cycles.PARTS, "all"]
    parts = {name: float(recall) for name, recall, _ in rows}
    whole = parts.pop("all")
    assert sum(parts.values()) == pytest.approx(whole, abs=len(parts))
    assert all(parts[name] > 0 for name in ("views and belief (compiled kernel)", "closures", "solver"))
    assert parts["judge"] == 0  # of whiskers only
    own, wrapper, builtin = ("/a/ratslam/x.py", 1, "f"), ("/lib/w.py", 1, "w"), ("~", 0, "b")
    root = ("/lib/main.py", 1, "main")
    stats = {
        own: (1, 1, 2.0, 7.0, {root: (1, 1, 2.0, 7.0)}),
        wrapper: (1, 1, 1.0, 4.0, {own: (1, 1, 1.0, 4.0)}),
        builtin: (2, 2, 4.0, 4.0, {wrapper: (1, 1, 3.0, 3.0), own: (1, 1, 1.0, 1.0)}),
    }
    assert cycles.own_times(stats)[own] == pytest.approx(7.0)
