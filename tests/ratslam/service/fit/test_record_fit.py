"""`fit` measures wheels, head and signals of a record, and writes what a configuration includes."""

from pathlib import Path

import numpy as np
import pytest

from evaluation.metrics.trajectory import ate
from ratslam.runs.build_session import open_source
from ratslam.runs.settings.run_config import load_config
from ratslam.service.record_fit import fit_record, fit_revisits, fit_wheels_of
from ratslam.service.rig_fit import Quantity, Rig, fit_wheels
from robot.recordings.mcap_writer import record_source
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources.in_memory import load_into_memory
from robot.sources.odometry import correct_motions, from_motions
from robot.world.maze import parse_maze, wall_boxes
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import integrate
from tactile.whisker_geometry import HeadConfig
from tests.helpers.commands import SQUARE, refused, said
from tests.helpers.corridor_camera import write_csv

ROWS = 900
NOISE, DEAD = 3e-3, 7


def value(rig: Rig, name: str) -> float:
    return next(quantity.value for quantity in rig.quantities if quantity.name == name)


def fitted(folder: Path, text: str) -> Rig:
    (folder / "config.yaml").write_text(text)
    return fit_record(load_config(folder / "config.yaml"))


def session(head: HeadConfig, **settings: object) -> HeadSimulation:
    return HeadSimulation(SimulationConfig.model_validate(settings), head)


def test_wheels_are_measured_and_the_file_is_included(tmp_path: Path, capsys) -> None:
    """The turns are 10 % short by the odometry."""
    random = np.random.default_rng(0)
    time, way, turn = 0.5 * np.arange(ROWS), random.uniform(0, 0.2, ROWS), random.normal(0, 0.2, ROWS)
    way[0] = turn[0] = 0
    wander = 0.01 * random.standard_normal(ROWS)  # rad
    x, y, heading = integrate(from_motions(time, way, 0.0, 1.1 * turn + wander)[:, :3]).T
    (tmp_path / "bare").mkdir()
    for name in ("bare/alone.csv", "drive_odometry.csv"):
        write_csv(tmp_path / name, t=time, distance=way, turn=turn)
    write_csv(tmp_path / "drive_truth.csv", t=time, x=x, y=y, heading=heading)
    rig = tmp_path / "rig.yaml"
    lines = said(capsys, "fit", tmp_path / "drive_odometry.csv", "-o", rig).splitlines()
    row = next(line.split() for line in lines if line.startswith("turn scale"))
    assert (row[2], row[-1]) == ("1", "recording.odometry.turn_scale")
    assert float(row[3]) == pytest.approx(1.1, abs=0.02)
    assert any(line.startswith("length scale") and line.endswith("unchanged, within 2 sd") for line in lines)
    (tmp_path / "mine.yaml").write_text("include: [rig.yaml]\nrecording: {file: drive_odometry.csv}\n")
    found = load_config(tmp_path / "mine.yaml").recording.odometry
    assert (found.turn_scale, found.length_scale) == (pytest.approx(1.1, abs=0.02), 1)
    assert f"# {lines[0]}" in rig.read_text()
    # Without truth and views the wheels are unknown, and nothing is written.
    bare = refused(capsys, "fit", tmp_path / "bare" / "alone.csv", "-o", tmp_path / "no.yaml")
    assert "nothing that tells of the rig" in bare
    assert not (tmp_path / "no.yaml").exists()


def test_settings_are_those_that_differ() -> None:
    head = {"touch": {"head": {"dead": [2]}}}
    sure = Quantity("a", 1.0, 1.1, 0.01, "", "recording.odometry.turn_scale")
    unsure = Quantity("b", 1.0, 1.1, 0.1, "", "recording.odometry.length_scale")
    rig = Rig((sure, unsure, Quantity("c", None, 3.0, 0.1, "")), head)
    assert rig.included() == {"recording": {"odometry": {"turn_scale": 1.1}}} | head
    assert "nothing to include" in Rig().file_text("a.csv")


def test_the_head_and_its_dead_whiskers_are_measured(tmp_path: Path, capsys) -> None:
    whisks = session(HeadConfig(rest_deg=62, dead=(4,)), path={"explore": 120}, motion={"speed": 0.03})
    record_source(whisks, tmp_path / "w.mcap")
    wrong = ["--set", "touch.head.rest_deg=75", "--set", "touch.head.dead=[]"]
    text = said(capsys, "fit", tmp_path / "w.mcap", "-o", tmp_path / "head.yaml", *wrong)
    assert "not determined: noise, drift, baseline" in text  # of whisks without raw samples
    assert "not determined: radius of ring 0" in text
    (tmp_path / "head_run.yaml").write_text("include: [head.yaml]\nrecording: {file: w.mcap}\n")
    head = load_config(tmp_path / "head_run.yaml").touch.head
    assert head.rest_deg == pytest.approx(62 + np.degrees(0.015), abs=0.5)
    assert head.rings[2].radius == pytest.approx(0.08, rel=0.02)
    assert head.dead == (4,)


