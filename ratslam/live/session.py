"""A live session: arm and head in this process, the engine in another; recorded before it is used."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from math import ceil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from evaluation.metrics.scorecard import Scorecard
from ratslam.config.run_config import RunConfig
from ratslam.core.session import CHUNK
from ratslam.live.mapper_process import Mapper, Order
from ratslam.pipeline.run import interrupts
from robot.drivers.outcome import Fault, Outcome
from robot.live.recorder import Journal
from robot.live.rig import Faulted, Rig, Stopped
from robot.live.route import approach, checked, descent, routed, way, world
from robot.live.selftest import reported, room, started
from robot.live.whisk_loop import Handed, drive, free_whisks, go
from robot.recordings.formats import RecordingConfig
from robot.sources.source_info import SourceInfo
from robot.world.head_trajectory import Path as Way
from robot.world.maze import POSE_CELL_SIZE
from robot.world.scene import maze_info
from tactile.base.errors import InputError
from tactile.features.calibration import Calibration, calibrated
from tactile.features.whisker_image import view_shape
from tactile.whiskers.head_geometry import ur10_head

RECORDING, REPORT = "session.mcap", "live.json"
"""In the run directory: what was recorded, and how the session went."""
LONGEST = 300.0
"""How long the mapper may take to be ready, compilation included, s."""


class Ended(NamedTuple):
    """How a session ended.

    Attributes:
        fault: which end, and what was found. report: how it went (`live.json`).
    """

    fault: Fault
    report: dict[str, Any]

    @property
    def outcome(self) -> Outcome:
        return self.fault.outcome

    def __str__(self) -> str:
        return str(self.fault)


def live(
    config: RunConfig,
    directory: Path,
    tell: Callable[[str], None],
    mapping: Callable[..., None] | None = None,
    armed: Callable[[Path], None] = lambda directory: None,
) -> tuple[Ended, Scorecard | None]:
    """Tests arm and head, makes the calibration, goes the way and maps; then scores.

    Args:
        directory: the new run directory. tell: is told a line at a time.
        mapping: what the mapper's process does; None: `ratslam.live.mapper_process.mapping`. armed: is
        told the
            directory when the session begins.

    Returns:
        how it ended, and the score of what was mapped, if anything was.

    Raises:
        InputError: why nothing was armed.
    """
    assert config.live is not None
    path = way(config.live, ur10_head(config.touch.head))
    checked(config.live, path)
    if directory.exists():
        raise InputError(str(directory), "exists already", "a new run directory", "choose another with -o")
    tell(room(config.live, directory))
    handed: list[Handed] = []
    with interrupts("stopping the arm") as stopped, Mapper(mapping) as mapper:
        with Rig(config.live, config.touch.head, stopped) as rig:
            try:
                calibration = _calibrated(rig, config, path, tell)
                order = ordered(config, path, calibration, directory)
                _armed(rig, path, calibration, mapper, order, tell)
                armed(directory)
                with journal(order) as rig.journal:
                    _driven(rig, path, mapper, handed)
                fault = Fault(Outcome.COMPLETE, f"{len(handed)} whisks", time.monotonic())
            except Faulted as error:
                fault = error.fault
            except Stopped:
                fault = Fault(Outcome.INTERRUPTED, f"after {len(handed)} whisks", time.monotonic())
            standing = rig.rest(fault.detail)
            report = _report(fault, rig, mapper, handed, standing)
        card = mapper.finish(fault.outcome is not Outcome.COMPLETE) if handed else None
    with suppress(OSError):  # a full disk has been told
        (directory / REPORT).write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    return Ended(fault, report), card


def ordered(config: RunConfig, path: Way, calibration: Calibration, directory: Path) -> Order:
    """What the mapper is to do, and what the recording says about the robot."""
    assert config.live is not None
    head = ur10_head(config.touch.head)
    plan = config.live.plan
    rate = plan.whisking.rate
    rows = ceil(1.5 * path.duration * rate) if config.live.whisks is None else config.live.whisks
    session = config.session
    if not session.reserve:  # nothing compiles on the way
        session = session.model_copy(update={"reserve": rows + CHUNK})
    recording = RecordingConfig(file=directory.resolve() / RECORDING)
    mapped = config.model_copy(update={"live": None, "recording": recording, "session": session})
    start = path.pose[0]
    return Order(
        mapped.covering(float(np.abs(path.pose[:, :2] - start[:2]).max()))
        if config.backend == "grid"
        else mapped,
        SourceInfo(
            raw_whiskers=True,
            cell_size=POSE_CELL_SIZE,
            head=config.touch.head,
            calibration=calibration,
            maze=None if config.live.waypoints else maze_info(world(plan, head).maze, plan.maze, plan.seed),
            provenance={"live": config.live.model_dump(mode="json", exclude={"plan": {"maze": {"file"}}})},
        ),
        directory,
        view_shape(config.touch.image, head),
        len(head.length),
        rate,
    )


def journal(order: Order) -> Journal:
    """What the session is recorded to."""
    return Journal(
        order.directory / RECORDING,
        view_shape=order.view_shape,
        whiskers=order.whiskers,
        rate_hz=order.rate_hz,
        info=order.info,
    )


def _calibrated(rig: Rig, config: RunConfig, path: Way, tell: Callable[[str], None]) -> Calibration:
    """Tests everything, and whisks in free air above the start of the way."""
    plan = rig.config.plan
    reported(started(rig), tell)
    tell("arm: going above the start of the way")
    go(rig, approach(rig.config, path))
    count = ceil(plan.calibration.shortest * plan.whisking.rate)
    tell(f"head: {count} whisks in free air")
    rig.driver.whisk(plan.whisking.model_copy(update={"mode": "open"}))
    record = free_whisks(rig, count)
    return calibrated(plan.calibration, record, config.touch.contact.slope_window, "free whisking")


def _armed(
    rig: Rig, path: Way, calibration: Calibration, mapper: Mapper, order: Order, tell: Callable[[str], None]
) -> None:
    """Has the mapper compile, then lets the head down and whisk as the session does."""
    tell("mapper: compiling")
    mapper.begin(order)
    rig.until(mapper.ready, LONGEST, Outcome.MAPPER_GONE, "the mapper's start")
    go(rig, descent(rig.config, path))
    rig.driver.whisk(rig.config.plan.whisking, calibration.threshold[:, 1], calibration.mean[:, 1])
    tell("armed")


def _driven(rig: Rig, path: Way, mapper: Mapper, handed: list[Handed]) -> None:
    rate = rig.config.plan.whisking.rate
    total = rig.config.whisks or ceil(path.duration * rate)
    rig.begin()
    with tqdm(total=total, unit="whisk", desc="live", file=sys.stderr, mininterval=0.5) as bar:

        def tell(whisk: Handed) -> None:
            handed.append(whisk)
            bar.update()
            bar.set_postfix_str(_status(rig, mapper, handed), refresh=False)

        try:
            drive(rig, routed(rig.config, path), mapper, tell)
        except Faulted as error:
            rig.note("fault", str(error.fault))
            raise


def _status(rig: Rig, mapper: Mapper, handed: list[Handed]) -> str:
    told = mapper.told[-1] if mapper.told else None
    place = "" if told is None or told.place < 0 else f", place {told.place}"
    took = "" if told is None else f"map {1e3 * told.seconds:.0f} ms{place}, "
    dropped = sum(not whisk.seen for whisk in handed)
    lost = sum(whisk.missing for whisk in handed)
    return f"{took}late {1e3 * handed[-1].lateness:.0f} ms, {lost} samples lost, {dropped} images dropped"


def _report(fault: Fault, rig: Rig, mapper: Mapper, handed: list[Handed], standing: bool) -> dict[str, Any]:
    return {
        "outcome": fault.outcome.name.lower(),
        "detail": fault.detail,
        "standing": standing,
        "whisks": len(handed),
        "dropped": sum(not whisk.seen for whisk in handed),
        "missing": sum(whisk.missing for whisk in handed),
        "lateness_s": _spread([whisk.lateness for whisk in handed]),
        "state_age_s": _spread(rig.ages),
        "mapper_s": _spread([told.seconds for told in mapper.told]),
        "head": rig.head.decoder.counts._asdict() | {"stalls": rig.head.stalls},
    }


def _spread(values: list[float]) -> dict[str, float]:
    """Median, 99 % and largest of what is finite; nothing of nothing."""
    known = np.array(values)[np.isfinite(values)]
    if not len(known):
        return {}
    return {name: float(np.quantile(known, q)) for name, q in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))}
