"""Live progress of a run in another process: an image and a status line (command `watch`).

It only reads the run directory, so it does not slow the run (Fox et al. 2012, II-D: monitors are separate
processes).
"""

from __future__ import annotations

import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from math import atan2
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.artifacts.run_reader import (
    RUNNING,
    check_run_directory,
    checkpoint_steps,
    read_manifest,
    read_walls,
)
from evaluation.metrics.run_metrics import DOUBTED, path_length
from evaluation.metrics.trajectory import align
from evaluation.plots import style
from evaluation.plots.map_plot import NO_WALLS, draw_walls, split_at_jumps
from evaluation.plots.style import BLUE, GREY, LABEL_GREY, LINE_GREY, VERMILLION, YELLOW
from tactile.base.errors import InputError, os_errors_of
from tactile.base.files import write_atomically
from tactile.base.se2 import between, compose

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
    outcomes: Counter[str]
    lost: int
    online_error: float | None
    checkpoint: int
    rate: float | None
    silence: float
    doubt: float | None = None
    warnings: tuple[str, ...] = ()

    @property
    def length(self) -> float:
        """Length of the path by odometry from the start of the run, m."""
        return path_length(np.concatenate([np.zeros((1, 3)), self.odometry]))

    @property
    def step_count(self) -> str:
        """Number of steps as text."""
        count = len(self.path)
        return f"{count} steps" if self.total is None else f"{count} of {self.total} steps"

    def status_line(self, pace: float | None) -> str:
        """The state of a run in one line; `pace` is in steps per second."""
        parts = [f"{self.name}: {self.status}", self.step_count, f"{self.length:.1f} m"]
        parts += [] if pace is None else [f"{pace:.0f} steps/s"]
        parts += [] if self.online_error is None else [f"error {self.online_error:.3g} m"]
        parts += [f"{count} {name}" for name, count in self.outcomes.most_common()]
        parts += [f"{self.lost} lost"] if self.lost else []
        parts += [f"map_doubted ({self.doubt:.0%})"] if (self.doubt or 0.0) > DOUBTED else []
        parts += [f"input warned ({len(self.warnings)})"] if self.warnings else []
        parts += [f"checkpoint at {self.checkpoint}"] if self.checkpoint else []
        if self.status == RUNNING and self.silence > SILENCE_SHOWN:
            parts.append(f"silent for {self.silence:.0f} s")
        return ", ".join(parts)


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
        self._counted.update(self._outcomes[self._counted.total() : count])  # those not counted yet
        began, last = self._date("config.yaml"), self._date("steps.csv")
        checkpoint = checkpoint_steps(self.directory)
        with os_errors_of(self.directory, "cannot be read", "the directory of a run"):
            files = [path.name for path in self.directory.iterdir() if not path.name.endswith(WATCH_IMAGE)]
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
            checkpoint=checkpoint,
            rate=count / (last - began) if 0 < began < last else None,
            silence=max(0.0, time.time() - self._date(*files)),
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

    def _date(self, *names: str) -> float:
        """Time of the last write to these files, s; 0 without any."""
        dates = [0.0]
        for name in names:
            with suppress(OSError):  # not written yet, or just renamed
                dates.append((self.directory / name).stat().st_mtime)
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


SILENCE_LIMIT = 300.0
"""A run without output for this long counts as killed, s; compiling and the final plots take less."""
SILENCE_SHOWN = 10.0
"""The status line reports silence longer than this, s."""
REST_FACTOR = 9.0
"""Pause as a multiple of the working time; limits the monitor to a tenth of a processor core."""


def watch_run(
    directory: Path,
    report: Callable[[str], None],
    *,
    every: float = 2.0,
    patience: float = SILENCE_LIMIT,
    once: bool = False,
) -> RunProgress:
    """Updates watch.png in a run directory and reports the status, until the run ends.

    Args:
        report: called with the status line after each update. every: least time between updates, s.
        patience: silence after which the run counts as killed, s. once: whether to stop after one update.

    Returns:
        the last state.

    Raises:
        InputError: the directory holds no run or cannot be written to.
    """
    monitor, before, last = RunMonitor(directory), None, 0.0
    while True:
        began = time.monotonic()
        seen = monitor.read()
        pace = seen.rate
        if before is not None and seen.status == RUNNING:
            pace = (len(seen.path) - len(before.path)) / (began - last)
        if before is None or (len(seen.path), seen.status) != (len(before.path), before.status):
            figure, file = draw_watch(seen, read_walls(directory)), directory / WATCH_IMAGE
            with os_errors_of(file, "cannot be written", "a run directory that can be written to"):
                write_atomically(file, figure.savefig)
        report(seen.status_line(pace))
        if once or seen.status != RUNNING or seen.silence > patience:
            return seen
        before, last = seen, began
        time.sleep(max(every, REST_FACTOR * (time.monotonic() - began)))


