"""The doctor: what a recording holds, what reads it, and whether to believe the map of a run."""

import json
import re
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

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
from tests.helpers.commands import ROOT, said
from tests.helpers.corridor_camera import Camera, CorridorLoop, write_csv, write_video
from tests.helpers.ros_bags import Entry, header, odometry, scan, tf, transform, write_bag

START, STEP = 1_700_000_000_000_000_000, 100_000_000  # ns
STEPS = 40
STAMPS = range(START, START + STEPS * STEP, STEP)
REAL = ROOT / "tests" / "data" / "real_touch"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of a robot that drives along an arc at 1 m/s, one of each kind."""
    folder, time = tmp_path_factory.mktemp("recordings"), np.arange(STEPS) / 10
    heading = 0.05 * np.arange(STEPS)
    x, y = np.cumsum(0.1 * np.cos(heading)), np.cumsum(0.1 * np.sin(heading))
    ranges = 1 + np.abs(np.sin(time[:, None] + np.arange(36)))
    write_csv(folder / "lab_odometry.csv", t=time, x=x, y=y, theta=heading)
    write_csv(folder / "lab_scans.csv", time=time, **{f"r{k}": ranges[:, k] for k in range(36)})
    write_csv(folder / "lab_truth.csv", t=time, x=x, y=y, yaw=heading)
    write_csv(folder / "speeds.csv", Time=time, V=np.full(STEPS, 1.0), omega=np.full(STEPS, 0.5))
    write_csv(folder / "degrees.csv", t=time, x=x, y=y, heading=np.rad2deg(20 * heading))
    write_csv(folder / "walls.csv", x1=x, y1=y)
    messages = []
    for k, stamp in enumerate(STAMPS):
        messages += [odometry(stamp, x[k], y[k], heading[k]), scan(stamp, ranges[k], -np.pi, np.pi / 18)]
    write_bag(folder, "sqlite3", messages)
    world = CorridorLoop(seed=5, length=5.0, depth=4.0, breadth=1.4, laps=0.05)
    write_video(folder / "loop.avi", Camera(fov_deg=90, width=96, height=64).frames(world), 10, "MJPG")
    touch = HeadSimulation(SimulationConfig.model_validate({"path": {"explore": 5}}))
    record_source(touch, folder / "touch.mcap")
    return folder


@pytest.fixture
def written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """A function that gives the configuration that the doctor writes for a recording, and what it says."""

    def write(path: Path) -> tuple[Any, str]:
        (tmp_path / "mine.yaml").unlink(missing_ok=True)
        text = said(capsys, "doctor", path, "-o", tmp_path / "mine.yaml")
        return load_config(tmp_path / "mine.yaml"), text

    return write


@pytest.mark.parametrize(
    ("name", "samples", "whiskers", "cell"),
    [
        ("lab_odometry.csv", STEPS, 0, 0.19),  # 13 cells in the range
        ("speeds.csv", STEPS, 0, 0.1),
        ("run", STEPS, 0, 0.62),
        ("loop.avi", None, 0, None),
        ("touch.mcap", 5, 18, None),
    ],
)
def test_the_configuration_reads_the_recording(folder, written, name, samples, whiskers, cell) -> None:
    config, _ = written(folder / name)
    with open_source(config) as source:
        assert source.whiskers == whiskers
        assert samples is None or len(list(source)) == samples
        assert samples is None or source.view_shape == (3, 6, 1)
        assert len(list(islice(source, 5))) == 5
    assert cell is None or (config.pose_cells.cells_xy, config.pose_cells.cell_size) == (61, cell)
    if name == "loop.avi":
        assert (config.recording.video.rate, config.recording.visual_odometry.fov_deg) == (10, 60)
    if name == "run":  # a ring of beams
        assert config.recall.sector_fov == pytest.approx(2 * np.pi, abs=1e-3)


def test_a_recording_of_a_registered_source_is_named(written) -> None:
    for name, plugin in (
        ("stanford/stage_cylinder_2.csv", "whisker_stage"),  # a table without times
        ("purdue/cherry.csv", "whisker_objects"),  # no header
        ("sheffield/TXZY_dataI.mat", "taxel_contacts"),  # no reader of ours
    ):
        config, _ = written(REAL / name)
        assert config.source.plugin == plugin
        with open_source(config) as source:
            assert len(list(islice(source, 5))) == 5


def test_a_table_is_put_together_from_the_files_beside_it(folder: Path, written, monkeypatch) -> None:
    """By a configuration that stands in another folder."""
    monkeypatch.chdir(folder)
    config, text = written(Path("lab_odometry.csv"))
    for words in ("lab_scans.csv", "lab_truth.csv", "truth: for 100% of the samples"):
        assert words in text
    table = config.recording.table
    assert (table.pose.heading, table.views.time, table.truth.heading) == ("theta", "time", "yaw")
    assert table.views.max_range == 2.5  # 1.25 times the 90 % quantile, rounded
    monkeypatch.chdir(folder.parent)
    with open_source(config) as source:
        known = [sample.truth is not None and bool(sample.reading.view_seen) for sample in source]
    assert known == [True] * STEPS


def images(folder: Path, encoding: str, height: int, width: int) -> Path:
    """A bag of small images of another camera beside the odometry."""
    entries, data = [], np.full(width * 4 * height, 7, np.uint8)
    fields = {"height": height, "width": width, "step": width * 4, "encoding": encoding, "data": data}
    for stamp in STAMPS:
        entries.append(odometry(stamp, (stamp - START) / 10**9, 0, 0))
        entries.append(Entry("/camera", "sensor_msgs/msg/Image", stamp, fields | {"header": header(stamp)}))
    folder.mkdir()
    return write_bag(folder, "mcap", entries)


def test_small_images_are_views_as_they_are_and_other_robots_are_named(tmp_path: Path, written) -> None:
    images(tmp_path / "bag", "mono8", 3, 6)
    config, _ = written(tmp_path / "bag" / "run" / "metadata.yaml")
    assert config.recording.file == tmp_path / "bag" / "run"
    with open_source(config) as source:
        assert source.view_shape == (3, 6, 1)
    still = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    links = [
        tf(stamp, *(transform(stamp, f"{name}/odom", f"{name}/base_link", stamp / 10**9 - 1.7e9, 0, still)
                    for name in ("ada", "bob")))
        for stamp in STAMPS
    ]  # fmt: skip
    write_bag(tmp_path, "ros1", links)
    config, text = written(tmp_path / "run.bag")
    assert config.recording.topics.odometry.tf == ("ada/odom", "ada/base_link")
    assert "other robots: [bob/odom, bob/base_link]" in text


def test_what_cannot_be_read_is_a_fault(folder: Path, tmp_path: Path, capsys) -> None:
    """A fault that a setting cures has a configuration to set it in."""
    output, bag = tmp_path / "mine.yaml", images(tmp_path / "bag", "32FC1", 60, 80)
    for path, words in (
        (bag, r"/camera, message 0, at.*distances \(32FC1\).*recording.topics.views"),
        (folder / "walls.csv", "no configuration reads it"),
        (folder / "degrees.csv", "--set recording.table.units.angle=deg"),
    ):
        assert not output.exists()
        assert re.search(f"fault: .*{words}", said(capsys, "doctor", path, "-o", output, code=1))
    assert output.exists()


def test_the_turtlebot_bag_runs_as_the_doctor_says(reference_data: Path, written) -> None:
    bag = reference_data / "bags" / "turtlebot4_first_floor"
    if not bag.is_dir():
        pytest.skip(f"no bag {bag}")
    config, _ = written(bag)
    assert config.recording.topics.odometry.topic == "/odom"
    with open_source(config) as source:
        assert source.length == 920
        assert sum(bool(sample.reading.view_seen) for sample in source) == 355


def map_of(config: RunConfig, path: Path) -> SavedMap:
    """The map of a session with this configuration, without its arrays."""
    with open_source(config) as source:
        return SavedMap(path, "", "", complete(config, source), describe_readings(source), "", {})


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("lab_odometry.csv", ["recording.table.columns=4", "recording.table.views.max_range=1.5"]),
        ("run", ["recording.topics.views.rows=2", "recording.topics.views.max_range=3"]),
        ("loop.avi", ["recording.image.rows=6", "recording.image.crop.y_min=9"]),
        ("touch.mcap", ["touch.image.tallest=0.2"]),
    ],
)
def test_a_configuration_like_a_map_fits_it(folder, written, name, settings, tmp_path: Path) -> None:
    """It has every setting of the sensor and the method that a session in the map needs."""
    written(folder / name)
    settings += ["pose_cells.cell_size=0.07", "keyframes.min_score=0.7"]
    like = map_of(load_config(tmp_path / "mine.yaml", settings), tmp_path / "map.npz")
    found = diagnose_recording(folder / name, like)
    assert not found.faults
    config = validate(parse(dump_data(found.config), "like.yaml"), RunConfig)
    with open_source(config) as source:
        completed = complete(config, source)
        assert like.sensor.differences(Sensor.of(completed, source)) == []
    assert differing_settings([like.config, completed]) == {}


def test_a_configuration_like_a_map_of_another_sensor_is_a_fault(folder, written, tmp_path: Path) -> None:
    like = map_of(written(folder / "run")[0], tmp_path / "map.npz")
    for name, words in (("touch.mcap", "the sensor is whisker head"), ("lab_odometry.csv", "a table")):
        assert any(words in fault for fault in diagnose_recording(folder / name, like).faults)
    with pytest.raises(InputError, match=r"topics of a bag over .* rad, and not a table over an unknown"):
        localising(written(folder / "lab_odometry.csv")[0], like)


# Of a run


def test_a_good_map_is_believed_and_the_doubt_in_its_health_decides(run: Path, capsys) -> None:
    text = said(capsys, "doctor", run)
    for words in ("Believe this map.", ": better than odometry", "input: clean", "loop closures: "):
        assert words in text
    assert "--continue" not in text
    for doubt, words in (
        (0.9, "Do not believe this map. It is 90%"),
        (0.5, "Take this map with care. It is 50%"),
        (0.1, "Believe this map. It is 90%"),
    ):
        (run / "health.json").write_text(json.dumps({"worse_than_odometry": doubt}))
        text = said(capsys, "doctor", run)
        assert words in text
        assert ("keyframes.noise" in text) == (doubt > 0.1)


def test_a_map_as_good_as_the_odometry_or_worse_or_without_closures_is_told(run: Path, capsys) -> None:
    path, odometry = (run / "trajectory.tum").read_text(), (run / "odometry.tum").read_text()
    (run / "trajectory.tum").write_text(odometry)
    assert ": no better than odometry" in said(capsys, "doctor", run)
    (run / "odometry.tum").write_text(path)
    assert ": worse than odometry" in said(capsys, "doctor", run)
    (run / "truth.tum").write_text("")
    assert "nothing but the health tells" in said(capsys, "doctor", run)
    file = run / "closures.csv"
    file.write_text(file.read_text().replace(",accepted,", ",open,"))
    assert "no loop closure was accepted" in said(capsys, "doctor", run)
    file.write_text(file.read_text().splitlines()[0] + "\n")
    assert "no place was recognised" in said(capsys, "doctor", run)


def test_a_run_is_said_to_be_interrupted_or_killed_and_how_to_go_on(run: Path, capsys) -> None:
    manifest = json.loads((run / "manifest.json").read_text())
    for status, digest, words in (
        ("interrupted", "abc", ""),
        ("running", "", "next: map its recording: python -m ratslam run "),
        ("running", "abc", "It was killed, or ended by an error"),
        ("running", "abc", "a run that was killed before its first step"),
    ):
        changes = {"status": status, "recording": manifest["recording"] | {"sha256": digest}}
        (run / "manifest.json").write_text(json.dumps(manifest | changes))
        if "first step" in words:
            (run / "online.tum").write_text("")
        text = said(capsys, "doctor", run)
        assert words in text
        assert (f"--continue {run}/map.npz" in text) == bool(digest)
        assert "This method" not in text


def test_bad_steps_are_faults_and_the_advice_is_a_setting_of_the_program(run: Path, capsys) -> None:
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("cell_size: 0.1\n", "cell_size: 0.01\n", 1))
    (advice,) = (line for line in said(capsys, "doctor", run).splitlines() if "cell_size" in line)
    assert advice.split("--set ")[1].split(":")[0] == "pose_cells.cell_size=0.1"
    header, *lines = (run / "steps.csv").read_text().splitlines()
    cells = lines[7].split(",")
    cells[header.split(",").index("outcome")] = "too_fast"
    lines[7] = ",".join(cells)
    (run / "steps.csv").write_text("\n".join([header, *lines]) + "\n")
    assert "fault: 1 of 349 steps: too fast" in said(capsys, "doctor", run, code=1)
