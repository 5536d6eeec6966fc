"""Progress of a run in another process, read from its run directory."""

from __future__ import annotations

import time
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping
from math import atan2
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.artifacts.manifest import RUNNING, read_manifest
from evaluation.artifacts.run_reader import check_run_directory, checkpoint_steps
from tactile.base.errors import InputError, os_errors_of

KILLED = "killed"
"""Status of a run that has not ended and that no process writes."""
WATCH_IMAGE = "watch.png"
"""The monitor's own image in the run directory; ignored when looking for activity of the run."""

_NUMBERS = ("t", "x", "y", "heading", "sd_x", "sd_y", "sd_heading", "lost")


class RunProgress(NamedTuple):
    """State of a run after N steps.

    Attributes:
        status: from the manifest; of a live session that ended before its map was finished, the outcome from
            its report; without either `running`, or `killed`. total: final number of steps, if known.
        path: [N, 3] online poses in the map frame, m, m, rad. sd: [3] standard deviations of the last pose;
            NaN before it. odometry: [N, 3] from the start of this run. truth: [N, 2] m, NaN if unknown.
        doubt: probability that the map is worse than odometry at the last step; None if it is not judged.
        outcomes: number of steps by outcome. lost: number of steps lost. online_error: position error at the
            last comparison with the truth, after alignment of the path, m.
        checkpoint: steps of the last checkpoint. rate: mean steps per second, by file dates.
        silence: time since the last write of the run, s. warnings: about the input.
    """

    name: str
    status: str
    total: int | None
    path: np.ndarray
    sd: np.ndarray
    odometry: np.ndarray
    truth: np.ndarray
    outcomes: Mapping[str, int]
    lost: int
    online_error: float | None
    checkpoint: int
    rate: float | None
    silence: float
    doubt: float | None = None
    warnings: tuple[str, ...] = ()


def step_count(seen: RunProgress) -> str:
    """Number of steps as text."""
    return f"{len(seen.path)} steps" if seen.total is None else f"{len(seen.path)} of {seen.total} steps"


class RunMonitor:
    """Reads a run directory repeatedly; each line is read once and no file stays open.

    Raises:
        InputError: the directory holds no run.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        check_run_directory(directory)
        names = ("steps.csv", "odometry.tum", "truth.tum", "online_error.csv")
        self._steps, self._odometry, self._truth, self._errors = (_Lines(directory / name) for name in names)
        self._header: list[str] = []
        self._rows = _Rows(len(_NUMBERS))
        self._outcomes: list[str] = []
        self._counted: Counter[str] = Counter()  # of the first outcomes
        self._reckoned = _Rows(3)  # x, y, heading
        self._true = _Rows(2)  # x, y of each step, NaN while unknown
        self._untrue: dict[float, int] = {}  # t: number of a step without truth
        self._early: dict[float, list[float]] = {}  # t: x, y of a step that is not read yet
        self._online_error: float | None = None
        self._doubt: float | None = None

    def read(self) -> RunProgress:
        """The current state of the run.

        Raises:
            InputError: a malformed line or manifest, or the directory was removed.
        """
        manifest = read_manifest(self.directory)  # read first: after the end, no line is missing
        self._read()
        count = min(len(self._rows), len(self._reckoned))  # the lines of a chunk are written file by file
        rows = self._rows.first(count)
        self._count(count)
        began, last = self._date("config.yaml"), self._date("steps.csv")
        return RunProgress(
            name=self.directory.resolve().name,
            status=KILLED if manifest.killed and manifest.status == RUNNING else manifest.status,
            total=manifest.total,
            path=rows[:, 1:4],
            sd=rows[-1, 4:7] if count else np.full(3, np.nan),
            odometry=self._reckoned.first(count),
            truth=self._true.first(count),
            outcomes=self._counted.copy(),
            lost=int(rows[:, 7].sum()),
            online_error=self._online_error,
            doubt=self._doubt,
            warnings=manifest.warnings,
            checkpoint=checkpoint_steps(self.directory),
            rate=count / (last - began) if 0 < began < last else None,
            silence=max(0.0, time.time() - self._date(*self._files())),
        )

    def _read(self) -> None:
        for where, line in self._steps.read_new():
            cells = line.split(",")
            if not self._header:
                self._header = cells
                continue
            row = dict(zip(self._header, cells, strict=False))
            numbers = _numbers(where, [row.get(name, "") for name in _NUMBERS], len(_NUMBERS))
            self._rows.append(numbers)
            if numbers[0] in self._early:
                self._true.append(self._early.pop(numbers[0]))
            else:
                self._untrue[numbers[0]] = len(self._true)
                self._true.append([np.nan, np.nan])
            self._outcomes.append(row.get("outcome", ""))
            self._doubt = _numbers(where, [row["doubt"]], 1)[0] if row.get("doubt") else None
        for where, line in self._odometry.read_new():
            _, x, y, *_, qz, qw = _numbers(where, line.split(), 8)
            self._reckoned.append([x, y, 2 * atan2(qz, qw)])
        for where, line in self._truth.read_new():
            t, x, y, *_ = _numbers(where, line.split(), 8)
            if t in self._untrue:
                self._true.replace(self._untrue.pop(t), [x, y])
            else:
                self._early[t] = [x, y]
        for where, line in self._errors.read_new():
            if not line.startswith("t,"):
                self._online_error = _numbers(where, line.split(","), 2)[1]

    def _count(self, count: int) -> None:
        """Counts the outcomes of the first steps that are not counted yet."""
        self._counted.update(self._outcomes[self._counted.total() : count])

    def _files(self) -> list[str]:
        """All files except the monitor's own."""
        with os_errors_of(self.directory, "cannot be read", "the directory of a run"):
            return [path.name for path in self.directory.iterdir() if not path.name.endswith(WATCH_IMAGE)]

    def _date(self, *names: str) -> float:
        """Time of the last write to these files, s; 0 without any."""
        dates = [0.0]
        for name in names:
            try:
                dates.append((self.directory / name).stat().st_mtime)
            except OSError:
                continue  # not written yet, or just renamed
        return max(dates)


class _Rows:
    """Rows of numbers, to which more are appended; copied as one block instead of number by number."""

    def __init__(self, width: int) -> None:
        self._width, self._numbers = width, array("d")

    def __len__(self) -> int:
        return len(self._numbers) // self._width

    def append(self, row: list[float]) -> None:
        self._numbers.extend(row)

    def replace(self, number: int, row: list[float]) -> None:
        self._numbers[number * self._width : (number + 1) * self._width] = array("d", row)

    def first(self, count: int) -> np.ndarray:
        """A copy of the first rows [count, width]."""
        return np.array(self._numbers, float).reshape(-1, self._width)[:count]


class _Lines:
    """A growing text file; an incomplete last line is read once it is complete."""

    def __init__(self, path: Path) -> None:
        self.path, self._offset, self._count = path, 0, 0

    def read_new(self) -> Iterator[tuple[str, str]]:
        """The complete lines since the last call, each with `file:line`."""
        try:
            with self.path.open("rb") as file:
                file.seek(self._offset)
                added = file.read()
        except FileNotFoundError:
            return
        whole = added[: added.rfind(b"\n") + 1]
        self._offset += len(whole)
        for line in whole.decode("utf-8", "replace").split("\n")[:-1]:
            self._count += 1
            yield f"{self.path}:{self._count}", line


def _numbers(where: str, cells: list[str], count: int) -> list[float]:
    try:
        numbers = [float(cell) for cell in cells]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise InputError(where, f"'{' '.join(cells)}'", f"{count} numbers")
    return numbers