def test_the_walls_are_those_of_the_simulation() -> None:
    source = session(HeadConfig(), path={"explore": 5}, maze={"heights": [0.03, 0.05]})
    maze, walls = source.info.maze, source.scene.surroundings.walls
    heights = stream(maze.seed, "maze.heights")
    again = wall_boxes(parse_maze(maze.text, Path("maze of the recording")), heights, maze.heights)
    np.testing.assert_array_equal(again.box, walls.box)
    np.testing.assert_array_equal(again.height, walls.height)


def test_noise_rest_angle_and_a_dead_whisker_are_found_in_raw_whisks(tmp_path: Path) -> None:
    """Of a head of rest angle 60 degrees with a dead whisker, fitted as one of 75 degrees."""
    settings = {"raw": True, "path": {"explore": 60}, "mechanics": {"noise": NOISE}, "seed": 1}
    record_source(session(HeadConfig(rest_deg=60, dead=(DEAD,)), **settings), tmp_path / "raw.mcap")
    rig = fitted(tmp_path, "recording: {file: raw.mcap}\ntouch: {head: {rest_deg: 75, dead: []}}\n")
    assert value(rig, "noise, median channel") == pytest.approx(NOISE, rel=0.05)
    assert abs(value(rig, "correlation of neighbours")) < 0.1
    # Sensor noise alone, at rest: its means over 50 ms move by chance only.
    assert value(rig, "drift, median channel") < 0.2 * NOISE
    head = rig.included()["touch"]["head"]
    assert head["dead"] == [DEAD]
    assert f"whisker {DEAD}: dead: no signal" in [line.strip() for line in rig.notes]
    assert 60 < head["rest_deg"] < 62.5  # from detected contacts, whose delay is part of it


def test_whiskers_of_the_arm_in_clutter(reference_data: Path, tmp_path: Path) -> None:
    file = next((reference_data / "real_touch").rglob("reaching_take20_in_clutter.csv"))
    rig = fitted(tmp_path, f"source: {{plugin: whisker_reach, settings: {{file: {str(file)!r}}}}}\n")
    assert 1.2 < value(rig, "noise, median channel") < 3.0
    assert 0.2 < value(rig, "correlation of neighbours") < 0.7
    dirty = [k for k, line in enumerate(rig.notes) if "dirty" in line]
    assert [rig.notes[k - 1].split(":")[0].strip() for k in dirty] == ["right5"]
    unknown = " ".join(rig.unknown)
    assert all(f"drift of left{k}" not in unknown for k in (4, 5, 6, 7))  # they never touch
    assert "drift of right4" in unknown
    assert "stage-to-signal map: no known touch" in unknown
    assert not any("nan" in line for line in rig.notes)
    assert rig.included() == {}


@pytest.mark.parametrize("scrambled", [False, True])
def test_the_map_of_a_stage_is_scored_on_rows_held_out(scrambled: bool, tmp_path: Path) -> None:
    """Of a calibration along rays from a whisker's base, in mm and counts; or of signals in random order."""
    random = np.random.default_rng(0)
    ray, reach = np.meshgrid(np.linspace(-0.8, 0.8, 12), np.linspace(0, 40, 13), indexing="ij")
    across, along = np.sin(ray) * reach, np.cos(ray) * reach
    signal = np.stack([10 * across, along**2 / 4, across * along / 10], axis=-1).reshape(-1, 3)
    signal += random.standard_normal(signal.shape)
    if scrambled:
        signal = random.permutation(signal)
    place = np.stack([50 + along, 60 + across, np.full(ray.shape, 20.0)], axis=-1).reshape(-1, 3)
    rows, header = np.column_stack([np.arange(len(place)), place, signal]), ",px,py,pz,sx,sy,sz"
    np.savetxt(tmp_path / "stage.csv", rows, delimiter=",", header=header, comments="", fmt="%.9g")
    rig = fitted(tmp_path, "source: {plugin: whisker_stage, settings: {file: stage.csv}}\n")
    error, control = value(rig, "error of the map, held out"), value(rig, "error without a map (the mean)")
    assert (error < 0.1 * control) == (not scrambled)


@pytest.mark.soak
def test_revisits_tell_the_heading_bias_of_the_square() -> None:
    """Against its true poses: three laps of a square by a robot with a biased gyro."""
    config = load_config(SQUARE)
    with open_source(config) as source:
        log = load_into_memory(source)
    assert log.truth is not None
    true, found = fit_wheels(log.time, log.motion, log.truth), fit_revisits(config)
    assert found is not None
    bias = found.quantities[-1].value
    assert abs(true.heading_bias[0]) > 0.01
    assert abs(bias - true.heading_bias[0]) < 0.5 * abs(true.heading_bias[0])
    assert np.sign(bias) == np.sign(true.heading_bias[0])


