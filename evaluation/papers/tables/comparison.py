"""The figures of each session in a file, and two runs of a table compared session by session.

A table hides what a change of the code does: its medians move with the sessions that happen to be in it. Here
the same session is measured before and after the change, so that its maze, its noise and its luck are in both
and only the change is left. The sessions of a run are in `NAME.csv`, one a row: the row of the table, the
session, the code that measured it, and its figures, each a number or yes or no.

- What is unknown is an empty cell. It is NaN here, and a pair that is unknown on either side is left out of
  what compares that figure; a cell that leaves pairs out says of how many it is.
- The ratio of a pair is that now over that before: 1 where both are equal, also if both are 0 or infinite,
  and infinite where only that before is 0.
- The interval of a median of ratios is that of order statistics, which covers the median of the population
  with at least 95 % whatever the distribution (Thompson 1936); there is none with fewer than six pairs.
- Cured and new failures are compared by the two-sided sign test (McNemar 1947, exact), as all other pairs say
  nothing of the difference.

Example:
    >>> key = ("clean", "31100")
    >>> old, new = ({key: ("", {"em": em})} for em in (0.02, 0.01))
    >>> pairs = _pair_sessions(old, new, ["clean"])
    >>> paired_ratios(*pairs.known("em")).tolist()
    [0.5]
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from evaluation.papers.tables.markdown import markdown_header, markdown_row
from evaluation.studies.executor import run_tasks
from evaluation.studies.machine import code_digest
from evaluation.studies.study_report import csv_text
from tactile.base.bounded import read_rows
from tactile.base.errors import InputError
from tactile.base.files import write_text_atomically

KEY = ("row", "session", "code")
"""The first columns of a file."""
Figure = bool | int | float
Record = Mapping[str, Figure]
"""The figures of a session by name."""
Key = tuple[str, str]
"""Row and session."""
Task = TypeVar("Task")
Result = TypeVar("Result")


class Measured(NamedTuple):
    """What is measured of one session.

    Attributes:
        record: its figures by name, of which `True` is a failure. shown: what its table and its picture show
            besides, by name.
    """

    record: Record
    shown: Mapping[str, Any]


def column(found: Sequence[Measured], name: str) -> np.ndarray:
    """[n] a figure of all sessions, recorded or shown."""
    return np.array([one.record[name] if name in one.record else one.shown[name] for one in found])


Sessions = dict[Key, tuple[str, Record]]
"""The rows of a file: what measured a session, which is the digest of the code and the settings beside row
and session on which the figures depend; and its figures."""


def measured_rows(
    measure: Callable[[Task], Result],
    rows: Mapping[str, Mapping[str, Task]],
    workers: int,
    log: SessionLog | None = None,
) -> Iterator[tuple[str, list[Result]]]:
    """Each row with the results of its sessions, as soon as all of them are measured.

    Args:
        measure: a session from its task; a `Measured` with a log. rows: the tasks by row and session.
            workers: processes. log: gets each session as soon as it is measured.
    """
    tasks = [task for sessions in rows.values() for task in sessions.values()]
    results = run_tasks(measure, tasks, workers=workers)
    for row, sessions in rows.items():
        found = []
        for session in sessions:
            found.append(next(results))
            if log is not None:
                log.add(row, session, cast(Measured, found[-1]).record)
        yield row, found


class SessionLog:
    """The sessions of a run, each in its file as soon as it is added.

    A file that is there already keeps the sessions that are not measured again, each with the code that
    measured it.

    Args:
        name: of the table; its file is `NAME.csv`. output: folder of the file; None: none is written.
            against: folder of the earlier run to compare with, if any. rows: the sessions that will be
            measured, by row. settings: see `Sessions`.

    Attributes:
        measured: the sessions added so far. earlier: those of the run to compare with; None without one.

    Raises:
        InputError: a file of the run cannot be used.
    """

    def __init__(
        self,
        name: str,
        output: Path | None,
        against: Path | None,
        rows: Mapping[str, Iterable[str]],
        settings: str = "",
    ) -> None:
        planned = [(row, session) for row, sessions in rows.items() for session in sessions]
        self.measured: Sessions = {}
        self.earlier = None if against is None else _earlier_sessions(against, f"{name}.csv", planned)
        if output is not None and against is not None and output.resolve() == against.resolve():
            cure = "choose another with -o"
            raise InputError("--against", f"{against} is the folder of -o too", "that of another run", cure)
        self._code = f"{code_digest()} {settings}".strip()
        self._path = None if output is None else output / f"{name}.csv"
        self._kept: Sessions = {}
        if self._path is not None and self._path.exists():
            self._kept = read_sessions(self._path)

    def add(self, row: str, session: str, figures: Mapping[str, Any]) -> None:
        """Adds a session, and writes the file."""
        plain = {
            name: value.item() if isinstance(value, np.generic) else value for name, value in figures.items()
        }
        self.measured[row, session] = self._code, plain
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_text_atomically(self._path, sessions_text({**self._kept, **self.measured}))


def sessions_text(sessions: Sessions) -> str:
    """The text of a file; a cell is empty where a session has no such figure, or NaN."""
    return csv_text([
        dict(zip(KEY, (*key, code), strict=True))
        | {name: repr(value) if value == value else "" for name, value in figures.items()}
        for key, (code, figures) in sessions.items()
    ])  # fmt: skip


def read_sessions(path: Path) -> Sessions:
    """The sessions of a file.

    Raises:
        InputError: it cannot be read, is another file, or has a session twice; with the line.
    """
    seen: set[Key] = set()

    def parse(cells: Mapping[str, str]) -> tuple[Key, tuple[str, Record]]:
        key = cells["row"], cells["session"]
        if None in cells or None in cells.values():
            raise ValueError("cells that are missing, or too many")
        if key in seen:
            raise ValueError(f"session {' '.join(key)} for the second time")
        seen.add(key)
        figures = dict[str, Figure]()
        for name, cell in cells.items():
            if name in KEY or not cell:
                continue
            if cell in ("True", "False"):
                figures[name] = cell == "True"
            else:
                figures[name] = int(cell) if cell.lstrip("-").isdecimal() else float(cell)
        return key, (cells["code"], figures)

    return dict(read_rows(path, "a file of sessions, as -o writes it", parse))


def _earlier_sessions(folder: Path, name: str, planned: list[Key]) -> Sessions:
    """The sessions of an earlier run, of which some are planned now."""
    cure = "name the folder that the earlier run was given by -o"
    if not (folder / name).is_file():
        found = f"no {name} in it" if folder.is_dir() else "no such folder"
        raise InputError(str(folder), found, f"a folder with the {name} of an earlier run", cure)
    sessions = read_sessions(folder / name)
    if planned and sessions.keys().isdisjoint(planned):
        wanted, there = (some_of(" ".join(key) for key in keys) for keys in (planned, sessions))
        found = f"none of the {len(planned)} sessions to be measured ({wanted}), but {there}"
        raise InputError(str(folder / name), found, "a run of the same rows and sessions", cure)
    return sessions


def some_of(sessions: Iterable[str]) -> str:
    """The first and the last of some sessions."""
    names = list(sessions)
    return ", ".join(names if len(names) < 3 else (names[0], "...", names[-1])) or "no session"


class _Pairs(NamedTuple):
    """n sessions that were measured twice.

    Attributes:
        keys: [n]. old, new: [n] figures before and now. only_old, only_new: number of sessions that are in
            one run alone.
    """

    keys: list[Key]
    old: list[Record]
    new: list[Record]
    only_old: int = 0
    only_new: int = 0

    def known(self, *names: str) -> tuple[np.ndarray, np.ndarray]:
        """Figures before and now, each [k, m] (of one name: [m]), of the m pairs that have all of them."""
        return self.named(*names)[1:]

    def named(self, *names: str) -> tuple[list[Key], np.ndarray, np.ndarray]:
        """The same with the sessions [m]."""
        values = np.array(
            [[[one.get(name, np.nan) for one in side] for name in names] for side in (self.old, self.new)],
            float,
        )
        has = ~np.isnan(values).any(axis=(0, 1))
        old, new = values[..., has] if len(names) > 1 else values[:, 0, has]
        return [key for key, there in zip(self.keys, has, strict=True) if there], old, new


def _pair_sessions(old: Sessions, new: Sessions, rows: Sequence[str]) -> _Pairs:
    """The sessions of these rows that are in both runs, in the order of that now."""
    old, new = ({key: one for key, one in run.items() if key[0] in rows} for run in (old, new))
    keys = [key for key in new if key in old]
    before, after = ([run[key][1] for key in keys] for run in (old, new))
    return _Pairs(keys, before, after, len(old) - len(keys), len(new) - len(keys))


def paired_ratios(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """[n] ratio of each pair of figures [n] that are not negative: 1 of equal ones, infinite over 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(old == new, 1.0, new / old)


