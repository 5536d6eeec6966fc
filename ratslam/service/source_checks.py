"""Conformance checks of a source and of a touch front end.

Of a source: its attributes, its samples, and that they can be read again. Of a front end, on the readings
of a source: shapes, masks, motion, no memory.
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
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources.source import SOURCES, ClosedSource, Sample, Source, SourceEntry, SourceInfo, rate_of
from robot.touch_source import TOUCH, ReadingProcessor, TouchEntry, open_touch_source, touch_config_of
from tactile.base.errors import InputError
from tactile.base.plugins import NoSettings, PluginConfig
from tactile.base.se2 import compose
from tactile.base.types import Observation
from tactile.frontend import TouchConfig
from tactile.whisker_geometry import HeadConfig

SAMPLES = 4096
"""Samples of a source that are examined unless said otherwise."""
READINGS = 256
"""Readings that are examined."""
MOTION_TOLERANCE = 1e-6
"""Difference allowed between motions, m, rad and s: front ends may round."""
ATTRIBUTES = ("name", "rate_hz", "view_shape", "whiskers", "length", "digest", "info")
METHODS = ("__iter__", "__enter__", "__exit__")
OPENED, READ, OBSERVED = range(3)
"""Groups of checks, in their order: of what is opened or built, of what is read, of what is made of it."""


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
        return open_touch_source(stored, touch_config_of(stored.info, TouchConfig(frontend=self.frontend)))

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
        sound = isinstance(source.digest, str)
        require(sound, f"digest {source.digest!r}", "sha256 (hex), '' for a live robot")
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
        found = "__exit__ returned a true value"
        require(not self.reading.suppresses, found, "None: errors must get through")

    @check(OBSERVED, "times never decrease", "trajectories are matched with truth by time")
    def times_increase(self) -> None:
        times = [sample.time for sample in self.reading.samples]
        for k, time in enumerate(times):
            sound = isinstance(time, float | int | np.floating | np.integer) and bool(np.isfinite(time))
            require(sound, f"time {time!r} of sample {k}", "a finite number of seconds")
        back = np.flatnonzero(np.diff(np.array(times, float)) < 0)
        if len(back):
            k = int(back[0])
            found = f"time {times[k + 1]} of sample {k + 1} after {times[k]}"
            raise Violation(found, "times that never decrease")

    @check(OBSERVED, "observations have the declared shapes", "the kernel is compiled for them")
    def views_have_shapes(self) -> None:
        source = self.observing
        for k, observation in enumerate(self.observations):
            _require_shapes(observation, source.view_shape, source.whiskers, f"observation {k}")

    @check(OBSERVED, "absent values are masked, not NaN", "one NaN spoils a step")
    def masks_values(self) -> None:
        for k, observation in enumerate(self.observations):
            _require_masked(observation, f"observation {k}", self.observing.info.signed_views)

    @check(OBSERVED, "truth is [3] or None", "scores are computed from it")
    def truth_is_pose(self) -> str:
        known = 0
        for k, sample in enumerate(self.reading.samples):
            if sample.truth is not None:
                truth, known = sample.truth, known + 1
                sound = isinstance(truth, np.ndarray) and truth.shape == (3,)
                sound = sound and bool(np.isfinite(truth).all())
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
        what = f"rate_hz {rate:g}, but {found:.3g} Hz by the times"
        require(found / 2 <= rate <= 2 * found, what, "the same")
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
        found = f"digest {source.digest} and then {again}"
        require(source.digest == again, found, "the same for the same input")
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


def _require_shapes(found: Any, view_shape: tuple[int, ...], whiskers: int, what: str) -> None:
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


def _require_masked(found: Observation, what: str, signed: bool = False) -> None:
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


def check_source(
    name: str, assignments: Sequence[str] = (), touch: str | None = None, most: int = SAMPLES
) -> Iterator[Result]:
    """Checks the source registered under a name.

    Args:
        assignments: of its settings, each `settings.key=value`; of those of the front end `touch.key=value`.
        touch: name of the registered front end that turns its readings into observations.
        most: samples to examine.

    Raises:
        InputError: as `find_parts`, or the source refuses its settings, as a file that is missing.
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


