"""A session as in the README, by the program: emulators, `live`, and `run` on the recording."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.live import HEAD_FAULTS, ROOT, UR_FAULTS, started, until
from tests.ratslam.live.live_session import child_of, raise_priority, read_recorded

CONFIG = str(ROOT / "configs" / "live_maze.yaml")
REPLAY = """
import sys
from ratslam.__main__ import main
code = main(sys.argv[1:])
strangers = ("rtde", "dashboard_client", "usb", "serial", "libusb_package")
print([name for name in sys.modules if name.startswith(strangers)])
sys.exit(code)
"""
SAME = (
    "steps.csv", "trajectory.tum", "online.tum", "odometry.tum", "truth.tum", "map.json", "map.g2o",
    "map.tum",
)  # fmt: skip
PATIENT = (
    "live.arm.stale=30", "live.arm.heartbeat=30", "live.arm.watchdog_hz=0.05", "live.arm.patience=60",
    "live.arm.connect=60", "live.head.silence=30", "live.head.patience=60", "live.grace=1.0",
    "live.residual=1", "live.room=0",
)  # fmt: skip
"""Long time-outs: emulators and session share a busy machine."""
SHORT = (*PATIENT, "live.plan.whisking.rate=2", "live.budget=1.5", "live.plan.calibration.min_duration=2")


def complete_session(
    host: str,
    folder: Path,
    *settings: str,
    longest: float,
    freeze: float = 0.0,
    options: Sequence[str] = (),
    outcome: str = "complete",
) -> Path:
    """The run directory of a session that ends as planned within `longest` s, on emulators of its own; with
    more options of `live`, and its mapper stopped for `freeze` s on the way."""
    given = [word for setting in settings for word in ("--set", setting)]
    directory, log = folder / "live", folder / "log"
    hosts = [CONFIG, "--host", host, "--ur-host", host]
    with ExitStack() as stack:
        arm, head = (
            stack.enter_context(started(["-m", "ratslam", "emulate", what, *hosts, *given], port, host))
            for what, port in (("ur10", UR_FAULTS), ("head", HEAD_FAULTS))
        )
        command = [sys.executable, "-m", "ratslam", "live", CONFIG, "--ur-host", host, "--head", host]
        process = subprocess.Popen(
            [*command, "-o", str(directory), *given, *options],
            cwd=ROOT, stdout=stack.enter_context(log.open("wb")), stderr=subprocess.STDOUT,
        )  # fmt: skip
        for pid in (arm.process.pid, head.process.pid, process.pid):
            raise_priority(pid)

        def begun() -> bool:
            """Whether its progress bar shows at least three whisks; fails when it has ended."""
            assert process.poll() is None, log.read_text()
            return any(int(done) >= 3 for done in re.findall(r"(\d+)/\d+ \[", log.read_text()))

        try:
            if freeze and until(begun, "the third whisk", longest):  # a new machine compiles first
                mapper = child_of(process.pid, b"spawn_main")
                os.kill(mapper, signal.SIGSTOP)
                time.sleep(freeze)
                os.kill(mapper, signal.SIGCONT)
            code = process.wait(longest)
        finally:
            process.kill()
            process.wait(5)
        output = log.read_text()
        assert code == 0, output
        assert f"{outcome}: " in output
        assert "clocks: head" in output, "the self-test has found the head's rate"
        assert "Traceback" not in output
        state = arm.state()
        assert (state["moving"], state["watchdog_stops"]) == (False, 0)
        assert head(do="counts")["lost"] == 0
    return directory


def check_session(directory: Path, whisks: int) -> dict:
    """The report of a session; checks that nothing was lost and that the replay has the same files."""
    report = json.loads((directory / "live.json").read_text())
    print(json.dumps(report, indent=1))
    found = [report[name] for name in ("outcome", "standing", "whisks", "missing")]
    assert found == ["complete", True, whisks, 0]
    faults = {name: count for name, count in report["head"].items() if name != "good"}
    assert set(faults.values()) == {0}, faults
    recorded = read_recorded(directory / "session.mcap")
    assert len(recorded.samples) == whisks
    assert (np.diff(recorded.sequence) == 1).all()
    assert recorded.names().count("dropped") == report["dropped"]

    again = directory.parent / "again"
    done = subprocess.run(
        [sys.executable, "-c", REPLAY, "run", str(directory / "config.yaml"), "-o", str(again)],
        cwd=ROOT, capture_output=True, text=True, timeout=1200,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]", "the replay loads what only live sessions need"
    for name in SAME:
        assert (directory / name).read_bytes() == (again / name).read_bytes(), name
    assert len((directory / "steps.csv").read_text().splitlines()) == whisks + 1
    return report


def test_a_session_and_its_replay(loopback: str, tmp_path: Path) -> None:
    """The mapper is stopped for a while: images dropped live are dropped in the replay too. A view changes
    nothing."""
    from rerun.chunk import RrdReader

    view, settings = tmp_path / "view.rrd", [*SHORT, "live.whisks=10"]
    options = ["--rerun", str(view)]
    directory = complete_session(loopback, tmp_path, *settings, longest=280, freeze=3.0, options=options)
    report = check_session(directory, 10)  # the replay has no view
    assert 1 <= report["dropped"] < 10
    chunks = RrdReader(view).stream().collect().stream()
    robot = [chunk for chunk in chunks if chunk.entity_path == "/world/robot" and not chunk.is_static]
    # The view is the last to get processor time: on a busy machine it may be late, but then this is said.
    late = "did not keep up" in (tmp_path / "log").read_text()
    assert late or sum(chunk.num_rows for chunk in robot) == 10


@pytest.mark.soak
@pytest.mark.timeout(2400)
@pytest.mark.parametrize("hz", [125, 500])
def test_ten_minutes_and_their_replay(loopback: str, tmp_path: Path, hz: int) -> None:
    settings = ["live.whisks=600", f"live.arm.hz={hz}", "live.plan.path.circuits=CACACA"]
    report = check_session(complete_session(loopback, tmp_path, *settings, longest=1000), 600)
    assert report["dropped"] == 0
    assert report["lateness_s"]["p99"] <= 0.05
    assert report["state_age_s"]["p99"] <= 0.02
    assert report["mapper_s"]["p99"] <= 0.6
