"""Cost of simulation, and how images differ between its tiers of fidelity; shortened sessions."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from evaluation.metrics.metric import Finding, Quantity
from evaluation.studies.metrics import quantity
from evaluation.studies.study import with_settings
from evaluation.studies.view_separation import image_difference
from ratslam.runs.open_source import open_observations
from ratslam.runs.settings.run_config import RunConfig
from robot.simulation.head.simulated_session import HeadSimulation
from robot.sources.in_memory import InMemorySource, load_into_memory
from tactile.base.errors import InputError

FEWEST_LAPS = 2  # laps of a shortened session: fewer give nothing to recognise


def compare_with_tier(config: RunConfig, log: InMemorySource, cost: float, tier: str) -> dict[str, Quantity]:
    """Cost of a simulated session, and the difference of its images from those of another tier.

    An `InputError` says that the session is not simulated, or has no images.

    Args:
        config: completed by the source. cost: time that simulation and images took, s.
    """
    if config.simulation is None or log.views is None:
        expected = "a session of whisker images to simulate"
        raise InputError("simulation", "missing", expected, "`simulation: {}` is a whole session")
    reference = _reference_views(with_tier(config, tier).model_dump_json())
    contact, height = image_difference(log.views, reference, config.touch.image.tallest)
    duration = float(log.time[-1] - log.time[0])
    return (
        quantity("simulation_time", Finding(1e6 * cost / duration))
        | quantity("contact_difference", Finding(contact))
        | quantity("height_difference", Finding(1e3 * height))
    )


def with_tier(config: RunConfig, tier: str) -> RunConfig:
    """The configuration with another fidelity of simulation and without raw samples, if it simulates."""
    if config.simulation is None:
        return config
    return with_settings(config, {"simulation.fidelity": tier, "simulation.raw": False})


def shortened(config: RunConfig, seconds: float) -> RunConfig:
    """The configuration with fewer circuits, two at least, or less exploration; a path of cells stays."""
    cheapest = with_tier(config, "kinematic").simulation
    assert cheapest is not None
    path, length = cheapest.path, dict[str, Any]()
    if path.explore:
        length["simulation.path.explore"] = min(path.explore, seconds)
    elif path.circuits:
        lap = float(HeadSimulation(cheapest).time[-1]) / len(path.circuits)
        length["simulation.path.circuits"] = path.circuits[: max(FEWEST_LAPS, int(seconds / lap))]
    return with_settings(config, length)


@lru_cache(maxsize=1)
def _reference_views(config: str) -> np.ndarray:
    with open_observations(RunConfig.model_validate_json(config)) as (_, source):
        return load_into_memory(source).views
