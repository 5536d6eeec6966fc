"""The doctor names what a recording holds, and writes the configuration that reads it."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from ratslam.cli import main
from ratslam.runs.build_session import open_source
from ratslam.runs.localise import localising
from ratslam.runs.map_settings import Sensor, differing_settings
from ratslam.runs.saved_map import SavedMap, describe_readings
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig, load_config
from ratslam.runs.settings.strict_yaml import dump_data, parse, validate
from ratslam.service.recording_check import diagnose_recording
from robot.recordings.mcap_writer import record_source
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from tactile.base.errors import InputError
from tests.helpers.corridor_camera import Camera, CorridorLoop, write_video
from tests.helpers.ros_bags import Entry, header, odometry, scan, tf, transform, write_bag

START, STEP = 1_700_000_000_000_000_000, 100_000_000  # ns
STEPS = 40
REAL = Path(__file__).parents[3] / "data" / "real_touch"


def write_table(path: Path, **columns: np.ndarray) -> None:
    lines = [
        ",".join(columns),
        *(",".join(map(repr, row)) for row in np.stack(list(columns.values()), 1).tolist()),
    ]
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Recordings of a robot that drives along an arc at 1 m/s, one of each kind."""
    time = np.arange(STEPS) / 10
    heading = 0.05 * np.arange(STEPS)
    x, y = np.cumsum(0.1 * np.cos(heading)), np.cumsum(0.1 * np.sin(heading))
    ranges = 1 + np.abs(np.sin(time[:, None] + np.arange(36)))
    beams = {f"r{k}": ranges[:, k] for k in range(36)}
    write_table(tmp_path / "lab_odometry.csv", t=time, x=x, y=y, theta=heading)
    write_table(tmp_path / "lab_scans.csv", time=time, **beams)
    write_table(tmp_path / "lab_truth.csv", t=time, x=x, y=y, yaw=heading)
    write_table(tmp_path / "speeds.csv", Time=time, V=np.full(STEPS, 1.0), omega=np.full(STEPS, 0.5))
    write_table(tmp_path / "degrees.csv", t=time, x=x, y=y, heading=np.rad2deg(20 * heading))
    write_table(tmp_path / "walls.csv", x1=x, y1=y)
    messages = []
    for k in range(STEPS):
        stamp = START + k * STEP
        messages.append(odometry(stamp, x[k], y[k], heading[k]))
        messages.append(scan(stamp, ranges[k], -np.pi, np.pi / 18))
    write_bag(tmp_path, "sqlite3", messages)
    world = CorridorLoop(seed=5, length=5.0, depth=4.0, breadth=1.4, laps=0.05)
    write_video(tmp_path / "loop.avi", Camera(fov_deg=90, width=96, height=64).frames(world), 10, "MJPG")
    record_source(
        HeadSimulation(SimulationConfig.model_validate({"path": {"explore": 5}})), tmp_path / "touch.mcap"
    )
    return tmp_path


def written(folder: Path, name: str) -> RunConfig:
    """The configuration that the doctor writes for a recording."""
    output = folder / "elsewhere.yaml"
    output.unlink(missing_ok=True)
    assert main(["doctor", str(folder / name), "-o", str(output)]) == 0
    return load_config(output)


@pytest.mark.parametrize(
    ("name", "samples", "shape", "whiskers"),
    [
        ("lab_odometry.csv", STEPS, (3, 6, 1), 0),
        ("speeds.csv", STEPS, (3, 6, 1), 0),
        ("run", STEPS, (3, 6, 1), 0),
        ("loop.avi", None, None, 0),
        ("touch.mcap", 5, (3, 6, 1), 18),
    ],
)
def test_the_configuration_reads_the_recording(
    folder: Path, name: str, samples: int | None, shape: tuple[int, int, int] | None, whiskers: int
) -> None:
    with open_source(written(folder, name)) as source:
        assert source.whiskers == whiskers
        assert samples is None or len(list(source)) == samples
        assert shape is None or source.view_shape == shape
        assert len(list(islice(source, 5))) == 5


