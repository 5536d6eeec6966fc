"""A live session: arm and head in this process, the mapper in another; all data are recorded before use."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from evaluation.artifacts.run_directory import SESSION_REPORT
from evaluation.metrics.run_metrics import DOUBTED
from evaluation.metrics.scorecard import Scorecard
from ratslam.config.run_config import RunConfig
from ratslam.core.session import CHUNK
from ratslam.live.mapper_process import Mapper, MappingJob
from ratslam.pipeline.run import catch_interrupt
from robot.drivers.outcome import Fault, SessionOutcome
from robot.drivers.process_priority import urgent
from robot.live.recorder import LiveRecorder
from robot.live.rig import OperatorStop, Rig, SessionFault
from robot.live.route import approach_route, check_targets, descent_route, main_route, plan_path, plan_scene
from robot.live.selftest import check_disk, find_devices, start_and_check
from robot.live.whisk_loop import WhiskReport, follow_route, record_free_whisks, run_whisk_loop
from robot.recordings.formats import RecordingConfig
from robot.sources.source_info import SourceInfo
from robot.world.head_trajectory import HeadPath
from robot.world.maze import POSE_CELL_SIZE
from robot.world.scene import maze_info
from tactile.base.errors import InputError
from tactile.features.calibration import Calibration, calibrate
from tactile.features.whisker_image import view_shape
from tactile.whiskers.head_geometry import ur10_head

RECORDING = "session.mcap"
"""The recording in the run directory."""
START_TIMEOUT = 300.0
"""Time limit of the mapper's start, with compilation, s."""


def run_live_session(
    config: RunConfig,
    directory: Path,
    log: Callable[[str], None],
    mapping: Callable[..., None] | None = None,
    armed: Callable[[Path], None] = lambda directory: None,
    view: str | None = None,
) -> tuple[Fault, Scorecard | None]:
    """Finds arm and head, compiles, tests both, calibrates, moves along the route, maps and scores.

    Args:
        directory: the new run directory. log: called with each line of progress.
        mapping: main function of the mapper process; None: `ratslam.live.mapper_process.run_mapper`.
        armed: called with the directory when the session begins. view: target of a live view, or None.

    Returns:
        the outcome of the session with its finding, and the score of the map, if there is one.

    Raises:
        InputError: the session could not be armed.
    """
    assert config.live is not None
    path = plan_path(config.live, ur10_head(config.touch.head))
    check_targets(config.live, path)
    if directory.exists():
        raise InputError(str(directory), "exists already", "a new run directory", "choose another with -o")
    log(check_disk(config.live, directory))
    whisks: list[WhiskReport] = []
    with urgent(), catch_interrupt("stopping the arm") as stopped, Mapper(mapping) as mapper:
        with Rig(config.live, config.touch.head, stopped) as rig:
            try:
                job = mapping_job(config, path, directory)._replace(view=view)
                _compile(rig, mapper, job, log)
                calibration = _calibrate(rig, config, path, log)
                _arm(rig, path, calibration, mapper, log)
                armed(directory)
                with open_recorder(job, calibration) as rig.recorder:
                    _run(rig, path, mapper, whisks)
                fault = Fault(SessionOutcome.COMPLETE, f"{len(whisks)} whisks", time.monotonic())
            except SessionFault as error:
                fault = error.fault
            except OperatorStop:
                fault = Fault(SessionOutcome.INTERRUPTED, f"after {len(whisks)} whisks", time.monotonic())
            standing = rig.rest()
            report = _report(fault, rig, mapper, whisks, standing)
        card = mapper.finish(fault.outcome is not SessionOutcome.COMPLETE) if whisks else None
    with suppress(OSError):  # a full disk has been reported
        (directory / SESSION_REPORT).write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    return fault, card


def mapping_job(config: RunConfig, path: HeadPath, directory: Path) -> MappingJob:
    """The job of the mapper, with the description of the robot for the recording."""
    assert config.live is not None
    head = ur10_head(config.touch.head)
    plan = config.live.plan
    rate = plan.whisking.rate
    rows = ceil(1.5 * path.duration * rate) if config.live.whisks is None else config.live.whisks
    session = config.session
    if not session.reserve:  # no compilation during the session
        session = session.model_copy(update={"reserve": rows + CHUNK})
    recording = RecordingConfig(file=directory.resolve() / RECORDING)
    mapped = config.model_copy(update={"live": None, "recording": recording, "session": session})
    return MappingJob(
        mapped,
        SourceInfo(
            raw_whiskers=True,
            cell_size=POSE_CELL_SIZE,
            head=config.touch.head,
            maze=None
            if config.live.waypoints
            else maze_info(plan_scene(plan, head).maze, plan.maze, plan.seed),
            provenance={"live": config.live.model_dump(mode="json", exclude={"plan": {"maze": {"file"}}})},
        ),
        directory,
        view_shape(config.touch.image, head),
        len(head.length),
        rate,
        float(np.abs(path.pose[:, :2] - path.pose[0, :2]).max()),
    )


