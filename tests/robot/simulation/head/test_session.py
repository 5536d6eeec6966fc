"""Simulated sessions of the head: reproducibility, independent random streams, samples."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.simulation.head.odometry_errors import OdometryConfig
from robot.sources.source import Source
from robot.touch_source import open_touch_source
from robot.world.maze import CELL_SIDE, maze_text
from tactile.base.se2 import between, wrap
from tactile.base.types import Cycle, Whisk
from tactile.frontend import TouchConfig
from tactile.whisker_geometry import HeadConfig
from tests.robot.simulation.head.session_cases import bits, simulate


def test_a_session_is_bit_identical_for_the_same_settings() -> None:
    one = simulate()
    assert isinstance(one, Source)
    with one as source:
        first = bits(source)
        assert bits(source) == first
    assert bits(simulate()) == first
    assert len(first) == one.length > 250
    assert simulate().digest == one.digest
    other = simulate(seed=1)
    assert other.digest != one.digest
    assert bits(other)[:50] != first[:50]


def test_the_digest_depends_on_the_configuration(tmp_path: Path) -> None:
    maze = tmp_path / "maze.txt"
    maze.write_text(maze_text(simulate().scene.maze))
    loop = simulate().scene.loop
    sessions = [
        simulate(),
        simulate(seed=3),
        simulate(HeadConfig(rest_deg=70.0)),
        simulate(mechanics={"servo": 0.5}),
        simulate(maze={"file": maze}, path={"loop": loop, "circuits": "CA"}),
    ]
    assert len({session.digest for session in sessions}) == len(sessions)
    again = tmp_path / "copy.txt"
    again.write_text(maze.read_text().replace("o", "+"))
    moved = simulate(maze={"file": again}, path={"loop": loop, "circuits": "CA"})
    assert moved.digest == sessions[-1].digest  # the content counts, not the path
    maze.write_text(maze.read_text().replace("|", " ", 1).replace(" ", "|", 1))
    assert str(tmp_path) not in moved.info.to_json()


def test_streams_are_independent() -> None:
    """A changed setting affects only its own stream: odometry errors leave contacts unchanged."""
    base = simulate()
    other = simulate(odometry={"noise": "white"})
    assert (base.odometry != other.odometry).any()
    assert all((one == two).all() for one, two in zip(base.features[1:], other.features[1:], strict=True))
    noisy = simulate(mechanics={"noise": 5e-3})
    assert (noisy.odometry == base.odometry).all()
    assert (noisy.features.touched != base.features.touched).any()
    fuller = simulate(maze={"share": 0.9})
    assert fuller.scene.loop == base.scene.loop
    assert (fuller.truth == base.truth).all()
    rough = simulate(motion={"jitter": {"position": 0.005}})
    assert maze_text(rough.scene.maze) == maze_text(base.scene.maze)
    assert (rough.truth != base.truth).any()


def test_samples_agree_with_the_session() -> None:
    session = simulate()
    samples = list(session)
    assert len(samples) == session.length
    assert (np.diff([sample.time for sample in samples]) > 0).all()
    assert samples[0].time == 0.25  # the middle of the protraction
    assert session.rate_hz == 1.0
    assert session.view_shape == (3, 6, 1)
    truth = np.array([sample.truth for sample in samples])
    assert (truth[:, :2] > 0).all()
    assert (truth[:, :2] < [7 * CELL_SIDE, 5 * CELL_SIDE]).all()
    assert (np.abs(truth[:, 2]) <= np.pi).all()
    readings = [sample.reading for sample in samples]
    assert all(isinstance(reading, Whisk) for reading in readings)
    contact = np.array([reading.contact for reading in readings])
    assert 0.1 < contact.mean() < 0.6
    measured = np.array([[*reading.odometry] for reading in readings])
    assert (measured == session.odometry).all()
    samples[0].truth[:] = 9  # a copy
    assert (next(iter(session)).truth != 9).all()


def test_twice_the_rate_is_twice_the_whisks() -> None:
    once, twice = simulate(), simulate(whisking={"rate": 2.0})
    assert abs(twice.length - 2 * once.length) <= 1
    assert twice.rate_hz == 2.0
    assert twice.time[0] == 0.125


@pytest.mark.parametrize("name", ["quasistatic", "dynamic"])
def test_raw_sessions_are_bit_identical_and_agree_with_the_kinematic_tier(name: str) -> None:
    changes: dict[str, Any] = {"path": {"explore": 20.0}, "fidelity": name, "mechanics": {"noise": 1e-3}}
    raw = simulate(**changes)
    first = bits(raw)
    assert bits(raw) == first
    assert bits(simulate(**changes)) == first
    assert len(first) == 20
    reading = next(iter(raw)).reading
    assert isinstance(reading, Cycle)
    assert reading.angle.shape == (2000, 18)
    simple = simulate(**changes | {"fidelity": "kinematic"})
    assert (raw.truth == simple.truth).all()
    assert (raw.odometry == simple.odometry).all()
    readings = [
        np.array([s.reading.contact for s in open_touch_source(source, TouchConfig())])
        for source in (raw, simple)
    ]
    assert (readings[0] == readings[1]).mean() > 0.85
    assert readings[0].mean() > 0.1
    assert raw.info.calibration is not None


def test_odometry_is_between_mid_protractions() -> None:
    session = simulate(odometry=OdometryConfig(noise="none").model_dump())
    true = between(session.truth[:-1], session.truth[1:])
    assert np.allclose(session.odometry[1:, :2], true[:, :2], atol=1e-12)
    assert np.allclose(wrap(session.odometry[1:, 2] - true[:, 2]), 0, atol=1e-9)
    assert (session.odometry[1:, 3] == 1).all()
