"""Sessions of a table in a file, and two runs of it compared session by session."""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.papers.tables import buildings, comparison
from evaluation.papers.tables import touch_table as touch
from evaluation.papers.tables.comparison import (
    Record,
    SessionLog,
    paired_ratios,
    read_sessions,
    sessions_text,
)
from evaluation.papers.tables.recordings import Recording
from evaluation.studies import machine
from evaluation.studies.metrics import TouchMetrics
from ratslam.cli import main
from tactile.base.errors import InputError

ROWS = ("clean", "main")
SESSION = touch.SessionFigures(
    TouchMetrics(
        em=0.1, em_experiences=0.02, em_odometry=2.0, arr=0.5, arcr=np.nan, arcr_chain_free=0.95,
        relocalisations=90, closures=100, false_closures=3, experiences=50, steps=200,
    ),
    revisits_closed=0.8, em_live=0.4, em_pieces=0.008, unjoined=0.1, across=40, recovery=(10, 20, 90),
)  # fmt: skip


def figures(em: float, live: float = 1.0, odometry: float = 2.0, closed: float = 0.5) -> Record:
    counts = {"false_closures": 1, "closures": 10}
    return {"em": em, "em_live": live, "em_odometry": odometry, "revisits_closed": closed} | counts


Sessions = dict[tuple[str, str], Record]


def text_of(sessions: Sessions, code: str = "code") -> str:
    return sessions_text({key: (code, record) for key, record in sessions.items()})


def write(folder: Path, sessions: Sessions, name: str = "touch.csv") -> Path:
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(text_of(sessions))
    return folder


def compared(folder: Path, old: Sessions, new: Sessions, rows: Sequence[str] = ROWS) -> list[dict[str, str]]:
    """The lines of the comparison by column, then those below it in a column of their own."""
    log = SessionLog("touch", (None, write(folder / "old", old)), new)
    for (row, session), record in new.items():
        log.add(row, session, record)
    _, _, _, header, *lines = comparison.compare_runs(touch.COMPARED, log, rows)
    columns = header.split("\n")[0].strip("| ").split(" | ")
    table = [line.strip("| ").split(" | ") for line in lines if line.startswith("|")]
    below = [{"below": line} for line in lines if line and not line.startswith("|")]
    return [dict(zip(columns, cells, strict=True)) for cells in table] + below


def stub_sessions(monkeypatch: pytest.MonkeyPatch, em: dict[int, float]) -> None:
    """Replaces the sessions of the touch table by those with these errors, by maze."""

    def run_tasks(function, tasks, workers):  # type: ignore[no-untyped-def]
        for task in tasks:
            yield SESSION._replace(metrics=SESSION.metrics._replace(em=em[task.maze]))

    monkeypatch.setattr(touch, "run_tasks", run_tasks)


def test_each_touch_session_is_in_the_file_as_soon_as_it_is_done(tmp_path: Path, monkeypatch) -> None:
    stub_sessions(monkeypatch, {1: 0.1, 2: 0.2})  # the third one fails
    with pytest.raises(KeyError):
        list(touch.touch_table(["clean"], 1, 3, files=(tmp_path / "new" / "run", None)))
    with (tmp_path / "new" / "run" / "touch.csv").open() as file:
        one, two = csv.DictReader(file)
    assert (one["row"], one["session"], one["em"]) == ("clean", "1", "0.1")
    assert (two["row"], two["session"], two["em"]) == ("clean", "2", "0.2")
    assert one["code"].endswith(" recall")
    assert {*TouchMetrics._fields, *touch.SessionFigures._fields} - {"metrics"} <= set(one)
    assert (one["arcr"], one["kidnaps"], one["recovery"], one["steps"]) == ("", "3", "20.0", "200")


def test_a_run_against_itself_has_ratios_of_one_and_nothing_changed(tmp_path: Path, monkeypatch) -> None:
    stub_sessions(monkeypatch, {k: 0.05 * k for k in range(1, 8)})
    list(touch.touch_table(ROWS, 1, 7, files=(tmp_path, None)))
    lines = list(touch.touch_table(ROWS, 1, 7, files=(None, tmp_path)))
    clean, main_row, both, _, failures, code = lines[-6:]
    same = "1.000 [1.000-1.000] | 1.000 [1.000-1.000] | 0.100, 0.100 | 0, 0 | 0, 0 | 0.800, 0.800"
    assert clean == f"| clean | 7 | {same} | 21 / 700, 21 / 700 | 3, 3 | 0, 0 (1) |"
    assert main_row == clean.replace("clean", "main")
    assert both == f"| all rows | 14 | {same} | 42 / 1400, 42 / 1400 | 6, 6 | 0, 0 (1) |"
    assert failures == "New failures: none."
    digest = comparison.code_digest()
    assert code == f"Code before: {digest} recall (14 sessions); now: {digest} recall (14 sessions)."