@pytest.mark.parametrize("known", [True, False])
def test_a_record_without_truth_tells_no_length_scale(known: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same record, its truth withheld; a map that closes no loops tells nothing at all."""
    config = load_config(SQUARE)
    with open_source(config) as source:
        samples = list(source)
    if known:
        names = [quantity.name for quantity in fit_wheels_of(config, config, samples, 0).quantities]
        assert names[:3] == ["length scale", "turn scale", "heading bias"]
    turn = Quantity("turn scale", 1.0, 1.0, 0.02, "rad/rad", "recording.odometry.turn_scale")
    bias = Quantity("heading bias", 0.0, 0.03, 0.001, "rad/m", "recording.odometry.heading_bias")
    found = Rig((turn, bias)) if known else None
    monkeypatch.setattr("ratslam.service.record_fit.fit_revisits", lambda config, assumed: found)
    rig = fit_wheels_of(config, config, [sample._replace(truth=None) for sample in samples], 0)
    assert [quantity.name for quantity in rig.quantities] == (["turn scale", "heading bias"] if known else [])
    assert any("length scale" in reason for reason in rig.unknown)
    assert rig.included() == ({"recording": {"odometry": {"heading_bias": 0.03}}} if known else {})


# Wheels whose errors are known

LENGTH, TURN, BIAS = 0.93, 1.12, -0.04
HEADING_NOISE, TURN_NOISE = 0.03, 0.05  # rad per root metre, rad per root radian
LONG = 3000


def drive(seed: int, rows: int = LONG, turning: float = 0.25) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, odometry with the errors above, and true poses of a robot."""
    random, time = np.random.default_rng(seed), 0.5 * np.arange(rows)
    way, turn = random.uniform(0, 0.2, rows), turning * random.standard_normal(rows)
    motion = from_motions(time, way, 0.0, turn)[:, :3]
    noise = HEADING_NOISE * np.sqrt(way) * random.standard_normal(rows)
    noise += TURN_NOISE * np.sqrt(np.abs(turn)) * random.standard_normal(rows)
    noise[0] = way[0] = turn[0] = 0
    true = from_motions(time, LENGTH * way, 0.0, TURN * turn + BIAS * way + noise)[:, :3]
    return time, motion, integrate(true)


def assert_near(found: tuple[float, float] | None, value: float) -> None:
    assert found is not None
    assert abs(found[0] - value) < 4 * found[1], (found, value)


def test_systematic_errors_and_noise_are_found() -> None:
    """Those of one half help the other; noises and bootstrapped deviations follow from the seed."""
    time, motion, truth = drive(0)
    found = fit_wheels(time, motion, truth)
    for pair, value in ((found.length_scale, LENGTH), (found.turn_scale, TURN), (found.heading_bias, BIAS)):
        assert_near(pair, value)
    known = [
        *(0.928631, 0.000578346, 1.11782, 0.00403612, -0.0399550, 0.00273854, 0.0418676, 0.0284970),
        *(0.0462067, 0.0169346, 0.0112152, 0.000474860, 0.0142971, 0.000576295),
    ]
    np.testing.assert_allclose(np.ravel(found[:7]), known, rtol=1e-4)
    assert found[7:] == (149, 0, pytest.approx(296.8448), pytest.approx(594.2349))
    assert found.heading_bias[1] != fit_wheels(time, motion, truth, seed=4).heading_bias[1]
    half = LONG // 2
    correction = fit_wheels(time[:half], motion[:half], truth[:half]).correction
    rest = motion[half:]
    before = ate(integrate(rest), truth[half:])
    assert ate(integrate(correct_motions(correction, rest)), truth[half:]) < 0.5 * before


def test_slips_are_counted_and_spoil_little_and_rows_without_truth_are_bridged() -> None:
    time, motion, truth = drive(8)
    clean = fit_wheels(time, motion, truth)
    motion[[500, 1500, 2500], 2] += 2.0
    slipped = fit_wheels(time, motion, truth)
    assert (clean.slips, slipped.slips) == (4, 8)
    truth[::3] = np.nan
    found = [np.array(one[:3])[:, 0] for one in (clean, slipped, fit_wheels(time, motion, truth))]
    np.testing.assert_allclose(found[1:], [found[0]] * 2, rtol=0, atol=0.01)
    straight = fit_wheels(*drive(10, turning=1e-4))
    assert straight.turn_scale is None  # of a robot that hardly turns
    assert_near(straight.heading_bias, BIAS)


def test_a_record_that_tells_nothing_is_refused() -> None:
    time, motion, truth = drive(12, 252)  # 12 windows of 10 s
    assert fit_wheels(time, motion, truth).windows == 12
    short = time[:240], motion[:240], truth[:240]
    for record in (short, (time, 0 * motion, truth), (time, motion, np.nan * truth)):
        with pytest.raises(InputError, match="windows"):
            fit_wheels(*record)