class Compared(NamedTuple):
    """What is compared of a table whose sessions have an error, that of the live pose, and odometry's.

    Attributes:
        label: name of the error. error, live, odometry: names of the figures. worse, failed: whether sessions
            are worse than odometry, and whether they fail, [n] bool from an error and odometry's [n]. counts:
            title, and the figures of which one is part of the other. medians: title and figure.
    """

    label: str
    error: str
    live: str
    odometry: str
    worse: Callable[[np.ndarray, np.ndarray], np.ndarray]
    failed: Callable[[np.ndarray, np.ndarray], np.ndarray]
    counts: Mapping[str, tuple[str, str]]
    medians: Mapping[str, str]


def compare_runs(what: Compared, log: SessionLog, rows: Sequence[str]) -> Iterator[str]:
    """The lines below a table that compare its run with an earlier one; none without one.

    Each row of the table has a line, and all together have one. Figures are before and now.
    """
    if log.earlier is not None:
        cells = {name: _compared_cells(what, pairs) for name, pairs in _groups(log, rows)}
        keys, before, now = _failures(what, _pair_sessions(log.earlier, log.measured, rows))
        new = ", ".join(" ".join(key) for key, is_new in zip(keys, now & ~before, strict=True) if is_new)
        lines = [[name, *each.values()] for name, each in cells.items()]
        yield from _lines(log, rows, ["row", *next(iter(cells.values()))], lines, new)


