"""The bench check of a Create: emulated robots with drawn firmware, in simulated time; one on a terminal."""

import json
import subprocess
import sys

import numpy as np
import pytest

from ratslam.cli import main
from ratslam.runs.settings.run_config import load_config
from ratslam.service.create_check import TOLERANCE, judge_create
from ratslam.service.robot_check import RobotReport, RobotRequest, check_create
from robot.drivers.create.driver_config import CreateConfig
from robot.drivers.create.protocol import MODELS, WRAP
from robot.emulators.create.emulator_config import FirmwareConfig
from robot.live.create_bench import BenchPlan, drive_bench, runs_of_data, runs_to_data
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tests.helpers.create_line import SimulatedBench, SimulatedDriver

UNKNOWN = "cannot tell"


def drawn(seed):
    """A firmware and a wheel base, m, drawn by a seed."""
    random = stream(seed, "firmware")
    model = ("create1", "create2")[seed % 2]

    def scale(known):
        kind = random.integers(4)
        if kind == 0:
            return 1.0
        if kind == 1:
            return float(random.choice(known))
        return 1 + float(random.choice([-1, 1]) * random.uniform(0.02, 0.2))

    wrap = int(random.choice([WRAP, WRAP, WRAP, 2**15]))
    firmware = FirmwareConfig(
        model=model,
        distance_scale=scale([0.923, 1.083]),
        turn_scale=scale([91 / 360, 420 / 360]),
        remainders=str(random.choice(["kept", "lost"])),
        counts=int(random.integers(wrap)) if random.uniform() < 0.15 else 0,
        wrap=wrap,
        latency=random.uniform(0.001, 0.018) if random.uniform() < 0.7 else random.uniform(0.035, 0.08),
    )
    return firmware, MODELS[model].wheel_base * random.uniform(0.98, 1.02)


def truth_of(firmware, base):
    """What the check should say of a robot; encoders know nothing of the distance between its wheels."""
    one = firmware.model == "create1"
    wider = 1.0 if one else base / MODELS[firmware.model].wheel_base
    wrong = lambda scale: "scale wrong" if abs(1 / scale - 1) > TOLERANCE else "fine"  # noqa: E731
    return {
        "remainders": "remainders lost" if one and firmware.remainders == "lost" else "fine",
        "wrap": "fine" if one or firmware.wrap == WRAP else "wrap",
        "latency": "latency" if firmware.latency > 0.025 else "fine",
        "turn": wrong(firmware.turn_scale * wider),
        "distance": wrong(firmware.distance_scale),
    }


def checked(firmware, base, marks=True):
    """The check of an emulated robot: its bench, runs, verdicts, rig."""
    simulated = SimulatedBench(firmware, base, marks)
    config = CreateConfig(model=firmware.model)
    runs, measured = drive_bench(config, BenchPlan(), simulated.bench, lambda line: None)
    return simulated, runs, *judge_create(config, runs, *measured)


def errors_with(simulated, rig):
    """Errors of the odometry with the settings of a rig: degrees a turn, over six, and share of 2 m."""
    found = rig.included().get("live", {}).get("create", {})
    config = CreateConfig(**{"model": simulated.line.robot.config.firmware.model, **found})
    driver, robot = SimulatedDriver(simulated.line, config), simulated.line.robot
    errors = []
    for commands in (2 * [(0, 5), (0, 20), (0, 60)], [(0.1, 0), (0.2, 0)]):
        driver.refresh()
        driver.loop.take_odometry()
        before = robot.base
        for forward, turn in commands:
            for _ in range(round((360 / turn if turn else 1 / forward) / 0.4)):
                driver.drive(forward, np.radians(turn))
                driver.sleep(0.4)
            driver.stop()
            driver.sleep(0.4)
        driver.refresh()
        motion = driver.loop.take_odometry()
        errors.append((motion, robot.base.turned - before.turned, robot.base.travelled - before.travelled))
    (turn, turned, _), (drive, _, travelled) = errors
    return abs(np.degrees(turn.dtheta - turned)) / 6, abs(np.hypot(drive.dx, drive.dy) / travelled - 1)


def score(seeds):
    """Numbers of wrong verdicts and of robots of which something is not known; worst errors of known ones."""
    wrong, unknown, worst = [], set(), [0.0, 0.0]
    for seed in seeds:
        firmware, base = drawn(seed)
        simulated, _, verdicts, rig = checked(firmware, base)
        truth = truth_of(firmware, base)
        found = {each.question: each.found for each in verdicts}
        assert found.keys() == truth.keys()
        wrong += [(seed, q, found[q], truth[q]) for q in truth if found[q] not in (truth[q], UNKNOWN)]
        unknown |= {seed} if UNKNOWN in found.values() else set()
        errors = errors_with(simulated, rig)
        for k, question in enumerate(("turn", "distance")):
            if UNKNOWN not in (found[question], found["wrap"]):
                worst[k] = max(worst[k], errors[k])
    return wrong, unknown, worst


