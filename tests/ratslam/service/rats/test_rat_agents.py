"""A real RatInABox agent: its path as a source, and pose cells as its neurons."""

from __future__ import annotations

import sys

import matplotlib.pyplot as plt
import numpy as np
import pytest
from ratinabox.Agent import Agent
from ratinabox.Environment import Environment

from ratslam.classic.config import NetworkConfig
from ratslam.service.rat_agents import (
    PoseCellNeurons,
    agent_in_box,
    agent_path,
    agent_pose,
    agent_source,
    anchor_at_truth,
)
from ratslam.service.spikes import settled_peak
from robot.simulation.rat.rat_path import RatOdometryConfig
from robot.simulation.rat.simulated_session import RatSimulationConfig
from robot.sources.source import Source
from tactile.base.errors import InputError
from tactile.base.se2 import integrate, wrap

DT = 0.05
CONFIG = NetworkConfig(cell_size=0.05)  # a torus of 1.05 m
SIDE = np.array([1.05, 1.05, 2 * np.pi])
CELLS = list(range(0, 15876, 250))


def new_agent(steps: int = 0, seed: int = 5, speed: float = 0.2, **environment) -> Agent:
    """An agent after some updates; RatInABox draws from NumPy's global generator."""
    np.random.seed(seed)  # noqa: NPY002
    agent = Agent(Environment(environment), {"dt": DT, "speed_mean": speed})
    for _ in range(steps):
        agent.update()
    return agent


@pytest.fixture(scope="module")
def agent():
    return new_agent(200, seed=3, speed=0.08)


def test_truth_is_the_history_and_odometry_leads_along_it(agent):
    source = agent_source(agent)
    assert isinstance(source, Source)
    assert source.length == 200
    assert source.rate_hz == pytest.approx(1 / DT)
    samples = list(source)
    truth = np.array([sample.truth for sample in samples])
    np.testing.assert_allclose(truth[:, :2], agent.history["pos"], atol=1e-12)
    head = np.array(agent.history["head_direction"])
    np.testing.assert_allclose(np.exp(1j * truth[:, 2]), head @ [1, 1j], atol=1e-12)
    motion = np.array([sample.reading.odometry for sample in samples])
    np.testing.assert_allclose(motion[1:, 3], DT)
    np.testing.assert_allclose(integrate(motion[:, :3], truth[0])[:, :2], truth[:, :2], atol=1e-9)
    assert not any(sample.reading.view_seen for sample in samples)


