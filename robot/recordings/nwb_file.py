"""Sessions of animals from Neurodata Without Borders files (Rübel et al. 2022, eLife 11: e78362): positions,
head direction and spikes. pynwb of the extra [nwb] reads them, whoever wrote them."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import PositiveFloat

from robot.recordings.csv_config import PER_UNIT, per_unit, split_unit
from robot.recordings.input_judge import (
    GAP,
    MotionTrack,
    UnitLimits,
    heading_errors,
    tracker_faults,
    unit_errors,
)
from robot.recordings.sanity_checks import clock_errors, count_others, nonfinite_errors
from robot.sources.input_files import missing_error, raise_errors, require_file
from robot.sources.source import Warn
from tactile.base.bounded import check_size, reason
from tactile.base.errors import InputError
from tactile.base.se2 import wrap
from tactile.base.settings import Settings

ANIMAL = UnitLimits(speed=5.0, turn_rate=30.0)
"""Limits of the unit check for animals: m/s and rad/s of half of the way and of the turning."""


class NwbConfig(Settings):
    """Which series of an NWB file are read, where there are several, and their unit."""

    position: str = ""
    """Name of the series of positions; empty: the only one, or the only one in `Position`."""
    heading: str = ""
    """Name of the series of head directions; empty: the only one, or the only one in `CompassDirection`."""
    leds: tuple[str, str] | None = None
    """Names of the series of positions of two marks on the head, front and back, instead of `position` and
    `heading`: the place is half-way, and the heading leads from the back to the front."""
    unit: PositiveFloat | None = None
    """Length of the unit of positions, m: 0.01 for cm; null: the one that the file states."""


class NwbSession(NamedTuple):
    """A session.

    Attributes:
        time: [N] s from the start of the session, increasing. position: [N, 2] m, NaN where unknown.
        heading: [N] rad in -pi to pi, NaN where unknown; None without a measured one.
        names: [C] of the units. spikes: of each unit the times [n], s, ascending. observed: [K, 2] s, the
            times in which all units were recorded; None: always.
        subject, start: id of the subject and ISO time of the start, '' if the file has none.
    """

    time: np.ndarray
    position: np.ndarray
    heading: np.ndarray | None
    names: tuple[str, ...]
    spikes: list[np.ndarray]
    observed: np.ndarray | None
    subject: str
    start: str


def read_nwb(path: Path, config: NwbConfig | None = None, warn: Warn = None) -> NwbSession:
    """A session from an NWB file, judged: samples of a tracker that jumped away and back have no position.

    Args:
        warn: called with one sentence for each fault of the tracker.

    Raises:
        InputError: pynwb is not installed, the file is damaged, of another kind or has no positions, a name
            is not unique, times do not increase, or the units are not those of an animal.
    """
    config = config or NwbConfig()
    with _opened(path) as file:
        found = _Series(path, file, config)
        names, spikes, observed = _units(path, file)
        subject = getattr(file.subject, "subject_id", None) or ""
        start = file.session_start_time.isoformat() if file.session_start_time else ""
        if config.leds is None:
            time, position = found.positions(config.position, "position")
            heading = found.headings(time)
        else:
            (time, front), (other, back) = (found.positions(name, "leds") for name in config.leds)
            if not np.array_equal(time, other):
                said = f"{config.leds[0]} and {config.leds[1]} have different times"
                raise InputError(str(path), said, "two marks of one tracker, at the same times")
            position = (front + back) / 2
            heading = np.arctan2(*(front - back).T[::-1])
    raise_errors(
        nonfinite_errors(time, "a time", lambda row: f"{path}, sample {row}")
        or clock_errors(time, "the time", lambda row: f"{path}, sample {row}")
    )
    position = _judge(path, time, position, warn)
    return NwbSession(time, position, heading, names, spikes, observed, subject, start)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The content of an NWB file; whatever pynwb raises is one error."""
    try:
        import pynwb
        from h5py import is_hdf5
    except ImportError:
        cure = "pip install 'ratslam[nwb]'"
        raise InputError(str(path), "pynwb is not installed", "the extra 'nwb'", cure) from None
    require_file(path)
    expected = "an NWB file of version 2"
    if not is_hdf5(path):
        raise InputError(str(path), "no HDF5 file", expected)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of other versions of its schema
            with pynwb.NWBHDF5IO(path, "r") as reader:
                yield reader.read()
    except InputError:
        raise
    except Exception as error:  # hdmf has errors of its own for every part of a file
        cure = "`pynwb-validate` says more; write positions as a SpatialSeries and spikes as units"
        raise InputError(str(path), f"cannot be read ({reason(error)})", expected, cure) from None


