"""A live session on a Create with whiskers or light bumpers: self-test, exploration by the state machine."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from ratslam.live.live_robot import LiveRobot, mapped_config, mapper_status
from ratslam.live.mapper_process import Mapper, MappingJob
from ratslam.runs.settings.run_config import RunConfig
from robot.drivers.create.protocol import LIGHTS
from robot.live.create_rig import RIGS, CreateRig, run_create_loop
from robot.live.polling import HeadRig
from robot.recordings.cdr import doubts_of
from robot.simulation.create.simulated_session import describe_create
from robot.simulation.create.state_machine import CreateState
from robot.sources.source import PlanarWhiskersInfo, SourceDescription
from robot.world.arena import make_arena, wall_segments
from tactile.base.errors import InputError
from tactile.base.se2 import between
from tactile.base.types import StepEnd

SHORTEST_STEP = 0.25
"""Mean duration of a motion for which the session reserves rows, s: most take 0.5."""


def prepare_create_session(
    config: RunConfig, directory: Path
) -> Callable[[Callable[[], bool]], CreateSession]:
    """Checks that the method maps what a Create reports; returns the function that opens the devices.

    Raises:
        InputError: the backend needs views; touch of a Create has none, or they look too much alike.
    """
    if config.backend in ("recall", "classic"):
        found = f"{config.backend}, which recognises views"
        expected = "a method that maps contacts, such as `grid`: touch of a Create tells no place by its look"
        raise InputError("backend", found, expected, "--set backend=grid")
    return lambda stopped: CreateSession(config, directory, stopped)


class CreateSession(LiveRobot):
    """The Create's part of a session."""

    unit = "report"
    rig: CreateRig

    def __init__(self, config: RunConfig, directory: Path, stopped: Callable[[], bool]) -> None:
        assert config.live is not None
        assert config.live.create is not None
        self.rig = RIGS[config.live.create.touch](config.live, stopped)
        plan = config.live.create.plan
        arena = make_arena(plan.arena, plan.seed)
        info = describe_create(plan, arena)
        live = config.live.model_dump(mode="json", exclude={"create": {"plan": {"arena": {"file"}}}})
        if config.live.create.touch == "light":  # the bumper in the directions of these sensors
            mounts = tuple((0.0, 0.0, angle) for angle in LIGHTS)
            ring = PlanarWhiskersInfo(mounts=mounts, length=plan.behaviour.body)
            info = info.model_copy(update={"raw_whiskers": False, "planar_whiskers": ring})
        whiskers = len(self.rig.alive)
        ends = wall_segments(arena).reshape(-1, 2)
        seen = between(arena.start, np.column_stack([ends, np.zeros(len(ends))]))  # from the start
        info = info.model_copy(update={"provenance": {**info.provenance, "live": live}})
        source = SourceDescription((1, whiskers, 1), whiskers, 1 / plan.behaviour.step, info)
        rows = plan.reports or ceil(60 * plan.minutes / SHORTEST_STEP)
        extent = float(np.abs(seen[:, :2]).max())
        self.job = MappingJob(mapped_config(config, directory, rows), source, directory, extent)
        self.total = plan.reports
        self._ends: Counter[StepEnd] = Counter()

    def run(self, mapper: Mapper, tell: Callable[[str], None]) -> None:
        def count(time: float, state: CreateState, moment: StepEnd) -> None:
            self.count += 1
            self._ends[moment] += 1
            ends = ", ".join(f"{self._ends[end]} {end.name}" for end in StepEnd if end is not StepEnd.FREE)
            tell(f"{mapper_status(mapper)}{time:.0f} s, {state.name}, {ends}")

        try:
            run_create_loop(self.rig, mapper, count)
        finally:
            mapper.warn(doubts_of([] if self.rig.doubt is None else [self.rig.doubt]))

    def report(self) -> dict[str, Any]:
        head = super().report() if isinstance(self.rig, HeadRig) else {}
        return head | {
            "ends": {end.name.lower(): self._ends[end] for end in StepEnd},
            "alive": self.rig.alive.tolist(),
            "serial": self.rig.robot.counts._asdict(),
        }
