"""What a whisker would meet at each place and heading of a finished map, in classes.

The class of a whisker is where along it the first surface lies, and what is known about the place of its
contacts. It is looked up in a table, so that many supposed poses are compared with a report at once."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ratslam.grid.surfaces import Surfaces
from tactile.base.types import Array
from tactile.whiskers.planar_whiskers import PlanarWhiskers

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


class Expectation(NamedTuple):
    """Tables of a finished map with S x S cells.

    Attributes:
        whiskers: for each length of whisker [L, HEADINGS * S * S] class with its base in a cell. length: [W]
            the row of each whisker. base: [W, 2] m. angle: [W] rad. body: [S * S] class. direction: [2, S *
            S] see `Surfaces`. side: S. cell: m.
    """

    whiskers: np.ndarray
    length: np.ndarray
    base: np.ndarray
    angle: np.ndarray
    body: np.ndarray
    direction: np.ndarray
    side: int
    cell: float

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
        cell, inside = self._cells(_placed(pose, jnp.asarray(self.base, dtype)))
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
        cell, inside = self._cells(_placed(pose, place[None])[:, 0])
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


def expect(surfaces: Surfaces, feelers: PlanarWhiskers, body: float) -> Expectation:
    """The tables of surfaces for these whiskers and a robot of radius `body`, m."""
    lengths, row = np.unique(feelers.length, return_inverse=True)
    tables = [_whisker_table(surfaces, float(length)) for length in lengths]
    side = surfaces.side
    return Expectation(
        np.stack(tables), row, feelers.base, np.arctan2(feelers.direction[:, 1], feelers.direction[:, 0]),
        _body_table(surfaces, BODY * body), surfaces.direction.reshape(2, -1), side, surfaces.cell,
    )  # fmt: skip


def _whisker_table(surfaces: Surfaces, length: float) -> np.ndarray:
    """[HEADINGS * S * S] uint8."""
    centres, tables = surfaces.centres(), []
    for turn in np.arange(HEADINGS) * 2 * np.pi / HEADINGS:
        ahead = length * np.array([np.cos(turn), np.sin(turn)])
        first = np.full(centres.shape[:2], len(SHARES))
        for k in range(len(SHARES) - 1, -1, -1):
            first[surfaces.at(surfaces.evidence, centres + SHARES[k] * ahead) > SURFACE] = k
        tip = np.digitize(surfaces.at(surfaces.evidence, centres + CONTACT * ahead), [FREE, TOUCHED])
        tables.append((first // 2 * TIPS + tip).astype(np.uint8).reshape(-1))
    return np.concatenate(tables)


def _body_table(surfaces: Surfaces, radius: float) -> np.ndarray:
    """[S * S] uint8; all 0 for a robot without a body."""
    if not radius:
        return np.zeros(surfaces.side**2, np.uint8)
    angle = np.arange(8) * np.pi / 4
    rim = np.concatenate([np.zeros((1, 2)), radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    most = np.max([surfaces.at(surfaces.evidence, surfaces.centres() + off) for off in rim], axis=0)
    return np.digitize(most, BODY_LIMITS).astype(np.uint8).reshape(-1)


def _placed(pose: Array, points: Array) -> Array:
    """[N, K, 2] points [K, 2] of base_link at poses [N, 3]."""
    c, s = jnp.cos(pose[:, 2:]), jnp.sin(pose[:, 2:])
    right, up = points[None, :, 0], points[None, :, 1]
    return jnp.stack([pose[:, :1] + c * right - s * up, pose[:, 1:2] + s * right + c * up], axis=-1)
