"""A camera alone, from a video to a map by the command `run`: a rendered corridor loop with known truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from evaluation.metrics.trajectory import read_tum
from ratslam.cli import main
from ratslam.runs.build_session import open_source
from ratslam.runs.settings.run_config import load_config
from tactile.base.se2 import integrate
from tests.helpers.corridor_camera import Camera, CorridorLoop, write_csv, write_video

# The parts of the image that look ahead (turns) and at near things (distances), as shares of it.
CROPS = {
    60: {"rotation": (0, 1, 180 / 480, 300 / 480), "translation": (0, 1, 0.5, 1)},
    360: {
        "rotation": (260 / 640, 380 / 640, 150 / 480, 330 / 480),
        "translation": (0, 1, 150 / 480, 330 / 480),
    },
}


def crop(camera: Camera, shares: tuple[float, float, float, float]) -> dict[str, int]:
    sizes = camera.width, camera.width, camera.height, camera.height
    names = ("x_min", "x_max", "y_min", "y_max")
    return {name: round(share * size) for name, share, size in zip(names, shares, sizes, strict=True)}


def write_loop(folder: Path, world: CorridorLoop, camera: Camera, name: str, codec: str = "MJPG") -> Path:
    """A video of the loop with truth and wheel odometry beside it, and the configuration that maps it."""
    time, pose = world.truth
    write_video(folder / name, camera.frames(world), world.rate, codec)
    write_csv(folder / "truth.csv", t=time, x=pose[:, 0], y=pose[:, 1], heading=pose[:, 2])
    clock, speed, turn = world.wheels()
    write_csv(folder / "wheels.csv", t=clock, vx=speed, w=turn)
    visual = {key: crop(camera, shares) for key, shares in CROPS[int(camera.fov_deg)].items()}
    recording = {
        "file": name,
        "video": {"rate": world.rate},
        "image": {"crop": crop(camera, (0, 1, 0.25, 0.75)), "rows": 12, "columns": 60},
        "visual_odometry": {"fov_deg": camera.fov_deg, **visual},
        "table": {"truth": {"file": "truth.csv"}},
    }
    cells = {"cells_xy": 41, "cell_size": 0.25}
    config = {"recording": recording, "presets": ["visual_odometry"], "pose_cells": cells}
    (folder / f"{name}.yaml").write_text(yaml.safe_dump(config))
    return folder / f"{name}.yaml"


def run_errors(config: Path, output: Path, *settings: str) -> tuple[float, float]:
    """Runs a configuration, and the errors (m) of its odometry and its map after the best similarity."""
    options = [option for setting in settings for option in ("--set", setting)]
    assert main(["run", str(config), "-o", str(output), *options]) == 0
    odometry, path, truth = (
        read_tum(output / f"{name}.tum")[1] for name in ("odometry", "trajectory", "truth")
    )
    return scale_free_error(odometry, truth), scale_free_error(path, truth)


def scale_free_error(path: np.ndarray, truth: np.ndarray) -> float:
    """RMS distance, m, of a path [N, 3] from the truth after rotation, translation and scaling of the
    path."""
    a, b = (pose[:, 0] + 1j * pose[:, 1] for pose in (path, truth))
    a, b = a - a.mean(), b - b.mean()
    return float(np.sqrt(np.mean(np.abs(np.vdot(a, b) / np.vdot(a, a) * a - b) ** 2)))


@pytest.mark.parametrize("fov_deg", [60, pytest.param(360, marks=pytest.mark.soak)])
def test_visual_odometry_goes_round_a_loop(fov_deg: int, tmp_path: Path) -> None:
    """Without a map, whose kernels take a minute to compile."""
    world = CorridorLoop(seed=2, length=9.0, depth=5.5, breadth=1.8, laps=1.0, rate=8.0)
    config = load_config(write_loop(tmp_path, world, Camera(fov_deg, 320, 240), "loop.avi"))
    with open_source(config) as source:
        samples = list(source)
    truth = world.truth[1]
    path = integrate(np.array([sample.reading.odometry[:3] for sample in samples]), truth[0])[-len(truth) :]
    assert scale_free_error(path, truth) < 0.8  # the loop is 7.2 m x 3.7 m
    turned = sum(float(sample.reading.odometry[2]) for sample in samples)
    assert turned == pytest.approx(truth[-1, 2] - truth[0, 2], abs=0.6)


@pytest.mark.soak
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("exposure", [0.4, 1.0, 1.8])
@pytest.mark.parametrize("fov_deg", [60, 360])
def test_a_camera_alone_maps_a_loop(fov_deg: int, exposure: float, tmp_path: Path) -> None:
    """With visual and with wheel odometry, and from another codec."""
    world = CorridorLoop(seed=2, length=9.0, depth=5.5, breadth=1.8)
    camera = Camera(fov_deg, exposure=exposure)
    config = write_loop(tmp_path, world, camera, "loop.avi")
    odometry, alone = run_errors(config, tmp_path / "alone")
    assert odometry < 1.2
    assert alone < odometry * 0.7
    beside = ("recording.video.odometry=wheels.csv", "recording.table.velocity.forward=vx")
    wheels, mapped = run_errors(config, tmp_path / "wheels", *beside, "presets=[]", "templates.patch=2")
    assert mapped < wheels * 0.2
    assert mapped < alone * 0.5
    if (fov_deg, exposure) == (60, 1.0):
        other = run_errors(write_loop(tmp_path, world, camera, "loop.mp4", "mp4v"), tmp_path / "other")
        assert other == pytest.approx((odometry, alone), abs=0.05)