@pytest.mark.parametrize(
    ("name", "plugin"),
    [
        ("stanford/stage_cylinder_2.csv", "whisker_stage"),  # a table without times
        ("purdue/cherry.csv", "whisker_objects"),  # no header
        ("sheffield/TXZY_dataI.mat", "taxel_contacts"),  # no reader of ours
    ],
)
def test_a_recording_of_a_registered_source_is_named(name: str, plugin: str, tmp_path: Path) -> None:
    assert main(["doctor", str(REAL / name), "-o", str(tmp_path / "mine.yaml")]) == 0
    config = load_config(tmp_path / "mine.yaml")
    assert config.source is not None
    assert config.source.plugin == plugin
    with open_source(config) as source:
        assert len(list(islice(source, 5))) == 5


def test_a_table_is_put_together_from_the_files_beside_it(folder: Path, capsys) -> None:
    config = written(folder, "lab_odometry.csv")
    said = capsys.readouterr().out
    assert "lab_scans.csv" in said
    assert "lab_truth.csv" in said
    table = config.recording and config.recording.table
    assert table is not None
    assert table.pose is not None
    assert table.pose.heading == "theta"
    assert table.views is not None
    assert table.views.time == "time"
    assert table.views.max_range == 2.5  # 1.25 times the 90 % quantile, rounded
    assert table.truth is not None
    assert table.truth.heading == "yaw"
    assert config.pose_cells.cell_size == 0.19  # 13 cells in the range
    with open_source(config) as source:
        samples = list(source)
    assert all(sample.truth is not None and sample.reading.view_seen for sample in samples)


def test_the_configuration_may_stand_in_another_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "configs").mkdir()
    monkeypatch.chdir(folder)
    assert main(["doctor", "lab_odometry.csv", "-o", "configs/mine.yaml"]) == 0
    monkeypatch.chdir(folder.parent)
    with open_source(load_config(folder / "configs" / "mine.yaml")) as source:
        assert sum(sample.truth is not None and bool(sample.reading.view_seen) for sample in source) == STEPS


def images(folder: Path, encoding: str, height: int, width: int) -> Path:
    """A bag of small images of another camera beside the odometry."""
    entries = []
    for stamp in range(START, START + STEPS * STEP, STEP):
        entries.append(odometry(stamp, (stamp - START) / 10**9, 0, 0))
        fields = {"height": height, "width": width, "step": width * 4, "encoding": encoding}
        data = {"header": header(stamp), "data": np.full(width * 4 * height, 7, np.uint8)}
        entries.append(Entry("/camera", "sensor_msgs/msg/Image", stamp, fields | data))
    folder.mkdir()
    return write_bag(folder, "mcap", entries)


def test_small_images_are_views_as_they_are(tmp_path: Path) -> None:
    images(tmp_path / "bag", "mono8", 3, 6)
    config = written(tmp_path, "bag/run/metadata.yaml")
    assert config.recording is not None
    assert config.recording.file == tmp_path / "bag" / "run"
    with open_source(config) as source:
        assert source.view_shape == (3, 6, 1)


def test_views_that_cannot_be_read_are_a_fault(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "mine.yaml"
    assert main(["doctor", str(images(tmp_path / "bag", "32FC1", 60, 80)), "-o", str(output)]) == 1
    assert not output.exists()
    (fault,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("fault: "))
    assert "/camera, message 0, at" in fault
    assert "distances (32FC1)" in fault
    assert "recording.topics.views" in fault


def test_other_robots_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    still = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    links = [
        tf(stamp, *(transform(stamp, f"{name}/odom", f"{name}/base_link", stamp / 10**9 - 1.7e9, 0, still)
                    for name in ("ada", "bob")))
        for stamp in range(START, START + STEPS * STEP, STEP)
    ]  # fmt: skip
    write_bag(tmp_path, "ros1", links)
    config = written(tmp_path, "run.bag")
    assert config.recording is not None
    assert config.recording.topics is not None
    assert config.recording.topics.odometry is not None
    assert config.recording.topics.odometry.tf == ("ada/odom", "ada/base_link")
    said = capsys.readouterr().out
    assert "other robots: [bob/odom, bob/base_link]" in said
    assert "frames: ada/odom -> ada/base_link, bob/odom -> bob/base_link; 0 fixed links" in said


def test_a_ring_of_beams_has_its_field_of_view(folder: Path) -> None:
    assert written(folder, "run").recall.sector_fov == pytest.approx(2 * np.pi, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "fault"),
    [("degrees.csv", "--set recording.table.units.angle=deg"), ("walls.csv", "no configuration reads it")],
)
def test_a_recording_that_cannot_be_read_has_a_fault(folder: Path, name: str, fault: str, capsys) -> None:
    """A fault that a setting cures has a configuration to set it in."""
    output = folder / "mine.yaml"
    assert main(["doctor", str(folder / name), "-o", str(output)]) == 1
    assert fault in capsys.readouterr().out
    assert output.exists() == fault.startswith("--set")


