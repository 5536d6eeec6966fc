"""A live session on the topics of a running robot: nothing is moved, everything used is recorded first."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ratslam.live.live_robot import LiveRobot, mapped_config, mapper_status, quantiles
from ratslam.live.mapper_process import Mapper, MappingJob
from ratslam.runs.map_settings import views_of
from ratslam.runs.settings.run_config import RunConfig
from robot.live.map_publisher import MapPublisher, PoseReport
from robot.live.topics_rig import TopicsRig, require_topics, run_topics_loop
from robot.recordings.cdr import doubts_of
from robot.sources.source import SourceDescription, SourceInfo
from tactile.base.errors import InputError, tell

KEPT = 1024
"""Views whose odometry is kept until they are mapped."""
RESERVED = 8192
"""Views for which the mapper reserves rows; more let it compile again."""


def prepare_topics_session(
    config: RunConfig, directory: Path
) -> Callable[[Callable[[], bool]], TopicsSession]:
    """Checks that topics are assigned; returns the function that opens the connection.

    Raises:
        InputError: they are not.
    """
    assert config.live is not None
    assert config.live.topics is not None
    require_topics(config.live.topics, config.recording)
    return lambda stopped: TopicsSession(config, directory, stopped)


class TopicsSession(LiveRobot):
    """The robot's part of a session."""

    unit = "view"
    rig: TopicsRig

    def __init__(self, config: RunConfig, directory: Path, stopped: Callable[[], bool]) -> None:
        assert config.live is not None
        assert config.recording is not None
        self._config, self._directory = config, directory
        warn, pokes = lambda text: tell(f"warning: {text}"), config.touch.pokes
        self.rig = TopicsRig(config.live, config.recording, stopped, warn, pokes)
        self.total = None

    def find(self) -> Iterator[str]:
        yield from self.rig.find()
        yield from self.rig.check()
        shape = self.rig.steps.shape
        if shape is None:
            where = next(iter(self.rig.steps.topics))
            cure = "start the node that publishes it, or set recording.topics.touch.rows and columns"
            raise InputError(where, "no message yet that says how many sensors there are", "", cure)
        assert self._config.live is not None
        origin = {"live": self._config.live.model_dump(mode="json", include={"topics"})}
        origin |= {} if self.rig.steps.whiskers else {"views": views_of(self._config)[1]}
        pokes = self.rig.steps.pokes
        drives = pokes is None and self.rig.steps.whiskers > 0
        info = SourceInfo(provenance=origin, drives=drives, pokes=None if pokes is None else pokes.config)
        source = SourceDescription(shape, self.rig.steps.whiskers, 0.0, info)
        extent = 10.0 if self._config.grid.side is None else self._config.grid.side / 2
        mapped = mapped_config(self._config, self._directory, RESERVED)
        draws = self.rig.topics.publish
        self.job = MappingJob(mapped, source, self._directory, extent, draws=draws)
        if draws and "cdr" not in self.rig.client.accepts:
            cure = "give the bridge the capability clientPublish, or --set live.topics.publish=false"
            raise InputError(self.rig.topics.source, "accepts no messages", "a bridge that does", cure)

    def check(self) -> Iterator[str]:
        yield from ()

    def run(self, mapper: Mapper, tell: Callable[[str], None]) -> None:
        publisher = MapPublisher(self.rig.client) if self.rig.topics.publish else None
        sent = deque[tuple[int, float, np.ndarray | None]](maxlen=KEPT)

        def count(moment: float, odometry: np.ndarray | None) -> None:
            sent.append((self.count, moment, odometry))
            self.count += 1
            if publisher is not None and publisher.due():
                _publish(publisher, mapper, sent)
            lost = sum(self.rig.steps.dropped.values())
            tell(f"{mapper_status(mapper)}{lost} views dropped, {self.rig.outages} outages")

        try:
            run_topics_loop(self.rig, mapper, count)
        finally:
            mapper.warn(doubts_of(self.rig.events))

    def report(self) -> dict[str, Any]:
        rig, now = self.rig, (time.process_time(), time.monotonic())
        return {
            "cpu": (now[0] - rig.began[0]) / max(now[1] - rig.began[1], 1e-9),
            "messages": dict(rig.messages.counts),
            "unusable": dict(rig.spoilt),
            "dropped": dict(rig.steps.dropped),
            "outages": rig.outages,
            "pieces": rig.steps.track.piece + 1,
            "latency_s": quantiles(rig.latencies),
        }


def _publish(
    publisher: MapPublisher, mapper: Mapper, sent: Iterable[tuple[int, float, np.ndarray | None]]
) -> None:
    """Publishes the newest result of the mapper."""
    mapper.receive()
    if not mapper.mapped:
        return
    newest, drawing = mapper.mapped[-1], mapper.drawing
    known = {number: (moment, odometry) for number, moment, odometry in sent}
    if newest.number not in known:
        return
    moment, odometry = known[newest.number]
    publisher.publish(
        PoseReport(moment, newest.pose, newest.spread, odometry, newest.doubt, newest.lost), drawing
    )
    mapper.drawing = None