def test_the_firmware_of_six_robots_is_named_and_corrected():
    wrong, unknown, worst = score(range(6))
    assert wrong == []
    assert len(unknown) <= 2
    assert worst[0] < 1.0
    assert worst[1] < 0.01


@pytest.mark.soak
def test_the_firmware_of_fifty_robots_is_named_and_corrected():
    wrong, unknown, worst = score(range(50))
    print(wrong, unknown, worst)
    assert wrong == []
    assert len(unknown) <= 5
    assert worst[0] < 1.0
    assert worst[1] < 0.01


def test_without_marks_the_scales_are_unknown_and_the_rest_is_not():
    _, runs, verdicts, rig = checked(FirmwareConfig(remainders="lost", turn_scale=0.9), 0.258, marks=False)
    found = {each.question: each.found for each in verdicts}
    assert (found["turn"], found["distance"], found["remainders"]) == (UNKNOWN, UNKNOWN, "remainders lost")
    assert rig.included()["live"]["create"] == {"remainders": "lost"}
    again = [*runs_of_data(json.loads(json.dumps(runs_to_data(runs))))]
    verdicts, rig = judge_create(CreateConfig(), again, 353.0, 1.0)
    assert {each.question: each.found for each in verdicts}["turn"] == "scale wrong"
    assert "turn_scale" in rig.included()["live"]["create"]


@pytest.mark.parametrize(("stuck", "found"), [((5,), "fine"), ((5, 0.01), UNKNOWN)])
def test_wheels_that_stick_at_low_speed_are_not_taken_for_lost_remainders(stuck, found):
    _, runs, _, _ = checked(FirmwareConfig(), 0.258)
    for run in runs:
        run.rows[:, 4:6] *= run.speed not in stuck
    verdicts, _ = judge_create(CreateConfig(), runs, 360.0, 1.0)
    assert {each.question: each.found for each in verdicts}["remainders"] == found


def test_the_report_has_a_page_a_rig_and_a_record(tmp_path):
    _, runs, verdicts, rig = checked(FirmwareConfig(turn_scale=0.9), 0.258)
    report = RobotReport(verdicts, rig, {"robot": "create", "runs": runs_to_data(runs)})
    report.write(tmp_path / "bench", "create.yaml")
    assert report.faulty
    assert "scale wrong" in (tmp_path / "bench/page.txt").read_text()
    (tmp_path / "create.yaml").write_text("include: [bench/rig.yaml]\nbackend: grid\n")
    assert abs(load_config(tmp_path / "create.yaml").live.create.turn_scale - 1 / 0.9) < 0.004
    assert json.loads((tmp_path / "bench/bench.json").read_text())["robot"] == "create"


OTHERS = [
    "", "[]", '{"format": "ratslam-bench-1", "robot": "create"}', '{"format": 1, "robot": "arm"}',
    json.dumps({"format": "ratslam-bench-1", "robot": "create", "settings": {}, "marks": {}, "runs": []}),
]  # fmt: skip


@pytest.mark.parametrize("text", OTHERS)
def test_a_record_of_something_else_is_refused(text, tmp_path):
    (tmp_path / "bench.json").write_text(text)
    with pytest.raises(InputError, match="a check of `create`"):
        check_create(RobotRequest(tmp_path / "bench.json", [], {"turned_deg": 353.0, "drove_m": None}))


def test_a_robot_on_a_terminal_is_checked(tmp_path):
    """A short plan in real time, through the port, the driver and its watchdog."""
    pytest.importorskip("serial", reason="needs pyserial")
    pytest.importorskip("termios", reason="needs pseudo-terminals")
    port = tmp_path / "create.tty"
    emulated = {"port": str(port), "firmware": {"remainders": "lost", "turn_scale": 0.8}}
    words = [sys.executable, "-m", "robot.emulators.create", "--config", json.dumps(emulated)]
    pipe = subprocess.PIPE
    process = subprocess.Popen(words, stdin=pipe, stdout=pipe, text=True, bufsize=1)
    config = tmp_path / "create.yaml"
    limits = "silence: 2, patience: 5, replug: 0.01"
    config.write_text(f"live: {{create: {{port: {port}, {limits}}}}}\nbackend: grid\n")
    plan = BenchPlan(turn=40, turn_rates=(5, 60), way=0.15, slow_way=0.02, polls=(20,))
    try:
        assert process.stdout.readline().split()[0] == str(port)
        report = check_create(RobotRequest(config, [], {"turned_deg": 40.0, "drove_m": 0.15}), plan)
    finally:
        process.kill()
        process.communicate()
    found = {each.question: each.found for each in report.verdicts}
    assert found["remainders"] == "remainders lost"
    assert found["turn"] == "scale wrong"
    assert abs(report.rig.included()["live"]["create"]["turn_scale"] - 1.25) < 0.15
    report.write(tmp_path / "bench", "create.yaml")
    again = ["check", "robot", "create", str(tmp_path / "bench/bench.json"), "--turned-deg", "32"]
    assert main([*again, "--drove-m", "0.15", "-o", str(tmp_path / "again")]) == 1
    assert json.loads((tmp_path / "again/bench.json").read_text())["marks"]["turned_deg"] == 32
