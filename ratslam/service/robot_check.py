"""Bench checks of robots: each drives one, asks a few questions, and writes a page, a rig and a record.

A robot of one's own is an entry of `ROBOTS`: a function that drives it, or reads a record, and judges it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from ratslam.runs.run import catch_interrupt
from ratslam.runs.settings.run_config import load_config
from ratslam.service.arm_check import judge_arm, judge_head
from ratslam.service.create_check import Verdict, judge_create
from ratslam.service.rig_fit import Rig, aligned
from robot.drivers.create.driver import CreateDriver
from robot.drivers.create.driver_config import CreateConfig
from robot.live import arm_bench
from robot.live.create_bench import Bench, BenchPlan, BenchRun, drive_bench, runs_of_data, runs_to_data
from robot.live.live_config import LiveConfig
from robot.live.poke_loop import FreePokes
from tactile.base.errors import InputError, tell
from tactile.base.files import new_folder
from tactile.frontend import TouchConfig

FORMAT = "ratslam-bench-1"
FINE, UNKNOWN = "fine", "cannot tell"


class RobotRequest(NamedTuple):
    """What is checked.

    Attributes:
        config: configuration of a live session, or the JSON file of an earlier check. settings: replaced
            ones. marks: what the user measured, by its name; None: not. ask: asks the user for a number;
            None: nobody is asked.
    """

    config: Path
    settings: list[str]
    marks: dict[str, float | None]
    ask: Callable[[str], float | None] | None = None


class RobotReport(NamedTuple):
    """What a check found. Attributes: record: all that was measured, as JSON values."""

    verdicts: list[Verdict]
    rig: Rig
    record: dict[str, Any]

    @property
    def faulty(self) -> bool:
        """Whether a fault was found."""
        return any(verdict.found not in (FINE, UNKNOWN) for verdict in self.verdicts)

    def render(self) -> str:
        """The verdicts and the rig as text."""
        rows = [(verdict.question, verdict.found, verdict.detail) for verdict in self.verdicts]
        return "\n".join([*aligned(rows), "", self.rig.render()])

    def write(self, folder: Path, name: str) -> None:
        """Writes page.txt, rig.yaml and bench.json into a new folder."""
        record = {"format": FORMAT, **self.record, "verdicts": [each._asdict() for each in self.verdicts]}
        with new_folder(folder) as inside:
            (inside / "page.txt").write_text(f"Check of {name}\n\n{self.render()}\n", encoding="utf-8")
            rig = self.rig.file_text(name, "check robot")
            (inside / "rig.yaml").write_text(rig, encoding="utf-8")
            (inside / "bench.json").write_text(json.dumps(record), encoding="utf-8")


def check_create(request: RobotRequest, plan: BenchPlan | None = None) -> RobotReport:
    """Checks the odometry of a Create: it turns and drives for about four minutes, on 2 m of free floor."""
    if request.config.suffix == ".json":
        with _reading(request.config, "create") as record:
            create, runs = CreateConfig(**record["settings"]), [*runs_of_data(record["runs"])]
            if len({run.turns for run in runs}) < 2:
                raise ValueError("a turn and a drive")
            marks = {name: value or record["marks"][name] for name, value in request.marks.items()}
    else:
        config = load_config(request.config, request.settings).live
        if config is None or config.create is None:
            raise InputError(f"{request.config}: live.create", "missing", "the settings of a Create")
        fields = config.create.model_dump(include=set(CreateConfig.model_fields))
        create = CreateConfig(**fields)
        names, ask = list(request.marks), request.ask

        def measure(run: BenchRun) -> float | None:
            name = names[0 if run.turns else 1]
            if request.marks[name] is not None or ask is None:
                return request.marks[name]
            return ask(f"How far was that, {'degrees' if run.turns else 'm'}? (Enter: not measured) ")

        if ask is not None:
            ask("The robot turns, then drives 1 m ahead. Mark its place and heading; Enter starts it. ")
        bench = Bench(CreateDriver, time.monotonic, time.sleep, measure)
        runs, measured = drive_bench(create, plan or BenchPlan(), bench, tell)
        marks = dict(zip(names, measured, strict=True))
    verdicts, rig = judge_create(create, runs, *marks.values())
    data = {
        "robot": "create",
        "version": version("ratslam"),
        "settings": create.model_dump(mode="json"),
        "marks": marks,
    }
    return RobotReport(verdicts, rig, {**data, "runs": runs_to_data(runs)})


def check_arm(request: RobotRequest, trials: int = arm_bench.TRIALS) -> RobotReport:
    """Checks force, states and position of an arm by pokes in free air, in about four minutes."""
    live, touch, record = _record_of(request, "arm", FreePokes, trials)
    return _report("arm", live, touch, record, judge_arm(live, touch, record))


def check_head(request: RobotRequest, trials: int = arm_bench.TRIALS) -> RobotReport:
    """Checks the whiskers of a head on an arm by whisks in free air, in about a minute."""
    live, touch, record = _record_of(request, "head", arm_bench.FreeWhisks, trials)
    return _report("head", live, touch, record, judge_head(live, touch, record))


def _record_of(
    request: RobotRequest, robot: str, kind: Callable[..., Any], trials: int
) -> tuple[LiveConfig, TouchConfig, Any]:
    """Settings and record of an arm or its head: measured now, or of an earlier check."""
    if any(mark is not None for mark in request.marks.values()):
        raise InputError(f"check robot {robot}", "a mark", "marks with `check robot create` only")
    if request.config.suffix == ".json":
        with _reading(request.config, robot) as stored:
            settings = stored["settings"]
            record = arm_bench.record_of_text(kind, stored["record"])
            return LiveConfig(**settings["live"]), TouchConfig(**settings["touch"]), record
    config = load_config(request.config, request.settings)
    live, touch = config.live, config.touch
    if live is None or live.create is not None or live.topics is not None:
        raise InputError(f"{request.config}: live.arm", "missing", "the settings of an arm")
    with catch_interrupt("stopping the robot") as stopped:
        if robot == "arm":
            return live, touch, arm_bench.poke_in_air(live, touch.head, touch.pokes, stopped, tell, trials)
        if live.arm.touch == "force":
            cure = "`check robot arm` checks an arm without one"
            raise InputError(f"{request.config}: live.arm.touch", "force", "a whisker head", cure)
        return live, touch, arm_bench.whisk_in_air(live, touch.head, stopped, tell, trials)


KEPT = {name: True for name in ("arm", "head", "gap", "grace", "residual")} | {
    "plan": {"whisking": True, "calibration": True}
}
"""Settings of `live` that a record keeps."""


def _report(
    robot: str, live: LiveConfig, touch: TouchConfig, record: Any, judged: tuple[list[Verdict], Rig]
) -> RobotReport:
    settings = {"live": live.model_dump(mode="json", include=KEPT), "touch": touch.model_dump(mode="json")}
    data = {"robot": robot, "version": version("ratslam"), "settings": settings}
    return RobotReport(*judged, {**data, "record": arm_bench.record_to_text(record)})


@contextmanager
def _reading(file: Path, robot: str) -> Iterator[dict[str, Any]]:
    """The record of an earlier check; what is wrong with it is an `InputError`."""
    expected = f"the bench.json of a check of `{robot}`"
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
        if (record["format"], record["robot"]) != (FORMAT, robot):
            raise InputError(str(file), f"{record['format']} of `{record['robot']}`", expected)
        yield record
    except (OSError, ValueError, KeyError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(str(file), f"cannot be read ({type(error).__name__})", expected) from None


ROBOTS: dict[str, Callable[[RobotRequest], RobotReport]] = {
    "create": check_create,
    "arm": check_arm,
    "head": check_head,
}
"""The checks by the name of the robot."""
