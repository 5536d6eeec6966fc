"""A source of whiskers seen through the sense of touch: a source of observations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np

from robot.simulation.create.session import RovingConfig
from robot.simulation.create.template_training import trained
from robot.sources.source import Rigged, Sample, Source, rig_of
from tactile.base.errors import InputError
from tactile.base.types import Observation
from tactile.features.calibration import Calibration, from_arrays
from tactile.frontend import Frontend, TouchConfig
from tactile.wall_estimation.report_frontend import Reporting, ReportsConfig
from tactile.wall_estimation.strain_templates import StrainTemplates
from tactile.whiskers.head_geometry import HeadConfig, ur10_head
from tactile.whiskers.planar_whiskers import Feelers, swept

TALLEST = 0.05
"""Of the walls of micromouse mazes, m."""


class Sense(Protocol):
    """Turns readings, in their order, into observations.

    Attributes:
        view_shape: of the views. whiskers: W.
    """

    @property
    def view_shape(self) -> tuple[int, int, int]: ...
    @property
    def whiskers(self) -> int: ...
    def observed(self, reading: Any) -> Observation | None:
        """What an engine is given; None if the reading is kept for the next one."""


class Sensing:
    """A source whose readings are all observations.

    Args:
        source: of whiskers, at least in part. sense: makes a sense that has felt nothing yet. where: what
            configures its whiskers.

    Raises:
        InputError: another number of whiskers than the sense has.
    """

    whisked = False

    def __init__(self, source: Source, sense: Callable[[], Sense], where: str) -> None:
        first = sense()
        if source.whiskers != first.whiskers:
            raise InputError(where, f"{first.whiskers} whiskers", f"{source.whiskers}, as {source.name} has")
        self.source, self.sense = source, sense
        self.name, self.rate_hz, self.digest = source.name, source.rate_hz, source.digest
        self.view_shape, self.whiskers, self.length = first.view_shape, source.whiskers, source.length
        self.rig: Mapping[str, Any] = rig_of(source)
        self.params: Mapping[str, Any] = getattr(source, "params", {})

    def __iter__(self) -> Iterator[Sample]:
        sense = self.sense()
        for sample in self.source:
            reading = sense.observed(sample.reading)
            if reading is None:
                continue
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
    if "roving" in source.rig:
        reports = reports_of(source, config.reports)
        templates = templates_of(source, reports)
        return Sensing(source, lambda: Reporting(reports, templates), "touch.reports.mounts")
    frontend = Frontend(config, calibration_of(source))
    return Sensing(source, lambda: frontend, "touch.head")


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


def feelers_of(source: Source, config: TouchConfig) -> Feelers | None:
    """A source's whiskers as a map of the floor sees them; None of one without.

    Raises:
        InputError: it does not say what whiskers it has.
    """
    if not source.whiskers:
        return None
    if "roving" in rig_of(source):
        return reports_of(source, config.reports).feelers
    return swept(ur10_head(head_of(source, config.head)), TALLEST)


def reports_of(source: Source, config: ReportsConfig) -> ReportsConfig:
    """The settings with the whiskers of a source of reports, but for what is set.

    Raises:
        InputError: it does not say what whiskers it has.
    """
    whiskers = _roving(source).whiskers
    found = {
        "mounts": tuple((mount.x, mount.y, mount.direction_deg) for mount in whiskers.mounts),
        "length": whiskers.length,
    }
    return config.model_copy(update={k: v for k, v in found.items() if k not in config.model_fields_set})


def templates_of(source: Source, config: ReportsConfig) -> StrainTemplates | None:
    """Strain templates of a simulated Create, driven into walls as it was made; None where none are asked for
    or a file has them."""
    if config.templates is not None or config.walls not in ("template", "fused"):
        return None
    return trained(_roving(source))


def _roving(source: Source) -> RovingConfig:
    made = {name: value for name, value in rig_of(source)["roving"].items() if name != "sha256"}
    try:
        return RovingConfig.model_validate(made)
    except (TypeError, ValueError) as error:
        raise InputError(f"{source.name}: roving", str(error), "a robot as kept with a session") from None