def compare_figures(log: SessionLog, rows: Sequence[str]) -> Iterator[str]:
    """The same for rows whose sessions have figures of any name: a line for each figure of a row, and for
    those that several rows have. Yes or no is whether a session fails in something."""
    if log.earlier is None:
        return
    lines, failures = [], []
    for row, pairs in _groups(log, rows):
        for name in dict.fromkeys(chain.from_iterable(pairs.new)):
            having = {key[0] for key, one in zip(pairs.keys, pairs.new, strict=True) if name in one}
            if row == ALL and len(having) < 2:
                continue
            keys, old, new = pairs.named(name)
            all_of = sum(key[0] in having for key in pairs.keys)
            number = f"{len(keys)} of {all_of}" if len(keys) < all_of else str(all_of)
            if any(isinstance(one.get(name), bool) for one in pairs.new):
                cells = [f"{old.sum():.0f}", f"{new.sum():.0f}", "-", _changed(old > 0, new > 0)]
                changed = [" ".join(key) for key, is_new in zip(keys, new > old, strict=True) if is_new]
                failures += [f"{name}: {', '.join(changed)}"] if changed and row != ALL else []
            else:
                cells = [_median(old), _median(new), _spread(paired_ratios(old, new)), "-"]
            lines.append([row, name, number, *cells])
    columns = ["row", "figure", "sessions", "before", "now", "now / before [95 %]", "cured, new (p)"]
    yield from _lines(log, rows, columns, lines, "; ".join(failures))


def _lines(
    log: SessionLog, rows: Sequence[str], columns: list[str], lines: list[list[str]], failures: str
) -> Iterator[str]:
    """A comparison as Markdown; below it new failures, the sessions that are in one run alone, and what
    measured the others."""
    assert log.earlier is not None
    yield from ["", "Before, and now, of the same sessions:", "", markdown_header(columns)]
    yield from map(markdown_row, lines)
    yield from ["", f"New failures: {failures or 'none'}."]
    lone = [
        f"{row} {pairs.only_old} before, {pairs.only_new} now"
        for row, pairs in _groups(log, rows)
        if row != ALL and pairs.only_old + pairs.only_new
    ]
    if lone:
        yield f"In one run alone and left out, sessions: {'; '.join(lone)}."
    keys = _pair_sessions(log.earlier, log.measured, rows).keys
    codes = [Counter(run[key][0] for key in keys) for run in (log.earlier, log.measured)]
    named = [", ".join(f"{code} ({count} sessions)" for code, count in each.items()) for each in codes]
    yield f"Code before: {named[0] or 'none'}; now: {named[1] or 'none'}."


