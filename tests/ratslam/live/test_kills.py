"""Sessions killed or interrupted at any moment: the arm stops, and the recording is complete up to then."""

from __future__ import annotations

import os
import resource
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from ratslam.cli import main
from robot.recordings.mcap_reader import UNCLOSED, Recording
from robot.recordings.mcap_writer import recover
from tactile.base.random_streams import stream
from tests.helpers.live import PATIENCE, until
from tests.ratslam.live.bench import Bench
from tests.ratslam.live.expected_outcomes import LOST, STRICT, ended, stands
from tests.ratslam.live.recorded_data import read_recorded

FEW, MANY = range(1), range(1, 52)
NUMBERS = [*FEW, *(pytest.param(number, marks=pytest.mark.soak) for number in MANY)]


def recovered(recording: Path) -> Path:
    """A complete recording with the readable part of an incomplete one."""
    whole = recording.with_name("whole.mcap")
    samples, _ = recover(recording, whole)
    assert samples == Recording(whole).length > 0
    return whole


@pytest.mark.parametrize("number", NUMBERS)
def test_the_whole_session_is_killed(bench: Bench, number: int) -> None:
    with bench.session(arm={"watchdog_hz": 10.0 if number in MANY else 0.5}) as session:
        session.wait_for("armed")
        time.sleep(float(stream(number, "killed").uniform(0.6, 2.0)))
        at = bench.moment()
        os.killpg(session.process.pid, signal.SIGKILL)
        stands(bench, STRICT if number in MANY else PATIENCE)
        session.process.wait(PATIENCE)
        saved = read_recorded(recovered(session.directory / "session.mcap"))
        assert saved.lost(at) <= (STRICT if number in MANY else LOST)
        # The readable part of the cut recording is the same.
        cut = session.recorded()
        assert len(cut.samples) == len(saved.samples)
        np.testing.assert_array_equal(cut.sequence, saved.sequence)


def test_the_parent_is_killed_in_motion(bench: Bench) -> None:
    with bench.in_motion() as session:
        at = bench.moment()
        session.process.kill()
        stands(bench)
        session.process.wait(PATIENCE)
        saved = read_recorded(recovered(session.directory / "session.mcap"))
        assert saved.lost(at) <= LOST
        until(lambda: not session.lives(), "nothing of it stays")
        assert bench.arm.state()["runtime"] == "STOPPED"
    until(lambda: bench.head.state()["resting"], "the whiskers are retracted")


@pytest.mark.parametrize(("sent", "code_of"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("number", NUMBERS)
def test_an_interrupt_ends_the_session(bench: Bench, number: int, sent: int, code_of: int) -> None:
    """At any moment, sent to all of its processes: a controlled stop, and a complete recording up to then."""
    with bench.session(waypoints=[(0.63, 0.45, 0.0), (0.7, 0.45, 0.0)]) as session:
        session.wait_for("disk:")
        time.sleep(float(stream(number, "interrupted").uniform(0.0, 5.0)))
        at = bench.moment()
        os.killpg(session.process.pid, sent)
        code = session.code()
        stands(bench)
        until(lambda: not session.lives(), "nothing of it stays")
        assert "Traceback" not in session.output()
        if session.directory.exists() and (session.directory / "session.mcap").exists():
            outcome = session.report()["outcome"]
            assert (outcome, code) in {("interrupted", code_of), ("complete", 0)}
            if outcome == "interrupted":
                ended(bench, session, outcome, at)
        else:
            assert code == code_of
            assert "interrupted" in session.output()
            assert "recording" not in session.output()
        assert bench.arm.state()["watchdog_stops"] == bench.starved


def test_a_second_interrupt_stops_the_arm_by_the_dashboard(bench: Bench) -> None:
    """The second interrupt waits for the arm only."""
    with bench.in_motion() as session:
        for _ in range(3):  # the third is ignored
            session.process.send_signal(signal.SIGINT)
            time.sleep(0.005)
        assert session.code() == 130
        assert "Traceback" not in session.output()
        stands(bench)
        until(lambda: bench.arm.state()["runtime"] == "STOPPED", "its program is ended")
        recovered(session.directory / "session.mcap")


def test_interrupts_while_it_finishes_leave_the_report(bench: Bench) -> None:
    with bench.session(mapper=None, whisks=4) as session:
        session.wait_for("4/4")
        for _ in range(3):
            session.process.send_signal(signal.SIGINT)
            time.sleep(0.1)
        assert session.code() in (0, 130)
        assert session.report()["outcome"] in ("complete", "interrupted")
        assert "Traceback" not in session.output()
        assert "nothing to do" not in session.output()
        until(lambda: not session.lives(), "nothing of it stays")


@pytest.mark.parametrize("number", [*FEW, *(pytest.param(k, marks=pytest.mark.soak) for k in range(1, 31))])
def test_a_killed_session_is_mapped_again_to_the_same_bits(bench: Bench, number: int, tmp_path: Path) -> None:
    """With its mapper, or alone: the mapper then completes the run."""
    with bench.session(mapper=None, waypoints=[(0.63, 0.45, 0.0), (0.7, 0.45, 0.0)] * 3) as session:
        session.wait_for("armed")
        time.sleep(float(stream(number, "mapped").uniform(0.0, 8.0)))
        (os.kill if number % 2 else os.killpg)(session.process.pid, signal.SIGKILL)
        until(lambda: not session.lives(), "nothing of it stays")
        live = session.directory
        recorded, mapped = session.recorded(), (live / "online.tum").read_text()
        assert recorded.broken in ("", UNCLOSED)  # "": it was complete
        assert len(recorded.samples) >= mapped.count("\n")
        if recorded.samples:
            assert main(["run", str(live / "config.yaml"), "-o", str(tmp_path / "again")]) == 0
            for name in ("online.tum", "odometry.tum", "steps.csv"):
                assert (tmp_path / "again" / name).read_text().startswith((live / name).read_text())
        print(f"{len(recorded.samples)} samples recorded, {mapped.count(chr(10))} mapped live")


def test_the_disk_is_full(bench: Bench) -> None:
    with bench.in_motion() as session:
        at = bench.moment()
        size = (session.directory / "session.mcap").stat().st_size
        resource.prlimit(session.process.pid, resource.RLIMIT_FSIZE, (size + 5000, size + 5000))
        code = session.code()
        assert code == 2
        assert "disk_full: " in session.output()
        assert "Traceback" not in session.output()
        stands(bench)
        saved = read_recorded(recovered(session.directory / "session.mcap"))
        assert saved.lost(at) <= LOST