def test_a_file_of_no_known_kind_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("notes.txt", "notes.mat", "speeds.csv"):
        (tmp_path / name).write_text("t,v,w\n0,1,0\n1,1,0\n")
    for words, error in {
        "nothing.bag": "no such file",
        "notes.txt": "no reader for '.txt'",
        "notes.mat": "no reader for '.mat' files",
        "speeds.csv --set seed=1": "--set",  # settings belong to live sessions
    }.items():
        assert main(["doctor", *f"{tmp_path}/{words}".split()]) == 2
        assert error in capsys.readouterr().err


def test_the_turtlebot_bag_runs_as_the_doctor_says(reference_data: Path, tmp_path: Path) -> None:
    bag = reference_data / "bags" / "turtlebot4_first_floor"
    if not bag.is_dir():
        pytest.skip(f"no bag {bag}")
    output = tmp_path / "mine.yaml"
    assert main(["doctor", str(bag), "-o", str(output)]) == 0
    config = load_config(output)
    assert config.recording is not None
    assert config.recording.topics is not None
    assert config.recording.topics.odometry is not None
    assert config.recording.topics.odometry.topic == "/odom"
    with open_source(config) as source:
        assert source.length == 920
        assert sum(bool(sample.reading.view_seen) for sample in source) == 355


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("lab_odometry.csv", ["recording.table.columns=4", "recording.table.views.max_range=1.5"]),
        ("run", ["recording.topics.views.rows=2", "recording.topics.views.max_range=3"]),
        ("loop.avi", ["recording.image.rows=6", "recording.image.crop.y_min=9"]),
        ("touch.mcap", ["touch.image.tallest=0.2"]),
    ],
)
def test_a_configuration_like_a_map_fits_it(folder: Path, name: str, settings: list[str]) -> None:
    """It has every setting of the sensor and the method that a session in the map needs."""
    written(folder, name)
    settings += ["pose_cells.cell_size=0.07", "keyframes.min_score=0.7"]
    with open_source(load_config(folder / "elsewhere.yaml", settings)) as source:
        config = complete(load_config(folder / "elsewhere.yaml", settings), source)
        like = SavedMap(folder / "map.npz", "", "", config, describe_readings(source), "", {})
    found = diagnose_recording(folder / name, like)
    assert not found.faults
    with open_source(validate(parse(dump_data(found.config), "like.yaml"), RunConfig)) as source:
        completed = complete(validate(parse(dump_data(found.config), "like.yaml"), RunConfig), source)
        assert like.sensor.differences(Sensor.of(completed, source)) == []
    assert differing_settings([config, completed]) == {}


def test_a_configuration_like_a_map_of_another_sensor_is_a_fault(folder: Path) -> None:
    config = written(folder, "run")
    with open_source(config) as source:
        like = SavedMap(
            folder / "map.npz", "", "", complete(config, source), describe_readings(source), "", {}
        )
    for name, words in (("touch.mcap", "the sensor is whisker head"), ("lab_odometry.csv", "a table")):
        assert any(words in fault for fault in diagnose_recording(folder / name, like).faults)
    with pytest.raises(InputError, match=r"topics of a bag over .* rad, and not a table over an unknown"):
        localising(written(folder, "lab_odometry.csv"), like)
