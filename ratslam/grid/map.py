"""The map of the grid filter: the mean path of the surviving particles, and contacts drawn along it.

A wall of known direction is drawn as an edge (Fox et al. 2012, II-F, eq. 4), other contacts as blobs (II-E,
eq. 3). Each footprint is a probability that tends to 0.5 far away, where eq. 3 and 4 as printed tend to 0 and
would erase the map; footprints are added as log-odds.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit, logit

from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.core.backend import Map
from ratslam.core.estimates import Estimate, GridDrawing
from ratslam.grid.config import DrawingConfig, GridConfig
from ratslam.grid.particles import Genealogy
from tactile.base.se2 import compose
from tactile.base.types import MotionKind, Observation
from tactile.whisker_geometry import PlanarWhiskers

FAR = 3.0
"""Standard deviations beyond which a footprint is 0."""


class ContactLog(NamedTuple):
    """Contacts of T reports with W whiskers.

    Attributes:
        valid: [T] bool, the report counts as evidence. contact, free: [T, W] bool. turning: [T] bool. point:
            [T, W, 2] contacts in base_link, m. wall: [T, 2] nearest point of the wall in base_link, m; NaN
            where unknown.
    """

    valid: np.ndarray
    contact: np.ndarray
    free: np.ndarray
    turning: np.ndarray
    point: np.ndarray
    wall: np.ndarray

    def walls(self) -> dict[int, tuple[np.ndarray, float]]:
        """By the number of each report with a wall, the place [2] on it where the mean contact projects, m,
        and the direction of its normal, rad, in base_link."""
        distance, found = np.hypot(*self.wall.T), {}
        there = np.isfinite(distance) & (distance > 1e-6) & self.valid & self.contact.any(axis=1)
        for k in np.flatnonzero(there).tolist():
            normal, middle = self.wall[k] / distance[k], self.point[k][self.contact[k]].mean(axis=0)
            place = middle + normal * (distance[k] - normal @ middle)
            found[k] = place, float(np.arctan2(normal[1], normal[0]))
        return found


def contact_log(
    motion: np.ndarray, contact: np.ndarray, alive: np.ndarray, point: np.ndarray, wall: np.ndarray
) -> ContactLog:
    """The log of T reports: motion [T], contact and alive [T, W], point [T, W, 2], wall [T, 2].

    A contact without a finite point is dropped, and its whisker does not count as free.
    """
    valid = motion != MotionKind.BACK
    counts = alive & valid[:, None]
    finite = np.isfinite(point).all(axis=2)
    turning = motion == MotionKind.TURN
    return ContactLog(valid, contact & counts & finite, ~contact & counts, turning, point, wall)


_Footprint = tuple[np.ndarray, float, float, float]
"""Centre [2] in m, probability there, standard deviation in m, and a wall's direction in rad or NaN."""


def draw_occupancy(
    config: GridConfig, whiskers: PlanarWhiskers, side: int, path: np.ndarray, log: ContactLog
) -> np.ndarray:
    """[S, S] probability of an obstacle in each cell.

    Args:
        side: S, cells. path: [T, 3] pose at each report, relative to the middle of the map.
    """
    drawing, cell, most = config.drawing, config.cell, config.drawing.max_log_odds
    evidence = np.zeros((side, side))
    for centre, most_likely, sd, direction in _footprints(drawing, config.body, whiskers, path, log):
        is_edge = np.isfinite(direction)
        reach = FAR * (drawing.edge_sd if is_edge else sd)
        place = centre / cell + (side - 1) / 2
        low = np.clip(np.ceil(place - reach / cell), 0, side).astype(int)
        high = np.clip(np.floor(place + reach / cell) + 1, 0, side).astype(int)
        across, up = (np.arange(low[k], high[k]) * cell - place[k] * cell for k in (0, 1))
        across, up = across[None, :], up[:, None]
        away = across**2 + up**2
        if is_edge:  # eq. 4; direction from the contact modulo pi, so that the edge extends both ways
            off = np.mod(np.arctan2(up, across) - direction + np.pi / 2, np.pi) - np.pi / 2
            off = np.where(away > 0, off, 0.0)
            shape = np.exp(-away / (2 * drawing.edge_sd**2) - off**2 / (2 * drawing.edge_sector**2))
        else:  # eq. 3
            shape = np.exp(-away / (2 * sd**2))
        chance = 0.5 + (most_likely - 0.5) * shape
        rows = slice(low[1], high[1]), slice(low[0], high[0])
        evidence[rows] = np.clip(evidence[rows] + logit(chance), -most, most)
    return expit(evidence + logit(config.prior))


