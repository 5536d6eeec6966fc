"""Pose cells as neurons of a real RatInABox agent."""

from __future__ import annotations

import sys
from functools import partial

import matplotlib.pyplot as plt
import numpy as np
import pytest
from ratinabox.Agent import Agent
from ratinabox.Environment import Environment

from ratslam.classic.config import NetworkConfig
from ratslam.service.rat_agents import PoseCellNeurons, agent_pose, anchor_at_truth
from ratslam.service.spikes import settled_peak
from tactile.base.errors import InputError

CONFIG = NetworkConfig(cell_size=0.05)  # a torus of 1.05 m
SIDE = np.array([1.05, 1.05, 2 * np.pi])
CELLS = list(range(0, 15876, 250))


def new_agent(**environment):
    """RatInABox draws from NumPy's global generator."""
    np.random.seed(5)  # noqa: NPY002
    return Agent(Environment(environment), {"dt": 0.05, "speed_mean": 0.2})


def errors_of(neurons, steps):
    """[T, 3] distance of the packet from the agent after each of some updates, m, m, rad."""
    errors = []
    for _ in range(steps):
        neurons.Agent.update()
        neurons.update()
        away = neurons.network.pose - agent_pose(neurons.Agent)
        errors.append(np.abs((away + SIDE / 2) % SIDE - SIDE / 2))
    return np.array(errors)


@pytest.fixture(scope="module")
def walked():
    """Neurons after 400 updates, and the distance of the packet from the agent."""
    neurons = PoseCellNeurons(new_agent(), {"pose_cells": CONFIG, "cell": CELLS})
    return neurons, errors_of(neurons, 400)


def test_the_packet_follows_the_agent(walked):
    _, errors = walked
    assert np.all(errors < [0.005, 0.005, 0.03])


def test_rates_are_activity_over_the_settled_peak(walked):
    neurons, _ = walked
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
    _, axes = neurons.plot_rate_map(chosen_neurons=[0, 3])
    assert len(axes) == 2
    assert all(np.nanmax(panel.get_images()[0].get_array()) >= 0 for panel in axes)
    neurons.plot_rate_timeseries(chosen_neurons=[0])
    plt.close("all")
    with pytest.raises(InputError, match=r"'all'; expected 'agent'.*plot_rate_map\(method='history'\)"):
        neurons.get_state(evaluate_at="all")


@pytest.mark.soak
def test_noise_drifts_and_the_true_pose_anchors():
    noise = {"pose_cells": CONFIG, "cell": [0], "heading_noise": 0.1, "speed_noise": 0.1}
    drifting = errors_of(PoseCellNeurons(new_agent(), noise), 600)
    anchored = errors_of(PoseCellNeurons(new_agent(), noise | {"anchor": anchor_at_truth(0.5, 0.5)}), 600)
    assert drifting.max(axis=0)[2] > 0.3
    assert np.all(anchored.mean(axis=0) < drifting.mean(axis=0) / 3)


def test_the_same_seed_gives_the_same_rates_and_another_other_ones():
    run = partial(_rates, {"pose_cells": CONFIG, "cell": CELLS, "heading_noise": 0.1})
    np.testing.assert_array_equal(run(seed=1), run(seed=1))
    assert not np.array_equal(run(seed=1), run(seed=2))


def _rates(params, seed):
    neurons = PoseCellNeurons(new_agent(), params | {"seed": seed})
    errors_of(neurons, 20)
    return np.array(neurons.history["firingrate"])


def test_in_a_periodic_box_the_packet_goes_round_with_the_agent():
    agent = new_agent(boundary_conditions="periodic", scale=1.05)
    neurons = PoseCellNeurons(agent, {"pose_cells": CONFIG, "cell": [0]})
    assert np.all(errors_of(neurons, 400) < [0.005, 0.005, 0.03])
    steps = np.abs(np.diff(agent.history["pos"], axis=0))
    assert steps.max() > 0.5  # the agent crossed an edge


def test_an_agent_at_nan_has_no_rate_and_the_network_waits():
    neurons = PoseCellNeurons(new_agent(), {"pose_cells": CONFIG, "cell": CELLS})
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
        PoseCellNeurons(new_agent(**environment), {"pose_cells": CONFIG} | params)


def test_a_leap_beyond_the_network_is_an_error():
    neurons = PoseCellNeurons(new_agent(scale=100.0, dx=1.0), {"pose_cells": CONFIG, "cell": [0]})
    neurons.Agent.update(forced_next_position=(neurons.Agent.pos + 50.0) % 100.0)
    with pytest.raises(InputError, match=r"m and .* rad in one step; expected at most 192 cells"):
        neurons.update()


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ratinabox.Neurons", None)
    monkeypatch.delitem(sys.modules, "ratslam.service.rat_agents")
    with pytest.raises(InputError, match=r"pip install 'ratslam\[ratinabox\]'"):
        import ratslam.service.rat_agents  # noqa: F401
