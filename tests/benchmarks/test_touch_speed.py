"""Sessions with whiskers: simulated seconds per second of computation, on one core, after compilation."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.exm import experience_metric
from ratslam.runs.build_session import build_session, open_source, read_observations
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig
from robot.touch_source import open_touch_source

JITTER = {"position": 0.005, "yaw_deg": 1.5, "speed": 0.05}


def config(**simulation):
    """A simulated session with jitter of the motion."""
    return RunConfig.model_validate({"simulation": {"motion": {"jitter": JITTER}} | simulation})


def simulate(settings):
    """All observations and truths of a session, and the source."""
    source = open_source(settings)
    settings = complete(settings, source)
    seen = open_touch_source(source, settings.touch)
    rows = list(read_observations(seen))
    return settings, seen, [reading for _, reading in rows], np.array([sample.truth for sample, _ in rows])


def simulate_map_and_score(settings, session):
    """Simulation, contact features, mapping and scoring, with a compiled session."""
    settings, _, observations, truth = simulate(settings)
    session.restart(settings.session.seed)
    place = np.array([int(step.estimate.place) for step in session.replay(observations)])
    experience_metric(place, truth)
    return energy_all_pairs(session.map.trajectory(), truth)


def report_ratio(benchmark, length):
    """Adds the ratio to the benchmark's results, if times were measured."""
    if benchmark.stats is not None:
        benchmark.extra_info["times_real_time"] = round(length / benchmark.stats.stats.median)


def test_ten_circuits_are_mapped_and_scored(benchmark):
    settings = config() if benchmark.enabled else config(path={"circuits": "CC"})
    settings = settings.model_copy(update={"session": settings.session.model_copy(update={"reserve": 2048})})
    completed, source, observations, truth = simulate(settings)
    session = build_session(completed, source)
    list(session.replay(observations[:32]))
    benchmark.pedantic(partial(simulate_map_and_score, settings, session), rounds=3)
    report_ratio(benchmark, len(truth))


@pytest.mark.parametrize("tier", ["kinematic", "quasistatic", "dynamic"])
def test_one_circuit_is_simulated(benchmark, tier):
    settings = config(fidelity=tier, path={"circuits": "C"})
    length = len(simulate(settings)[3])
    benchmark.pedantic(partial(simulate, settings), rounds=3)
    report_ratio(benchmark, length)