def test_buildings_write_each_run_and_compare_final_maps_worse_than_odometry(
    tmp_path: Path, monkeypatch
) -> None:
    def runs(final: float, files: comparison.Files) -> list[str]:
        closures, sequences = np.array([True, False]), np.array([[True, True], [True, False], [False, True]])
        figures = buildings.RunFigures(1.0, final, 1.2, closures, sequences, np.zeros(3))
        monkeypatch.setattr(buildings, "run_tasks", lambda _, tasks, workers: iter([figures] * len(tasks)))
        return list(buildings.buildings_table(rows, 6, files=files))

    rows = {
        "lab": buildings.BuildingsRow(Recording("lab", "configs/square.yaml"), "buildings", "miscalibrated")
    }
    runs(0.5, (tmp_path, None))
    with (tmp_path / "buildings.csv").open() as file:
        first, *others = csv.DictReader(file)
    assert [one["session"] for one in others] == list("123456")
    assert list(first.values())[3:] == ["1.0", "0.5", "1.2", "2", "1", "2", "1"]
    *_, line, _, failures, _ = runs(1.5, (None, tmp_path))
    assert line == (
        "| lab | 7 | 3.000 [3.000-3.000] | 1.000 [1.000-1.000] | 0.500, 1.500 | 0, 7 | 0, 0 "
        "| 7 / 14, 7 / 14 | 7 / 14, 7 / 14 | 0, 7 | 0, 7 (0.016) |"
    )
    assert failures == f"New failures: {', '.join(f'lab {seed}' for seed in range(7))}."


def test_known_medians_intervals_and_sign_tests(tmp_path: Path) -> None:
    before = {("clean", str(k)): figures(0.1, odometry=0.2) for k in range(1, 10)}
    after = {("clean", str(k)): figures(0.1 * k, 2.0, 0.2, 0.7) for k in range(1, 10)}
    clean, _, _, new, _ = compared(tmp_path, before, after)
    assert clean["sessions"] == "9"
    assert clean["EM, now / before [95 %]"] == "5.000 [2.000-8.000]"
    assert clean["live EM, now / before [95 %]"] == "2.000 [2.000-2.000]"
    assert clean["EM / odometry, median"] == "0.500, 2.500"
    assert clean["worse than odometry"] == "0, 7"
    assert clean["live worse than odometry"] == "9, 9"
    assert clean["revisits closed"] == "0.500, 0.700"
    assert clean["false / closures"] == "9 / 90, 9 / 90"
    assert clean["failures"] == "0, 7"
    assert clean["cured, new (p)"] == "0, 7 (0.016)"
    assert new["below"].startswith("New failures: clean 3, clean 4, ")


def test_what_is_unknown_or_in_one_run_alone_is_left_out_and_said(tmp_path: Path) -> None:
    nan = figures(0.1, closed=np.nan)
    old: Sessions = {("clean", "1"): nan, ("clean", "2"): figures(0.1), ("clean", "3"): figures(0.1)}
    old |= {("rough", "1"): figures(0.1)}
    new: Sessions = {("clean", "1"): figures(0.3), ("clean", "2"): figures(0.2), ("main", "4"): nan}
    clean, empty, both, failures, alone, _ = compared(tmp_path, old, new)
    assert clean["revisits closed"] == both["revisits closed"] == "0.500, 0.500 of 1"
    assert clean["EM, now / before [95 %]"] == "2.500 [-]"
    assert empty["sessions"] == "0"
    assert empty["EM, now / before [95 %]"] == "-"
    assert failures["below"] == "New failures: clean 1."
    assert alone["below"].endswith("sessions: clean 1 before, 0 now; main 0 before, 1 now.")


