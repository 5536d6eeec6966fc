"""Other touch sensors map a maze by configuration and plug-in alone; a rat in a box; a camera alone."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from evaluation.metrics.trajectory import read_tum
from ratslam.cli import main
from ratslam.examples import taxel_array
from ratslam.runs.build_session import open_source
from ratslam.runs.run import run
from ratslam.runs.settings.run_config import RunConfig, load_config
from robot.sources.source import SOURCES
from robot.touch_source import TOUCH
from tactile.base.errors import InputError
from tests.helpers import tactile_arrays
from tests.helpers.corridor_camera import Camera, CorridorLoop, write_csv, write_video

SENSORS = {
    "taxels": (tactile_arrays.TAXELS, taxel_array.ENTRY),
    "wrench": (tactile_arrays.WRENCH, tactile_arrays.WRENCH_FRONTEND),
}
SIMULATION = {
    "motion": {"jitter": {"position": 0.005, "yaw_deg": 1.5, "speed": 0.05}},
    "maze": {"columns": 3, "rows": 3, "loop": 8}, "path": {"circuits": "CCC"},
}  # fmt: skip


@pytest.mark.parametrize("plugin", [pytest.param("taxels", marks=pytest.mark.soak), "wrench"])
def test_another_touch_sensor_maps_three_circuits(plugin: str, tmp_path: Path, monkeypatch) -> None:
    source, frontend = SENSORS[plugin]
    monkeypatch.setitem(SOURCES.builtin, plugin, source)
    monkeypatch.setitem(TOUCH.builtin, plugin, frontend)
    source = {"plugin": plugin, "settings": {"simulation": SIMULATION}}
    parts = {"pose_cells": {"cells_xy": 11}, "touch": {"frontend": {"plugin": plugin}}, "source": source}
    metric = run(RunConfig.model_validate(parts), tmp_path / "run")[0].quantities["energy_all"]
    assert metric.value < 0.3 * metric.odometry


RAT = ("rat_simulation.seconds=4", "session.reserve=64")


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


@pytest.mark.parametrize(("setting", "message"), [
    ("path.file=none.npz", "none.npz: no such file"),
    ("box.width=0", "rat_simulation.box.width"),
    ("phases=[{start: 900, dark: true}]", "rat_simulation.phases.0.start: 900 s"),
    ("path.max_speed=0.1", "sargolini.npz:"),
])  # fmt: skip
def test_a_wrong_setting_of_the_rat_is_one_error(setting: str, message: str) -> None:
    with pytest.raises(InputError, match=f"^[^\n]*{message}[^\n]*$"):
        open_source(load_config("rat_box", [f"rat_simulation.{setting}"]))


VISUAL = {
    "fov_deg": 60, "rotation": {"y_min": 180, "y_max": 300}, "translation": {"y_min": 240, "y_max": 480},
}  # fmt: skip
"""The parts of the image that look ahead (turns) and at near things (distances)."""


def run_errors(config: Path, output: Path, *settings: str) -> list[float]:
    """The errors (RMS, m) of the odometry and of the map after rotation, translation and scaling of each."""
    options = [option for setting in settings for option in ("--set", setting)]
    assert main(["run", str(config), "-o", str(output), *options]) == 0
    poses = [read_tum(output / f"{name}.tum")[1] for name in ("truth", "odometry", "trajectory")]
    truth, *paths = (pose[:, 0] + 1j * pose[:, 1] - (pose[:, 0] + 1j * pose[:, 1]).mean() for pose in poses)
    return [np.sqrt(np.mean(np.abs(np.vdot(a, truth) / np.vdot(a, a) * a - truth) ** 2)) for a in paths]


@pytest.mark.soak
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("exposure", [0.4, 1.0, 1.8])
def test_a_camera_alone_maps_a_loop(exposure: float, tmp_path: Path) -> None:
    world, config = CorridorLoop(seed=2, length=9.0, depth=5.5, breadth=1.8), tmp_path / "loop.yaml"
    (time, pose), (clock, speed, turn) = world.truth, world.wheels()
    write_video(tmp_path / "loop.avi", Camera(60, exposure=exposure).frames(world), world.rate, "MJPG")
    write_csv(tmp_path / "truth.csv", t=time, x=pose[:, 0], y=pose[:, 1], heading=pose[:, 2])
    write_csv(tmp_path / "wheels.csv", t=clock, vx=speed, w=turn)
    recording = {
        "file": "loop.avi", "video": {"rate": world.rate}, "visual_odometry": VISUAL,
        "image": {"crop": {"y_min": 120, "y_max": 360}, "rows": 12, "columns": 60},
        "table": {"truth": {"file": "truth.csv"}},
    }  # fmt: skip
    cells = {"cells_xy": 41, "cell_size": 0.25}
    settings = {"recording": recording, "presets": ["visual_odometry"], "pose_cells": cells}
    config.write_text(yaml.safe_dump(settings))
    odometry, alone = run_errors(config, tmp_path / "alone")
    assert odometry < 1.2
    assert alone < odometry * 0.7
    beside = ("recording.video.odometry=wheels.csv", "recording.table.velocity.forward=vx")
    wheels, mapped = run_errors(config, tmp_path / "wheels", *beside, "presets=[]", "templates.patch=2")
    assert mapped < wheels * 0.2
    assert mapped < alone * 0.5
