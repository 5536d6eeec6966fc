"""A random walk in a box and cells whose tuning is known; maps of known lattices, and of noise."""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from evaluation.cells.rate_map import bin_activity
from evaluation.cells.recording import BinnedSums, CellRecording
from tactile.base.random_streams import stream

EDGES = np.linspace(0.0, 1.0, 21)
SHAPE, CELL_SIZE = (36, 21, 21), 0.05


class Walk(NamedTuple):
    """time: [T] s. truth: [T, 3] m, m, rad, inside a box of 1 m."""

    time: np.ndarray
    truth: np.ndarray


def random_walk(steps: int = 12000, dt: float = 0.05, seed: int = 0) -> Walk:
    """A smooth walk at some 0.2 m/s, folded at the walls; headings are those of the motion."""
    turn = np.cumsum(stream(seed, "walk").normal(0, 0.35, steps))
    free = 0.5 + np.cumsum(0.2 * dt * np.stack([np.cos(turn), np.sin(turn)], axis=1), axis=0)
    place = np.abs((free + 1) % 2 - 1)
    motion = np.diff(place, axis=0, append=place[-1:] + (place[-1:] - place[-2:-1]))
    heading = np.arctan2(motion[:, 1], motion[:, 0])
    return Walk(dt * np.arange(steps), np.column_stack([place, heading]))


def place_cells(place: np.ndarray, centres: np.ndarray, width: float = 0.12) -> np.ndarray:
    """[T, n] Gaussian fields of `width` m at centres [n, 2]."""
    squared = ((place[:, None] - centres) ** 2).sum(axis=-1)
    return np.exp(-squared / (2 * width**2))


def direction_cells(heading: np.ndarray, preferred: np.ndarray, sharpness: float = 4.0) -> np.ndarray:
    """[T, n] von Mises tuning of peak 1 at preferred headings [n], rad."""
    return np.exp(sharpness * (np.cos(heading[:, None] - preferred) - 1))


def mixed_cells(walk: Walk) -> np.ndarray:
    """[T, 10]: six place cells, two direction cells, a cell along the left wall and one always active."""
    centres = np.array([[0.2, 0.3], [0.5, 0.5], [0.8, 0.2], [0.7, 0.8], [0.35, 0.7], [0.9, 0.9]])
    along = np.exp(-walk.truth[:, :1] / 0.05)
    places, turns = (
        place_cells(walk.truth[:, :2], centres),
        direction_cells(walk.truth[:, 2], np.array([0.5, 4.0])),
    )
    return np.concatenate([places, turns, along, np.ones_like(along)], axis=1)


def mixed_sums(walk: Walk) -> BinnedSums:
    return bin_activity(*walk, mixed_cells(walk), EDGES, EDGES, 36)


def sheet_recording(walk: Walk, cells: np.ndarray, drift: np.ndarray | None = None) -> CellRecording:
    """A perfect sheet that shows poses off by drift [T, 3]: cells [C] fire round their place on the torus."""
    side = np.array([SHAPE[2] * CELL_SIZE, SHAPE[1] * CELL_SIZE, 2 * np.pi])
    pose = (walk.truth + (0 if drift is None else drift)) % side
    heading, row, column = np.unravel_index(cells, SHAPE)
    own = np.stack([column * CELL_SIZE, row * CELL_SIZE, heading * 2 * np.pi / SHAPE[0]], axis=1)
    angle = 2 * np.pi * (pose[:, None] - own) / side
    activity = np.exp((np.cos(angle) - 1) @ np.array([6.0, 6.0, 4.0]))
    packet, steps = pose / np.array([CELL_SIZE, CELL_SIZE, 2 * np.pi / SHAPE[0]]), len(walk.time)
    return CellRecording(
        SHAPE, CELL_SIZE, walk.time, walk.truth.copy(), packet, np.zeros(steps), np.full(steps, -1, np.int32),
        cells.astype(np.int32), activity.astype(np.float32), None,
    )  # fmt: skip


def lattice_map(directions: int, spacing: float, turn: float, shape: tuple[int, int]) -> np.ndarray:
    """[H, W] >= 0 with peaks `spacing` bins apart: hexagonal of 3 waves, square of 2; turned by rad."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    wave = 2 * np.pi / spacing / np.sin(np.pi / directions if directions == 3 else np.pi / 2)
    angles = turn + np.pi / 2 + np.arange(directions) * np.pi / directions
    return np.maximum(sum(np.cos(wave * (x * np.cos(a) + y * np.sin(a))) for a in angles), 0)


def mixed_maps(count: int, shape: tuple[int, int], seed: int) -> np.ndarray:
    """[count, H, W] of noise, of sparse bumps, of hexagonal and of square lattices with noise, in turn."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    maps = []
    for number in range(count):
        kind = number % 4
        if kind == 0:
            image = gaussian_filter(rng.random(shape), rng.uniform(0.5, 3))
        elif kind == 1:
            centres = rng.uniform((0, 0), shape, (rng.integers(1, 6), 2))
            image = sum(np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / 8) for cy, cx in centres)
            image = np.where(image > 0.05, image, 0)
        else:
            image = lattice_map(5 - kind, rng.uniform(5, 10), rng.uniform(0, np.pi), shape)
            image = image + 0.5 * rng.random(shape)
        maps.append(image)
    return np.array(maps)