class _Series:
    """The series of positions and headings of a file, by name."""

    def __init__(self, path: Path, file: Any, config: NwbConfig) -> None:
        self.path, self.config = path, config
        self.places: dict[str, Any] = {}
        self.turns: dict[str, Any] = {}
        from pynwb.behavior import SpatialSeries

        for series in file.objects.values():
            if not isinstance(series, SpatialSeries):
                continue
            check_size(f"{path}: {series.name}", 8 * int(np.prod(series.data.shape)), path.stat().st_size)
            columns = 1 if len(series.data.shape) == 1 else series.data.shape[1]
            within = f"{series.parent.name}/{series.name}" if series.parent is not None else series.name
            (self.turns if columns == 1 else self.places)[within] = series

    def positions(self, name: str, key: str) -> tuple[np.ndarray, np.ndarray]:
        """Times [N] s and positions [N, 2] m of a series."""
        series = self._only(self.places, name, key, "Position")
        if series is None:
            cure = "write it as a SpatialSeries of two columns, in processing/behavior"
            raise InputError(str(self.path), "no series of positions", "the position of the animal", cure)
        time, place = self._values(series)
        return time, place[:, :2] * self._length(series)

    def headings(self, time: np.ndarray) -> np.ndarray | None:
        """[N] measured headings at these times, rad, NaN where a gap is; None without a series."""
        series = self._only(self.turns, self.config.heading, "heading", "CompassDirection")
        if series is None:
            return None
        clock, angle = self._values(series)
        angle = angle.reshape(-1)
        unit = split_unit(f"heading [{series.unit}]")[1]
        angle = angle / (per_unit(unit, "angle") or 1.0)
        where = f"{self.path}: {series.name}"
        raise_errors(heading_errors(angle, clock, "the heading", where, ANIMAL))
        if np.array_equal(clock, time):
            return wrap(angle)
        known = np.flatnonzero(np.isfinite(angle) & np.isfinite(clock))
        if len(known) < 2:
            raise InputError(where, f"{len(known)} head directions", "two at least")
        clock, angle = clock[known], angle[known]
        after = np.clip(np.searchsorted(clock, time), 1, len(clock) - 1)
        near = np.minimum(np.abs(time - clock[after - 1]), np.abs(clock[after] - time))
        found = wrap(np.interp(time, clock, np.unwrap(angle)))
        return np.where(near <= GAP * np.median(np.diff(clock)), found, np.nan)

    def _only(self, found: dict[str, Any], name: str, key: str, container: str) -> Any:
        """The series of a name, with or without its container; without a name the only one, or None."""
        named = [each for each in found if name in (each, each.rpartition("/")[2])]
        if name and len(named) != 1:
            there = [*found] if "/" in name else [each.rpartition("/")[2] for each in found]
            raise missing_error(str(self.path), "series", name, there, f"--set {key}=NAME")
        usual = [each for each in found if each.startswith(f"{container}/")]
        chosen = named if name else list(found) if len(found) == 1 else usual
        if not chosen and len(found) < 2:
            return None
        if len(chosen) != 1:
            known = f"{len(found)} series: {', '.join(found)}"
            raise InputError(
                str(self.path), known, "one", f"name one with --set {key}=NAME, or --set leds=[A, B]"
            )
        return found[chosen[0]]

    def _values(self, series: Any) -> tuple[np.ndarray, np.ndarray]:
        """Times [N] s and data [N, ...] in its unit."""
        time = np.asarray(series.get_timestamps(), np.float64)
        data = np.asarray(series.get_data_in_units(), np.float64)
        if len(time) != len(data) or len(time) < 2:
            found = f"{len(data)} samples at {len(time)} times"
            raise InputError(f"{self.path}: {series.name}", found, "two or more samples, each with a time")
        return time, data

    def _length(self, series: Any) -> float:
        """m of the unit of a series."""
        if self.config.unit is not None:
            return self.config.unit
        factor = per_unit(split_unit(f"x [{series.unit}]")[1], "length")
        if factor is None:
            where, units = f"{self.path}: {series.name}", ", ".join(PER_UNIT["length"])
            cure = "--set unit=0.01 if it is 1 cm"
            raise InputError(where, f"positions in {series.unit!r}", f"a unit of length ({units})", cure)
        return 1 / factor