def _footprints(
    config: DrawingConfig, body: float, whiskers: PlanarWhiskers, path: np.ndarray, log: ContactLog
) -> list[_Footprint]:
    """All footprints in order of time; a contact's blob gives way to a later edge of its wall."""
    middles = whiskers.points(np.array([0.5]))[:, 0]
    made: list[_Footprint] = []
    before = np.zeros(log.contact.shape[1], bool)
    pending: list[_Footprint] = []
    walls = log.walls()
    for k, pose in enumerate(path):
        contact = log.contact[k]
        if not log.valid[k]:
            made += pending
            pending, before = [], np.zeros_like(before)
            continue
        made += [(_at(pose, p), config.free, config.free_sd, np.nan) for p in middles[log.free[k]]]
        if body:
            made.append((pose[:2], config.body, body, np.nan))
        if not contact.any():
            made += pending
            pending = []
        new = log.point[k][contact & ~before & ~log.turning[k]]
        pending += [(_at(pose, p), config.contact, config.blob_sd, np.nan) for p in new]
        if k in walls:
            # The wall goes through its nearest point; its edge is drawn where the contacts project on it.
            pending, (place, normal) = [], walls[k]
            made.append((_at(pose, place), config.contact, config.blob_sd, pose[2] + normal + np.pi / 2))
        before = contact
    return made + pending


def _at(pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    return compose(pose, np.array([*point, 0.0]))[:2]


class GridMap(Checkpointed, Map):
    """The map of the grid filter.

    Args:
        feelers: the whiskers of the observations. side: of the map, cells.
    """

    PARTS = ("_genealogy",)

    def __init__(self, config: GridConfig, feelers: PlanarWhiskers, side: int) -> None:
        self.config, self.feelers, self.side = config, feelers, side
        whiskers = len(feelers.length)
        self._genealogy = Genealogy(config.particles)
        self._online = GrowableArray((3,), np.float64)
        self._motion = GrowableArray((), np.int64)
        self._flags = GrowableArray((whiskers, 2), bool)  # in contact, alive
        self._point = GrowableArray((whiskers, 2), np.float64)
        self._wall = GrowableArray((2,), np.float64)  # nearest point; NaN: unknown

    def update(self, observation: Observation, estimate: Estimate, evidence: Any) -> Estimate:
        """Stores the particles and the contacts."""
        self._genealogy.append(evidence.poses, evidence.weights, evidence.ancestor)
        flags = np.stack([observation.contact, observation.alive], axis=1)
        wall = observation.wall_point if observation.wall else [np.nan, np.nan]
        self._append_row(estimate.pose, int(observation.motion), flags, observation.point, wall)
        return estimate

    def trajectory(self) -> np.ndarray:
        """[T, 3] the weighted mean path of the surviving particles."""
        return self._genealogy.path()

    def occupancy(self) -> np.ndarray:
        """[S, S] probability of an obstacle in each cell; rows are y, columns x, the middle is the start."""
        return draw_occupancy(self.config, self.feelers, self.side, self.trajectory(), self.contacts())

    def grid(self) -> GridDrawing:
        corner = np.full(2, -self.side * self.config.cell / 2)
        return GridDrawing(self.occupancy(), corner, self.config.cell)

    def files(self) -> dict[str, Callable[[Path], None]]:
        """The map as arrays: probability [S, S], origin [2] m of its lower left corner, cell m."""
        return {"grid.npz": lambda path: np.savez_compressed(path, **self.grid()._asdict())}

    def contacts(self) -> ContactLog:
        """The contacts of all reports."""
        contact, alive = np.moveaxis(self._flags.rows, 2, 0)
        return contact_log(self._motion.rows, contact, alive, self._point.rows, self._wall.rows)
