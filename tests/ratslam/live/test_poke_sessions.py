"""Sessions of an arm without a head: by the program, and faults of the arm while it pokes."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ratslam.cli import main
from robot.recordings.mcap_reader import Recording
from tests.helpers.commands import refused, said
from tests.helpers.live import ROOT, UR_FAULTS, started
from tests.ratslam.live.bench import Bench
from tests.ratslam.live.live_session import raise_priority
from tests.ratslam.live.test_complete_session import PATIENT, REPLAY, SAME

CONFIG = str(ROOT / "configs" / "live_poke.yaml")
QUICK = {"directions": 2, "reach": 0.085, "every": 0.09, "speed": 0.05}
"""Pokes ahead and behind that just reach a wall of the cell."""
RINGS = 4
SHORT = [
    *(name for name in PATIENT if not name.startswith(("live.head", "live.grace", "live.residual"))),
    f"live.whisks={RINGS}",
    *(f"touch.pokes.{name}={value}" for name, value in QUICK.items()),
]


def test_a_session_of_pokes_and_its_replay(loopback: str, tmp_path: Path) -> None:
    given = [word for setting in SHORT for word in ("--set", setting)]
    directory, log = tmp_path / "live", tmp_path / "log"
    hosts = [CONFIG, "--host", loopback, "--ur-host", loopback]
    with started(["-m", "ratslam", "emulate", "ur10", *hosts, *given], UR_FAULTS, loopback) as arm:
        command = [sys.executable, "-m", "ratslam", "live", CONFIG, "--ur-host", loopback]
        with log.open("wb") as output:
            process = subprocess.Popen(
                [*command, "-o", str(directory), *given], cwd=ROOT, stdout=output, stderr=subprocess.STDOUT
            )
        for pid in (arm.process.pid, process.pid):
            raise_priority(pid)
        try:
            code = process.wait(300)
        finally:
            process.kill()
            process.wait(5)
        said = log.read_text()
        assert code == 0, said
        assert not arm.state()["moving"]
    assert "2 pokes in free air" in said
    assert "is a contact" in said
    assert "Traceback" not in said
    assert "expected times in seconds" not in said  # a ring may take minutes
    report = json.loads((directory / "live.json").read_text())
    assert [report[name] for name in ("outcome", "standing", "rings")] == ["complete", True, RINGS]
    assert 1.0 <= report["threshold_N"] <= 10.0
    again = tmp_path / "again"
    done = subprocess.run(
        [sys.executable, "-c", REPLAY, "run", str(directory / "config.yaml"), "-o", str(again)],
        cwd=ROOT, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"
    for name in SAME:
        assert (directory / name).read_bytes() == (again / name).read_bytes(), name
    with Recording(directory / "session.mcap") as recorded:
        contact = np.array([sample.reading.contact for sample in recorded])
        assert recorded.info.interval == pytest.approx(2 * 0.085 * (20 + 20))
    assert contact.shape == (RINGS, 2)


def soak(*values: object) -> Any:
    return pytest.param(*values, marks=pytest.mark.soak)


@pytest.mark.parametrize(
    ("fault", "outcome"),
    [
        ({"do": "stall", "seconds": 60}, "arm_stale"),
        soak({"do": "malformed"}, "arm_malformed"),
        soak({"do": "truncated"}, "arm_malformed"),
        soak({"do": "huge"}, "arm_stale"),
        soak({"do": "nan"}, "arm_malformed"),
        soak({"do": "freeze"}, "arm_stale"),
        ({"do": "protective"}, "protective_stop"),
        soak({"do": "safeguard"}, "safeguard_stop"),
        soak({"do": "emergency"}, "emergency_stop"),
        soak({"do": "ik_fails"}, "unreachable"),
        ({"do": "die"}, "arm_gone"),
        soak({"do": "crash"}, "arm_gone"),
    ],
    ids=lambda value: value["do"] if isinstance(value, dict) else "",
)
def test_a_fault_ends_a_session_of_pokes(bench: Bench, fault: dict, outcome: str) -> None:
    """The others are tested in virtual time (`tests/robot/live/test_pokes.py`)."""
    arm = {"touch": "force"} | ({"stale": 1.0} if outcome == "arm_stale" else {})
    with bench.session(arm=arm, touch={"pokes": QUICK}) as session:
        session.wait_for("armed")
        session.until(lambda: not bench.still(), "a poke")
        if fault["do"] == "die":
            bench.arm.die()
        elif fault["do"] == "crash":
            os.kill(session.child(b"robot.drivers.ur10.rtde_process"), signal.SIGSEGV)
        else:
            bench.arm(**fault)
        report = session.ends(outcome)
        bench.stands()
        assert report["detail"]
        bench.ready()


def test_a_wall_that_the_law_cannot_see_ends_the_session(bench: Bench) -> None:
    """A collision on the way between two rings, where nothing pokes."""
    with bench.session(arm={"touch": "force"}, touch={"pokes": QUICK | {"every": 0.3}}) as session:
        session.wait_for("armed")
        at = bench.arm.state()["tcp"][0]
        bench.arm(do="wall", x=at + 0.12, stiffness=20_000)
        session.ends("contact")
        bench.stands()
        assert 0 < bench.arm.state()["penetration_max"] <= 0.004


def test_a_map_of_pokes_is_for_pokes_of_the_same_reach(tmp_path, capsys):
    short = ["--set", "simulation.path.circuits=C"]
    assert main(["run", "poke_maze", "-o", str(tmp_path / "map"), *short]) == 0

    def localise(config, *more):
        return "localise", tmp_path / "map", config, "-o", tmp_path / "there", *short, *more

    said_of_reach = refused(capsys, *localise("poke_maze", "--set", "touch.pokes.reach=0.2"))
    assert "touch.pokes.reach is 0.2 and was 0.27" in said_of_reach
    assert "pokes of an arm" in refused(capsys, *localise("whisker_maze"))
    said(capsys, *localise("poke_maze"))
    assert len((tmp_path / "there" / "steps.csv").read_text().splitlines()) > 50
