"""The bench check of a Create: what it drives, by itself and within five minutes, and the record of it.

One marked turn and one marked drive come first, with the counters read at their end: the user measures them.
The same turns at several speeds, and slow drives, follow at each of two reading rates: a robot that loses
remainders reports the less, the slower it moves and the more often it is asked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any, NamedTuple, Protocol

import numpy as np
from pydantic import PositiveFloat

from robot.drivers.create.driver_config import CommandRefused, CreateConfig, StopEvent
from robot.drivers.create.wheel_counters import CreateReading
from tactile.base.errors import InputError
from tactile.base.settings import Settings

RENEW, REST = 0.4, 0.4
"""Time after which a drive command is sent again, and for which the robot rests after a run, s."""


class BenchPlan(Settings):
    """What a bench check drives."""

    turn: PositiveFloat = 360.0
    """Turn of each run, degrees."""
    turn_rates: tuple[PositiveFloat, ...] = (5.0, 20.0, 60.0)
    """Turn rates at each reading rate, degrees/s; the marked turn has the last."""
    way: PositiveFloat = 1.0
    """Way of the marked drive, m."""
    speed: PositiveFloat = 0.15
    """Its speed, m/s."""
    slow_way: PositiveFloat = 0.1
    """Way of the slow drives, m."""
    slow: PositiveFloat = 0.01
    """Their speed, m/s."""
    polls: tuple[PositiveFloat, ...] = (20.0, 5.0)
    """Reading rates, Hz."""


class BenchRun(NamedTuple):
    """A turn or a drive.

    Attributes:
        turns: whether it is a turn. speed: degrees/s or m/s. amount: degrees or m. poll: reading rate, Hz; 0:
            at the end. rows: [N, 8] of its readings: asked, replied (s), expected way (mm), turn (degrees),
            reported way (mm) and turn (degrees), counts of left and right encoder (NaN without).
    """

    turns: bool
    speed: float
    amount: float
    poll: float
    rows: np.ndarray

    @property
    def name(self) -> str:
        """The run in words."""
        unit = "degrees" if self.turns else "m"
        how = f"{self.poll:g} readings/s" if self.poll else "read at its end"
        return (
            f"{'turn' if self.turns else 'drive'} of {self.amount:g} {unit} at {self.speed:g} {unit}/s, {how}"
        )

    def describe(self, expected: np.ndarray, reported: np.ndarray) -> str:
        """What was reported of the commanded motion [N] (degrees or mm of each reading), and its scatter."""
        commanded, found = expected.sum(), reported.sum()
        ratio = found / commanded if commanded else np.nan
        noise = float(np.std(reported - ratio * expected)) if len(expected) else np.nan
        unit = "degrees" if self.turns else "mm"
        said = f"reported {found:.1f} of {commanded:.1f} {unit} ({ratio:.3f}), noise {noise:.2f} a reading"
        return f"{self.name}: {said}"


class BenchRobot(Protocol):
    """The methods of `robot.drivers.create.driver.CreateDriver` that a bench check calls."""

    @property
    def active_stop(self) -> StopEvent | None: ...
    def drive(self, forward: float, turn: float) -> None: ...
    def stop(self) -> None: ...
    def refresh(self) -> None: ...


class Bench(NamedTuple):
    """What drives a robot and waits, in real or simulated time.

    Attributes:
        open: the robot with these settings; it calls the function with each reading. clock: time, s. sleep:
            waits s. measure: asks for the amount of a marked run; None if it is not measured.
    """

    open: Callable[[CreateConfig, Callable[[CreateReading], None]], AbstractContextManager[BenchRobot]]
    clock: Callable[[], float]
    sleep: Callable[[float], None]
    measure: Callable[[BenchRun], float | None]


def plan_runs(plan: BenchPlan) -> list[list[BenchRun]]:
    """The runs without readings, in groups of one reading rate; the marked turn and drive come first."""
    none = np.zeros((0, 8))
    back = BenchRun(False, -plan.speed, plan.way, 0.0, none)
    fast = plan.turn_rates[-1]
    groups = [
        [BenchRun(True, fast, plan.turn, 0.0, none), BenchRun(False, plan.speed, plan.way, 0.0, none), back]
    ]
    for poll in plan.polls:
        turns = [BenchRun(True, rate, plan.turn, poll, none) for rate in plan.turn_rates]
        groups.append([*turns, BenchRun(False, plan.slow, plan.slow_way, poll, none)])
    return groups


def drive_bench(
    config: CreateConfig, plan: BenchPlan, bench: Bench, say: Callable[[str], object]
) -> tuple[list[BenchRun], list[float | None]]:
    """Drives the runs of a plan; returns them with their readings, and the measured marks (degrees, m).

    Args:
        say: called with each run.

    Raises:
        InputError: the robot does not answer, stopped, or its speed limit is below the plan's speeds.
    """
    done: list[BenchRun] = []
    marks: list[float | None] = []
    for group in plan_runs(plan):
        rows: list[CreateReading] = []
        poll = group[0].poll or max(plan.polls)
        often = {
            "rate": poll,
            "silence": max(config.silence, 2.5 / poll),
            "patience": max(config.patience, 1.0),
        }
        # Read at the end of a run, whatever the robot does with remainders.
        seldom = {"remainders": "kept" if group[0].poll else "lost", "distance_scale": 1.0, "turn_scale": 1.0}
        with bench.open(config.model_copy(update={**often, **seldom}), rows.append) as robot:
            for run in group:
                say(run.name)
                robot.refresh()
                del rows[:-1]  # the last is from before the run
                _drive_run(robot, run, bench)
                done.append(run._replace(rows=np.array([reading.row for reading in rows]).reshape(-1, 8)))
                if len(marks) < 2:
                    marks.append(bench.measure(done[-1]))
    return done, marks


def _drive_run(robot: BenchRobot, run: BenchRun, bench: Bench) -> None:
    """Drives a run and rests."""
    end = bench.clock() + run.amount / abs(run.speed)
    command = (0.0, math.radians(run.speed)) if run.turns else (run.speed, 0.0)
    while (left := end - bench.clock()) > 0:
        try:
            robot.drive(*command)
        except CommandRefused as error:
            cure = (
                "clear its way and start the check again; a speed above the limit needs `live.create.speed`"
            )
            raise InputError(run.name, str(error), "a robot that drives", cure) from None
        bench.sleep(min(left, RENEW))
    robot.stop()
    bench.sleep(REST)
    robot.refresh()
    if robot.active_stop is not None:
        found, cure = f"the robot stopped: {robot.active_stop}", "clear its way and start the check again"
        raise InputError(run.name, found, "2 m of free, even floor", cure)


def runs_to_data(runs: list[BenchRun]) -> list[dict[str, Any]]:
    """Runs as JSON values; what is not a number is null."""
    none = lambda value: round(value, 6) if math.isfinite(value) else None  # noqa: E731
    return [
        run._asdict() | {"rows": [[none(value) for value in row] for row in run.rows.tolist()]}
        for run in runs
    ]


def runs_of_data(data: list[dict[str, Any]]) -> Iterator[BenchRun]:
    """The runs of `runs_to_data`."""
    for run in data:
        yield BenchRun(**run | {"rows": np.array(run["rows"], float).reshape(-1, 8)})
