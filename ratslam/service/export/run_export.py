"""Reads from a run directory what a file for ROS tools holds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.artifacts.closure_table import read_closure_table
from evaluation.artifacts.manifest import read_manifest
from evaluation.artifacts.nav2 import Nav2Map, read_nav2
from evaluation.artifacts.run_reader import read_column, read_run
from evaluation.artifacts.whisker_views import read_whisker_views
from evaluation.metrics.map_pieces import arrange_pieces
from evaluation.metrics.run_arrays import RunArrays
from evaluation.metrics.trajectory import align
from ratslam.runs.open_source import open_observations, read_observations
from ratslam.runs.settings.run_config import load_config
from tactile.base.errors import InputError
from tactile.base.se2 import compose, inverse

LAST_SECOND = 2**31 - 1
"""Largest number of seconds in a ROS 2 stamp."""


class ExportedRun(NamedTuple):
    """A run of N steps; poses are in the frame of the map unless stated otherwise.

    Attributes:
        stamps: [N] int64, ns, the times of the recording. run: its arrays, pieces of the map where
            plots show them.
        spread: [N, 3] standard deviations of the online pose, m, m, rad.
        truth: [N, 3] true poses brought nearest to the final trajectory by one rigid motion, NaN in rows
            without one; or None.
        candidates: [n, 2] earlier and later step of each candidate for a loop closure. verdicts: of each.
        grid: the occupancy map, or None. images: yields (step, [R, C, K] uint8) of each view that was seen.
    """

    stamps: np.ndarray
    run: RunArrays
    spread: np.ndarray
    truth: np.ndarray | None
    candidates: np.ndarray
    verdicts: list[str]
    grid: Nav2Map | None
    images: Callable[[], Iterator[tuple[int, np.ndarray]]]


def read_exported_run(directory: Path, warn: Callable[[str], None]) -> ExportedRun:
    """Reads a run directory, also the incomplete one of an interrupted run.

    Args:
        warn: called with a sentence if the views cannot be read.

    Raises:
        InputError: a file is missing or malformed, or a time does not fit into a ROS 2 stamp.
    """
    run = arrange_pieces(read_run(directory))
    steps = len(run.time)
    columns = [read_column(directory / "steps.csv", name)[:steps] for name in ("sd_x", "sd_y", "sd_heading")]
    closures = read_closure_table(directory)
    known = np.flatnonzero(((closures.steps >= 0) & (closures.steps < steps)).all(axis=1))
    return ExportedRun(
        stamps=ros_stamps(directory, run.time),
        run=run,
        spread=np.stack(columns, axis=1),
        truth=truth_in_map(run),
        candidates=closures.steps[known],
        verdicts=[closures.verdicts[k] for k in known],
        grid=read_nav2(directory / "map.yaml") if (directory / "map.yaml").exists() else None,
        images=lambda: _images(directory, run.time, warn),
    )


def ros_stamps(directory: Path, time: np.ndarray) -> np.ndarray:
    """Times [N] (s) in ns.

    Raises:
        InputError: a time does not fit into a ROS 2 stamp.
    """
    bad = ~((time >= 0) & (time <= LAST_SECOND))
    if bad.any():
        expected = f"0 to {LAST_SECOND} s, the range of ROS 2 stamps"
        raise InputError(str(directory / "online.tum"), f"a time of {time[bad][0]:g} s", expected)
    return np.rint(time * 1e9).astype(np.int64)


def truth_in_map(run: RunArrays) -> np.ndarray | None:
    """The true poses [N, 3], moved as near as possible to the final trajectory; None without truth."""
    if run.truth is None:
        return None
    known = np.isfinite(run.truth).all(axis=1)
    moved = np.full_like(run.truth, np.nan)
    moved[known] = compose(inverse(align(run.final[known], run.truth[known])), run.truth[known])
    return moved


def _images(
    directory: Path, time: np.ndarray, warn: Callable[[str], None]
) -> Iterator[tuple[int, np.ndarray]]:
    """Whisker images of the run directory, or the views of its recording if that is still there."""
    if (directory / "views.npz").exists():
        views = read_whisker_views(directory / "views.npz").view
        yield from enumerate(_pixels(view[..., None]) for view in views[: len(time)])
        return
    try:
        yield from _recorded_views(directory, time)
    except InputError as error:
        warn(f"the file has no views: {error}")


def _recorded_views(directory: Path, time: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """The views of the recording of a run; none for a simulation, which would have to be repeated."""
    config = load_config(directory / "config.yaml")
    if config.recording is None:
        return
    digest = read_manifest(directory).digest
    with open_observations(config) as (_, source):
        if source.digest != digest:
            cure = "the views are those of another recording"
            raise InputError(source.name, "changed since the run", "the recording of the run", cure)
        step = 0
        for sample, observation in read_observations(source):
            if step == len(time):
                return
            if sample.time != time[step]:  # a continued run starts later in its recording
                continue
            if observation.view_seen and observation.view.size:
                yield step, _pixels(observation.view)
            step += 1


def _pixels(view: np.ndarray) -> np.ndarray:
    """A view in 0..1 as 8-bit pixels."""
    return np.rint(255 * np.clip(view, 0.0, 1.0)).astype(np.uint8)
