"""Other touch sensors map the maze of `whisker_maze` by configuration and plug-in alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from evaluation.metrics.metric import Quantity
from ratslam.examples import taxel_array
from ratslam.runs.build_session import open_source
from ratslam.runs.run import run
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.packaged import PRESETS
from ratslam.runs.settings.run_config import RunConfig, load_config
from robot.sources.source import SOURCES
from robot.touch_source import TOUCH
from tests.helpers import tactile_arrays

SESSION = """
    motion: {jitter: {position: 0.005, yaw_deg: 1.5, speed: 0.05}}
"""
SHORT = """
    maze: {columns: 3, rows: 3, loop: 8}
    path: {circuits: CCC}
pose_cells: {cells_xy: 11}
attractor: {engine: dense}
"""
HEAD = """
touch:
  head:
    whiskers: 5
    rings:
      - {length: 0.05, radius: 0.045, height: 0.082}
      - {length: 0.08, radius: 0.055, height: 0.10}
      - {length: 0.11, radius: 0.065, height: 0.12}
      - {length: 0.16, radius: 0.08, height: 0.165}
simulation:
"""
TAXELS = """
touch: {frontend: {plugin: taxels}}
source:
  plugin: taxels
  settings:
   simulation:
"""
WRENCH = """
touch: {frontend: {plugin: wrench}}
source:
  plugin: wrench
  settings:
   simulation:
"""
LIMIT = {"head of 4 x 5": 0.1, "3 x 22 taxels": 0.1, "wrench of 1 x 6": 0.7}
"""Largest share of the odometry's Energy Metric after ten circuits."""
SENSORS = {"head of 4 x 5": HEAD, "3 x 22 taxels": TAXELS, "wrench of 1 x 6": WRENCH}


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


def scores(folder: Path, text: str, *settings: str) -> dict[str, Quantity]:
    """The scorecard of a configuration."""
    file = folder / "own.yaml"
    file.write_text(text, encoding="utf-8")
    return run(load_config(file, settings), folder / "run")[0].quantities


def improvement(found: dict[str, Quantity]) -> float:
    """The Energy Metric of all pairs over that of odometry."""
    metric = found["energy_all"]
    assert metric.value is not None
    assert metric.odometry is not None
    return metric.value / metric.odometry


@pytest.mark.parametrize(
    "sensor",
    [
        "wrench of 1 x 6",
        *(pytest.param(sensor, marks=pytest.mark.soak) for sensor in SENSORS if "1 x" not in sensor),
    ],
)
def test_it_maps_three_circuits(sensor: str, tmp_path: Path) -> None:
    found = scores(tmp_path, SENSORS[sensor] + SESSION + SHORT)
    print(sensor, found["energy_all"], found["ate_final"], found["map_doubt"])
    assert improvement(found) < 0.3


@pytest.mark.parametrize("sensor", [pytest.param("3 x 22 taxels", marks=pytest.mark.soak), "wrench of 1 x 6"])
def test_where_its_signal_is_lost_in_noise_odometry_remains(sensor: str, tmp_path: Path) -> None:
    found = scores(tmp_path, SENSORS[sensor] + SESSION + SHORT, "source.settings.noise=0.5")
    assert improvement(found) == pytest.approx(1.0, abs=0.05)


def test_touch_without_whiskers_has_the_preset_for_touch_and_no_layout() -> None:
    config = RunConfig.model_validate(
        {"source": {"plugin": "wrench", "settings": {"simulation": {"path": {"circuits": "C"}}}},
         "touch": {"frontend": {"plugin": "wrench"}}}
    )  # fmt: skip
    completed = complete(config, open_source(config))
    assert completed.presets == ("touch",)
    assert completed.recall.sector_fov == "none"
    assert completed.keyframes.noise.per_cell == PRESETS["touch"]["keyframes"]["noise"]["per_cell"]
    assert complete(completed, open_source(config)) == completed


@pytest.mark.soak
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sensor", SENSORS)
def test_it_maps_ten_circuits(sensor: str, seed: int, tmp_path: Path) -> None:
    key = "simulation.seed" if sensor.startswith("head") else "source.settings.simulation.seed"
    found = scores(tmp_path, SENSORS[sensor] + SESSION, f"{key}={seed}")
    print(sensor, seed, found["energy_all"], found["ate_final"], found["map_doubt"])
    assert improvement(found) < LIMIT[sensor]
