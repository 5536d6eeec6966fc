"""Paths of rats in files: packaged recordings of real rats, and one's own as CSV or .npz."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from robot.recordings.csv_file import read_csv
from robot.recordings.sanity_checks import RowName
from robot.simulation.rat.rat_path import MotionConfig, RatPath, check_path
from robot.sources.input_files import raise_errors, require_file
from tactile.base.errors import InputError
from tactile.base.npz import read_npz

PACKAGED = {path.stem: path for path in sorted((Path(__file__).resolve().parent / "data").glob("*.npz"))}
"""Files of the packaged paths by name: `sargolini` (600 s, 1 x 1 m), `tanni` (1200 s, 3.5 x 2.5 m)."""


class PathFileConfig(MotionConfig):
    """A recorded path."""

    file: Path = Path("sargolini")
    """`sargolini` (600 s in 1 x 1 m), `tanni` (1200 s in 3.5 x 2.5 m), or a file: `.csv` with columns t, x
    and y, or `.npz` with t [N] and pos [N, 2]; s and m, with integers in ms and mm. The origin is a corner of
    the box."""
    unit: PositiveFloat = 1.0
    """Length of the unit of positions, m: 0.01 for cm."""
    shift: tuple[float, float] = (0.0, 0.0)
    """Added to the positions, m."""
    skip: NonNegativeFloat = 0.0
    """Time to leave out at the beginning, s."""

    def resolved(self, folder: Path) -> PathFileConfig:
        """A copy whose file, unless packaged, is taken from the folder."""
        if str(self.file) in PACKAGED:
            return self
        return self.model_copy(update={"file": folder / self.file})


def read_path(config: PathFileConfig) -> RatPath:
    """The path of a file, checked, with the settings for unit, shift and skipped time applied.

    Raises:
        InputError: the file cannot be read, or holds no path of a rat (`check_path`), with its row.
    """
    file = PACKAGED.get(str(config.file), config.file)
    require_file(file)
    path, place = _read_csv_path(file) if file.suffix == ".csv" else _read_npz_path(file)
    path = path._replace(position=path.position * config.unit + np.asarray(config.shift))
    check_path(path, config, place)
    kept = path.time >= path.time[0] + config.skip
    if kept.sum() < 2:
        found = f"{config.skip:g} s to skip"
        expected = f"less than the duration of {file.name}, {path.time[-1] - path.time[0]:.4g} s"
        raise InputError("rat_simulation.path.skip", found, expected)
    return RatPath(path.time[kept], path.position[kept])


def _read_csv_path(file: Path) -> tuple[RatPath, RowName]:
    table = read_csv(file)
    raise_errors(table.absences([(name, "") for name in ("t", "x", "y")]))
    raise_errors(table.judge(["t", "x", "y"])[1])
    position = np.column_stack([table.column(name, "length") for name in ("x", "y")])
    return RatPath(table.column("t", "time"), position), table.place


def _read_npz_path(file: Path) -> tuple[RatPath, RowName]:
    path = read_npz(file, ("t", "pos"), _parse_arrays, "a path: arrays t [N] and pos [N, 2]")
    return path, lambda row: f"{file}:{row}"


def _parse_arrays(time: np.ndarray, position: np.ndarray) -> RatPath:
    if time.ndim != 1 or position.shape != (len(time), 2):
        raise ValueError(f"t {list(time.shape)} and pos {list(position.shape)}")
    return RatPath(_in_units(time), _in_units(position))


def _in_units(values: np.ndarray) -> np.ndarray:
    """Values in s or m; integers are thousandths."""
    if np.issubdtype(values.dtype, np.integer):
        return values / 1000.0
    return values.astype(np.float64)
