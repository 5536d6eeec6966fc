"""Touch front ends, built in or registered, turn the whisker readings of a source into observations."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np

from robot.simulation.create.simulated_session import CreateSimulationConfig, train_strain_templates
from robot.sources.source import ClosedSource, Sample, Source, SourceInfo
from tactile.base.errors import InputError
from tactile.base.plugins import Registry, read_settings
from tactile.base.settings import Settings
from tactile.base.types import Observation
from tactile.frontend import Frontend, TouchConfig
from tactile.wall_estimation.report_frontend import ReportFrontend, ReportFrontendConfig
from tactile.wall_estimation.strain_templates import StrainTemplates
from tactile.whisker_geometry import HeadConfig, PlanarWhiskers, project_to_plane, ur10_head

MAZE_WALL_HEIGHT = 0.05
"""Wall height of micromouse mazes, m."""


class ReadingProcessor(Protocol):
    """A touch front end: converts readings, in order, into observations.

    Attributes:
        view_shape: (R, C, K) of the views. whiskers: number of whiskers.
    """

    @property
    def view_shape(self) -> tuple[int, int, int]: ...
    @property
    def whiskers(self) -> int: ...
    def observe(self, reading: Any) -> Observation | None:
        """The observation of a reading, or None if its motion is added to the next one."""

    def arrays(self) -> dict[str, np.ndarray]:
        """What it remembers of earlier readings, for a checkpoint."""

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Replaces what it remembers by that of `arrays`."""


class TouchEntry(NamedTuple):
    """A registered touch front end.

    Attributes:
        config_class: its settings. build: makes a front end from these and the information of the source;
            called for every pass through the source.
    """

    config_class: type[Settings]
    build: Callable[[Any, SourceInfo], ReadingProcessor]


TOUCH: Registry[TouchEntry] = Registry("ratslam.touch", "touch front end", TouchEntry, {})
"""Touch front ends by the name in `touch.frontend.plugin`."""


class TouchSource(ClosedSource):
    """A source of observations made from a source of whisker readings.

    Args:
        source: the source of readings. start: returns a new front end; called for every iteration.
        where: configuration key of the whiskers, for errors.

    Raises:
        InputError: source and front end have different numbers of whiskers.
    """

    def __init__(self, source: Source, start: Callable[[], ReadingProcessor], where: str) -> None:
        first = start()
        if source.whiskers != first.whiskers:
            expected = f"{source.whiskers}, those of {source.name}"
            raise InputError(where, f"{first.whiskers} whiskers", expected)
        self.source, self.start = source, start
        self.name, self.rate_hz, self.digest = source.name, source.rate_hz, source.digest
        self.view_shape, self.whiskers, self.length = first.view_shape, source.whiskers, source.length
        self.info = source.info.model_copy(update={"raw_whiskers": False})

    def __iter__(self) -> Iterator[Sample]:
        frontend = self.start()
        for sample in self.source:
            reading = frontend.observe(sample.reading)
            if reading is None:
                continue
            if reading.view.shape != self.view_shape:
                found = f"a view of shape {reading.view.shape}"
                raise InputError(self.name, found, f"{self.view_shape}, the shape of whisker images")
            yield sample._replace(reading=reading)


def open_touch_source(source: Source, config: TouchConfig) -> Source:
    """The source, its whisker readings turned into observations.

    Args:
        config: with the whiskers of the source (`touch_config_of`).

    Raises:
        InputError: the source has another number of whiskers than the configuration, or lacks a required
            calibration.
    """
    info = source.info
    if config.frontend is not None:
        where = "touch.frontend"
        entry = TOUCH.get(config.frontend.plugin, f"{where}.plugin")
        settings = read_settings(entry.config_class, config.frontend.settings, f"{where}.settings")
        return TouchSource(source, lambda: entry.build(settings, source.info), where)
    if not info.raw_whiskers:
        return source
    if info.planar_whiskers is not None:
        templates = _strain_templates_of(source, config.reports)
        return TouchSource(source, lambda: ReportFrontend(config.reports, templates), "touch.reports.mounts")
    return TouchSource(source, lambda: Frontend(config, info.calibration), "touch.head")


def touch_config_of(info: SourceInfo, config: TouchConfig) -> TouchConfig:
    """The configuration with the whiskers of a source, see `head_config_of` and `report_config_of`."""
    heads = {"head": head_config_of(info, config.head), "reports": report_config_of(info, config.reports)}
    return config.model_copy(update=heads | {"pokes": info.pokes or config.pokes})


def head_config_of(info: SourceInfo, config: HeadConfig) -> HeadConfig:
    """The head of a source, with the values set in the configuration instead of its own.

    Raises:
        InputError: the combined values are not a valid head.
    """
    if info.head is None:
        return config
    try:
        return HeadConfig.model_validate({**info.head.model_dump(), **config.model_dump(exclude_unset=True)})
    except ValueError as error:
        raise InputError("touch.head", str(error), "values that fit the head of the source") from None


def observation_of(sample: Sample) -> Observation:
    """The reading of a sample, which must be an observation.

    Raises:
        InputError: the reading is whisker data.
    """
    if not isinstance(sample.reading, Observation):
        cure = "open it with open_touch_source"
        raise InputError("recording.file", "whisker readings", "observations", cure)
    return sample.reading


def planar_whiskers_of(source: Source, config: TouchConfig) -> PlanarWhiskers | None:
    """The whiskers of a source projected to the floor; None for a source without whiskers, and for a touch
    sensor that is not the head of the configuration."""
    if not source.whiskers:
        return None
    if source.info.planar_whiskers is not None:
        return config.reports.feelers
    head = ur10_head(config.head)
    return project_to_plane(head, MAZE_WALL_HEIGHT) if len(head.length) == source.whiskers else None


def report_config_of(info: SourceInfo, config: ReportFrontendConfig) -> ReportFrontendConfig:
    """The configuration, with the whiskers of the source unless it sets its own."""
    found = info.planar_whiskers.model_dump() if info.planar_whiskers else {}
    return config.model_copy(update={k: v for k, v in found.items() if k not in config.model_fields_set})


def _strain_templates_of(source: Source, config: ReportFrontendConfig) -> StrainTemplates | None:
    """Strain templates, trained by simulating the Create of a source; None if the configuration needs none or
    names a file.

    Raises:
        InputError: the source does not state how its Create was simulated.
    """
    if config.templates is not None or config.walls not in ("template", "fused"):
        return None
    try:
        made = CreateSimulationConfig.model_validate(source.info.provenance.get("create_simulation"))
    except ValueError as error:
        where, expected = f"{source.name}: create_simulation", "the configuration of a simulated Create"
        cure = "train strain templates and name their file in touch.reports.templates"
        raise InputError(where, str(error), expected, cure) from None
    return train_strain_templates(made)
