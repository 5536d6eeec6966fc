"""Pose cells as neurons of a RatInABox agent.

RatInABox: George et al. 2024, eLife 13: e85274; package `ratinabox`, of the extra [ratinabox].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ratslam.classic.pose_cell_config import NetworkConfig
from ratslam.service.rats.cell_poses import cell_poses, check_cells
from ratslam.service.rats.driven_network import DrivenNetwork
from ratslam.service.rats.settled_peak import settled_peak
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import between

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
        check_cells(shape, cell)
        super().__init__(Agent, {**given, "cell": cell, "n": len(cell)})
        self.cell_poses = cell_poses(shape, config.cell_size, cell)
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
            raise InputError(
                "evaluate_at", repr(evaluate_at), "'agent': these cells depend on the path", cure
            )
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