def open_recorder(job: MappingJob, calibration: Calibration) -> LiveRecorder:
    """The recorder of the session."""
    return LiveRecorder(
        job.directory / RECORDING,
        view_shape=job.view_shape,
        whiskers=job.whiskers,
        rate_hz=job.rate_hz,
        info=job.info.model_copy(update={"calibration": calibration}),
    )


def _compile(rig: Rig, mapper: Mapper, job: MappingJob, log: Callable[[str], None]) -> None:
    """Finds both devices, then waits until the mapper has compiled, before the arm is started: compiling
    takes this machine's processors for up to a minute."""
    for line in find_devices(rig):
        log(line)
    log("mapper: compiling")
    mapper.compile(job)
    rig.wait_until(mapper.compiled, START_TIMEOUT, SessionOutcome.MAPPER_GONE, "compiling")


def _calibrate(rig: Rig, config: RunConfig, path: HeadPath, log: Callable[[str], None]) -> Calibration:
    """Tests both devices, and records free whisks above the start of the route for the calibration."""
    plan = rig.config.plan
    for line in start_and_check(rig):
        log(line)
    log("arm: moving above the start of the route")
    follow_route(rig, approach_route(rig.config, path))
    count = ceil(plan.calibration.min_duration * plan.whisking.rate)
    log(f"head: {count} whisks in free air")
    rig.driver.whisk(plan.whisking.model_copy(update={"mode": "open"}))
    record = record_free_whisks(rig, count)
    return calibrate(plan.calibration, record, config.touch.contact.slope_window, "free whisking")


def _arm(
    rig: Rig,
    path: HeadPath,
    calibration: Calibration,
    mapper: Mapper,
    log: Callable[[str], None],
) -> None:
    """Waits until the mapper is ready, then lowers the head and starts whisking."""
    mapper.begin(calibration)
    rig.wait_until(mapper.ready, START_TIMEOUT, SessionOutcome.MAPPER_GONE, "the mapper's start")
    follow_route(rig, descent_route(rig.config, path))
    rig.driver.whisk(rig.config.plan.whisking, calibration.threshold[:, 1], calibration.mean[:, 1])
    log("armed")


def _run(rig: Rig, path: HeadPath, mapper: Mapper, whisks: list[WhiskReport]) -> None:
    rate = rig.config.plan.whisking.rate
    total = rig.config.whisks or ceil(path.duration * rate)
    dropped = lost = 0
    rig.begin()
    with tqdm(total=total, unit="whisk", desc="live", file=sys.stderr, mininterval=0.5) as bar:

        def count_whisk(whisk: WhiskReport) -> None:
            nonlocal dropped, lost
            whisks.append(whisk)
            dropped, lost = dropped + (not whisk.seen), lost + whisk.missing
            bar.update()
            bar.set_postfix_str(session_status(mapper, whisk, dropped, lost), refresh=False)

        try:
            run_whisk_loop(rig, main_route(rig.config, path), mapper, count_whisk)
        except SessionFault as error:
            rig.record_event("fault", str(error.fault))
            raise


def session_status(mapper: Mapper, whisk: WhiskReport, dropped: int, lost: int) -> str:
    """The newest result of the mapper and the newest whisk, as text.

    Args:
        dropped: number of images dropped so far. lost: number of samples lost so far.
    """
    result = mapper.mapped[-1] if mapper.mapped else None
    place = "" if result is None or result.place < 0 else f", place {result.place}"
    place += "" if result is None or not result.doubt > DOUBTED else ", map_doubted"
    took = "" if result is None else f"map {1e3 * result.seconds:.0f} ms{place}, "
    return f"{took}late {1e3 * whisk.lateness:.0f} ms, {lost} samples lost, {dropped} images dropped"


def _report(
    fault: Fault, rig: Rig, mapper: Mapper, whisks: list[WhiskReport], standing: bool
) -> dict[str, Any]:
    return {
        "outcome": fault.outcome.name.lower(),
        "detail": fault.detail,
        "standing": standing,
        "whisks": len(whisks),
        "dropped": sum(not whisk.seen for whisk in whisks),
        "missing": sum(whisk.missing for whisk in whisks),
        "lateness_s": _quantiles([whisk.lateness for whisk in whisks]),
        "state_age_s": _quantiles(rig.state_ages),
        "mapper_s": _quantiles([result.seconds for result in mapper.mapped]),
        "head": rig.head.decoder.counts._asdict() | {"stalls": rig.head.stalls},
    }


def _quantiles(values: list[float]) -> dict[str, float]:
    """Median, 99 % quantile and maximum of the finite values; empty without any."""
    known = np.array(values)[np.isfinite(values)]
    if not len(known):
        return {}
    return {name: float(np.quantile(known, q)) for name, q in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))}
