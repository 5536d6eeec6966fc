"""A source of whiskers seen through the sense of touch: a source of observations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Any, Self

import numpy as np

from robot.source import Rigged, Sample, Source, rig_of
from tactile.calibration import Calibration, arrays, from_arrays
from tactile.errors import InputError
from tactile.frontend import Frontend, TouchConfig
from tactile.head import HeadConfig
from tactile.types import Observation


class Sensing:
    """A source whose readings are all observations.

    Args:
        source: of whiskers, at least in part.

    Raises:
        InputError: another number of whiskers than the head has.
    """

    whisked = False

    def __init__(self, source: Source, frontend: Frontend) -> None:
        if source.whiskers != frontend.whiskers:
            raise InputError(
                "touch.head", f"{frontend.whiskers} whiskers", f"{source.whiskers}, as {source.name} has"
            )
        self.source, self.frontend = source, frontend
        self.name, self.rate_hz, self.digest = source.name, source.rate_hz, source.digest
        self.view_shape, self.whiskers, self.length = frontend.view_shape, source.whiskers, source.length
        self.rig: Mapping[str, Any] = rig_of(source)
        self.params: Mapping[str, Any] = getattr(source, "params", {})

    def __iter__(self) -> Iterator[Sample]:
        for sample in self.source:
            reading = self.frontend.observed(sample.reading)
            if reading.view.shape != self.view_shape:
                raise InputError(
                    self.name, f"a view of shape {reading.view.shape}", f"{self.view_shape}, as of whiskers"
                )
            yield sample._replace(reading=reading)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass


def sensing(source: Source, config: TouchConfig) -> Source:
    """The source as one of observations, by the calibration that it brings along.

    Raises:
        InputError: it does not go with the head, or its calibration cannot be used.
    """
    if not isinstance(source, Rigged) or not source.whisked:
        return source
    return Sensing(source, Frontend(config, calibration_of(source)))


def kept(calibration: Calibration) -> dict[str, Any]:
    """A calibration as JSON can hold it; what is infinite as text."""
    return {name: _plain(array.tolist()) for name, array in arrays(calibration).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return value if isinstance(value, bool) or np.isfinite(value) else str(value)


def calibration_of(source: Source) -> Calibration | None:
    """The calibration kept with a source."""
    found = rig_of(source).get("calibration")
    if found is None:
        return None
    where = f"{source.name}: calibration"
    try:
        return from_arrays({name: np.asarray(value, _kind(name)) for name, value in found.items()}, where)
    except (AttributeError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(where, str(error), "a calibration as kept with a session") from None


def _kind(name: str) -> type:
    return bool if name == "alive" else float


def head_of(source: Source, config: HeadConfig) -> HeadConfig:
    """The head that a source was made with, but for what is set in the configuration.

    Raises:
        InputError: the source's is none.
    """
    found = rig_of(source).get("head")
    if found is None:
        return config
    try:
        return HeadConfig.model_validate({**found, **config.model_dump(exclude_unset=True)})
    except (TypeError, ValueError) as error:
        raise InputError(f"{source.name}: head", str(error), "a head as kept with a session") from None


def observation_of(sample: Sample) -> Observation:
    """The reading of a source of observations.

    Raises:
        InputError: it is none.
    """
    if not isinstance(sample.reading, Observation):
        raise InputError("recording.file", "whiskers", "observations", "process the whiskers first")
    return sample.reading
