"""Poisson spikes of recorded pose cells, by time rescaling (Brown et al. 2002, Neural Computation 14: 325).

The rate of a cell, `peak_rate * activity / reference` in Hz, holds from a step to the next one. The
reference is an activity that the caller gives, as a rule that of a settled packet (`settled_peak`): the
largest activity of the chosen cells would make the rate of a cell depend on the others. Arrival times of a
process of rate 1 are mapped through the inverse of the integral of the rate, which is exact for piecewise
constant rates. There is no refractory period, no burst and no adaptation. A cell draws from a stream named
after its index: its spikes do not depend on which other cells were chosen, and a longer recording begins
with those of a shorter one.

Where activity is a posterior, the cells of all hypotheses fire at once, each by its probability. The rival
hypothesis is that each theta cycle holds one sample of it (Ujfalussy & Orban 2022, eLife 11: e74058). With
`theta_hz`, one cell is drawn in each cycle by its share of the activity, and fires for all of it: the mean
over many cycles is the same, and no two hypotheses fire in one cycle.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jax import lax
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat

from evaluation.cells.recording import CellRecording
from ratslam.classic import pose_cells
from ratslam.classic.config import NetworkConfig
from ratslam.classic.levels import to_full_torus, window_levels
from tactile.base.bounded import read_npz
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.settings import Settings
from tactile.base.types import Odometry


def cell_poses(shape: tuple[int, int, int], cell_size: float, cell: np.ndarray) -> np.ndarray:
    """[C, 3] poses of cells on the torus (m, m, rad): x and y in [0, N * cell_size), heading in [0, 2 pi).

    Args:
        shape: (K, N, N) cells over heading, y, x. cell_size: m. cell: [C] indices in the flattened network.

    Raises:
        InputError: an index is no cell of the network.
    """
    _check_cells(shape, cell)
    heading, y, x = np.unravel_index(np.asarray(cell, np.int64), shape)
    return np.stack([x, y, heading], axis=-1) * [cell_size, cell_size, 2 * np.pi / shape[0]]


def _check_cells(shape: tuple[int, int, int], cell: np.ndarray) -> None:
    """Checks the indices [C] of chosen cells.

    Raises:
        InputError: they are no whole numbers, there are none, or one is no cell of the network.
    """
    total, given = int(np.prod(shape)), np.asarray(cell)
    expected = f"indices of the {total} cells, 0 to {total - 1}"
    if given.ndim != 1 or not given.size or given.dtype.kind not in "iu":
        raise InputError("cell", f"an array of shape {given.shape} and type {given.dtype}", expected)
    wrong = given[(given < 0) | (given >= total)]
    if wrong.size:
        raise InputError("cell", f"the index {wrong[0]}", expected)


BLOCK = 1024
"""Arrivals drawn at a time."""


class SpikeConfig(Settings):
    """Settings of the spikes."""

    peak_rate: PositiveFloat = 20.0
    """Rate of a cell whose activity equals the reference, Hz."""
    seed: NonNegativeInt = 0
    """Seed of the random streams, one for each cell."""
    theta_hz: NonNegativeFloat = 0.0
    """Cycles per second, in each of which one cell is drawn and fires for all; 0: all fire at all times."""


class SpikeTrains(NamedTuple):
    """Spikes of C cells.

    Attributes:
        cell: [C] int32 indices in the flattened network. times: for each cell the times [n] of its spikes,
            ascending, s on the clock of the recording. start, stop: s, the time in which spikes were drawn.
        config: the peak rate and the seed with which they were drawn.
    """

    cell: np.ndarray
    times: list[np.ndarray]
    start: float
    stop: float
    config: SpikeConfig


def draw_spikes(recording: CellRecording, reference: float, config: SpikeConfig | None = None) -> SpikeTrains:
    """Draws the spikes of the chosen cells of a recording.

    Args:
        reference: the activity at which a cell fires at the peak rate.

    Raises:
        InputError: the recording is empty, its times fall, an activity is negative or not finite, a cell is
            not of the network, or the reference is not positive; see `sample_cycles`.
    """
    config = config or SpikeConfig()
    if config.theta_hz:
        drawn = sample_cycles(recording.time, recording.activity, config.theta_hz, config.seed)
        fires = drawn[:, None] == np.arange(len(recording.cell))
        recording = recording._replace(activity=fires.astype(np.float32))
    expected_counts = expected_spikes(recording, reference, config.peak_rate)
    time = np.asarray(recording.time, np.float64)
    times = []
    for k, cell in enumerate(np.asarray(recording.cell).tolist()):
        integral = np.concatenate([[0.0], np.cumsum(expected_counts[:, k])])
        arrivals = _unit_arrivals(stream(config.seed, f"spikes of cell {cell}"), integral[-1])
        # The times at which the integral of the rate reaches the arrivals.
        row = np.searchsorted(integral, arrivals, side="right") - 1
        share = (arrivals - integral[row]) / (integral[row + 1] - integral[row])
        times.append(np.minimum(time[row] + share * (time[row + 1] - time[row]), time[row + 1]))
    return SpikeTrains(np.asarray(recording.cell, np.int32), times, float(time[0]), float(time[-1]), config)


def sample_cycles(time: np.ndarray, activity: np.ndarray, theta_hz: float, seed: int) -> np.ndarray:
    """[T] int, the cell that is drawn in the theta cycle of each step: its column, or -1 for none of them.

    A cell is drawn with a probability that is its activity at the first step of the cycle; what is missing to
    1 is that of other cells and of novelty.

    Args:
        time: [T] s, ascending. activity: [T, C] of cells that exclude each other. theta_hz: cycles per
            second, above 0.

    Raises:
        InputError: the activity of a step is more than 1 or less than 0.
    """
    first, cycle = np.unique(np.floor((time - time[0]) * theta_hz), return_index=True, return_inverse=True)[
        1:
    ]
    ends = np.cumsum(np.asarray(activity, np.float64)[first], axis=1)
    if not (np.diff(ends, axis=1, prepend=0.0) >= 0).all() or not (ends <= 1 + 1e-4).all():
        found = f"activity from {np.min(activity):.3g}, in sum up to {ends.max():.3g}"
        cure = "grid cells overlap: record the pose cells, without `cells.sheet`"
        raise InputError("theta", found, "probabilities of cells that exclude each other", cure)
    at = stream(seed, "theta cycles").random(len(first))
    drawn = (ends <= at[:, None]).sum(axis=1)
    return np.where(drawn == activity.shape[1], -1, drawn)[cycle]


def expected_spikes(recording: CellRecording, reference: float, peak_rate: float) -> np.ndarray:
    """[T - 1, C] the expected number of spikes of each cell between successive steps.

    Raises:
        InputError: as `draw_spikes`.
    """
    time, activity = np.asarray(recording.time, float), np.asarray(recording.activity, np.float64)
    if not (np.isfinite(reference) and reference > 0):
        raise InputError("reference", f"{reference}", "an activity above 0")
    _check_cells(recording.shape, recording.cell)
    if len(time) < 2 or activity.shape != (len(time), len(recording.cell)):
        found = f"{len(time)} times and activity of shape {activity.shape}"
        expected = "[T] times and [T, C] activities of C cells, T at least 2"
        raise InputError("recording", found, expected)
    if not np.isfinite(time).all() or (np.diff(time) < 0).any():
        raise InputError("recording.time", "a time before the previous one", "ascending times, s")
    if not (np.isfinite(activity).all() and activity.min() >= 0):
        raise InputError("recording.activity", "a negative or not finite activity", "activities from 0 on")
    return activity[:-1] * (peak_rate / reference * np.diff(time))[:, None]


def _unit_arrivals(random: np.random.Generator, end: float) -> np.ndarray:
    """The arrival times below `end` of a Poisson process of rate 1; they do not depend on `end`."""
    blocks: list[np.ndarray] = []
    last = 0.0
    while last < end:
        gaps = random.standard_exponential(BLOCK)
        gaps[0] += last
        blocks.append(np.cumsum(gaps))
        last = float(blocks[-1][-1])
    arrivals = np.concatenate([np.zeros(0), *blocks])
    return arrivals[arrivals < end]


def write_spikes(path: str | Path, spikes: SpikeTrains) -> None:
    """Writes an .npz file; equal spikes give equal bytes.

    Arrays: `cell` [C] int32, `count` [C] spikes of each cell, `times` [sum of count] s, those of the first
    cell first, `interval` [2] start and stop, s, `peak_rate` Hz and `seed`.
    """
    arrays = {
        "cell": spikes.cell,
        "count": np.array([len(times) for times in spikes.times], np.int64),
        "times": np.concatenate([np.zeros(0), *spikes.times]),
        "interval": np.array([spikes.start, spikes.stop]),
        "peak_rate": np.array(spikes.config.peak_rate),
        "seed": np.array(spikes.config.seed),
    }
    with Path(path).open("wb") as file:  # with a path, NumPy would add a suffix to .NPZ
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def read_spikes(path: str | Path) -> SpikeTrains:
    """The inverse of `write_spikes`.

    Raises:
        InputError: the file is missing or malformed.
    """

    def parse(cell: np.ndarray, count: np.ndarray, times: np.ndarray, *rest: np.ndarray) -> SpikeTrains:
        interval, rate, seed = rest
        if cell.shape != count.shape or count.sum() != len(times) or interval.shape != (2,):
            raise ValueError("arrays that do not fit each other")
        parts = np.split(times, np.cumsum(count)[:-1])
        config = SpikeConfig(peak_rate=float(rate), seed=int(seed))
        return SpikeTrains(cell, parts, float(interval[0]), float(interval[1]), config)

    names = ("cell", "count", "times", "interval", "peak_rate", "seed")
    return read_npz(path, names, parse, "a file of spikes")


SETTLING = 60
"""Steps without motion; after 40 the peak of the default network changes by less than 1e-12 a step."""


def settled_peak(config: NetworkConfig) -> float:
    """The largest activity of a packet at rest on a cell, in the precision that JAX has by default.

    It depends on the network alone, so rates scaled by it can be compared between cells and recordings. A
    packet between cells, or in motion, is wider and its peak lower.
    """
    return _settled_peak(config, np.dtype(jax.dtypes.canonicalize_dtype(float)))


@lru_cache(maxsize=32)
def _settled_peak(config: NetworkConfig, dtype: np.dtype) -> float:
    levels = window_levels(config, dtype)
    zero = np.zeros((), dtype)
    still, nowhere = Odometry(zero, zero, zero, zero), np.zeros(3, dtype)

    def settle(_: object, cells: pose_cells.PoseCells) -> pose_cells.PoseCells:
        return pose_cells.step(config, levels, cells, still, nowhere, zero)[0]

    cells = jax.jit(lambda: lax.fori_loop(0, SETTLING, settle, pose_cells.start(config, dtype, levels)))()
    return float(np.asarray(to_full_torus(levels, cells.activity)).max())
