"""Conformance checks of a source: its attributes, its samples, and that they can be read again.

`require_shapes` and `require_masked` serve the checks of front ends too.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from ratslam.service.check_results import (
    Result,
    Trial,
    Violation,
    check,
    find_parts,
    leaves,
    require,
    require_equal,
)
from robot.sources.source import SOURCES, ClosedSource, Sample, Source, SourceEntry, SourceInfo, rate_of
from robot.touch_source import TOUCH, head_config_of, open_touch_source, report_config_of
from tactile.base.errors import InputError
from tactile.base.plugins import PluginConfig
from tactile.base.types import Observation
from tactile.frontend import TouchConfig

SAMPLES = 4096
"""Samples of a source that are examined unless said otherwise."""
OPENED, READ, OBSERVED = range(3)
"""Groups of checks, in their order."""


class Reading(NamedTuple):
    """What was read of an opened source.

    Attributes:
        samples: the first ones. copies: of each, made before the next one was read.
        again: those of a second pass; none for a live source.
        complete: whether there are no further samples. suppresses: what `__exit__` returned.
    """

    samples: list[Sample]
    copies: list[Sample]
    again: list[Sample]
    complete: bool
    suppresses: bool

    @classmethod
    def of(cls, source: Source, most: int) -> Reading:
        """Reads the first samples of a source, of a recording twice, and closes it."""
        source.__enter__()
        try:
            samples: list[Sample] = []
            copies: list[Sample] = []
            iterator = iter(source)
            for sample in islice(iterator, most):
                samples.append(sample)
                copies.append(copy.deepcopy(sample))
            complete = len(samples) < most or next(iterator, None) is None
            again = list(islice(source, most)) if source.digest else []  # a live robot has none
        finally:
            suppresses = bool(source.__exit__(None, None, None))  # type: ignore[func-returns-value]
        return cls(samples, copies, again, complete, suppresses)


class SourceTrial(Trial[SourceEntry]):
    """A source with settings: what its checks share, and the checks.

    Args:
        frontend: for readings that are not observations. most: samples to examine.
    """

    def __init__(
        self, entry: SourceEntry, settings: Any, frontend: PluginConfig | None = None, most: int = SAMPLES
    ) -> None:
        super().__init__(entry, settings)
        self.frontend, self.most = frontend, most

    @cached_property
    def source(self) -> Source:
        return self.entry.open(self.settings, None)

    @cached_property
    def reading(self) -> Reading:
        """What was read of the source."""
        return Reading.of(self.source, self.most)

    @cached_property
    def observing(self) -> Source:
        """The samples of the first pass, through the front end that they need."""
        stored = _StoredSource(self.source, self.reading.samples)
        config = TouchConfig(frontend=self.frontend)
        heads = {
            "head": head_config_of(stored.info, config.head),
            "reports": report_config_of(stored.info, config.reports),
        }
        return open_touch_source(stored, config.model_copy(update=heads))

    @cached_property
    def observations(self) -> list[Observation]:
        """Its observations.

        Raises:
            Violation: a reading is no observation, and no front end takes it.
        """
        found = [sample.reading for sample in self.observing]
        for k, reading in enumerate(found):
            if not isinstance(reading, Observation):
                what = f"reading {k} is of type {type(reading).__name__}"
                raise Violation(what, "Observation, or a front end (--touch NAME) that takes such readings")
        return found

    @check(OPENED, "the entry is complete", "a configuration names it with its settings")
    def entry_is_complete(self) -> str:
        entry = self.entry
        super().entry_is_complete.run(self)
        for suffix in entry.suffixes:
            sound = suffix.startswith(".") and suffix == suffix.lower()
            require(sound, f"suffix {suffix!r}", "a lower-case suffix such as '.bag'")
        reads = not entry.suffixes or "file" in entry.config_class.model_fields
        require(reads, f"suffixes {entry.suffixes} without a setting `file`", "a setting `file` of type Path")
        return ", ".join(entry.suffixes)

    @check(OPENED, "it has all attributes of a source", "the backend is built from them")
    def has_attributes(self) -> str:
        source = self.source
        missing = [name for name in (*ATTRIBUTES, *METHODS) if not hasattr(source, name)]
        require(not missing, f"{type(source).__name__} without {', '.join(missing)}", "all of a Source")
        rate, shape, length = source.rate_hz, source.view_shape, source.length
        require(isinstance(source.name, str) and source.name != "", f"name {source.name!r}", "a short name")
        sound = isinstance(rate, float | int) and np.isfinite(rate) and rate >= 0
        require(bool(sound), f"rate_hz {rate!r}", "samples per second, 0 if unknown")
        sound = isinstance(shape, tuple) and len(shape) == 3 and all(_is_count(n, 1) for n in shape)
        require(sound, f"view_shape {shape!r}", "a tuple of three sizes (R, C, K)")
        require(_is_count(source.whiskers), f"whiskers {source.whiskers!r}", "a number from 0")
        require(length is None or _is_count(length), f"length {length!r}", "a number of samples, or None")
        require(
            isinstance(source.digest, str), f"digest {source.digest!r}", "sha256 (hex), '' for a live robot"
        )
        require(isinstance(source.info, SourceInfo), f"info {type(source.info).__name__}", "SourceInfo")
        source.info.to_json()
        return f"view_shape {shape}, {source.whiskers} whiskers"

    @check(READ, "it yields samples", "a run needs a time and a reading at each step")
    def yields_samples(self) -> str:
        samples = self.reading.samples
        for k, sample in enumerate(samples):
            found = f"sample {k} is of type {type(sample).__name__}"
            require(isinstance(sample, Sample), found, "robot.sources.source.Sample")
        require(len(samples) > 0, "no samples", "at least one")
        return f"{len(samples)} read"

    @check(OBSERVED, "it closes without hiding errors", "a run that fails would look complete")
    def closes(self) -> None:
        require(
            not self.reading.suppresses, "__exit__ returned a true value", "None: errors must get through"
        )

    @check(OBSERVED, "times never decrease", "trajectories are matched with truth by time")
    def times_increase(self) -> None:
        times = [sample.time for sample in self.reading.samples]
        for k, time in enumerate(times):
            sound = isinstance(time, float | int | np.floating | np.integer) and bool(np.isfinite(time))
            require(sound, f"time {time!r} of sample {k}", "a finite number of seconds")
        back = np.flatnonzero(np.diff(np.array(times, float)) < 0)
        if len(back):
            k = int(back[0])
            raise Violation(
                f"time {times[k + 1]} of sample {k + 1} after {times[k]}", "times that never decrease"
            )

    @check(OBSERVED, "observations have the declared shapes", "the kernel is compiled for them")
    def views_have_shapes(self) -> None:
        source = self.observing
        for k, observation in enumerate(self.observations):
            require_shapes(observation, source.view_shape, source.whiskers, f"observation {k}")

    @check(OBSERVED, "absent values are masked, not NaN", "one NaN spoils a step")
    def masks_values(self) -> None:
        for k, observation in enumerate(self.observations):
            require_masked(observation, f"observation {k}", self.observing.info.signed_views)

    @check(OBSERVED, "truth is [3] or None", "scores are computed from it")
    def truth_is_pose(self) -> str:
        known = 0
        for k, sample in enumerate(self.reading.samples):
            if sample.truth is not None:
                truth, known = sample.truth, known + 1
                sound = (
                    isinstance(truth, np.ndarray) and truth.shape == (3,) and bool(np.isfinite(truth).all())
                )
                require(sound, f"truth {truth!r} of sample {k}", "an array [3] of finite numbers, or None")
        return f"known in {known} of {len(self.reading.samples)} samples"

    @check(OBSERVED, "the length is right", "memory is reserved for it")
    def length_is_right(self) -> str:
        length, count = self.source.length, len(self.reading.samples)
        if length is None:
            return "not known in advance"
        if self.reading.complete:
            require(length == count, f"length {length}, but {count} samples", "the number of samples")
            return ""
        require(length > count, f"length {length}, but more than {count} samples", "the number of samples")
        return f"first {count} of {length} samples examined"

    @check(OBSERVED, "the rate fits the times", "recordings are written in chunks of a second by it")
    def rate_fits(self) -> str:
        rate = self.source.rate_hz
        found = rate_of(np.array([sample.time for sample in self.reading.samples], float))
        if rate == 0 or found == 0:
            return "not known"
        require(
            found / 2 <= rate <= 2 * found, f"rate_hz {rate:g}, but {found:.3g} Hz by the times", "the same"
        )
        return f"{found:.3g} Hz"

    @check(OBSERVED, "a sample keeps its values", "a run processes samples in chunks")
    def keeps_samples(self) -> None:
        what = "a sample and the same sample after the next ones were read"
        require_equal(self.reading.copies, self.reading.samples, what)

    @check(OBSERVED, "the digest identifies the input", "`run --continue` compares it")
    def digest_identifies(self) -> str:
        source = self.source
        if not source.digest:
            found = f"no digest, but the length {source.length}"
            require(source.length is None, found, "sha256 (hex) of all input of a recording")
            return "a live source"
        again = self.entry.open(self.settings, None).digest
        require(
            source.digest == again, f"digest {source.digest} and then {again}", "the same for the same input"
        )
        return ""

    @check(OBSERVED, "it can be read again", "a result could not be reproduced")
    def repeats(self) -> str:
        if not self.source.digest:
            return "a live source, read once"
        first = self.reading.copies
        require_equal(first, self.reading.again, "the samples of two passes")
        other = Reading.of(self.entry.open(self.settings, None), self.most)
        require_equal(first, other.samples, "the samples of two openings")
        return ""


class _StoredSource(ClosedSource):
    """Samples that were read from a source, with its attributes."""

    def __init__(self, source: Source, samples: Sequence[Sample]) -> None:
        self.name, self.rate_hz, self.digest = source.name, source.rate_hz, source.digest
        self.view_shape, self.whiskers, self.info = source.view_shape, source.whiskers, source.info
        self.length: int | None = len(samples)
        self._samples = samples

    def __iter__(self) -> Iterator[Sample]:
        return iter(self._samples)


def require_shapes(found: Any, view_shape: tuple[int, ...], whiskers: int, what: str) -> None:
    """Raises `Violation` unless this is an observation of these shapes, with the dtypes of each field.

    Args:
        what: the observation, for the message.
    """
    require(isinstance(found, Observation), f"{what} is of type {type(found).__name__}", "Observation")
    shapes: dict[str, tuple[int, ...]] = {
        "view": tuple(view_shape),
        **dict.fromkeys(("contact", "alive"), (whiskers,)),
        "point": (whiskers, 2),
        "wall_point": (2,),
    }
    kinds = dict.fromkeys(("view_seen", "contact", "alive", "wall"), "b")
    kinds |= dict.fromkeys(("motion", "label"), "i")
    names = {"b": "bool", "i": "int", "f": "float"}
    for path, leaf in leaves(found):
        shape, kind = shapes.get(path, ()), kinds.get(path, "f")
        is_array = isinstance(leaf, np.ndarray | np.generic)
        text = f"{leaf.dtype} {leaf.shape}" if is_array else f"a Python {type(leaf).__name__}"
        fits = is_array and leaf.shape == shape and leaf.dtype.kind == kind
        require(fits, f"{path} of {what} is {text}", f"NumPy {names[kind]} {shape}")


def require_masked(found: Observation, what: str, signed: bool = False) -> None:
    """Raises `Violation` if an observation has NaN or infinite values, or a view outside 0..1.

    Args:
        what: the observation, for the message. signed: whether views are signed departures, of any size.
    """
    for path, leaf in leaves(found):
        finite, cure = bool(np.isfinite(leaf).all()), "absent values masked, for example view_seen"
        require(finite, f"{path} of {what} has NaN or infinity", cure)
    if not signed:
        low, high = float(np.min(found.view, initial=0.0)), float(np.max(found.view, initial=0.0))
        require(low >= 0 and high <= 1, f"view of {what} has values {low:g} to {high:g}", "values in 0..1")


ATTRIBUTES = ("name", "rate_hz", "view_shape", "whiskers", "length", "digest", "info")
METHODS = ("__iter__", "__enter__", "__exit__")


def check_source(
    name: str, assignments: Sequence[str] = (), touch: str | None = None, most: int = SAMPLES
) -> Iterator[Result]:
    """Checks the source registered under a name.

    Args:
        assignments: of its settings, each `settings.key=value`; of those of the front end `touch.key=value`.
        touch: name of the registered front end that turns its readings into observations.
        most: samples to examine.

    Raises:
        InputError: there is no such source or front end, its package is broken, the settings do not fit, or
            the source refuses them, for example because a file is missing.
    """
    parts = find_parts(
        {"settings": (SOURCES, name, "check source"), "touch": (TOUCH, touch, "--touch")}, assignments
    )
    frontend = None
    if touch is not None:
        given = parts["touch"][1]
        plain = {} if given is None else json.loads(given.model_dump_json(exclude_unset=True))
        frontend = PluginConfig(plugin=touch, settings=plain)
    trial = SourceTrial(*parts["settings"], frontend, most)
    try:
        _ = trial.source
    except InputError:
        raise
    except Exception:  # reported by a check
        pass
    return trial.run_checks()


def _is_count(value: Any, least: int = 0) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and int(value) >= least
