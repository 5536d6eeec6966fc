"""What was felt, drawn along a path: the maps of Fox et al. 2012, II-E and II-F.

The three mappers are one: wherever a wall's direction is known an edge is drawn, elsewhere a blob. Each mark
is a likelihood that is neutral, 0.5, far from where it was made (eq. 3 and 4 as printed fall to 0 there and
would erase the map), and marks are added as log-odds; other ways to fuse them are there for study.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import expit, logit

from ratslam.grid.config import DrawingConfig, GridConfig
from tactile.base.se2 import compose
from tactile.base.types import MotionKind
from tactile.whiskers.planar_whiskers import PlanarWhiskers

FAR = 3.0
"""Standard deviations beyond which a mark is left out."""
NEARLY = 1e-3
"""No chance comes nearer to 0 or 1 than this by the literal fusion, which knows no other limit."""


class Marks(NamedTuple):
    """T reports.

    Attributes:
        told: [T] bool, counts as evidence. contact, free: [T, W] bool. turning: [T] bool. point: [T, W, 2] m
            in base_link. wall: [T, 2] m, its nearest point; NaN where none is known.
    """

    told: np.ndarray
    contact: np.ndarray
    free: np.ndarray
    turning: np.ndarray
    point: np.ndarray
    wall: np.ndarray


def marks_of(
    motion: np.ndarray, contact: np.ndarray, alive: np.ndarray, point: np.ndarray, wall: np.ndarray
) -> Marks:
    """The marks of T reports: motion [T], contact and alive [T, W], point [T, W, 2], wall [T, 2]. A contact
    at no number is none, but its whisker does not count as free."""
    told = motion != MotionKind.BACK
    counts = alive & told[:, None]
    placed = np.isfinite(point).all(axis=2)
    return Marks(told, contact & counts & placed, ~contact & counts, motion == MotionKind.TURN, point, wall)


class Fusion(NamedTuple):
    """How marks become a map.

    Attributes:
        chance: what a mark tells of the cells around it: the chance of an obstacle, from that in its middle
            and its shape there, 1 in the middle and 0 far away.
        fuse: the evidence of cells, log-odds beyond the prior, once a mark's chances are fused with it.
        far: standard deviations beyond which a mark is left out.
    """

    chance: Callable[[float, np.ndarray], np.ndarray]
    fuse: Callable[[np.ndarray, np.ndarray, GridConfig], np.ndarray]
    far: float = FAR


def _neutral(middle: float, shape: np.ndarray) -> np.ndarray:
    return 0.5 + (middle - 0.5) * shape


def _printed(middle: float, shape: np.ndarray) -> np.ndarray:
    return middle * shape


def _added(there: np.ndarray, chance: np.ndarray, config: GridConfig) -> np.ndarray:
    most = config.drawing.most
    return np.clip(there + logit(chance), -most, most)


def _multiplied(there: np.ndarray, chance: np.ndarray, config: GridConfig) -> np.ndarray:
    """m l / (m l + (1 - m)(1 - l)), which is a sum of log-odds."""
    prior, most = logit(config.prior), -logit(NEARLY)
    return np.clip(there + prior + logit(chance), -most, most) - prior


def _stronger(there: np.ndarray, chance: np.ndarray, config: GridConfig) -> np.ndarray:
    told, most = logit(chance), config.drawing.most
    return np.clip(np.where(np.abs(told) > np.abs(there), told, there), -most, most)


def _averaged(there: np.ndarray, chance: np.ndarray, config: GridConfig) -> np.ndarray:
    prior = logit(config.prior)
    return logit((expit(there + prior) + expit(logit(chance) + prior)) / 2) - prior


FUSIONS: Mapping[str, Fusion] = {
    "log_odds": Fusion(_neutral, _added),
    "literal": Fusion(_printed, _multiplied, np.inf),
    "max": Fusion(_neutral, _stronger),
    "average": Fusion(_neutral, _averaged),
}
"""By the names of `DrawingConfig.fusion`, which says what each does."""


class _Mark(NamedTuple):
    """One stamp: its middle [2] m, its chance there, and a wall's direction or NaN."""

    place: np.ndarray
    chance: float
    sd: float
    direction: float


def draw(
    config: GridConfig, feelers: PlanarWhiskers, side: int, path: np.ndarray, marks: Marks
) -> np.ndarray:
    """[S, S] chance of an obstacle.

    Args:
        side: S, cells. path: [T, 3] where each report was made, from the middle of the map.
    """
    drawing, cell = config.drawing, config.cell
    fusion = FUSIONS[drawing.fusion]
    evidence = np.zeros((side, side))
    for mark in _marks(drawing, config.body, feelers, path, marks):
        reach = fusion.far * (drawing.edge_sd if np.isfinite(mark.direction) else mark.sd)
        place = mark.place / cell + (side - 1) / 2
        low = np.clip(np.ceil(place - reach / cell), 0, side).astype(int)
        high = np.clip(np.floor(place + reach / cell) + 1, 0, side).astype(int)
        across, up = (np.arange(low[k], high[k]) * cell - place[k] * cell for k in (0, 1))
        shape = _shape(drawing, mark, across[None, :], up[:, None])
        rows = slice(low[1], high[1]), slice(low[0], high[0])
        evidence[rows] = fusion.fuse(evidence[rows], fusion.chance(mark.chance, shape), config)
    return expit(evidence + logit(config.prior))


def _shape(config: DrawingConfig, mark: _Mark, across: np.ndarray, up: np.ndarray) -> np.ndarray:
    away = across**2 + up**2
    if not np.isfinite(mark.direction):
        return np.exp(-away / (2 * mark.sd**2))
    # Seen from the contact, modulo half a turn: the edge goes both ways.
    off = np.mod(np.arctan2(up, across) - mark.direction + np.pi / 2, np.pi) - np.pi / 2
    off = np.where(away > 0, off, 0.0)
    return np.exp(-away / (2 * config.edge_sd**2) - off**2 / (2 * config.edge_fan**2))


def _marks(
    config: DrawingConfig, body: float, feelers: PlanarWhiskers, path: np.ndarray, marks: Marks
) -> list[_Mark]:
    """All marks in the order they were made."""
    middles = feelers.points(np.array([0.5]))[:, 0]
    made: list[_Mark] = []
    before = np.zeros(marks.contact.shape[1], bool)
    pending: list[_Mark] = []
    for k, pose in enumerate(path):
        if not marks.told[k]:
            made += pending
            pending, before = [], np.zeros_like(before)
            continue
        for point in middles[marks.free[k]]:
            made.append(_Mark(_at(pose, point), config.free, config.free_sd, np.nan))
        if body:
            made.append(_Mark(pose[:2], config.body, body, np.nan))
        if not marks.contact[k].any():
            made += pending
            pending = []
        new = marks.contact[k] & ~before & ~marks.turning[k]
        pending += [_Mark(_at(pose, p), config.contact, config.blob_sd, np.nan) for p in marks.point[k][new]]
        foot = marks.wall[k]
        away = np.hypot(*foot)
        if np.isfinite(away) and away > 1e-6 and marks.contact[k].any():
            pending = []  # the edge says what these contacts were of
            normal = foot / away
            middle = marks.point[k][marks.contact[k]].mean(axis=0)
            place = _at(pose, middle + normal * (away - normal @ middle))
            direction = pose[2] + np.arctan2(normal[1], normal[0]) + np.pi / 2
            made.append(_Mark(place, config.contact, config.blob_sd, float(direction)))
        before = marks.contact[k]
    return made + pending


def _at(pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    return compose(pose, np.array([*point, 0.0]))[:2]
