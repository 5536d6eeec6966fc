"""Opens the source of a configuration: a recording or a simulation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ratslam.config.completion import complete
from ratslam.config.run_config import RunConfig
from robot.recordings.formats import open_recording
from robot.simulation.create.session import CreateSimulation
from robot.simulation.head.session import HeadSimulation
from robot.sources.registry import SOURCES
from robot.sources.source import Sample, Source
from robot.touch_source import observation_of, open_touch_source
from tactile.base.errors import InputError
from tactile.base.plugins import read_settings
from tactile.base.types import Observation


def open_source(config: RunConfig, report: Callable[[str], None] | None = None) -> Source:
    """The recording or simulation of a configuration with absolute paths.

    Args:
        report: called with one sentence about the fidelity of a simulation, or if a recording is incomplete.

    Raises:
        InputError: the source cannot be read or simulated, or is a live session.
    """
    if config.create_simulation is not None:
        return CreateSimulation(config.create_simulation)
    if config.simulation is not None:
        session = HeadSimulation(config.simulation, config.touch.head)
        if report is not None:
            report(f"simulating in the {session.tier.name} tier: {session.tier.why}")
        return session
    if config.source is not None:
        entry = SOURCES.get(config.source.plugin, "source.plugin")
        settings = read_settings(entry.config_class, config.source.settings, "source.settings")
        return entry.open(settings, _warning(report))
    if config.recording is None:
        cure = "`python -m ratslam live` runs it; `run` maps the recording that it makes"
        raise InputError("live", "a live session", "a recording or a simulation", cure)
    return open_recording(config.recording, _warning(report))


def _warning(report: Callable[[str], None] | None) -> Callable[[str], None] | None:
    return report and (lambda sentence: report(f"warning: {sentence}"))


@contextmanager
def open_observations(
    config: RunConfig, report: Callable[[str], None] | None = None
) -> Iterator[tuple[RunConfig, Source]]:
    """The completed configuration and its source, whisker readings turned into observations.

    Args, Raises: as `open_source` and `complete`.
    """
    with open_source(config, report) as source:
        config = complete(config, source)
        yield config, open_touch_source(source, config.touch)


def read_observations(source: Source) -> Iterator[tuple[Sample, Observation]]:
    """Samples, each with its reading as an observation.

    Raises:
        InputError: a reading is whisker data.
    """
    return ((sample, observation_of(sample)) for sample in source)