_TALL, _BOTTOM, _COUNTS = 4.55, 0.95, 1.55  # inches: height of the map, below it, and width of the counts
_DRAWN = 5000  # steps drawn of a long path, to limit the drawing time
_ROUND = 2 * np.pi * np.arange(49) / 48


def draw_watch(seen: RunProgress, walls: np.ndarray = NO_WALLS) -> style.Figure:
    """The online path over the truth, and the last pose with an ellipse of two standard deviations.

    With truth, everything is in its frame: the online path by the best rigid fit so far, odometry by its
    start pose. Odometry that drifts far off leaves the picture.

    Args:
        walls: [B, 5] west, south, east, north, height in m; drawn with truth.
    """
    parts = [seen.status, seen.step_count]
    if len(seen.path):
        x, y, turn = seen.sd
        parts.append(f"last pose ± {x:.2g} m, {y:.2g} m, {np.degrees(turn):.2g} degrees")
    parts += [] if seen.online_error is None else [f"error {seen.online_error:.3g} m"]
    figure, axes = style.new_chart(_TALL, _BOTTOM, seen.name, "  ·  ".join(parts), right=_COUNTS)
    axes.set_aspect("equal", adjustable="datalim")
    if len(seen.path):
        _paint(axes, seen, walls)
    axes.apply_aspect()
    style.metre_grid(axes, style.TRUTH if np.isfinite(seen.truth).any() else style.MAP)
    _paint_counts(figure, seen, style.LEFT + style.INNER - _COUNTS + 0.25)
    if len(seen.path):
        style.add_legend(figure, axes)
    return figure


def _paint(axes: style.Axes, seen: RunProgress, walls: np.ndarray) -> None:
    """Draws the layers in the order of the legend."""
    known = np.isfinite(seen.truth).all(axis=1)
    to_truth = align(seen.path[known], seen.truth[known]) if known.any() else np.zeros(3)
    rows = np.arange(len(seen.path) - 1, -1, -len(seen.path) // _DRAWN)[::-1]  # includes the last one
    path, truth = compose(to_truth, seen.path), seen.truth[rows]
    if known.any():
        if len(walls):
            draw_walls(axes, walls)
        axes.plot(*split_at_jumps(truth, truth).T, color=YELLOW, lw=3.5, zorder=2, label="truth")
    axes.plot(*split_at_jumps(path[rows, :2], truth).T, color=BLUE, lw=0.9, zorder=4, label="online path")
    # The current pose: an ellipse of two standard deviations, and a triangle that points ahead.
    around = np.column_stack([np.cos(_ROUND), np.sin(_ROUND)]) * 2 * seen.sd[:2]
    ellipse = compose(to_truth, np.column_stack([seen.path[-1, :2] + around, np.zeros(len(_ROUND))]))
    label, (x, y, heading) = "current pose, 2 standard deviations", compose(to_truth, seen.path[-1])
    axes.plot(*ellipse[:, :2].T, color=VERMILLION, lw=1.2, zorder=6, label=label)
    ahead = (3, 0, float(np.degrees(heading)) - 90.0)
    axes.plot(x, y, color=VERMILLION, ls="", marker=ahead, ms=11, mec="white", mew=0.8, zorder=7)
    axes.margins(0.08)
    axes.apply_aspect()
    axes.set(xlim=axes.get_xlim(), ylim=axes.get_ylim(), adjustable="box")  # odometry may leave the plot
    reckoned = compose(compose(path[0], between(seen.odometry[0], np.zeros(3))), seen.odometry[rows])
    dashed = (0, (5, 3))
    axes.plot(*reckoned[:, :2].T, color=GREY, lw=0.8, ls=dashed, zorder=1, label="odometry")


def _paint_counts(figure: style.Figure, seen: RunProgress, left: float) -> None:
    """Number of steps by outcome, right of the map."""
    counts = seen.outcomes.most_common() + [("lost", seen.lost)] * bool(seen.lost)
    steps = max(1, len(seen.path))
    for row, (name, count) in enumerate(counts):
        low = _BOTTOM + _TALL - 0.45 * (row + 1)
        bar = style.add_axes(figure, left, low, _COUNTS - 0.3, 0.1)
        bar.barh([0, 0], [1, count / steps], color=[LINE_GREY, GREY if name == "ok" else BLUE])
        bar.set(xlim=(0, 1), ylim=(-0.4, 0.4), xticks=[], yticks=[])
        bar.set_title(f"{name}  {count} steps", fontsize=8.5, color=LABEL_GREY, loc="left", pad=2)
