"""Conformance checks of a touch front end on the readings of a source: shapes, masks, motion, no memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from ratslam.service.check_results import Result, Trial, Violation, check, find_parts, require, require_equal
from ratslam.service.source_checks import Reading, require_masked, require_shapes
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
BUILT, OBSERVED, COMPARED = range(3)
"""Groups of checks, in their order."""


def check_touch(name: str, assignments: Sequence[str] = (), source: str | None = None) -> Iterator[Result]:
    """Checks the touch front end registered under a name.

    Args:
        assignments: of its settings, each `settings.key=value`; of those of the source `source.key=value`.
        source: name of the registered source of its readings; None: `Whisk`s of the simulated head.

    Raises:
        InputError: there is no such front end or source, its package is broken, or the settings do not fit.
    """
    parts = find_parts(
        {"settings": (TOUCH, name, "check touch"), "source": (SOURCES, source, "--source")}, assignments
    )
    readings = None
    if source is not None:
        entry, settings = parts["source"]
        readings = entry.open(settings or NoSettings(), None)
    return TouchTrial(*parts["settings"], readings).run_checks()


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

    @check(BUILT, "it builds for the source", "the backend is built from its attributes")
    def builds(self) -> str:
        front, source = self.first, self.source
        missing = [name for name in ("view_shape", "whiskers", "observe") if not hasattr(front, name)]
        require(
            not missing, f"{type(front).__name__} without {', '.join(missing)}", "all of a ReadingProcessor"
        )
        shape, whiskers = front.view_shape, front.whiskers
        counts = (
            isinstance(shape, tuple) and len(shape) == 3 and all(isinstance(n, int) and n > 0 for n in shape)
        )
        require(counts, f"view_shape {shape!r}", "a tuple of three sizes (R, C, K)")
        found = f"{whiskers} whiskers for those of {source.name}"
        require(whiskers == source.whiskers, found, f"{source.whiskers}, as the source says")
        return f"view_shape {shape}, {whiskers} whiskers"

    @check(OBSERVED, "observations have the declared shapes", "the kernel is compiled for them")
    def views_have_shapes(self) -> str:
        observations = self.observations()
        found = f"None for all {len(self.results)} readings of {self.source.name}"
        require(len(observations) > 0, found, "an observation for some of them")
        for what, one in observations:
            require_shapes(one, self.first.view_shape, self.first.whiskers, what)
        return f"{len(observations)} observations of {len(self.results)} readings of {self.source.name}"

    @check(COMPARED, "absent values are masked, not NaN", "one NaN spoils a step")
    def masks_values(self) -> None:
        for what, one in self.observations():
            require_masked(one, what)

    @check(COMPARED, "no motion is lost", "the pose is the sum of all motions")
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

    @check(COMPARED, "readings are not changed", "another pass would read other values")
    def changes_no_reading(self) -> None:
        _ = self.results
        copies = [sample.reading for sample in self.reading.copies]
        require_equal(copies, self.readings, "readings before and after they were observed")

    @check(COMPARED, "it is deterministic", "a result could not be reproduced")
    def is_deterministic(self) -> None:
        expected, front = self.results, self.build()
        found = [front.observe(reading) for reading in self.readings]
        require_equal(expected, found, "the results of two front ends with equal settings")

    @check(COMPARED, "it keeps nothing between passes", "each pass must give the same observations")
    def separates_passes(self) -> None:
        expected, first, second = self.results, self.build(), self.build()
        require(first is not second, "one front end for two passes", "a new one for each pass from `build`")
        found = []
        for k, reading in enumerate(self.readings):
            found.append(first.observe(reading))
            second.observe(self.readings[k // 2])  # another pass, at another place
        require_equal(expected, found, "the results of a pass alone and beside another one")