def test_figures_of_any_name_are_compared_where_both_runs_know_them(tmp_path: Path) -> None:
    old: Sessions = {("a", "1"): {"missed": False, "error": 2.0}, ("a", "2"): {"missed": True, "error": 1.0}}
    new: Sessions = {("a", "1"): {"missed": True, "error": np.nan}, ("a", "2"): {"missed": False, "error": 3}}
    log = SessionLog("maps", (None, write(tmp_path, old, "maps.csv")), new)
    for (row, session), record in new.items():
        log.add(row, session, record)
    *_, missed, error, _, failures, _ = comparison.compare_figures(log, ["a"])
    assert missed == "| a | missed | 2 | 1 | 1 | - | 1, 1 (1) |"
    assert error == "| a | error | 1 of 2 | 1.000 | 3.000 | 3.000 [-] | - |"
    assert failures == "New failures: missed: a 1."


def test_ratios_of_zero_infinity_and_nan() -> None:
    old = np.array([0, 0, 2, np.inf, np.inf, 1, np.nan, 1])
    new = np.array([0, 3, 0, np.inf, 1, np.inf, 1, np.nan])
    np.testing.assert_array_equal(paired_ratios(old, new), [1, np.inf, 0, 1, 0, np.inf, np.nan, np.nan])


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


@given(st.dictionaries(
    st.tuples(st.sampled_from(["clean", "3 % faults, max"]), st.integers(1, 5).map(str)),
    st.dictionaries(
        st.sampled_from(["a", "b", "c"]), st.booleans() | st.integers() | st.floats(allow_nan=False),
    ),
))  # fmt: skip
def test_a_file_is_read_as_it_was_written(tmp_path_factory, sessions: Sessions) -> None:
    path = tmp_path_factory.mktemp("run") / "touch.csv"
    path.write_text(text_of(sessions, "abc classic"))
    read = read_sessions(path)
    assert read == {key: ("abc classic", figures) for key, figures in sessions.items()}
    assert all(
        type(value) is type(sessions[key][name])
        for key, (_, figures) in read.items()
        for name, value in figures.items()
    )


def test_a_file_keeps_other_sessions_with_the_code_that_measured_them(tmp_path: Path, monkeypatch) -> None:
    def add(row: str, em: float, settings: str) -> dict[str, tuple[str, object]]:
        log = SessionLog("touch", (tmp_path, None), [(row, "1")], settings)
        log.add(row, 1, {"em": em})
        read = read_sessions(tmp_path / "touch.csv")
        return {key[0]: (code, figures["em"]) for key, (code, figures) in read.items()}

    monkeypatch.setattr(comparison, "code_digest", lambda: "a")
    assert add("clean", 0.1, "recall") == {"clean": ("a recall", 0.1)}
    assert add("main", 0.2, "classic") == {"clean": ("a recall", 0.1), "main": ("a classic", 0.2)}
    monkeypatch.setattr(comparison, "code_digest", lambda: "b")
    assert add("clean", 0.3, "") == {"clean": ("b", 0.3), "main": ("a classic", 0.2)}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "no touch.csv in it"),
        ("", "clean 31100.* no session"),
        ("row,session,code,em\nclean,31101,c,1.0\n", "clean 31100.* but clean 31101"),
        ("t,x\n1,2\n", "touch.csv:2: malformed"),
        ("row,session,code,em\nclean,31100,c,high\n", "touch.csv:2: malformed"),
        ("row,session,code,em\nclean,31100\n", "touch.csv:2: malformed"),
        ("row,session,code\nclean,31100,c\nclean,31100,c\n", "touch.csv:3: malformed"),
    ],
)
def test_a_folder_that_cannot_be_compared_is_refused(text, said, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(touch, "run_tasks", lambda *_, **__: pytest.fail("work"))
    command = ["reproduce", "tables", "touch", "--rows", "clean", "--sessions", "1", "--against"]
    if text is not None:
        (tmp_path / "touch.csv").write_text(text)
    assert main([*command, str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(said, line)
    assert main([*command, str(tmp_path / "none")]) == 2
    assert "none: no such folder" in capsys.readouterr().err


def test_a_file_of_an_earlier_run_or_of_others_is_not_written_over(tmp_path: Path, monkeypatch) -> None:
    stub_sessions(monkeypatch, {1: 0.1})
    file = write(tmp_path, {("clean", "1"): figures(0.3)}) / "touch.csv"
    before = file.read_bytes()
    with pytest.raises(InputError, match="is the folder of -o too"):
        next(touch.touch_table(["clean"], 1, 1, files=(tmp_path, tmp_path)))
    assert file.read_bytes() == before
    file.write_text("theirs\n1\n")
    with pytest.raises(InputError, match="without 'row'"):
        next(touch.touch_table(["clean"], 1, 1, files=(tmp_path, None)))
    assert file.read_text() == "theirs\n1\n"
