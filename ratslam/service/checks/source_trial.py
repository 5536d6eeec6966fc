"""A source under test, and what its checks share."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from ratslam.service.checks.check_results import Violation, leaves, require
from robot.sources.source import ClosedSource, Sample, Source
from robot.sources.source_registry import SourceEntry
from robot.touch_source import head_config_of, open_touch_source, report_config_of
from tactile.base.plugins import PluginConfig
from tactile.base.types import Observation
from tactile.frontend import TouchConfig

SAMPLES = 4096
"""Samples of a source that are examined unless said otherwise."""


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


class SourceTrial:
    """A source with settings, and what its checks share.

    Args:
        settings: an instance of the entry's `config_class`. frontend: for readings that are not observations.
        most: samples to examine.
    """

    def __init__(
        self, entry: SourceEntry, settings: Any, frontend: PluginConfig | None = None, most: int = SAMPLES
    ) -> None:
        self.entry, self.settings, self.frontend, self.most = entry, settings, frontend, most

    @cached_property
    def source(self) -> Source:
        return self.entry.open(self.settings, None)

    @cached_property
    def reading(self) -> Reading:
        """What was read of the source."""
        return read(self.source, self.most)

    @cached_property
    def observing(self) -> Source:
        """The samples of the first pass, through the front end that they need."""
        stored = StoredSource(self.source, self.reading.samples)
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


def read(source: Source, most: int) -> Reading:
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
        again = list(islice(source, most)) if is_recording(source) else []
    finally:
        suppresses = bool(source.__exit__(None, None, None))  # type: ignore[func-returns-value]
    return Reading(samples, copies, again, complete, suppresses)


def is_recording(source: Source) -> bool:
    """Whether it can be read again: a live robot has no digest."""
    return source.digest != ""


class StoredSource(ClosedSource):
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


def require_finite(found: Observation, what: str) -> None:
    """Raises `Violation` if an observation has NaN or infinite values.

    Args:
        what: the observation, for the message.
    """
    for path, leaf in leaves(found):
        finite = bool(np.isfinite(leaf).all())
        require(
            finite, f"{path} of {what} has NaN or infinity", "absent values masked, for example view_seen"
        )


def require_brightness(found: Observation, what: str) -> None:
    """Raises `Violation` if the view of an observation has values outside 0..1.

    Args:
        what: the observation, for the message.
    """
    low, high = float(np.min(found.view, initial=0.0)), float(np.max(found.view, initial=0.0))
    require(low >= 0 and high <= 1, f"view of {what} has values {low:g} to {high:g}", "values in 0..1")
