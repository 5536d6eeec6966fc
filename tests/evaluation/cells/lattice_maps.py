"""Rate maps of known lattices, and of noise."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter


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
