"""Sessions killed or interrupted at any moment: the arm stops, and the recording is complete up to then."""

from __future__ import annotations

import os
import resource
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from robot.recordings.mcap_reader import Recording, recover
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
    report = recover(recording, whole)
    assert report.samples == Recording(whole).length > 0
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


@pytest.mark.parametrize("number", NUMBERS)
def test_an_interrupt_ends_the_session(bench: Bench, number: int) -> None:
    """At any moment: a controlled stop, and a complete recording up to then."""
    with bench.session(waypoints=[(0.63, 0.45, 0.0), (0.7, 0.45, 0.0)]) as session:
        session.wait_for("disk:")
        time.sleep(float(stream(number, "interrupted").uniform(0.0, 5.0)))
        at = bench.moment()
        session.process.send_signal(signal.SIGINT)
        code = session.code()
        stands(bench)
        assert "Traceback" not in session.output()
        if session.directory.exists() and (session.directory / "session.mcap").exists():
            outcome = session.report()["outcome"]
            assert (outcome, code) in {("interrupted", 130), ("complete", 0)}
            if outcome == "interrupted":
                ended(bench, session, outcome, at)
        else:
            assert code == 130
            assert "interrupted" in session.output()
        assert bench.arm.state()["watchdog_stops"] == bench.starved


def test_a_second_interrupt_stops_the_arm_by_the_dashboard(bench: Bench) -> None:
    """The second interrupt waits for the arm only."""
    with bench.in_motion() as session:
        session.process.send_signal(signal.SIGINT)
        time.sleep(0.005)
        session.process.send_signal(signal.SIGINT)
        assert session.code() == 130
        stands(bench)
        until(lambda: bench.arm.state()["runtime"] == "STOPPED", "its program is ended")
        recovered(session.directory / "session.mcap")


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
