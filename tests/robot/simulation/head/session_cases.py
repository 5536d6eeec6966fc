"""Simulated sessions of the head on a short route, and their content as bytes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources.source import Sample, Source
from tactile.base.types import Cycle
from tactile.whisker_geometry import HeadConfig

SHORT = {"path": {"circuits": "CA"}}
LOOP = [(0, 0), (1, 0), (1, 1), (0, 1)]
"""Cells of a route."""


def simulate(head: HeadConfig | None = None, **changes: Any) -> HeadSimulation:
    return HeadSimulation(SimulationConfig.model_validate(SHORT | changes), head)


def leaves(sample: Sample) -> Iterator[bytes]:
    yield np.float64(sample.time).tobytes()
    yield b"" if sample.truth is None else sample.truth.tobytes()
    for part in (*sample.reading.odometry, *sample.reading[1:]):
        if not isinstance(part, tuple):
            yield np.asarray(part).tobytes()
    if isinstance(sample.reading, Cycle):
        yield sample.reading.time.tobytes()


def bits(source: Source) -> list[list[bytes]]:
    return [list(leaves(sample)) for sample in source]
