"""A growth study: cost of a step, memory and error against the length of a session.

One session is on known ground and one on new ground. A simulation of whiskers gives both. Another session
whose true poses are known, a recording of views or ids, gives known ground: its course again and again, with
noise of its own each time. Each session is played a step at a time in a process of its own and measured at
growing lengths; every row is on disk as soon as it is measured.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import islice, pairwise
from math import ceil
from pathlib import Path
from threading import RLock
from time import perf_counter, process_time, thread_time
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field, PositiveInt

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.trajectory import ate
from evaluation.plots import style
from evaluation.plots.style import BLUE, GREEN, PURPLE, VERMILLION
from evaluation.studies.executor import Executor
from evaluation.studies.machine import Machine, compilations, watch_machine
from evaluation.studies.metrics import FALSE_CLOSURE_DISTANCE, closure_errors
from evaluation.studies.perturbation import repeat_course
from evaluation.studies.run_job import KILLED, read_records
from evaluation.studies.study import preset_settings, with_settings
from evaluation.studies.study_report import (
    csv_text,
    describe_machines,
    find_disturbances,
    format_number,
    render_table,
    save_files,
)
from ratslam.core.session import Session
from ratslam.runs.build_session import build_session, open_observations, read_observations
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import load, override, validate
from robot.simulation.head.simulated_session import HeadSimulation
from robot.sources.in_memory import load_into_memory
from robot.world.maze import winding_loop
from robot.world.scene import PAPER_CIRCUITS, PathConfig
from tactile.base.errors import InputError, os_errors_of
from tactile.base.random_streams import stream
from tactile.base.se2 import integrate
from tactile.base.settings import Settings
from tactile.base.types import Observation

if TYPE_CHECKING:
    from matplotlib.figure import Figure


SIDE = 64
"""Columns and rows of the maze of new ground, cells: the largest that can be simulated."""
SPARE = 1.05
"""Length of a route relative to the length wanted, as estimated from a shorter one."""

Ground = Literal["known ground", "new ground"]
Length = Annotated[int, Field(ge=0, le=1_000_000)]


class _GrowthPlan(Settings):
    """The settings of a growth study."""

    first: PositiveInt = 400  # least length to measure at, steps; each further one is twice as long
    known_ground: Length = 3200  # greatest length of the session on known ground, steps; 0: no such session
    new_ground: Length = 3200  # greatest length of the session on new ground, steps; 0: no such session
    window: Length = 0  # steps before each length whose times are measured; 0: all since the length before

    def lengths(self, ground: Ground) -> list[int]:
        """The lengths to measure a session at, in increasing order."""
        most = self.known_ground if ground == "known ground" else self.new_ground
        found, length = list[int](), self.first
        while length < most:
            found.append(length)
            length *= 2
        return [*found, most] if most else []


class _GrowthTask(NamedTuple):
    """One session of a growth study."""

    ground: Ground
    config: RunConfig  # a simulation of whiskers is at least as long as the greatest length
    lengths: list[int]  # to measure at, increasing, steps
    window: int = 0  # see `_GrowthPlan`


def growth_study(path: Path, overrides: Sequence[str] = ()) -> tuple[str, list[_GrowthTask]]:
    """Name and sessions of the growth study of a configuration file.

    Args:
        overrides: each `a.b=value`: a key of `_GrowthPlan` where it is one, else of the configuration.

    Raises:
        InputError: the configuration is invalid, or the ground is too small.
    """
    plan, others = preset_settings(_GrowthPlan, "growth", overrides)
    document = override(load(path), others)
    config = validate(document, RunConfig).with_absolute_paths(path.parent.resolve())
    whiskers = config.simulation is not None
    tasks = []
    if lengths := plan.lengths("known ground"):
        known = _with_laps(config, lengths[-1]) if whiskers else config
        tasks.append(_GrowthTask("known ground", known, lengths, plan.window))
    if whiskers and (lengths := plan.lengths("new ground")):
        tasks.append(_GrowthTask("new ground", with_new_ground(config, lengths[-1]), lengths, plan.window))
    if not tasks:
        raise InputError("--preset growth", "no session", "known_ground or new_ground above 0 steps")
    return f"{path.stem}-growth", tasks


def _with_laps(config: RunConfig, steps: int) -> RunConfig:
    """The configuration with its circuits repeated for at least so many steps."""
    assert config.simulation is not None
    word, loop = config.simulation.path.circuits or PAPER_CIRCUITS, config.simulation.path.loop

    def repeated(laps: int) -> RunConfig:
        circuits = (word * ceil(laps / len(word)))[:laps]
        return with_settings(config, {"simulation.path": PathConfig(circuits=circuits, loop=loop)})

    return _lengthened(repeated, 1, steps)


def with_new_ground(config: RunConfig, steps: int) -> RunConfig:
    """The configuration in the largest maze, on a random route that enters no cell twice, of at least so many
    steps."""
    assert config.simulation is not None
    size = {"columns": SIDE, "rows": SIDE, "kind": "loop", "file": None}
    maze = config.simulation.maze.model_copy(update=size)
    seed = config.simulation.seed if maze.seed is None else maze.seed
    loop = tuple(winding_loop(SIDE, SIDE, stream(seed, "growth.route")))

    def visiting(cells: int) -> RunConfig:
        path = PathConfig(cells=loop[:cells], loop=loop)
        return with_settings(config, {"simulation.maze": maze, "simulation.path": path})

    return _lengthened(visiting, 8, steps, len(loop))


def _lengthened(
    made: Callable[[int], RunConfig], count: int, steps: int, most: int = sys.maxsize
) -> RunConfig:
    """What is made of a number of laps or cells, from `count` on, that suffices for so many steps."""
    while (length := _length(found := made(count))) < steps:
        if count == most:
            raise InputError("new_ground", f"{steps} steps", f"at most {length}, a visit of every cell")
        count = min(max(count + 1, ceil(SPARE * count * steps / length)), most)
    return found


def _length(config: RunConfig) -> int:
    """Number of whisks of a simulation."""
    assert config.simulation is not None
    cheapest = with_settings(config, {"simulation.fidelity": "kinematic", "simulation.raw": False}).simulation
    assert cheapest is not None
    return HeadSimulation(cheapest, config.touch.head).length or 0


_TALL, _BOTTOM = 4.4, 1.15  # inches: height of the axes, and below them
_COLORS = (BLUE, VERMILLION, GREEN, PURPLE)
_DASHES = (("mean", "-", "o"), ("99 %", "--", "s"), ("largest", ":", "^"))


SEED = 0
"""Seed of the noise of a course that is repeated."""
TIMES = ("mean", "process_mean", "median", "p99", "largest", "longest")
"""Fields of a row that need a step that compiled nothing."""


class _GrowthRow(Settings):
    """A session at one length. Times are of the steps since the length before, or of the window of
    `_GrowthPlan`, without those that compiled code; None if all did. Errors are of all steps so far."""

    ground: Ground
    steps: int  # length of the session
    keyframes: int  # number of rows of the backend's memory in use
    mean: float | None  # processor time of a step on the session's own thread, mean, us
    process_mean: float | None  # the same, with the process's other threads, us
    median: float | None  # processor time of a step on the session's own thread, us
    p99: float | None  # the same, 99 % quantile, us
    largest: float | None  # the same, largest, us
    longest: float | None  # wall time of the longest step, with waits for other threads, us
    compiling: float  # wall time of the steps that compiled code, s
    memory: float  # peak resident memory, MiB
    energy: float  # Energy Metric of the online map, all pairs, m^2 + rad^2
    ate: float  # ATE of the online map, m
    energy_odometry: float  # Energy Metric of odometry, all pairs, m^2 + rad^2
    closures: int  # number of loop closures of the final map
    false_closures: int  # number of these between steps farther apart than `FALSE_CLOSURE_DISTANCE`
    end: float  # processor time of the final optimisation if the session ended here, s
    energy_final: float  # Energy Metric of the final map, all pairs, m^2 + rad^2
    ate_final: float  # ATE of the final map, m
    machine: Machine


def _read_clocks() -> np.ndarray:
    """[3] processor time of this thread and of the process, and wall time, s."""
    return np.array([thread_time(), process_time(), perf_counter()])


class _StepClock:
    """Times steps, apart from those that compile code."""

    def __init__(self) -> None:
        self._compiled = compilations()
        self.restart()

    def take(self, session: Session, observation: Observation) -> None:
        """Takes and times a step of a session."""
        compiled, before = len(self._compiled), _read_clocks()
        session.step(observation)
        own, process, wall = _read_clocks() - before
        if len(self._compiled) == compiled:
            self._steps.append((own, wall))
        else:
            self._compiling += wall
            self._others += own - process  # threads that compile are no cost of a step

    def read(self) -> dict[str, float | None]:
        """The times of `_GrowthRow` since the last call or restart."""
        own, process, _ = _read_clocks() - self._began
        others = self._others + process - own
        steps, compiling = self._steps, self._compiling
        self.restart()
        if not steps:
            return {"compiling": compiling} | dict.fromkeys(TIMES)
        each, wall = 1e6 * np.array(steps).T
        # Threads beside the session also work between its steps.
        mean, beside = each.mean(), 1e6 * max(others, 0.0) / len(each)
        found = mean, mean + beside, np.median(each), np.quantile(each, 0.99), each.max(), wall.max()
        times: dict[str, float | None] = {"compiling": compiling}
        return times | dict(zip(TIMES, map(float, found), strict=True))

    def restart(self) -> None:
        """Forgets the steps so far."""
        self._steps: list[tuple[float, float]] = []
        self._compiling, self._others, self._began = 0.0, 0.0, _read_clocks()


def measure_growth(task: _GrowthTask, done: Callable[[], object] = lambda: None) -> Iterator[_GrowthRow]:
    """Plays the session once, to its greatest length; yields a row at each length.

    Args:
        done: called after each step.
    """
    with open_observations(task.config) as (config, source):
        # Rows reserved for the greatest length would cost from the first step on.
        reserve = config.session.reserve or 1
        kept = config.session.model_copy(update={"reserve": reserve})
        if config.simulation is None:
            source = repeat_course(load_into_memory(source), task.lengths[-1], SEED)
        session = build_session(config.model_copy(update={"session": kept}), source)
        rows, clock = read_observations(source), _StepClock()
        truth, motion = list[np.ndarray](), list[np.ndarray]()
        for before, length in pairwise([0, *task.lengths]):
            watched = watch_machine()
            window = min(task.window or length, length - before)
            for step, (sample, observation) in enumerate(islice(rows, length - before)):
                if step == length - before - window:
                    clock.restart()
                clock.take(session, observation)
                assert sample.truth is not None
                truth.append(sample.truth)
                motion.append(np.asarray(observation.odometry[:3], float))
                done()
            times, (memory, here) = clock.read(), watched()
            errors = _errors(session, np.array(truth), integrate(np.array(motion)))
            found = {"keyframes": session.backend.rows(session.state), "memory": memory, "machine": here}
            found |= {"ground": task.ground, "steps": length, **times, **errors}
            yield _GrowthRow.model_validate(found)


def _errors(session: Session, truth: np.ndarray, odometry: np.ndarray) -> dict[str, float]:
    """The errors of `_GrowthRow`, and the time of the final optimisation; the session stays as it is."""
    online = session.map.online_trajectory()
    began = thread_time()
    final, end = session.map.trajectory(), thread_time() - began
    closures = session.map.closures()
    return {
        "end": end,
        "energy_odometry": energy_all_pairs(odometry, truth).total,
        "closures": len(closures),
        "false_closures": int((closure_errors(truth, closures) > FALSE_CLOSURE_DISTANCE).sum()),
        "energy": energy_all_pairs(online, truth).total,
        "ate": ate(online, truth),
        "energy_final": energy_all_pairs(final, truth).total,
        "ate_final": ate(final, truth),
    }


FILE = "growth.jsonl"  # name of the file of rows in a study's folder
COLUMNS = {
    "": "ground", "steps": "steps", "keyframes": "keyframes", "mean us": "mean",
    "all threads us": "process_mean", "median us": "median", "99 % us": "p99", "largest us": "largest",
    "longest us": "longest", "memory MiB": "memory", "EM m^2 + rad^2": "energy", "ATE m": "ate",
    "odometry EM": "energy_odometry", "end s": "end", "final EM": "energy_final",
    "final ATE m": "ate_final", "closures": "closures", "false": "false_closures",
}  # fmt: skip
"""Fields of a row by their column in the table."""
NOTE = """\
mean, median, 99 %, largest: processor time of a step on the session's thread, over the steps since the length
before or the window, without those that compiled code. all threads: the mean with other threads. longest:
wall time of a step, with waits for the selection of closures, as steps follow one another without pause.
memory: peak since the length before. EM and ATE: of the online map so far. end: processor time of the final
optimisation if the session ended here. final, closures, false: of the map after it; closures of places more
than 0.1 m apart."""


def run_growth(tasks: Sequence[_GrowthTask], folder: Path) -> None:
    """Runs sessions one after another; each row is in `folder/FILE` as soon as it is measured.

    Raises:
        InputError: the folder cannot be made, a session cannot be simulated, or its process was killed.
    """
    with os_errors_of(folder, "cannot be written to", "a folder to write to"):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / FILE).write_bytes(b"")
    with Executor(fresh=True) as executor:
        measure = partial(_append_rows, folder / FILE)
        for _, killed in executor.completed(measure, tasks, lambda task: task.ground):
            if killed is not None:
                raise InputError(killed, KILLED, "memory for the whole session", "measure a shorter one")


def read_rows(folder: Path) -> list[_GrowthRow]:
    """The rows measured so far."""
    return read_records(folder / FILE, _GrowthRow)


def render_growth(rows: Sequence[_GrowthRow]) -> str:
    """The table and its notes as Markdown."""
    table = [list(COLUMNS)]
    for row in rows:
        values = [getattr(row, name) for name in COLUMNS.values()]
        known = ["-" if value is None else value for value in values]
        table.append([format_number(each) if isinstance(each, float) else str(each) for each in known])
    machines = [row.machine for row in rows]
    remarks = [f"{each[0].upper()}{each[1:]}." for each in find_disturbances(machines)]
    measured = describe_machines(machines, 1)
    return "\n".join([render_table(table), "", NOTE, "; ".join(measured.values()) + ".", *remarks])


def _draw(name: str, rows: Sequence[_GrowthRow]) -> Figure | None:
    """Mean, 99 % quantile and largest cost of a step against length; None without a step that compiled
    nothing."""
    timed = [row for row in rows if row.largest]
    if not timed:
        return None
    grounds = dict.fromkeys(row.ground for row in timed)
    cost = np.array([[row.mean, row.p99, row.largest] for row in timed], float) / 1e3
    steps = np.array([row.steps for row in timed])
    measured = describe_machines([row.machine for row in rows], 1)
    line = "  ·  ".join(measured[part] for part in ("machine", "build"))
    figure, axes = style.new_chart(_TALL, _BOTTOM, f"Cost of a step against length: {name}", line)
    style.log_axes(axes, steps, cost.ravel())
    for ground, color in zip(grounds, _COLORS, strict=False):
        these = [row.ground == ground for row in timed]
        for values, (statistic, dash, mark) in zip(cost[these].T, _DASHES, strict=True):
            text = f"{ground}, {statistic}"
            axes.plot(steps[these], values, dash, color=color, lw=1.5, marker=mark, ms=4.5, mew=0, label=text)
    style.name_axes(axes, "length of the session (steps)", "processor time of a step (ms), own thread")
    return style.add_legend(figure, axes, columns=len(grounds))


def save_growth(name: str, rows: Sequence[_GrowthRow], folder: Path) -> list[Path]:
    """Writes table.csv, table.md and, if there is something to draw, growth.png."""
    lines = [row.model_dump(exclude={"machine"}) | {"other_load": row.machine.other_load} for row in rows]
    figure, table = _draw(name, rows), f"{render_growth(rows)}\n"
    return save_files(folder, {"table.csv": csv_text(lines), "table.md": table, "growth.png": figure})


def _append_rows(path: Path, task: _GrowthTask) -> str | None:
    """Measures a session, with a progress bar; appends its rows to a file."""
    from tqdm import tqdm

    tqdm.set_lock(RLock())  # the default is a semaphore, which is left over when this process is ended
    bar = tqdm(total=task.lengths[-1], desc=task.ground, unit="step", file=sys.stderr, mininterval=0.5)
    with bar, path.open("a", encoding="utf-8") as file:
        for row in measure_growth(task, bar.update):
            file.write(row.model_dump_json() + "\n")
            file.flush()
    return None