ALL = "all rows"
"""Name of the line over several rows."""


def _groups(log: SessionLog, rows: Sequence[str]) -> Iterator[tuple[str, _Pairs]]:
    """The pairs of each row, then of all rows if there are several."""
    assert log.earlier is not None
    for row in rows:
        yield row, _pair_sessions(log.earlier, log.measured, [row])
    if len(rows) > 1:
        yield ALL, _pair_sessions(log.earlier, log.measured, rows)


def _failures(what: Compared, pairs: _Pairs) -> tuple[list[Key], np.ndarray, np.ndarray]:
    """The sessions [m], and whether they fail, [m] bool before and now."""
    keys, old, new = pairs.named(what.error, what.odometry)
    return keys, what.failed(*old), what.failed(*new)


def _compared_cells(what: Compared, pairs: _Pairs) -> dict[str, str]:
    """The cells of a line of `compare_runs` by the title of their column; figures are before, now."""
    over = [paired_ratios(odometry, error) for error, odometry in pairs.known(what.error, what.odometry)]
    medians, counts = dict[str, str](), dict[str, str]()
    for title, name in what.medians.items():
        old, new = pairs.known(name)
        medians[title] = _medians(old, new, pairs)
    for title, names in what.counts.items():
        sides = pairs.known(*names)
        sums = [f"{side[0].sum():.0f} / {side[1].sum():.0f}" for side in sides]
        counts[title] = f"{', '.join(sums)}{_of(sides[0].shape[1], pairs)}"
    return {
        "sessions": str(len(pairs.keys)),
        f"{what.label}, now / before [95 %]": _ratio(pairs, what.error),
        f"live {what.label.split()[-1]}, now / before [95 %]": _ratio(pairs, what.live),
        f"{what.label} / odometry, median": _medians(over[0], over[1], pairs),
        "worse than odometry": _count(what.worse, pairs, what.error, what.odometry),
        "live worse than odometry": _count(what.worse, pairs, what.live, what.odometry),
        **medians,
        **counts,
        "failures": _count(what.failed, pairs, what.error, what.odometry),
        "cured, new (p)": _changed(*_failures(what, pairs)[1:]),
    }


def _ratio(pairs: _Pairs, name: str) -> str:
    ratio = paired_ratios(*pairs.known(name))
    return _spread(ratio) + _of(len(ratio), pairs) * bool(len(ratio))


def _spread(ratio: np.ndarray) -> str:
    """Median of ratios [n], with its interval."""
    from scipy.stats import quantile_test  # slow to import

    if not len(ratio):
        return "-"
    low, high = quantile_test(ratio).confidence_interval(0.95)
    return f"{np.median(ratio):.3f} " + (f"[{low:.3f}-{high:.3f}]" if low == low else "[-]")


def _count(happens: Callable[[np.ndarray, np.ndarray], np.ndarray], pairs: _Pairs, *names: str) -> str:
    old, new = pairs.known(*names)
    return f"{happens(*old).sum()}, {happens(*new).sum()}{_of(old.shape[1], pairs)}"


def _changed(old: np.ndarray, new: np.ndarray) -> str:
    """Cured and new failures of sessions that fail [n] bool before and now."""
    from scipy.stats import binomtest

    cured, appeared = int((old & ~new).sum()), int((new & ~old).sum())
    # That failures are cured as often as there are new ones: so many heads of as many tosses of a coin.
    p = binomtest(appeared, cured + appeared).pvalue if cured + appeared else 1
    return f"{cured}, {appeared} ({p:.2g})"


def _median(values: np.ndarray) -> str:
    return f"{np.median(values):.3f}" if len(values) else "-"


def _medians(old: np.ndarray, new: np.ndarray, pairs: _Pairs) -> str:
    return f"{_median(old)}, {_median(new)}{_of(len(old), pairs)}"


def _of(count: int, pairs: _Pairs) -> str:
    """How many pairs a cell is of, where that is not all."""
    return f" of {count}" if count < len(pairs.keys) else ""
