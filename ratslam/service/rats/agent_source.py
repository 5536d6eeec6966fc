"""The path of a RatInABox agent as a source: with odometry alone, or with the views of a box with cues."""

from __future__ import annotations

from typing import Any

import numpy as np

from robot.simulation.rat.box import BoxConfig
from robot.simulation.rat.rat_odometry import RatOdometryConfig, measure_motion
from robot.simulation.rat.rat_path import RatPath
from robot.simulation.rat.simulated_session import RatSimulation, RatSimulationConfig
from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of
from robot.sources.odometry import from_poses
from tactile.base.errors import InputError


def agent_path(agent: Any) -> RatPath:
    """The history of a `ratinabox.Agent`, its head direction as the heading, in the axes of its environment.

    Raises:
        InputError: fewer than two updates, an environment of one dimension or a periodic one (its path jumps
            at the edges), a position that is not finite, or times that do not increase.
    """
    world = agent.Environment
    if world.dimensionality != "2D" or world.boundary_conditions != "solid":
        found = f"a {world.boundary_conditions} environment of {world.dimensionality}"
        raise InputError("agent", found, "a solid one of 2D")
    where, time = "agent.history", np.array(agent.history["t"], float)
    if len(time) < 2:
        cure = "call agent.update() first, with the parameter save_history"
        raise InputError(where, f"{len(time)} updates", "at least two", cure)
    position, head = (np.array(agent.history[name], float) for name in ("pos", "head_direction"))
    wrong = np.flatnonzero(~np.isfinite(np.column_stack([position, head])).all(axis=1))
    if len(wrong):
        found = f"a position or head direction that is not finite, at {time[wrong[0]]:g} s"
        raise InputError(where, found, "finite numbers")
    if (np.diff(time) <= 0).any():
        cure = "clear the history with agent.reset_history() when its clock is set back"
        raise InputError(where, "times that do not increase", "increasing times", cure)
    return RatPath(time, position, np.arctan2(head[:, 1], head[:, 0]))


def agent_source(agent: Any, odometry: RatOdometryConfig | None = None, seed: int = 0) -> InMemorySource:
    """The history of an agent as a source of odometry and truth without views, each update a sample.

    Later updates of the agent do not change the source.

    Args:
        odometry: errors of the odometry; None: none. seed: of the errors.

    Raises:
        InputError: as `agent_path`.
    """
    path = agent_path(agent)
    assert path.heading is not None
    time, rows = path.time, len(path.time)
    truth = np.column_stack([path.position, path.heading])
    motion = from_poses(time, truth)
    if odometry is not None:
        motion = measure_motion(odometry, motion, seed)
    return InMemorySource(
        name=str(agent.name),
        digest=digest_of([time.tobytes(), truth.tobytes(), motion.tobytes()]),
        time=time,
        motion=motion,
        moved=np.arange(rows) > 0,
        views=np.zeros((rows, 1, 1, 1)),
        seen=np.zeros(rows, bool),
        label=np.full(rows, -1, np.int32),
        truth=truth,
    )


def agent_in_box(agent: Any, config: RatSimulationConfig | None = None) -> RatSimulation:
    """The history of an agent as a source with views of a box with cues, sampled at an even rate.

    The times of the source begin with 0 at the first update. Walls inside the environment are not seen.

    Args:
        config: errors of the odometry, box, views and phases; its path is not used. None: the defaults, with
            a box of the size of the environment and the rate of the agent.

    Raises:
        InputError: as `agent_path`, a position is outside the box, or the path is faster than the
            configuration allows.
    """
    path = agent_path(agent)
    if config is None:
        left, right, bottom, top = np.asarray(agent.Environment.extent, float).tolist()
        if abs(left) > 1e-9 or abs(bottom) > 1e-9:
            cure = "give a configuration and move the environment to the origin"
            raise InputError(
                "agent", f"an environment from ({left:g}, {bottom:g}) on", "one from (0, 0)", cure
            )
        box = BoxConfig(width=right, height=top)
        config = RatSimulationConfig(box=box, rate_hz=round(1 / agent.dt, 6))
    return RatSimulation(config, path)
