"""Other touch sensors map the maze of `whisker_maze` by configuration and plug-in alone; a rat in a box."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ratslam.cli import main
from ratslam.core.session import Session
from ratslam.examples import taxel_array
from ratslam.runs.build_session import build_session, open_observations, open_source, read_observations
from ratslam.runs.run import run
from ratslam.runs.settings.run_config import RunConfig, load_config
from robot.sources.source import SOURCES
from robot.touch_source import TOUCH
from tactile.base.errors import InputError
from tests.helpers import tactile_arrays

TAXELS, WRENCH = "3 x 22 taxels", "wrench of 1 x 6"
NOISY = {"motion": {"jitter": {"position": 0.005, "yaw_deg": 1.5, "speed": 0.05}}}
SHORT = {"maze": {"columns": 3, "rows": 3, "loop": 8}, "path": {"circuits": "CCC"}}
LIMIT = {TAXELS: 0.1, WRENCH: 0.7}
"""Largest share of the odometry's Energy Metric after ten circuits."""


@pytest.fixture(autouse=True)
def plugins() -> Iterator[None]:
    SOURCES.register("taxels", tactile_arrays.TAXELS)
    SOURCES.register("wrench", tactile_arrays.WRENCH)
    TOUCH.register("taxels", taxel_array.ENTRY)
    TOUCH.register("wrench", tactile_arrays.WRENCH_FRONTEND)
    yield
    for registry in (SOURCES, TOUCH):
        for name in ("taxels", "wrench"):
            registry.unregister(name)


def improvement(folder: Path, sensor: str, simulation: dict[str, Any]) -> float:
    """The Energy Metric of all pairs over that of odometry, after a run in a simulated maze."""
    plugin = "taxels" if sensor == TAXELS else "wrench"
    parts: dict[str, Any] = {
        "pose_cells": {"cells_xy": 11} if "maze" in simulation else {},
        "touch": {"frontend": {"plugin": plugin}},
        "source": {"plugin": plugin, "settings": {"simulation": NOISY | simulation}},
    }
    metric = run(RunConfig.model_validate(parts), folder / "run")[0].quantities["energy_all"]
    print(sensor, simulation, metric)
    assert metric.value is not None
    assert metric.odometry is not None
    return metric.value / metric.odometry


@pytest.mark.parametrize("sensor", [pytest.param(TAXELS, marks=pytest.mark.soak), WRENCH])
def test_it_maps_three_circuits(sensor: str, tmp_path: Path) -> None:
    assert improvement(tmp_path, sensor, SHORT) < 0.3


@pytest.mark.soak
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sensor", LIMIT)
def test_it_maps_ten_circuits(sensor: str, seed: int, tmp_path: Path) -> None:
    assert improvement(tmp_path, sensor, {"seed": seed}) < LIMIT[sensor]


RAT = ("rat_simulation.seconds=4", "session.reserve=64")
PHASES = ("rat_darkness", "rat_cue_rotation", "rat_cue_conflict", "rat_kidnap", "rat_stretch")


def shortened(name: str) -> RunConfig:
    """A packaged session with all times divided by 20."""
    config = load_config(name)
    rat = config.rat_simulation
    assert rat is not None
    phases = [
        phase.model_copy(update={"start": phase.start / 20, "end": phase.end and phase.end / 20})
        for phase in rat.phases
    ]
    assert rat.seconds is not None
    rat = rat.model_copy(update={"phases": tuple(phases), "seconds": rat.seconds / 20})
    return config.model_copy(update={"rat_simulation": rat})


@pytest.fixture(scope="module")
def session() -> Session:
    """One session for all of them, so that its kernel is compiled once."""
    with open_observations(shortened("rat_box")) as opened:
        return build_session(*opened)


@pytest.mark.parametrize("name", PHASES)
def test_a_packaged_session_runs(name: str, session: Session) -> None:
    with open_observations(shortened(name)) as (config, source):
        observations = [observation for _, observation in read_observations(source)]
    assert (config.backend, config.presets) == ("classic", ())
    session.restart()
    estimates = [step.estimate for step in session.replay(observations)]
    assert len(estimates) == source.length == 120
    assert all(np.isfinite(estimate.pose).all() and not estimate.lost for estimate in estimates)


def test_a_recording_of_a_session_has_its_readings(tmp_path: Path) -> None:
    file = tmp_path / "rat.mcap"
    sets = [argument for setting in RAT for argument in ("--set", setting)]
    assert main(["simulate", "rat_box", "-o", str(file), *sets]) == 0
    (tmp_path / "again.yaml").write_text("recording: {file: rat.mcap}\n")
    made, read = open_source(load_config("rat_box", RAT)), open_source(tmp_path / "again.yaml")
    assert read.info.box == made.info.box
    for ours, theirs in zip(made, read, strict=True):
        np.testing.assert_allclose(theirs.reading.view, ours.reading.view, atol=1e-6)
        np.testing.assert_allclose(theirs.reading.odometry, ours.reading.odometry)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("path.file=none.npz", "none.npz: no such file"),
        ("box.width=0", "rat_simulation.box.width"),
        ("phases=[{start: 900, dark: true}]", "rat_simulation.phases.0.start: 900 s"),
        ("path.max_speed=0.1", "sargolini.npz:"),
    ],
)
def test_a_wrong_setting_of_the_rat_is_one_error(setting: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        open_source(load_config("rat_box", [f"rat_simulation.{setting}"]))
    assert "\n" not in str(caught.value)