class TouchTrial(Trial[TouchEntry]):
    """A touch front end with settings: what its checks share, and the checks.

    Args:
        source: of its readings; None: a simulated session of the whisker head, whose readings are `Whisk`s.
    """

    def __init__(self, entry: TouchEntry, settings: Any, source: Source | None = None) -> None:
        super().__init__(entry, settings)
        self.source = source or HeadSimulation(SimulationConfig(), HeadConfig())

    def build(self) -> ReadingProcessor:
        """A new front end, as for a pass through the source."""
        return self.entry.build(self.settings, self.source.info)

    @cached_property
    def first(self) -> ReadingProcessor:
        return self.build()

    @cached_property
    def reading(self) -> Reading:
        return Reading.of(self.source, READINGS)

    @property
    def readings(self) -> list[Any]:
        """The readings of the first samples."""
        return [sample.reading for sample in self.reading.samples]

    @cached_property
    def results(self) -> list[Observation | None]:
        """What the first front end makes of each reading."""
        return [self.first.observe(reading) for reading in self.readings]

    def observations(self) -> list[tuple[str, Observation]]:
        """The observations among the results, each with its name."""
        return [(f"the observation of reading {k}", o) for k, o in enumerate(self.results) if o is not None]

    @check(OPENED, "it builds for the source", "the backend is built from its attributes")
    def builds(self) -> str:
        front, source = self.first, self.source
        missing = [name for name in ("view_shape", "whiskers", "observe") if not hasattr(front, name)]
        found = f"{type(front).__name__} without {', '.join(missing)}"
        require(not missing, found, "all of a ReadingProcessor")
        shape, whiskers = front.view_shape, front.whiskers
        counts = isinstance(shape, tuple) and len(shape) == 3
        counts = counts and all(isinstance(n, int) and n > 0 for n in shape)
        require(counts, f"view_shape {shape!r}", "a tuple of three sizes (R, C, K)")
        found = f"{whiskers} whiskers for those of {source.name}"
        require(whiskers == source.whiskers, found, f"{source.whiskers}, as the source says")
        return f"view_shape {shape}, {whiskers} whiskers"

    @check(READ, "observations have the declared shapes", "the kernel is compiled for them")
    def views_have_shapes(self) -> str:
        observations = self.observations()
        found = f"None for all {len(self.results)} readings of {self.source.name}"
        require(len(observations) > 0, found, "an observation for some of them")
        for what, one in observations:
            _require_shapes(one, self.first.view_shape, self.first.whiskers, what)
        return f"{len(observations)} observations of {len(self.results)} readings of {self.source.name}"

    @check(OBSERVED, "absent values are masked, not NaN", "one NaN spoils a step")
    def masks_values(self) -> None:
        for what, one in self.observations():
            _require_masked(one, what)

    @check(OBSERVED, "no motion is lost", "the pose is the sum of all motions")
    def carries_motion(self) -> str:
        if not all(hasattr(reading, "odometry") for reading in self.readings):
            return "readings without odometry"
        waiting: list[Any] = []
        for k, (reading, result) in enumerate(zip(self.readings, self.results, strict=True)):
            waiting.append(reading.odometry)
            if result is None:
                continue
            if len(waiting) > 1:
                together = np.zeros(3)  # m, m, rad, of successive motions
                for motion in waiting:
                    together = compose(together, np.array(motion[:3], float))
                expected = np.append(together, sum(float(motion[3]) for motion in waiting))
                found = np.array(result.odometry, float)
                if not np.allclose(expected, found, rtol=0, atol=MOTION_TOLERANCE):
                    what = f"odometry {found.tolist()} in the observation of reading {k} after None"
                    raise Violation(what, f"{expected.tolist()}, with the motion of the readings before it")
            waiting = []
        return f"None for {sum(result is None for result in self.results)} readings"

    @check(OBSERVED, "readings are not changed", "another pass would read other values")
    def changes_no_reading(self) -> None:
        _ = self.results
        copies = [sample.reading for sample in self.reading.copies]
        require_equal(copies, self.readings, "readings before and after they were observed")

    @check(OBSERVED, "it is deterministic", "a result could not be reproduced")
    def is_deterministic(self) -> None:
        expected, front = self.results, self.build()
        found = [front.observe(reading) for reading in self.readings]
        require_equal(expected, found, "the results of two front ends with equal settings")

    @check(OBSERVED, "it keeps nothing between passes", "each pass must give the same observations")
    def separates_passes(self) -> None:
        expected, first, second = self.results, self.build(), self.build()
        require(first is not second, "one front end for two passes", "a new one for each pass from `build`")
        found = []
        for k, reading in enumerate(self.readings):
            found.append(first.observe(reading))
            second.observe(self.readings[k // 2])  # another pass, at another place
        require_equal(expected, found, "the results of a pass alone and beside another one")


def check_touch(name: str, assignments: Sequence[str] = (), source: str | None = None) -> Iterator[Result]:
    """Checks the touch front end registered under a name.

    Args:
        assignments: of its settings, each `settings.key=value`; of those of the source `source.key=value`.
        source: name of the registered source of its readings; None: `Whisk`s of the simulated head.

    Raises:
        InputError: as `find_parts`.
    """
    parts = find_parts(
        {"settings": (TOUCH, name, "check touch"), "source": (SOURCES, source, "--source")}, assignments
    )
    readings = None
    if source is not None:
        entry, settings = parts["source"]
        readings = entry.open(settings or NoSettings(), None)
    return TouchTrial(*parts["settings"], readings).run_checks()
