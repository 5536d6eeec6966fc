"""A live session: the robot in this process, the mapper in another; all data are recorded before use."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from evaluation.artifacts.run_reader import SESSION_REPORT
from evaluation.metrics.scorecard import Scorecard
from ratslam.live.arm_session import prepare_arm_session
from ratslam.live.create_session import prepare_create_session
from ratslam.live.live_robot import RECORDING, LiveRobot, quantiles
from ratslam.live.mapper_process import Mapper
from ratslam.live.topics_session import prepare_topics_session
from ratslam.runs.run import catch_interrupt
from ratslam.runs.settings.run_config import RunConfig
from robot.drivers.outcome import Fault, SessionOutcome
from robot.drivers.processes import urgent
from robot.live.polling import OperatorStop, SessionFault
from robot.live.recorder import LiveRecorder
from robot.live.selftest import check_disk
from robot.recordings.cdr import Event, doubts_of
from robot.recordings.mcap_writer import Recorder
from tactile.base.files import require_new_file
from tactile.calibration import Calibration

START_TIMEOUT = 300.0
"""Time limit of the mapper's start, with compilation, s."""


def run_live_session(
    config: RunConfig,
    directory: Path,
    log: Callable[[str], None],
    mapping: Callable[..., None] | None = None,
    armed: Callable[[Path], None] = lambda directory: None,
    view: str | None = None,
    resume: Path | None = None,
) -> tuple[Fault, Scorecard | None]:
    """Finds the devices, compiles, tests them, drives or moves, maps and scores.

    The robot is started after the compilation, which takes this machine's processors for up to a minute.

    Args:
        directory: the new run directory. log: called with each line of progress.
        mapping: main function of the mapper process; None: `ratslam.live.mapper_process.run_mapper`.
        armed: called with the directory when the session begins. view: target of a live view, or None.
        resume: map to continue, or None.

    Returns:
        the outcome of the session with its finding, and the score of the map, if there is one.

    Raises:
        InputError: the session could not be armed.
    """
    assert config.live is not None
    choose: Callable[..., Callable[[Callable[[], bool]], LiveRobot]] = prepare_arm_session
    if config.live.create is not None:
        choose = prepare_create_session
    elif config.live.topics is not None:
        choose = prepare_topics_session
    require_new_file(directory, parents=True)
    open_robot = choose(config, directory)
    log(check_disk(config.live, directory))
    with urgent(), catch_interrupt("ending the session") as stopped, Mapper(mapping) as mapper:
        robot = open_robot(stopped)
        robot.view, robot.resume = view, resume
        fault, standing, card = None, False, None
        try:
            with robot.rig as rig:
                try:
                    calibration = _prepare(robot, mapper, log)
                    log("armed")
                    armed(directory)
                    described = robot.job.source
                    info = described.info.model_copy(update={"calibration": calibration})
                    source = replace(described, info=info)
                    with LiveRecorder(Recorder(directory / RECORDING, source)) as rig.recorder:
                        _run(robot, mapper)
                    fault = Fault(robot.end, f"{robot.count} {robot.unit}s", time.monotonic())
                except SessionFault as error:
                    fault = error.fault
                except (OperatorStop, KeyboardInterrupt) as error:
                    done = f"after {robot.count} {robot.unit}s, which `run` on the recording maps"
                    detail = done if robot.count else "nothing was recorded"
                    fault = Fault(SessionOutcome.INTERRUPTED, detail, time.monotonic())
                    if isinstance(error, KeyboardInterrupt):  # a second one
                        raise
                standing = rig.rest()
            if robot.count:
                if behind := mapper.behind():
                    log(f"mapper: {behind:.1f} s behind, and is waited for")
                card = mapper.finish(not fault.outcome.planned)
        finally:
            if fault is not None:
                report = {
                    "outcome": fault.outcome.name.lower(),
                    "detail": fault.detail,
                    "standing": standing,
                    f"{robot.unit}s": robot.count,
                    **robot.report(),
                    "mapper_s": quantiles([result.seconds for result in mapper.mapped]),
                }
                text = json.dumps(report, indent=2) + "\n"
                with suppress(OSError):  # a full disk has been reported
                    (directory / SESSION_REPORT).write_text(text, encoding="utf-8")
    return fault, card


def _prepare(robot: LiveRobot, mapper: Mapper, log: Callable[[str], None]) -> Calibration | None:
    """Finds, tests and calibrates the devices, while the mapper compiles and makes its run directory."""
    rig, late = robot.rig, SessionOutcome.MAPPER_GONE
    for line in robot.find():
        log(line)
    log("mapper: compiling")
    job = robot.job._replace(view=robot.view, resume=robot.resume)
    rig.wait_until(mapper.prepare(job), START_TIMEOUT, late, "compiling")
    for line in robot.check():
        log(line)
    calibration = robot.calibrate(log)
    rig.wait_until(mapper.prepare(calibration), START_TIMEOUT, late, "the mapper's start")
    robot.lower(calibration)
    return calibration


def _run(robot: LiveRobot, mapper: Mapper) -> None:
    robot.rig.begin()
    with tqdm(total=robot.total, unit=robot.unit, desc="live", file=sys.stderr, mininterval=0.5) as bar:

        def tell(status: str) -> None:
            bar.update()
            bar.set_postfix_str(status, refresh=False)

        try:
            robot.run(mapper, tell)
        except SessionFault as error:
            robot.rig.record_event("fault", str(error.fault))
            mapper.warn(doubts_of([Event(robot.rig.now(), "fault", str(error.fault))]))
            raise
