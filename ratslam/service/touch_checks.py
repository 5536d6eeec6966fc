"""Checks of a touch front end on the readings of a source."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from ratslam.service.check_results import (
    Check,
    Result,
    Violation,
    read_assignments,
    require,
    require_equal,
    require_settings_class,
    run_checks,
)
from ratslam.service.source_checks import (
    Reading,
    read,
    require_brightness,
    require_finite,
    require_shapes,
)
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources.source import SOURCES, Source
from robot.touch_source import TOUCH, ReadingProcessor, TouchEntry
from tactile.base.plugins import NoSettings
from tactile.base.se2 import compose
from tactile.base.types import Observation
from tactile.whisker_geometry import HeadConfig

READINGS = 256
"""Readings that are examined."""
MOTION_TOLERANCE = 1e-6
"""Difference allowed between motions, m, rad and s: front ends may round."""


def check_touch(name: str, assignments: Sequence[str] = (), source: str | None = None) -> Iterator[Result]:
    """Checks the touch front end registered under a name.

    Args:
        assignments: of its settings, each `settings.key=value`; of those of the source `source.key=value`.
        source: name of the registered source of its readings; None: `Whisk`s of the simulated head.

    Raises:
        InputError: there is no such front end or source, its package is broken, or the settings do not fit.
    """
    entry = TOUCH.get(name, "check touch")
    models: dict[str, Any] = {"settings": entry.config_class}
    if source is not None:
        models["source"] = SOURCES.get(source, "--source").config_class
    settings = read_assignments(models, assignments)
    readings = simulated_head()
    if source is not None:
        readings = SOURCES.get(source, "--source").open(settings["source"] or NoSettings(), None)
    return run_checks(GROUPS, TouchTrial(entry, settings["settings"], readings))


def simulated_head() -> Source:
    """A simulated session of the whisker head, whose readings are `Whisk`s."""
    return HeadSimulation(SimulationConfig(), HeadConfig())


class TouchTrial:
    """A touch front end with settings, and what its checks share.

    Args:
        settings: an instance of the entry's `config_class`. source: of its readings.
    """

    def __init__(self, entry: TouchEntry, settings: Any, source: Source) -> None:
        self.entry, self.settings, self.source = entry, settings, source

    def build(self) -> ReadingProcessor:
        """A new front end, as for a pass through the source."""
        return self.entry.build(self.settings, self.source.info)

    @cached_property
    def first(self) -> ReadingProcessor:
        return self.build()

    @cached_property
    def reading(self) -> Reading:
        return read(self.source, READINGS)

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


def _entry(trial: TouchTrial) -> str:
    require_settings_class(trial.entry.config_class)
    return ""


def _builds(trial: TouchTrial) -> str:
    front, source = trial.first, trial.source
    missing = [name for name in ("view_shape", "whiskers", "observe") if not hasattr(front, name)]
    require(not missing, f"{type(front).__name__} without {', '.join(missing)}", "all of a ReadingProcessor")
    shape, whiskers = front.view_shape, front.whiskers
    counts = isinstance(shape, tuple) and len(shape) == 3 and all(isinstance(n, int) and n > 0 for n in shape)
    require(counts, f"view_shape {shape!r}", "a tuple of three sizes (R, C, K)")
    found = f"{whiskers} whiskers for those of {source.name}"
    require(whiskers == source.whiskers, found, f"{source.whiskers}, as the source says")
    return f"view_shape {shape}, {whiskers} whiskers"


def _shapes(trial: TouchTrial) -> str:
    observations = trial.observations()
    found = f"None for all {len(trial.results)} readings of {trial.source.name}"
    require(len(observations) > 0, found, "an observation for some of them")
    for what, one in observations:
        require_shapes(one, trial.first.view_shape, trial.first.whiskers, what)
    return f"{len(observations)} observations of {len(trial.results)} readings of {trial.source.name}"


def _masks(trial: TouchTrial) -> str:
    for what, one in trial.observations():
        require_finite(one, what)
        require_brightness(one, what)
    return ""


def _carried_motion(trial: TouchTrial) -> str:
    if not all(hasattr(reading, "odometry") for reading in trial.readings):
        return "readings without odometry"
    waiting: list[Any] = []
    for k, (reading, result) in enumerate(zip(trial.readings, trial.results, strict=True)):
        waiting.append(reading.odometry)
        if result is None:
            continue
        if len(waiting) > 1:
            expected, found = _together(waiting), np.array(result.odometry, float)
            if not np.allclose(expected, found, rtol=0, atol=MOTION_TOLERANCE):
                what = f"odometry {found.tolist()} in the observation of reading {k} after None"
                raise Violation(what, f"{expected.tolist()}, with the motion of the readings before it")
        waiting = []
    return f"None for {sum(result is None for result in trial.results)} readings"


def _together(motions: Sequence[Any]) -> np.ndarray:
    """[4] dx m, dy m, dtheta rad, dt s of successive motions together."""
    pose = np.zeros(3)
    for motion in motions:
        pose = compose(pose, np.array(motion[:3], float))
    return np.append(pose, sum(float(motion[3]) for motion in motions))


def _deterministic(trial: TouchTrial) -> str:
    expected, front = trial.results, trial.build()
    found = [front.observe(reading) for reading in trial.readings]
    require_equal(expected, found, "the results of two front ends with equal settings")
    return ""


def _separate(trial: TouchTrial) -> str:
    expected, first, second = trial.results, trial.build(), trial.build()
    require(first is not second, "one front end for two passes", "a new one for each pass from `build`")
    found = []
    for k, reading in enumerate(trial.readings):
        found.append(first.observe(reading))
        second.observe(trial.readings[k // 2])  # another pass, at another place
    require_equal(expected, found, "the results of a pass alone and beside another one")
    return ""


def _unchanged(trial: TouchTrial) -> str:
    _ = trial.results
    copies = [sample.reading for sample in trial.reading.copies]
    require_equal(copies, trial.readings, "readings before and after they were observed")
    return ""


ENTRY_CHECKS = (
    Check("the entry is complete", "a configuration names it with its settings", _entry),
    Check("it builds for the source", "the backend is built from its attributes", _builds),
)
SHAPE_CHECKS = (Check("observations have the declared shapes", "the kernel is compiled for them", _shapes),)
CONTENT_CHECKS = (
    Check("absent values are masked, not NaN", "one NaN spoils a step", _masks),
    Check("no motion is lost", "the pose is the sum of all motions", _carried_motion),
    Check("readings are not changed", "another pass would read other values", _unchanged),
    Check("it is deterministic", "a result could not be reproduced", _deterministic),
    Check("it keeps nothing between passes", "each pass must give the same observations", _separate),
)
GROUPS = (ENTRY_CHECKS, SHAPE_CHECKS, CONTENT_CHECKS)
CHECKS = tuple(check for group in GROUPS for check in group)
"""All checks of a touch front end; the checks of a group assume those of the groups before it."""
