"""Touch: simulated seconds for each second of work, on one core, after compilation."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.experience_metric import experience_metric
from ratslam.config.completion import complete
from ratslam.config.run_config import RunConfig
from ratslam.pipeline.runner import build_session
from ratslam.pipeline.source import open_source, read_observations
from robot.touch_source import open_touch_source

JITTER = {"position": 0.005, "yaw_deg": 1.5, "speed": 0.05}


def config(**simulation):
    """Seed 2's session."""
    return RunConfig.model_validate({"simulation": {"motion": {"jitter": JITTER}} | simulation})


def sensed(settings):
    """All observations and truths of a session, and the source."""
    source = open_source(settings)
    settings = complete(settings, source)
    seen = open_touch_source(source, settings.touch)
    rows = list(read_observations(seen))
    return settings, seen, [reading for _, reading in rows], np.array([sample.truth for sample, _ in rows])


def whole(settings, session):
    """Simulated, sensed, mapped and scored."""
    settings, source, observations, truth = sensed(settings)
    fresh = build_session(settings, source)
    fresh._run = session._run  # compiled once
    place = np.array([int(step.estimate.place) for step in fresh.replay(observations)])
    experience_metric(place, truth)
    return energy_all_pairs(fresh.map.trajectory(), truth)


def told(benchmark, length):
    """Writes the ratio beside the times, where times were taken."""
    if benchmark.stats is not None:
        benchmark.extra_info["times_real_time"] = round(length / benchmark.stats.stats.median)


def test_ten_circuits_mapped_and_scored(benchmark):
    settings = config() if benchmark.enabled else config(path={"circuits": "CC"})
    settings = settings.model_copy(update={"session": settings.session.model_copy(update={"reserve": 2048})})
    completed, source, observations, truth = sensed(settings)
    session = build_session(completed, source)
    list(session.replay(observations[:32]))
    benchmark.pedantic(partial(whole, settings, session), rounds=3)
    told(benchmark, len(truth))


@pytest.mark.parametrize("tier", ["kinematic", "quasistatic", "dynamic"])
def test_one_circuit_simulated_and_sensed(benchmark, tier):
    settings = config(fidelity=tier, path={"circuits": "C"})
    length = len(sensed(settings)[3])
    benchmark.pedantic(partial(sensed, settings), rounds=3)
    told(benchmark, length)
