"""Sessions of a simulated rat, held in memory: the recorded pose cells beside truth and odometry."""

from __future__ import annotations

import json
from typing import Any, Literal, Self

import numpy as np

from evaluation.cells.recording import CellRecording
from ratslam.core.session import Session
from ratslam.runs.build_session import build_session, open_observations, read_observations
from ratslam.runs.cell_recorder import CellSums, plan_recording, step_columns
from ratslam.runs.settings.run_config import RunConfig, load_config
from robot.simulation.rat.simulated_session import RatSimulation, RatSimulationConfig
from robot.sources.source import Source
from tactile.base.random_streams import stream

PACKAGED = "rat_box"
"""The packaged configuration that the sessions begin with: a box of 1 m, RatSLAM as published."""


EVERY = 3
"""Every third heading of a column is recorded: the packet is wider than the gap."""


class RatSessions:
    """Sessions of one configuration over sources alike, one after the other; compiled once.

    Args:
        config: its method has pose cells and it has `cells`; `rat_config` gives one.
    """

    def __init__(self, config: RunConfig) -> None:
        self.config = config
        self._session: Session | None = None

    @classmethod
    def of_columns(cls, columns: int, seed: int, *assignments: str) -> Self:
        """Sessions that record so many columns, drawn without repeats; each is the cells of one place on the
        torus. assignments: see `rat_config`."""
        cells = rat_config().pose_cells
        side, headings = cells.cells_xy, range(0, cells.cells_heading, EVERY)
        drawn = stream(seed, "cells.columns").permutation(side * side)[:columns].tolist()
        chosen = [[at % side, at // side, heading] for at in drawn for heading in headings]
        return cls(rat_config(f"cells={{chosen: {json.dumps(chosen)}}}", *assignments))

    @property
    def torus(self) -> float:
        """Side of the torus of the pose cells, m."""
        return self.config.pose_cells.cells_xy * self.config.pose_cells.cell_size

    def rat(self, seed: int, **changed: Any) -> RatSimulation:
        """The rat of the configuration with another seed and with settings of `RatSimulationConfig` replaced.

        Raises:
            InputError: see `RatSimulation`.
        """
        own = self.config.rat_simulation
        assert own is not None
        given = {name: getattr(own, name) for name in own.model_fields_set}
        return RatSimulation(RatSimulationConfig.model_validate({**given, "seed": seed, **changed}))

    def run(self, source: Source) -> CellRecording:
        """The recorded cells of T steps of a session over a source, from the start.

        Raises:
            InputError: see `plan_recording`.
        """
        if self._session is None:
            self._session = build_session(self.config, source)
        self._session.restart(self.config.session.seed)
        plan = plan_recording(self.config, source, self._session.backend)
        assert plan is not None
        rows = list(read_observations(source))
        samples = [sample for sample, _ in rows]
        steps = list(self._session.replay([observation for _, observation in rows]))
        cells, sums = plan.cells, None
        if plan.bins is not None:
            summed = CellSums(plan.bins, int(np.prod(cells.shape)), samples[0].time)
            summed.add_steps(cells, samples, steps)
            sums = summed.result()
        columns = step_columns(cells, samples, steps)
        return CellRecording(cells.shape, cells.cell_size, **columns, cell=plan.cell, sums=sums)


def rat_config(*assignments: str) -> RunConfig:
    """The configuration `rat_box` with recorded packets, and settings `a.b=value` replaced."""
    return load_config(PACKAGED, ("cells={chosen: 0}", *assignments))


Way = Literal["rat", "random walk"]
"""The path of a real rat (Sargolini et al. 2006, packaged), or a random walk."""
SECONDS = 599.0
"""Duration of a session, s: nearly that of the packaged path."""


def record_rat(
    way: Way, cells: int, sums: bool = False, seconds: float = SECONDS, seed: int = 0
) -> CellRecording:
    """The pose cells of a session at 20 Hz with views at 10 Hz and errors of the odometry.

    Args:
        cells: the first so many that were ever active, of twice as many drawn from the whole network. sums:
            whether all cells are summed at 10 Hz. seed: of the cells, the errors and the random walk.
    """
    own = [f"rat_simulation.seconds={seconds}", f"rat_simulation.seed={seed}", f"session.seed={seed}"]
    own += [f"cells.chosen={2 * cells}", "session.reserve=1024"]
    own += ["cells.sums={}"] if sums else []
    own += ["rat_simulation.walk={}"] if way == "random walk" else []
    with open_observations(load_config(PACKAGED, own)) as (config, source):
        recording = RatSessions(config).run(source)
    kept = np.flatnonzero(recording.activity.any(axis=0))[:cells]
    return recording._replace(cell=recording.cell[kept], activity=recording.activity[:, kept])


def column_activity(activity: np.ndarray, columns: int) -> np.ndarray:
    """Activity [T, columns] of columns: sums of that of their cells [T, C]."""
    return activity.reshape(len(activity), columns, -1).sum(axis=2)
