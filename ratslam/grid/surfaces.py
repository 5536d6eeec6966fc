"""The surfaces of a finished grid map, drawn sharply from its contacts along its path.

The maps of the particles are soft, so that each finds its way while it maps. Where a session is looked for in
a finished map, soft walls hide what tells two places apart. The footprints are ours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.grid.config import GridConfig
from ratslam.grid.map_drawing import ContactLog
from tactile.base.se2 import compose
from tactile.whiskers.planar_whiskers import PlanarWhiskers

FINER = 2
"""Cells of the surfaces along the side of a cell of the map."""
BLOB, ACROSS, ALONG = 0.6, 0.5, 0.55
"""Standard deviations of a contact, and of a wall across and along, as shares of those of the footprints."""
MET, PASSED, DRIVEN = 3.0, 0.7, 1.0
"""Log-odds of a contact or wall, of a free point of a whisker, and of the robot's body."""
MOST_PASSED, MOST_DRIVEN, MOST = 8, 6, 6.0
"""Free points and bodies that count in a cell, and the limit on its log-odds."""
FREE_SHARES = np.linspace(0.15, 0.85, 6)
"""Points of a whisker without contact that are marked free, as shares of its length."""
FAR = 4.0
"""Standard deviations beyond which a footprint is 0."""


class Surfaces(NamedTuple):
    """Surfaces on a grid of S x S cells whose middle is the map's; rows are y, columns x.

    Attributes:
        evidence: [S, S] log-odds of a surface, 0 where unexplored. direction: [2, S, S] sums of cosine and
            sine of the doubled directions of walls. cell: m.
    """

    evidence: np.ndarray
    direction: np.ndarray
    cell: float

    @property
    def side(self) -> int:
        """S."""
        return len(self.evidence)

    def at(self, layer: np.ndarray, point: np.ndarray) -> np.ndarray:
        """[...] a layer [S, S] at points [..., 2] (m), bilinear; 0 at the rim and outside."""
        place = point / self.cell + (self.side - 1) / 2
        low = np.floor(place).astype(int)
        inside = np.asarray(((low >= 0) & (low < self.side - 1)).all(axis=-1))
        column, row = np.moveaxis(np.where(inside[..., None], low, 0), -1, 0)
        right, up = np.moveaxis(place - np.floor(place), -1, 0)
        below = layer[row, column] * (1 - right) + layer[row, column + 1] * right
        above = layer[row + 1, column] * (1 - right) + layer[row + 1, column + 1] * right
        return np.where(inside, below * (1 - up) + above * up, 0.0)

    def centres(self) -> np.ndarray:
        """[S, S, 2] middles of the cells, m."""
        at = (np.arange(self.side) - (self.side - 1) / 2) * self.cell
        return np.stack(np.meshgrid(at, at), axis=-1)


def draw_surfaces(
    config: GridConfig, whiskers: PlanarWhiskers, side: int, path: np.ndarray, log: ContactLog
) -> Surfaces:
    """The surfaces of a map of `side` cells with this path [T, 3] and these contacts."""
    cell = config.cell / FINER
    empty = np.zeros((side * FINER,) * 2)
    made = Surfaces(empty, np.stack([empty, empty]), cell)
    centres, met = made.centres(), empty.copy()
    before = np.vstack([np.zeros_like(log.contact[:1]), log.contact[:-1]])
    new = log.contact & ~before & ~log.turning[:, None]
    for k, whisker in zip(*np.nonzero(new), strict=True):
        place = compose(path[k], np.array([*log.point[k, whisker], 0.0]))
        rows, off = _near(centres, place, FAR * BLOB * config.footprint.blob_sd)
        met[rows] += np.exp(-(off**2).sum(axis=-1) / (2 * (BLOB * config.footprint.blob_sd) ** 2))
    for place in _walls(path, log):
        along, across = ALONG * config.footprint.along, ACROSS * config.footprint.across
        rows, off = _near(centres, place, FAR * along)
        c, s = np.cos(place[2]), np.sin(place[2])
        ahead, aside = off @ np.array([c, s]), off @ np.array([-s, c])
        shape = np.exp(-((ahead / along) ** 2 + (aside / across) ** 2) / 2)
        met[rows] += shape
        made.direction[0][rows] += shape * np.cos(2 * place[2])
        made.direction[1][rows] += shape * np.sin(2 * place[2])
    passed, driven = _free(config, whiskers, made, path, log)
    evidence = MET * met - PASSED * np.minimum(passed, MOST_PASSED) - DRIVEN * np.minimum(driven, MOST_DRIVEN)
    return made._replace(evidence=np.clip(evidence, -MOST, MOST))


def _walls(path: np.ndarray, log: ContactLog) -> list[np.ndarray]:
    """Places and directions [3] of the walls of the reports in the map."""
    found = []
    distance = np.hypot(*log.wall.T)
    for k in np.flatnonzero((distance > 1e-6) & log.valid & log.contact.any(axis=1)).tolist():
        normal = log.wall[k] / distance[k]
        middle = log.point[k][log.contact[k]].mean(axis=0)
        foot = middle + normal * (distance[k] - normal @ middle)
        direction = np.arctan2(normal[1], normal[0]) + np.pi / 2
        found.append(compose(path[k], np.array([*foot, direction])))
    return found


def _free(
    config: GridConfig, whiskers: PlanarWhiskers, made: Surfaces, path: np.ndarray, log: ContactLog
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers [S, S] of free whisker points and of bodies in each cell."""
    passed, driven = np.zeros((made.side,) * 2), np.zeros((made.side,) * 2)
    points = whiskers.points(FREE_SHARES)
    shaft = np.concatenate([points, np.zeros((*points.shape[:2], 1))], axis=2)
    at = compose(path[:, None, None], shaft[None])[log.free][..., :2].reshape(-1, 2)
    column, row = np.round(at / made.cell + (made.side - 1) / 2).astype(int).T
    inside = (column >= 0) & (column < made.side) & (row >= 0) & (row < made.side)
    np.add.at(passed, (row[inside], column[inside]), 1)
    centres = made.centres()
    for pose in path if config.body else path[:0]:
        rows, off = _near(centres, pose, config.body)
        driven[rows] += (off**2).sum(axis=-1) < config.body**2
    return passed, driven


def _near(centres: np.ndarray, place: np.ndarray, reach: float) -> tuple[tuple[slice, slice], np.ndarray]:
    """The cells within a square about a place, and their offsets [n, m, 2] from it, m."""
    x, y = centres[0, :, 0], centres[:, 0, 1]
    across = slice(*np.searchsorted(x, [place[0] - reach, place[0] + reach]).tolist())
    up = slice(*np.searchsorted(y, [place[1] - reach, place[1] + reach]).tolist())
    return (up, across), centres[up, across] - place[:2]
