"""Reads complete and truncated MCAP recordings, copies sources to recordings and recovers truncated ones."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from robot.recordings.bags.bag import container_fault
from robot.recordings.cdr import TRUTH, Event
from robot.recordings.input_judge import DEFAULT_JUDGE, InputJudge, MotionTrack
from robot.recordings.mcap_scanner import UNCLOSED, McapScanner, is_foreign
from robot.recordings.mcap_writer import Recorder
from robot.recordings.sanity_checks import clock_errors, first_error, nonfinite_errors, view_errors
from robot.sources.input_files import digest_of_files, raise_errors, require_file
from robot.sources.source import ClosedSource, Sample, Source, rate_of
from tactile.base.errors import InputError
from tactile.base.files import flush_to_disk, make_new_file, require_new_file
from tactile.base.types import Cycle, Observation, Odometry, Report, Whisk


class Recording(ClosedSource):
    """An MCAP recording as a `Source`. All samples are checked first; iteration then reads them one by one,
    so that raw recordings larger than the memory can be replayed.

    Args:
        path: an `.mcap` file written by `Recorder`, complete or not.
        judge: is told if the file is truncated or damaged.

    Attributes:
        truncated: whether the file ends early; its first `length` samples are readable.
        warning: that sentence, or ''.
        events: events of a live session: faults, discontinuities, dropped images.
        info: devices, world and origin, as stored; `raw_whiskers` is set from the readings.

    Raises:
        InputError: the file is missing, has no readable sample, or has impossible values.
    """

    whiskers: int
    view_shape: tuple[int, int, int]

    def __init__(self, path: Path, judge: InputJudge = DEFAULT_JUDGE) -> None:
        require_file(path)
        self.path = path
        self.name = path.stem
        self.digest = digest_of_files([path])
        scanner = McapScanner(path)
        columns = array("d")
        events: list[Event] = []
        raw_whiskers = False
        for entry in scanner.entries():
            if isinstance(entry.content, Sample):
                columns.extend(_checked_values(entry.content))
                raw_whiskers |= not isinstance(entry.content.reading, Observation)
            elif isinstance(entry.content, Event):
                events.append(entry.content)
        description = scanner.description
        if description is None or not scanner.count:
            raise _unreadable_recording_error(scanner)
        self.events = tuple(events)
        self.view_shape, self.whiskers = description.view_shape, description.whiskers
        self.info = description.info.model_copy(update={"raw_whiskers": raw_whiskers})
        self.length = scanner.count
        self.truncated = bool(scanner.broken)
        self.warning = ""
        if self.truncated:
            self.warning = f"{path}: {self.length} samples are readable, the rest is lost: {scanner.broken}"
        if scanner.broken == UNCLOSED:
            self.warning = f"{path}: {UNCLOSED}; all {self.length} samples are there that were written"
        rows = np.frombuffer(columns).reshape(scanner.count, -1)
        inside = judge.stretch.rows(rows[:, 0], str(path))
        self._first, self._last = int(inside.argmax()), len(inside) - int(inside[::-1].argmax())
        self.length, self.digest = self._last - self._first, judge.stretch.digest(self.digest)
        time = self._check_columns(rows[self._first : self._last], judge)
        self.rate_hz = rate_of(time) or description.rate_hz
        if self.truncated:
            judge.say(self.warning)

    def _check_columns(self, columns: np.ndarray, judge: InputJudge) -> np.ndarray:
        """Times [N] s of the samples with odometry; raises the errors of all columns."""
        time, motion, truth = columns[:, 0], columns[:, 1:5], columns[:, 5:8]
        low, high, odd, has_truth = columns[:, 8:].T
        moved = (motion != 0).any(axis=1)
        moved[0] = True  # the first row sets the clock

        def place(row: int) -> str:
            return f"{self.path}, row {row + self._first}"

        errors = nonfinite_errors(time, "time", place) + clock_errors(time, "time", place, moved)
        errors += nonfinite_errors(motion, "odometry", place, most=1e6) + view_errors(
            low, high, "view", place
        )
        errors += nonfinite_errors(odd, "a number in the reading", place)
        errors += nonfinite_errors(truth, "truth", place, has_truth > 0)
        dt = motion[:, 3]
        errors += first_error(dt < 0, place, lambda row: f"odometry has dt {dt[row]} s", "at least 0 s")
        track = MotionTrack(time, moved, motion, truth if has_truth.any() else None)
        raise_errors(errors + judge.errors(track, place, str(self.path), in_order=not errors))
        return time[moved]

    def __iter__(self) -> Iterator[Sample]:
        scanner = McapScanner(self.path)
        for sample in scanner:
            if scanner.count > self._first + 1 or (self._first == 0 and scanner.count == 1):
                yield sample
            elif scanner.count == self._first + 1:  # it begins here
                still = Odometry(0.0, 0.0, 0.0, 0.0)
                yield sample._replace(reading=sample.reading._replace(odometry=still))
            if scanner.count == self._last:
                return
        found = f"had {self._last} samples and now has {scanner.count}"
        raise InputError(str(self.path), found, "a file that does not change while it is read")


def record_source(source: Source, path: Path) -> int:
    """Write all samples of a source to a new recording; returns their number."""
    with _recorder_like(source, path) as recorder:
        for sample in source:
            recorder.write(sample)
        return recorder.count


def _recorder_like(source: Source, path: Path) -> Recorder:
    shape, whiskers, rate, info = source.view_shape, source.whiskers, source.rate_hz, source.info
    return Recorder(path, view_shape=shape, whiskers=whiskers, rate_hz=rate, info=info)


def recover(path: Path, out: Path) -> tuple[int, str]:
    """Copy every readable message of a truncated or damaged recording, unchanged, to a new, complete one.

    The new file appears under its name only when it is complete. Values are not checked.

    Returns:
        the number of samples, and the fault of the old file, '' if it was complete.

    Raises:
        InputError: `path` has no readable sample, or `out` exists.
    """
    require_file(path)
    require_new_file(out)
    scanner = McapScanner(path)
    entries = scanner.entries()
    first = next(entries, None)
    if first is None or scanner.description is None:
        raise _unreadable_recording_error(scanner)
    described = scanner.description

    def write(path: Path) -> None:
        with _recorder_like(described, path) as recorder:
            for entry in chain([first], entries):
                if entry.truth is not None:
                    recorder.append(TRUTH, entry.time, entry.truth)
                recorder.append(entry.name, entry.time, entry.message)
        if not scanner.count:
            raise _unreadable_recording_error(scanner)
        flush_to_disk(path)

    make_new_file(out, write)
    return scanner.count, scanner.broken


def _unreadable_recording_error(scanner: McapScanner) -> InputError:
    """The error for a file without a description or without samples."""
    foreign = is_foreign(scanner.path)
    if foreign and (fault := container_fault(scanner.path)):
        return InputError(str(scanner.path), fault[0], "a recording of ratslam", fault[1])
    if scanner.description is None:
        found = f"cannot be read as a recording: {scanner.broken or 'it has no ratslam metadata'}"
        cure = "`python -m ratslam doctor` says what it is" if foreign else "record it again"
        return InputError(str(scanner.path), found, "an MCAP file written by this version of ratslam", cure)
    found, cure = f"holds no samples{': ' + scanner.broken if scanner.broken else ''}", "record it again"
    return InputError(str(scanner.path), found, "at least one sample", f"{cure}: nothing can be recovered")


def _checked_values(sample: Sample) -> tuple[float, ...]:
    """The checked columns of a sample: time, odometry, truth, smallest and largest view value, one non-finite
    number or 0, and whether there is a truth."""
    reading = sample.reading
    truth = (np.nan,) * 3 if sample.truth is None else sample.truth
    low = high = np.nan
    if isinstance(reading, Cycle):
        parts = [reading.time, reading.angle, reading.deflection]
    elif isinstance(reading, Report):
        parts = [reading.time, reading.strain]
    elif isinstance(reading, Whisk):
        parts = [reading.touched, reading.highest, reading.reach]
    else:
        parts = [reading.view, reading.point, reading.wall_point, reading.wall_sd]
        if reading.view_seen:
            low, high = reading.view.min(), reading.view.max()
    odd = next((float(part[~good].flat[0]) for part in parts if not (good := np.isfinite(part)).all()), 0.0)
    return (sample.time, *reading.odometry, *truth, low, high, odd, sample.truth is not None)