def _units(path: Path, file: Any) -> tuple[tuple[str, ...], list[np.ndarray], np.ndarray | None]:
    """Names, spike times and common intervals of the units of a file, which may have none."""
    units = file.units
    if units is None or "spike_times" not in units.colnames:
        return (), [], None
    spikes = []
    for number in range(len(units)):
        times = np.asarray(units.get_unit_spike_times(number), np.float64)
        if not np.isfinite(times).all():
            raise InputError(f"{path}: unit {number}", "a spike time that is not finite", "times in s")
        spikes.append(np.sort(times))
    names = tuple(map(str, units.id[:]))
    if "obs_intervals" not in units.colnames:
        return names, spikes, None
    common: np.ndarray | None = None
    for number in range(len(units)):
        own = np.asarray(units.get_unit_obs_intervals(number), np.float64).reshape(-1, 2)
        if not len(own):
            continue
        if common is not None:  # the times in both lists
            first = np.maximum.outer(common[:, 0], own[:, 0]).ravel()
            last = np.minimum.outer(common[:, 1], own[:, 1]).ravel()
            own = np.column_stack([first, last])[first < last]
        common = own
    return names, spikes, common


def _judge(path: Path, time: np.ndarray, position: np.ndarray, warn: Warn) -> np.ndarray:
    """The positions [N, 2] m, NaN where the tracker had jumped away.

    Raises:
        InputError: none is known, or the units are not those of an animal.
    """
    known = np.flatnonzero(np.isfinite(position).all(axis=1))
    if len(known) < 2:
        raise InputError(str(path), f"{len(known)} of {len(time)} positions are known", "two at least")
    clock, place = time[known], position[known]
    steps = np.diff(place, axis=0, prepend=place[:1])
    motion = np.column_stack([steps, np.zeros(len(known)), np.diff(clock, prepend=clock[:1])])
    track = MotionTrack(clock, np.ones(len(known), bool), motion)

    def cure(quantity: str, unit: str) -> str:
        per = PER_UNIT[quantity][unit]
        return f"--set unit={1 / per:g}" if quantity == "length" else f"divide its times by {per:g}"

    raise_errors(unit_errors(track, str(path), ANIMAL, cure))
    wild, moved = tracker_faults(track)
    for rows, what in (
        (wild, "the tracker jumps away and comes back; positions in between are left out"),
        (moved, "the tracker jumps and stays: a box or an animal that was moved; all positions are kept"),
    ):
        if warn is not None and rows.any():
            warn(f"{path}: {what}, at t = {clock[rows][0]:.3f} s{count_others(rows)}")
    lost = float(np.diff(clock)[np.diff(clock) > GAP * np.median(np.diff(time))].sum())
    if warn is not None and lost:
        share = 100 * lost / (time[-1] - time[0])
        warn(f"{path}: no position for {lost:.1f} s in gaps, {share:.1f} % of the session; it does not count")
    judged = position.copy()
    judged[known[wild]] = np.nan
    return judged
