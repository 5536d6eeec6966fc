"""Occupancy maps as files: `grid.npz` and its ground truth `arena.npz`; `map.yaml` with `map.pgm` for nav2.

As nav2's map_server reads them (with `negate: 0`), bright pixels are free, the first row of the image has the
largest y, and `origin` is the lower left corner. In mode `trinary` a cell is occupied above one threshold,
free below the other and unknown between. Unknown cells are customarily 205, an occupancy of 0.196, so the
usual free_thresh of 0.25 turns them into free ones.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from evaluation.metrics.occupancy_grid import GridTruth, OccupancyGrid
from tactile.base.bounded import read_npz, read_plain_yaml
from tactile.base.errors import InputError, os_errors_of
from tactile.base.files import write_atomically, write_text_atomically


def read_grid(path: str | Path) -> OccupancyGrid:
    """Reads the map of a run with a grid."""

    def parse(probability: np.ndarray, origin: np.ndarray, cell: np.ndarray) -> OccupancyGrid:
        grid = OccupancyGrid(probability.astype(float), origin.astype(float).reshape(2), float(cell))
        grid.check()
        return grid

    expected = "an occupancy map: probability [H, W], origin [2] and cell"
    return read_npz(path, OccupancyGrid._fields, parse, expected)


def write_grid_truth(path: str | Path, truth: GridTruth, start: np.ndarray) -> None:
    """Writes the truth in the frame of the map, and `start` [3]: the pose of that frame (where the robot
    started) in the frame of the true poses."""
    np.savez_compressed(path, **truth._asdict(), start=start)


def read_grid_truth(path: str | Path) -> tuple[GridTruth, np.ndarray]:
    """The inverse of `write_grid_truth`."""

    def parse(*arrays: np.ndarray) -> tuple[GridTruth, np.ndarray]:
        occupied, inside, segments, start = arrays
        return GridTruth(occupied, inside, segments.astype(float)), start.astype(float)

    return read_npz(path, (*GridTruth._fields, "start"), parse, "the arena.npz of a run directory")


FREE_THRESH, OCCUPIED_THRESH = 0.19, 0.65
"""Thresholds of free and occupied cells; 205 stays unknown even for a reader that divides by 256."""

_BLACK, _UNKNOWN, _WHITE = 0, 205, 254  # the values of map_saver
_HEAD = re.compile(rb"P5(?:\s+|#[^\n]*\n)+(\d+)(?:\s+|#[^\n]*\n)+(\d+)(?:\s+|#[^\n]*\n)+(\d+)\s")


class Nav2Map(NamedTuple):
    """A map as map_server publishes it.

    Attributes:
        cell: [H, W] int, occupancy in 0..100 or -1 for unknown; row j counts y upwards.
        origin: [3] x, y (m) and yaw (rad) of the lower left corner. resolution: cell side length, m.
    """

    cell: np.ndarray
    origin: np.ndarray
    resolution: float


def write_nav2(folder: Path, grid: OccupancyGrid, name: str = "map") -> None:
    """Writes NAME.pgm (binary, 8 bits, dark is occupied) and NAME.yaml into a folder, each atomically."""
    grid.check()
    free, occupied = grid.probability < FREE_THRESH, grid.probability > OCCUPIED_THRESH
    pixel = np.where(occupied, _BLACK, np.where(free, _WHITE, _UNKNOWN)).astype(np.uint8)
    height, width = pixel.shape
    image = f"P5\n{width} {height}\n255\n".encode() + pixel[::-1].tobytes()
    write_atomically(folder / f"{name}.pgm", lambda path: path.write_bytes(image))
    file = yaml.safe_dump(f"{name}.pgm", width=1 << 30).splitlines()[0]
    # All digits without an exponent, since some YAML readers take 1e-05 as a string.
    x, y, cell = (np.format_float_positional(float(value), trim="0") for value in (*grid.origin, grid.cell))
    write_text_atomically(
        folder / f"{name}.yaml",
        f"image: {file}\nmode: trinary\nresolution: {cell}\norigin: [{x}, {y}, 0.0]\n"
        f"negate: 0\noccupied_thresh: {OCCUPIED_THRESH}\nfree_thresh: {FREE_THRESH}\n",
    )


def read_nav2(path: str | Path) -> Nav2Map:
    """Reads map.yaml and its image like map_server (modes trinary, scale and raw; binary 8-bit PGM)."""
    path = Path(path)
    given = read_plain_yaml(path, "the map.yaml of a map_server")
    keys = ("resolution", "free_thresh", "occupied_thresh")
    resolution, free, occupied = (_value(path, given, key) for key in keys)
    origin = given.get("origin")
    if not isinstance(origin, list) or len(origin) != 3:
        raise InputError(f"{path}: origin", repr(origin), "[x, y, yaw]")
    place = np.array([_value(path, {"origin": value}, "origin") for value in origin])
    if resolution <= 0 or not 0 <= free < occupied <= 1:
        found = f"resolution {resolution:g}, thresholds {free:g}, {occupied:g}"
        expected = "a positive resolution, and free_thresh below occupied_thresh"
        raise InputError(str(path), found, expected)
    shade = _image(path.parent / str(given.get("image", "")))[::-1] / 255
    occupancy = shade if given.get("negate") else 1 - shade
    mode = given.get("mode", "trinary")
    if mode == "raw":
        cell = np.where(shade * 255 <= 100, np.rint(shade * 255), -1)
    elif mode in ("trinary", "scale"):
        between = -1 if mode == "trinary" else np.rint(100 * (occupancy - free) / (occupied - free))
        cell = np.where(occupancy > occupied, 100, np.where(occupancy < free, 0, between))
    else:
        raise InputError(f"{path}: mode", repr(mode), "trinary, scale or raw")
    return Nav2Map(cell.astype(int), place, resolution)


def _value(path: Path, given: dict[str, Any], key: str) -> float:
    try:
        value = float(given[key])
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{path}: {key}", repr(given.get(key)), "a number") from None
    if not np.isfinite(value):
        raise InputError(f"{path}: {key}", f"{value}", "a finite number")
    return value


def _image(path: Path) -> np.ndarray:
    """Pixels [H, W], top row first."""
    with os_errors_of(path, "cannot be read", "an image beside its map.yaml"):
        content = path.read_bytes()
    head = _HEAD.match(content)
    if head is None or int(head[3]) != 255:
        raise InputError(str(path), "another kind of image", "a binary 8-bit PGM (P5)")
    width, height = int(head[1]), int(head[2])
    pixels = np.frombuffer(content[head.end() :], np.uint8)
    if len(pixels) != width * height or len(pixels) == 0:
        raise InputError(str(path), f"{len(pixels)} pixels", f"{width} x {height}")
    return pixels.reshape(height, width)
