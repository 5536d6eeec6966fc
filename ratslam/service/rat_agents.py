"""RatSLAM's pose cells and RatInABox, both ways (George et al. 2024, eLife 13: e85274; extra [ratinabox]).

The path of an agent becomes a source, with odometry alone or with the views of a box with cues. Pose cells
become neurons of an agent, by `DrivenNetwork`, a network that a loop of one's own drives with motions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import jax
import numpy as np

from ratslam.classic import pose_cells
from ratslam.classic.config import NetworkConfig, rings, units
from ratslam.classic.levels import point_activity, to_full_torus, window_levels
from ratslam.classic.pose_cells import LARGEST_SUBSTEP, MOST_SUBSTEPS, Outcome, PoseCells
from ratslam.service.spikes import cell_poses, settled_peak
from robot.simulation.rat.box import BoxConfig
from robot.simulation.rat.rat_path import RatOdometryConfig, RatPath, measure_motion
from robot.simulation.rat.simulated_session import RatSimulation, RatSimulationConfig
from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of
from robot.sources.odometry import from_poses
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import between
from tactile.base.types import Odometry


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
            found = f"an environment from ({left:g}, {bottom:g}) on"
            raise InputError("agent", found, "one from (0, 0)", cure)
        config = RatSimulationConfig(box=BoxConfig(width=right, height=top), rate_hz=round(1 / agent.dt, 6))
    return RatSimulation(config, path)


class DrivenNetwork:
    """A network and its state. Steps are compiled once for each `NetworkConfig` in a process, in the
    precision that JAX has by default.

    The axes of the torus are those of the world: a pose is at the cell of its position divided by the cell
    size, and of its heading divided by 2 pi / K, each modulo the size of its ring.

    Args:
        pose: [3] m, m, rad, at which the network starts with one active cell.

    Attributes:
        activity: [K * N * N] of all cells; it sums to 1. packet: [3] decoded over x, y, heading, cells.
    """

    def __init__(self, config: NetworkConfig, pose: np.ndarray) -> None:
        self.config = config
        self._dtype = np.dtype(jax.dtypes.canonicalize_dtype(float))
        self._unit, self._rings = units(config, self._dtype), rings(config, self._dtype)
        start, self._step = _compiled(config, self._dtype)
        self._cells: PoseCells = start(self._position(pose))
        self.packet = np.asarray(self._cells.pose)
        self.activity = np.asarray(to_full_torus(window_levels(config, self._dtype), self._cells.activity))
        self.activity = self.activity.ravel()

    @property
    def pose(self) -> np.ndarray:
        """[3] the decoded packet on the torus, m, m, rad."""
        return self.packet * self._unit

    def advance(self, motion: np.ndarray, anchor: np.ndarray | None = None, energy: float = 0.0) -> None:
        """One step.

        Args:
            motion: [4] dx m, dy m, dtheta rad, dt s, in the frame of the body before it.
            anchor: [3] pose (m, m, rad) at which energy is injected; None: nowhere. energy: activity injected
                there, as a share of the activity of all cells.

        Raises:
            InputError: a number is not finite, the energy is negative, or the motion is longer than a step
                can follow.
        """
        where = np.zeros(3) if anchor is None else self._position(anchor)
        given = np.array([*motion, *where, energy if anchor is not None else 0.0], self._dtype)
        if not (np.isfinite(given).all() and given[-1] >= 0):
            found = f"motion {motion}, anchor {anchor}, energy {energy}"
            raise InputError("motion", found, "finite numbers, and an energy from 0 on")
        self._cells, outcome, activity = self._step(self._cells, given)
        if int(outcome) == Outcome.TOO_FAST:
            most = MOST_SUBSTEPS * LARGEST_SUBSTEP
            found = f"{np.hypot(*motion[:2]):.3g} m and {motion[2]:.3g} rad in one step"
            raise InputError("motion", found, f"at most {most:g} cells", "take shorter steps or larger cells")
        self.packet, self.activity = np.asarray(self._cells.pose), np.asarray(activity)

    def _position(self, pose: np.ndarray) -> np.ndarray:
        """[3] cells of a pose (m, m, rad), in [0, N) and [0, K)."""
        cells = (np.asarray(pose, np.float64) / self._unit % self._rings).astype(self._dtype)
        return np.where(cells >= self._rings, 0, cells)


@lru_cache(maxsize=16)
def _compiled(config: NetworkConfig, dtype: np.dtype) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """The start of the network at a position [3] in cells, and its step with the numbers [8] of motion,
    anchor in cells, and energy."""
    levels = window_levels(config, dtype)

    def start(position: Any) -> PoseCells:
        activity = point_activity(levels, position)
        return PoseCells(activity, position, jax.numpy.zeros(3, dtype), jax.numpy.int32(0))

    def step(cells: PoseCells, given: Any) -> tuple[PoseCells, Any, Any]:
        odometry, recall, energy = Odometry(*given[:4]), given[4:7], given[7]
        cells, (_, outcome, _) = pose_cells.step(config, levels, cells, odometry, recall, energy)
        return cells, outcome, to_full_torus(levels, cells.activity).ravel()

    return jax.jit(start), jax.jit(step)


try:
    from ratinabox.Neurons import Neurons
except ImportError:
    cure = "pip install 'ratslam[ratinabox]'"
    raise InputError("ratinabox", "not installed", "the extra 'ratinabox'", cure) from None

Anchor = Callable[["PoseCellNeurons"], tuple[np.ndarray, float] | None]
"""Called before each step of the network with the neurons: the pose [3] (m, m, rad) at which energy is
injected and the energy, as a share of the activity of all cells; None for none."""


class PoseCellNeurons(Neurons):
    """The cells of a network that integrates the path of a RatInABox agent.

    At `update()` the motion of the agent since the last update drives the network: displacement in the frame
    of the head direction, and turn of the head. The rates are `max_fr * activity / settled_peak(pose_cells)`:
    a cell fires at `max_fr` at the peak of a packet at rest. The network starts at the pose of the agent, and
    its axes are those of the environment, modulo the torus. An agent at NaN has no rate, and the network
    waits.

    `params` beside those of `Neurons` (`min_fr` has no effect, `n` follows from `cell`):
        pose_cells: a `NetworkConfig`, the network. cell: [C] indices in the flattened network [K, N, N];
        None: all. max_fr: Hz. speed_noise: white error of the speed as a share of it over one second,
        sqrt(s). heading_noise: white error of the turn, rad/sqrt(s). seed: of these errors. anchor: an
        `Anchor`, or None.

    The cells have no receptive field in closed form, so rate maps come from the history.

    Attributes:
        network: the `DrivenNetwork`. cell_poses: [C, 3] pose of each cell on the torus, m, m, rad.

    Raises:
        InputError: the environment has not two dimensions, or `cell` is not of the network.
    """

    default_params: dict[str, Any] = {  # noqa: RUF012 (the form that RatInABox reads)
        "name": "PoseCellNeurons",
        "pose_cells": NetworkConfig(),
        "cell": None,
        "max_fr": 20.0,
        "speed_noise": 0.0,
        "heading_noise": 0.0,
        "seed": 0,
        "anchor": None,
    }

    def __init__(self, Agent: Any, params: Mapping[str, Any] | None = None) -> None:
        if Agent.Environment.dimensionality != "2D":
            raise InputError("Agent", "an environment of one dimension", "one of two dimensions")
        given = {**self.default_params, **(params or {})}
        config: NetworkConfig = given["pose_cells"]
        shape = (config.cells_heading, config.cells_xy, config.cells_xy)
        cell = np.arange(np.prod(shape)) if given["cell"] is None else np.asarray(given["cell"])
        self.cell_poses = cell_poses(shape, config.cell_size, cell)
        super().__init__(Agent, {**given, "cell": cell, "n": len(cell)})
        self._peak = settled_peak(config)
        self._random = stream(self.seed, f"pose cell neurons {self.name}")
        self._pose, self._time = agent_pose(Agent), float(Agent.t)
        self.network = DrivenNetwork(config, self._pose)

    def update(self, **kwargs: Any) -> None:
        """Moves the network by the motion of the agent since the last update, then computes the rates."""
        pose, time = agent_pose(self.Agent), float(self.Agent.t)
        if np.isfinite(pose).all():
            anchor = None if self.anchor is None else self.anchor(self)
            self.network.advance(self._measure_motion(pose, time - self._time), *(anchor or ()))
        self._pose, self._time = pose, time
        super().update(**kwargs)

    def get_state(self, evaluate_at: str = "agent", **_: Any) -> np.ndarray:
        """[C, 1] rates of the present state of the network, Hz.

        Raises:
            InputError: the rates are asked for elsewhere; `plot_rate_map` then takes the history.
        """
        if evaluate_at not in ("agent", "last"):
            cure = "plot_rate_map(method='history') shows the history"
            expected = "'agent': these cells depend on the path"
            raise InputError("evaluate_at", repr(evaluate_at), expected, cure)
        rates: np.ndarray = self.max_fr / self._peak * self.network.activity[self.cell]
        return rates[:, None]

    def plot_rate_map(self, chosen_neurons: Any = "all", method: str = "history", **kwargs: Any) -> Any:
        """As that of `Neurons`, from the history."""
        return super().plot_rate_map(chosen_neurons, method, **kwargs)

    def _measure_motion(self, pose: np.ndarray, seconds: float) -> np.ndarray:
        """[4] the motion (m, m, rad, s) since the last update with its errors; none after a NaN."""
        if not np.isfinite(self._pose).all():
            return np.array([0.0, 0.0, 0.0, seconds])
        distances = self.Agent.Environment.get_vectors_between___accounting_for_environment
        way = distances(pos1=pose[:2], pos2=self._pose[:2]).reshape(2)  # the short way round a periodic box
        motion = between(np.array([0.0, 0.0, self._pose[2]]), np.array([*way, pose[2]]))
        speed, turn = self._random.standard_normal(2)
        if seconds > 0:
            motion[:2] *= 1 + self.speed_noise * speed / np.sqrt(seconds)
            motion[2] += self.heading_noise * turn * np.sqrt(seconds)
        return np.array([*motion, seconds])


def agent_pose(agent: Any) -> np.ndarray:
    """[3] position and head direction of an agent, m, m, rad."""
    return np.array([*agent.pos, np.arctan2(agent.head_direction[1], agent.head_direction[0])], float)


def anchor_at_truth(period: float, energy: float) -> Anchor:
    """An anchor that injects energy at the true pose of the agent whenever a multiple of a period passes.

    Args:
        period: s. energy: as a share of the activity of all cells.
    """

    def anchor(neurons: PoseCellNeurons) -> tuple[np.ndarray, float] | None:
        before, now = (np.floor(time / period + 1e-9) for time in (neurons.Agent.prev_t, neurons.Agent.t))
        return (agent_pose(neurons.Agent), energy) if now > before else None

    return anchor