def test_errors_and_digest_follow_from_settings_and_seed(agent):
    noise = RatOdometryConfig(speed_white=0.1, heading_white=0.1)
    first, again, other = (agent_source(agent, noise, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.motion, again.motion)
    assert first.digest == again.digest != other.digest
    turn = wrap(first.motion[1:, 2] - agent_source(agent).motion[1:, 2])
    assert turn.std() == pytest.approx(0.1 * np.sqrt(DT), rel=0.2)


def test_a_box_with_cues_has_the_size_of_the_environment_and_gives_views(agent):
    source = agent_in_box(agent)
    samples = list(source)
    assert source.rate_hz == 1 / DT
    assert sum(sample.reading.view_seen for sample in samples) == 200 // source.config.views.every
    truth = np.array([sample.truth for sample in samples])
    np.testing.assert_allclose(truth[:, :2], agent.history["pos"], atol=1e-6)
    assert source.info.box == (0.0, 0.0, 1.0, 1.0)
    assert agent_in_box(new_agent(20, aspect=2.0)).info.box == (0.0, 0.0, 2.0, 1.0)
    with pytest.raises(InputError, match=r"in the box of 0\.5 x 1 m"):
        agent_in_box(agent, RatSimulationConfig(box={"width": 0.5}))
    shifted = new_agent(20, boundary=[[-1, 0], [1, 0], [1, 1], [-1, 1]])
    with pytest.raises(InputError, match=r"an environment from \(-1, 0\) on"):
        agent_in_box(shifted)
    assert agent_source(shifted).length == 20


def test_bad_histories_get_one_clear_error():
    for agent, message in (
        (new_agent(1), r"1 updates; expected at least two; call agent\.update"),
        (new_agent(5, boundary_conditions="periodic"), "a periodic environment of 2D; expected a solid one"),
    ):
        with pytest.raises(InputError, match=message):
            agent_source(agent)
    for name, value, message in (
        ("pos", [np.nan, 0.0], r"not finite, at 0.15 s"), ("t", 0.1, "times that do not increase"),
    ):  # fmt: skip
        agent = new_agent(5)
        agent.history[name][2] = value
        with pytest.raises(InputError, match=message):
            agent_path(agent)


def errors_of(neurons, steps):
    """[T, 3] distance of the packet from the agent after each of some updates, m, m, rad."""
    errors = []
    for _ in range(steps):
        neurons.Agent.update()
        neurons.update()
        away = neurons.network.pose - agent_pose(neurons.Agent)
        errors.append(np.abs((away + SIDE / 2) % SIDE - SIDE / 2))
    return np.array(errors)


def new_neurons(agent=None, **params):
    return PoseCellNeurons(agent or new_agent(), {"pose_cells": CONFIG, "cell": CELLS} | params)


@pytest.fixture(scope="module")
def walked():
    """Neurons after 400 updates, and the distance of the packet from the agent."""
    neurons = new_neurons()
    return neurons, errors_of(neurons, 400)


def test_the_packet_follows_the_agent_and_rates_are_activity_over_the_settled_peak(walked):
    neurons, errors = walked
    assert np.all(errors < [0.005, 0.005, 0.03])
    expected = 20.0 / settled_peak(CONFIG) * neurons.network.activity[CELLS]
    np.testing.assert_allclose(neurons.firingrate, expected, rtol=1e-12)
    np.testing.assert_array_equal(neurons.get_state()[:, 0], neurons.firingrate)  # asking moves nothing
    rates = np.array(neurons.history["firingrate"])
    assert rates.shape == (400, len(CELLS))
    assert 5.0 < rates.max() <= 20.0


def test_a_cell_fires_where_it_stands(walked):
    """The pose of the agent, averaged over the rates of a cell, is the pose of the cell."""
    neurons, _ = walked
    rates = np.array(neurons.history["firingrate"])
    cell = int(rates.sum(axis=0).argmax())
    where = np.array(neurons.Agent.history["pos"])[rates[:, cell] > 0.5 * rates[:, cell].max()]
    away = np.abs(where - neurons.cell_poses[cell, :2] + 0.525) % 1.05 - 0.525
    assert np.abs(away).max() < 0.1


@pytest.mark.filterwarnings("ignore")  # of the package's plots
def test_rate_maps_come_from_the_history(walked):
    neurons, _ = walked
    assert len(neurons.plot_rate_map(chosen_neurons=[0, 3])[1]) == 2
    plt.close("all")
    with pytest.raises(InputError, match=r"'all'; expected 'agent'.*plot_rate_map\(method='history'\)"):
        neurons.get_state(evaluate_at="all")


@pytest.mark.soak
def test_noise_drifts_and_the_true_pose_anchors():
    noise = {"cell": [0], "heading_noise": 0.1, "speed_noise": 0.1}
    drifting = errors_of(new_neurons(**noise), 600)
    anchored = errors_of(new_neurons(**noise, anchor=anchor_at_truth(0.5, 0.5)), 600)
    assert drifting.max(axis=0)[2] > 0.3
    assert np.all(anchored.mean(axis=0) < drifting.mean(axis=0) / 3)


def test_the_same_seed_gives_the_same_rates_and_another_other_ones():
    def run(seed):
        neurons = new_neurons(heading_noise=0.1, seed=seed)
        errors_of(neurons, 20)
        return np.array(neurons.history["firingrate"])

    first = run(1)
    np.testing.assert_array_equal(first, run(1))
    assert not np.array_equal(first, run(2))


def test_in_a_periodic_box_the_packet_goes_round_with_the_agent():
    agent = new_agent(boundary_conditions="periodic", scale=1.05)
    assert np.all(errors_of(new_neurons(agent, cell=[0]), 400) < [0.005, 0.005, 0.03])
    steps = np.abs(np.diff(agent.history["pos"], axis=0))
    assert steps.max() > 0.5  # the agent crossed an edge


def test_an_agent_at_nan_has_no_rate_and_the_network_waits():
    neurons = new_neurons()
    errors_of(neurons, 5)
    before = neurons.network.packet
    neurons.Agent.pos = np.full(2, np.nan)
    neurons.update()
    assert not neurons.firingrate.any()
    np.testing.assert_array_equal(neurons.network.packet, before)


@pytest.mark.parametrize(
    ("environment", "params", "message"),
    [
        ({"dimensionality": "1D"}, {}, "an environment of one dimension"),
        ({}, {"cell": [15876]}, "the index 15876; expected indices of the 15876 cells"),
        ({}, {"cell": []}, "an array of shape"),
    ],
)
@pytest.mark.filterwarnings("ignore:Warning. You have solid 1D")
def test_bad_input_gets_one_clear_error(environment, params, message):
    with pytest.raises(InputError, match=message):
        new_neurons(new_agent(**environment), **params)


def test_a_leap_beyond_the_network_is_an_error():
    neurons = new_neurons(new_agent(scale=100.0, dx=1.0), cell=[0])
    neurons.Agent.update(forced_next_position=(neurons.Agent.pos + 50.0) % 100.0)
    with pytest.raises(InputError, match=r"m and .* rad in one step; expected at most 192 cells"):
        neurons.update()


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ratinabox.Neurons", None)
    monkeypatch.delitem(sys.modules, "ratslam.service.rat_agents")
    with pytest.raises(InputError, match=r"pip install 'ratslam\[ratinabox\]'"):
        import ratslam.service.rat_agents  # noqa: F401
