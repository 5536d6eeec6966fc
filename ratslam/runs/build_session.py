"""Opens the source of a configuration (a recording or a simulation), and makes the session for the two."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ratslam.core.compilation import prepare_precision
from ratslam.core.session import Session
from ratslam.mapping.config import FULL, Ablation
from ratslam.methods.method_registry import Sensors, build
from ratslam.runs.cell_recorder import plan_recording
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig, load_config
from robot.recordings.formats import open_recording
from robot.simulation.create.simulated_session import CreateSimulation
from robot.simulation.head.simulated_pokes import PokeSimulation
from robot.simulation.head.simulated_session import HeadSimulation
from robot.simulation.rat.simulated_session import RatSimulation
from robot.sources.source import SOURCES, Sample, Source
from robot.touch_source import observation_of, open_touch_source, planar_whiskers_of
from tactile.base.errors import InputError
from tactile.base.plugins import read_settings
from tactile.base.types import Observation

RESERVED = 4096
"""Longest source, in steps, that has its rows reserved from the start, so that the kernel is compiled once.
Longer sources seldom fill their rows, and a step takes time for each row, in use or not."""


def build_session(config: RunConfig, source: Source, ablation: Ablation = FULL) -> Session:
    """A new session for a completed configuration and its source of observations; prepares JAX's precision.

    Args:
        ablation: parts of the keyframe map to switch off.

    A configuration that reserves no rows reserves those of the source (`RESERVED`): equal sources and
    configurations give equal capacities, and so equal bits. A configuration with `cells` gives steps with
    the records of `RecordingPlan.probe`.

    Raises:
        InputError: see `ratslam.methods.method_registry.build` and `plan_recording`.
    """
    prepare_precision(config.session.precision)
    sensors = Sensors(source.view_shape, planar_whiskers_of(source, config.touch))
    backend = build(config.backend, config, sensors, config.session.precision, ablation)
    plan, length = plan_recording(config, source, backend), source.length
    rows = length if length is not None and length <= RESERVED else 0  # a step adds at most one
    return Session(
        backend,
        seed=config.session.seed,
        reserve=config.session.reserve or rows,
        precision=config.session.precision,
        probe=plan and plan.probe,
    )


ConfigLike = str | os.PathLike[str] | RunConfig
"""A configuration, its file, or its name."""


def resolve_config(config: ConfigLike, *, source_required: bool = True) -> RunConfig:
    """The configuration with absolute paths; those of a `RunConfig` start at the working folder.

    Args:
        source_required: whether a file without a source is an error.

    Raises:
        InputErrors: all errors in the file.
    """
    if isinstance(config, RunConfig):
        return config.with_absolute_paths(Path.cwd())
    return load_config(config, source_required=source_required)


def open_source(
    config: ConfigLike, report: Callable[[str], None] | None = None, warnings: list[str] | None = None
) -> Source:
    """The recording or simulation of a configuration, a context manager; readings are as recorded.

    Args:
        report: called with one sentence about the fidelity of a simulation, or if a recording is incomplete.
        warnings: gets the sentences that are warnings, also while the source is read.

    Raises:
        InputErrors: the configuration has errors.
        InputError: the source cannot be read or simulated, is a live session, or there is none.
    """
    config = resolve_config(config)
    if config.create_simulation is not None:
        return CreateSimulation(config.create_simulation)
    if config.rat_simulation is not None:
        return RatSimulation(config.rat_simulation, warn=_warning(report, warnings))
    if config.simulation is not None and config.simulation.touch == "force":
        return PokeSimulation(config.simulation, config.touch.pokes)
    if config.simulation is not None:
        session = HeadSimulation(config.simulation, config.touch.head)
        if report is not None:
            report(f"simulating in the {session.tier} tier: {session.tier_reason}")
        return session
    if config.source is not None:
        entry = SOURCES.get(config.source.plugin, "source.plugin")
        settings = read_settings(entry.config_class, config.source.settings, "source.settings")
        return entry.open(settings, _warning(report, warnings))
    if config.recording is None and config.live is None:
        cure = "ratslam.Slam takes `info` instead: the source of the readings, or a SourceDescription"
        raise InputError("config", "no source", "a recording or a simulation", cure)
    if config.recording is None or config.recording.file is None:
        cure = "`python -m ratslam live` runs it; `run` maps the recording that it makes"
        raise InputError("live", "a live session", "a recording or a simulation", cure)
    return open_recording(config.recording, _warning(report, warnings), config.touch.pokes)


def _warning(report: Callable[[str], None] | None, warnings: list[str] | None) -> Callable[[str], None]:
    def warn(sentence: str) -> None:
        is_note = sentence.startswith("note: ")  # a fact that is no fault
        if warnings is not None and not is_note:
            warnings.append(sentence)
        if report is not None:
            report(sentence if is_note else f"warning: {sentence}")

    return warn


@contextmanager
def open_observations(
    config: RunConfig, report: Callable[[str], None] | None = None, warnings: list[str] | None = None
) -> Iterator[tuple[RunConfig, Source]]:
    """The completed configuration and its source, whisker readings turned into observations.

    Args, Raises: as `open_source` and `complete`.
    """
    with open_source(config, report, warnings) as source:
        config = complete(config, source)
        yield config, open_touch_source(source, config.touch)


def read_observations(source: Source) -> Iterator[tuple[Sample, Observation]]:
    """Samples, each with its reading as an observation.

    Raises:
        InputError: a reading is whisker data.
    """
    return ((sample, observation_of(sample)) for sample in source)
