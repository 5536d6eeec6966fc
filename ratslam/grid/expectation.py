"""What a whisker would meet at each place and heading of a finished grid map, in classes.

`draw_surfaces` draws the map anew from its contacts along its path, sharply: the maps of the particles are
soft, so that each finds its way while it maps, but soft walls hide what tells two places apart. `Expectation`
tabulates for every pose where along each whisker the first surface lies, and what is known about the place of
its contacts, so that many pose hypotheses are compared with a report at once.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ratslam.grid.config import GridConfig
from ratslam.grid.map import ContactLog
from ratslam.grid.particles import placed
from tactile.base.se2 import compose
from tactile.base.types import Array
from tactile.whisker_geometry import PlanarWhiskers

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
    for k, (foot, normal) in log.walls().items():
        place = compose(path[k], np.array([*foot, normal + np.pi / 2]))
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


HEADINGS = 72
"""Number of headings of the tables."""
SHARES = np.array([0.1, 0.25, 0.4, 0.55, 0.7, 0.8, 0.9, 1.0, 1.15, 1.3])
"""Points at which a surface is looked for, as shares of a whisker's length."""
CROSSINGS, TIPS = 6, 3
"""Classes of the first surface (at 0.1 or 0.25, 0.4 or 0.55, ..., none), and of the place of contacts: free,
unexplored, surface."""
CLASSES = CROSSINGS * TIPS
UNEXPLORED = (CROSSINGS - 1) * TIPS + 1
"""Class outside the map."""
SURFACE, FREE, TOUCHED = 1.0, -0.3, 0.3
"""Log-odds of a surface that a whisker meets, of free space, and of a surface at the place of contacts."""
CONTACT = 0.93
"""Place of contacts as a share of a whisker's length."""
WALL_LIMITS = np.radians([4.0, 10.0, 20.0, 45.0])
"""Limits between the classes of the difference of a wall's direction; the last class: no wall is known."""
WALL_CLASSES = len(WALL_LIMITS) + 2
LEAST_FIELD = 0.3
"""Length of the field of directions from which on a wall is known."""
BODY_LIMITS = (0.0, 1.0, 3.0)
"""Limits between the classes of the largest log-odds under the robot's body."""
BODY = 2 / 3
"""Radius within which it is looked for, as a share of the robot's."""


class Expectation:
    """Tables of a finished map with S x S cells.

    Args:
        feelers: the whiskers of the reports. body: radius of the robot, m; 0: without a body.

    Attributes:
        whiskers: for each length of whisker [L, HEADINGS * S * S] class with its base in a cell. length: [W]
            the row of each whisker. base: [W, 2] m. angle: [W] rad. body: [S * S] class. direction: [2, S *
            S] see `Surfaces`. side: S. cell: m.
    """

    def __init__(self, surfaces: Surfaces, feelers: PlanarWhiskers, body: float) -> None:
        lengths, self.length = np.unique(feelers.length, return_inverse=True)
        self.base, self.side, self.cell = feelers.base, surfaces.side, surfaces.cell
        self.angle = np.arctan2(feelers.direction[:, 1], feelers.direction[:, 0])
        self.direction = surfaces.direction.reshape(2, -1)
        centres, evidence = surfaces.centres(), surfaces.evidence
        whiskers = []
        for length in lengths.tolist():
            tables = []
            for turn in np.arange(HEADINGS) * 2 * np.pi / HEADINGS:
                ahead = length * np.array([np.cos(turn), np.sin(turn)])
                first = np.full(centres.shape[:2], len(SHARES))  # the nearest point with a surface
                for k in range(len(SHARES) - 1, -1, -1):
                    first[surfaces.at(evidence, centres + SHARES[k] * ahead) > SURFACE] = k
                tip = np.digitize(surfaces.at(evidence, centres + CONTACT * ahead), [FREE, TOUCHED])
                tables.append((first // 2 * TIPS + tip).astype(np.uint8).reshape(-1))
            whiskers.append(np.concatenate(tables))
        self.whiskers = np.stack(whiskers)
        self.body = np.zeros(self.side**2, np.uint8)
        radius = BODY * body
        if radius:
            angle = np.arange(8) * np.pi / 4
            rim = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            most = np.max([surfaces.at(evidence, centres + off) for off in (np.zeros(2), *rim)], axis=0)
            self.body = np.digitize(most, BODY_LIMITS).astype(np.uint8).reshape(-1)

    def places(self, free: int, apart: float, apart_heading: float) -> float:
        """Number of poses that can be told apart.

        Args:
            free: number of cells in which the robot may stand. apart, apart_heading: distance, m, and
                difference in heading, rad, within which two poses are the same.
        """
        return max(free * self.cell**2 / (np.pi * apart**2), 1.0) * np.pi / apart_heading

    def whisker_classes(self, pose: Array) -> Array:
        """[N, W] class of each whisker at poses [N, 3]."""
        dtype = pose.dtype
        cell, inside = self._cells(placed(pose, jnp.asarray(self.base, dtype)))
        turned = (pose[:, 2:] + jnp.asarray(self.angle, dtype)[None]) * (HEADINGS / (2 * np.pi))
        heading = jnp.round(turned).astype(jnp.int32) % HEADINGS
        index = heading * self.side**2 + cell
        found = jnp.asarray(self.whiskers)[self.length[None], index]
        return jnp.where(inside, found, UNEXPLORED).astype(jnp.int32)

    def body_classes(self, pose: Array) -> Array:
        """[N] class of the robot's body at poses [N, 3]."""
        cell, inside = self._cells(pose[:, :2])
        return jnp.where(inside, jnp.asarray(self.body)[cell], 0).astype(jnp.int32)

    def wall_classes(self, pose: Array, place: Array, direction: Array) -> Array:
        """[N] class of a wall at `place` [2] of base_link, with its direction there, at poses [N, 3]."""
        cell, inside = self._cells(placed(pose, place[None])[:, 0])
        cosine, sine = jnp.asarray(self.direction, pose.dtype)[:, cell]
        off = 2 * (pose[:, 2] + direction) - jnp.arctan2(sine, cosine)
        off = jnp.abs(off - 2 * np.pi * jnp.round(off / (2 * np.pi))) / 2
        known = inside & (jnp.hypot(cosine, sine) >= LEAST_FIELD)
        found = jnp.searchsorted(jnp.asarray(WALL_LIMITS, pose.dtype), off).astype(jnp.int32)
        return jnp.where(known, found, WALL_CLASSES - 1)

    def _cells(self, place: Array) -> tuple[Array, Array]:
        """The index of the cell at places [..., 2] (m), and whether it is in the map."""
        at = jnp.round(place / self.cell + (self.side - 1) / 2)
        inside = jnp.all((at >= 0) & (at < self.side), axis=-1)
        at = jnp.where(inside[..., None], at, 0.0).astype(jnp.int32)
        return at[..., 1] * self.side + at[..., 0], inside
