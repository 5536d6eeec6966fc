"""The path of a real RatInABox agent is a source."""

from __future__ import annotations

import numpy as np
import pytest
from ratinabox.Agent import Agent
from ratinabox.Environment import Environment

import ratslam
from ratslam.service.rat_agents import agent_in_box, agent_path, agent_source
from robot.simulation.rat.rat_path import RatOdometryConfig
from robot.simulation.rat.simulated_session import RatSimulationConfig
from robot.sources.source import Source
from tactile.base.errors import InputError
from tactile.base.se2 import compose, integrate, inverse, wrap

DT = 0.05


def walked_agent(steps: int = 200, **environment):
    """An agent after some updates; RatInABox draws from NumPy's global generator."""
    np.random.seed(3)  # noqa: NPY002
    agent = Agent(Environment(environment), {"dt": DT})
    for _ in range(steps):
        agent.update()
    return agent


@pytest.fixture(scope="module")
def agent():
    return walked_agent()


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
    exact = agent_source(agent).motion
    turn = wrap(first.motion[1:, 2] - exact[1:, 2])
    assert turn.std() == pytest.approx(0.1 * np.sqrt(DT), rel=0.2)


def test_a_loop_follows_the_agent(agent, tmp_path):
    source = agent_source(agent)
    (tmp_path / "loop.yaml").write_text("backend: classic\n")
    slam = ratslam.Slam(tmp_path / "loop.yaml", info=source)
    for sample in source:
        estimate = slam.step(sample)
    true = compose(inverse(source.truth[0]), source.truth[-1])
    assert np.all(np.abs(estimate.pose - true) < [0.03, 0.03, 0.05])


def test_a_box_with_cues_gives_views(agent):
    source = agent_in_box(agent)
    samples = list(source)
    assert source.rate_hz == 1 / DT
    assert sum(sample.reading.view_seen for sample in samples) == 200 // source.config.views.every
    truth = np.array([sample.truth for sample in samples])
    np.testing.assert_allclose(truth[:, :2], agent.history["pos"], atol=1e-6)
    assert source.info.box == (0.0, 0.0, 1.0, 1.0)
    with pytest.raises(InputError, match=r"in the box of 0\.5 x 1 m"):
        agent_in_box(agent, RatSimulationConfig(box={"width": 0.5}))


def test_an_environment_of_another_shape_has_a_box_of_its_size():
    source = agent_in_box(walked_agent(20, aspect=2.0))
    assert source.info.box == (0.0, 0.0, 2.0, 1.0)
    shifted = walked_agent(20, boundary=[[-1, 0], [1, 0], [1, 1], [-1, 1]])
    with pytest.raises(InputError, match=r"an environment from \(-1, 0\) on"):
        agent_in_box(shifted)
    assert agent_source(shifted).length == 20


def test_bad_histories_get_one_clear_error():
    with pytest.raises(InputError, match=r"0 updates; expected at least two; call agent\.update"):
        agent_source(walked_agent(0))
    with pytest.raises(InputError, match="a periodic environment of 2D; expected a solid one"):
        agent_source(walked_agent(5, boundary_conditions="periodic"))
    agent = walked_agent(5)
    agent.history["pos"][2] = [np.nan, 0.0]
    with pytest.raises(InputError, match=r"not finite, at 0.15 s"):
        agent_path(agent)
    agent = walked_agent(5)
    agent.history["t"][2] = 0.0
    with pytest.raises(InputError, match="times that do not increase"):
        agent_path(agent)
