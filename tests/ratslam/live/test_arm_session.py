"""Sessions of an arm with a head: faults of arm, mapper and head, kills and interrupts, localisation."""

import csv
import os
import resource
import signal
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ratslam.cli import main
from robot.recordings.mcap_reader import UNCLOSED, Recording
from robot.recordings.mcap_writer import recover
from tactile.base.random_streams import stream
from tests.helpers.live import PATIENCE, ROOT, until
from tests.ratslam.live.bench import LEGS, LOST, START, STRICT, Bench, whisk_count
from tests.ratslam.live.live_session import RecordedData, Session, read_recorded

BLIND = {"stall", "malformed", "truncated", "huge", "nan", "freeze", "die", "crash"}
"""Faults after which the session gets no states of the arm."""
LATE = {"stall", "huge", "freeze"}
"""Faults that are found by the age of the newest state."""
RTDE, MAPPER = "robot.drivers.ur10.rtde_process", "spawn_main"
"""Words of the command lines of the session's processes."""


def soak(*values: object) -> Any:
    """Values of a test that `make soak` runs; every run of the suite tests arm and head alone with such
    faults (`tests/robot/drivers`)."""
    return pytest.param(*values, marks=pytest.mark.soak)


@pytest.mark.parametrize(
    ("device", "fault", "outcome"),
    [
        soak("arm", {"do": "stall", "seconds": 1.5}, "arm_stale"),
        ("arm", {"do": "stall", "seconds": 60}, "arm_stale"),
        soak("arm", {"do": "malformed"}, "arm_malformed"),
        soak("arm", {"do": "truncated"}, "arm_malformed"),
        soak("arm", {"do": "huge"}, "arm_stale"),
        soak("arm", {"do": "nan"}, "arm_malformed"),
        soak("arm", {"do": "freeze"}, "arm_stale"),
        ("arm", {"do": "protective"}, "protective_stop"),
        soak("arm", {"do": "safeguard"}, "safeguard_stop"),
        soak("arm", {"do": "emergency"}, "emergency_stop"),
        soak("arm", {"do": "ik_fails"}, "unreachable"),
        ("arm", {"do": "die"}, "arm_gone"),
        ("head", {"do": "unplug"}, "head_gone"),
        ("head", {"do": "silence", "seconds": 60}, "head_silent"),
        soak("head", {"do": "corrupt", "frames": 10**6}, "head_garbled"),
        ("head", {"do": "clock", "jump_us": 500_000}, "clock_jumped"),
        soak("head", {"do": "clock", "jump_us": -200_000}, "clock_jumped"),
        (RTDE, {"do": "crash"}, "arm_gone"),
        (MAPPER, {"do": "kill"}, "mapper_gone"),
    ],
    ids=lambda value: value["do"] if isinstance(value, dict) else "",
)
def test_a_fault_ends_the_session(bench: Bench, device: str, fault: dict, outcome: str) -> None:
    """With its outcome, the arm at rest, and all data recorded."""
    do, gone = fault["do"], outcome.startswith("head_")
    settings = {"arm": {"stale": 1.0}} if do in LATE else {}
    with bench.in_motion(**settings, head={"patience": 1.5, "silence": 1.0} if gone else {}) as session:
        at = bench.moment()
        if do == "die":
            bench.arm.die()
        elif device in ("arm", "head"):
            getattr(bench, device)(**fault)
        else:
            os.kill(session.child(device.encode()), signal.SIGSEGV if do == "crash" else signal.SIGKILL)
        if gone:
            until(bench.still, "the arm stands while the head sends nothing")
        report, recorded = bench.ended(session, outcome, at)
        assert report["standing"] or do in BLIND
        assert recorded.names()[-1] == "fault"
        assert not gone or recorded.names()[-2] == "held"
        assert recorded.events[-1].text.startswith(outcome)
        assert {"crash": "SIGSEGV", "clock": "head"}.get(do, "") in report["detail"]
        if do in {"safeguard", "protective", "stall", "freeze"}:
            bench.arm(do="clear")  # nothing resumes by itself
            bench.stands()
        elif do == "corrupt":
            assert report["head"]["bad"] > 1000
            bench.replace_head()
    if do == "clock":
        bench.head(do="clock", jump_us=-fault["jump_us"])


def test_a_collision_with_a_wall(bench: Bench) -> None:
    with bench.in_motion() as session:
        at, touched = bench.moment(), bench.arm.state()["tcp"][0] + 0.02
        bench.arm(do="wall", x=touched, stiffness=20_000)
        bench.ended(session, "contact", at)
        state = bench.arm.state()
        assert 0 < state["penetration_max"] <= 0.003
        assert state["safety"] == "NORMAL"
        assert state["tcp"][0] == pytest.approx(touched + state["penetration_max"] - 0.01, abs=0.0015)


@pytest.mark.parametrize(
    "faults",
    [[{"do": "unplug"}, {"do": "stall", "seconds": 2.5}], soak([{"do": "silence", "seconds": 2.5}])],
    ids=["unplug, stall", "silence"],
)
def test_the_session_continues_when_the_head_is_back(bench: Bench, faults: list[dict]) -> None:
    leg = LEGS[0], LEGS[5]  # of 7 s, so that the head's silence ends the motion before the leg ends
    with bench.in_motion(head={"silence": 1.0}, waypoints=leg) as session:
        for fault in faults:
            session.until(bench.moves, "the arm moves")
            bench.head(**fault)
            until(bench.still, "the arm stands")
            bench.head(do="plug")
        report, recorded = bench.ended(session, "complete")
        assert report["standing"]
        assert [name for name in recorded.names() if name != "dropped"] == ["held", "resumed"] * len(faults)
        assert report["head"]["restarts"] == sum(fault["do"] == "unplug" for fault in faults)
        assert (report["head"]["stalls"] > 0) == any(fault["do"] == "stall" for fault in faults)
        assert len(recorded.samples) == report["whisks"]
        goal = START[:2] + np.subtract(leg[1][:2], leg[0][:2])
        np.testing.assert_allclose(bench.arm.state()["tcp"][:2], goal, atol=1e-3)
        # The arm was stopped meanwhile; the odometry includes this motion.
        travelled = sum(float(np.hypot(*sample.reading.odometry[:2])) for sample in recorded.samples)
        truth = [sample.truth for sample in recorded.samples]
        way = sum(float(np.hypot(*(b - a)[:2])) for a, b in pairwise(truth))
        assert travelled == pytest.approx(way, abs=1e-6)


def test_a_slow_mapper_drops_images_damage_is_counted_and_no_odometry_is_lost(bench: Bench) -> None:
    """Exact counts of damaged, skipped and swapped frames, of garbage and of an overrun."""
    with bench.in_motion(mapper=0.55, budget=0.3, whisks=16) as session:
        before = bench.head(do="counts")
        bench.head(do="corrupt", frames=7)
        bench.head(do="garbage", bytes=100_000)
        bench.head(do="skip", frames=30)
        bench.head(do="swap", frames=5)
        seen = whisk_count(session)
        session.until(lambda: whisk_count(session) > seen, "the damage is read")
        bench.head(do="silence", seconds=2.4)  # more than its FIFO holds
        report, recorded = bench.ended(session, "complete")
        lost, counts = bench.head(do="counts")["lost"] - before["lost"], report["head"]
        assert lost > 100
        assert counts["bad"] >= 7  # random bytes may spell the magic
        assert counts["skipped_bytes"] == 7 * 128 + 100_000
        assert counts["duplicates"] == counts["restarts"] == 0
        assert counts["overruns"] >= 1
        known = np.unique(recorded.sequence)
        assert counts["missing"] == known[-1] - known[0] + 1 - len(known) == 37 + lost
        assert report["missing"] >= 37 + lost  # and frames that arrived too late
        assert report["standing"]
        assert report["whisks"] == 16
        assert 4 <= report["dropped"] <= 15
        assert recorded.names().count("dropped") == report["dropped"]
        shown = [len(sample.reading.time) > 0 for sample in recorded.samples]
        assert shown.count(False) == report["dropped"]
        assert shown[0]
        recording = Recording(session.directory / "session.mcap")
        assert recording.length == 16
        for sample, again in zip(recorded.samples, recording, strict=True):
            assert (sample.time, sample.reading.odometry) == (again.time, again.reading.odometry)
            assert len(sample.reading.time) == len(again.reading.time)
        # The whole path is recorded: the arm's odometry has no errors here.
        x = np.cumsum([sample.reading.odometry.dx for sample in recorded.samples])
        truth = np.array([sample.truth[0] for sample in recorded.samples])
        np.testing.assert_allclose(x - x[0], truth - truth[0], atol=1e-6)
        assert x.max() > 0.05


def test_an_overloaded_whisker_ends_the_session(bench: Bench) -> None:
    with bench.in_motion() as session:
        at = bench.moment()
        bench.head(do="saturate", whisker=11, seconds=0.3)
        furthest = until(lambda: bench.still() and bench.arm.state()["tcp"], "a standstill")
        report, _ = bench.ended(session, "contact", at)
        assert "whisker 11" in report["detail"]
        back = np.linalg.norm(np.subtract(bench.arm.state()["tcp"], furthest))
        assert back == pytest.approx(0.01, abs=0.001)


def recovered(session: Session) -> RecordedData:
    """The readable part of an incomplete recording, made a complete one."""
    recording = session.directory / "session.mcap"
    whole = recording.with_name("whole.mcap")
    samples, _ = recover(recording, whole)
    assert samples == Recording(whole).length > 0
    return read_recorded(whole)


@pytest.mark.parametrize(("number", "whole"), [(0, True), (0, False), *(soak(k, True) for k in range(1, 52))])
def test_a_killed_session_stops_the_arm_and_loses_little(bench: Bench, number: int, whole: bool) -> None:
    """All of its processes, whose arm the controller's watchdog stops, or the parent alone."""
    within, lost = (STRICT, STRICT) if number else (PATIENCE, LOST)
    with bench.in_motion(arm={"watchdog_hz": 10.0 if number else 0.5} if whole else {}) as session:
        time.sleep(float(stream(number, "killed").uniform(0.0, 1.4)))
        at = bench.moment()
        (session.send_to_all if whole else session.send)(signal.SIGKILL)
        bench.stands(within)
        session.code()
        saved = recovered(session)
        assert saved.lost(at) <= lost
        # The readable part of the cut recording is the same.
        cut = session.recorded()
        assert len(cut.samples) == len(saved.samples)
        np.testing.assert_array_equal(cut.sequence, saved.sequence)
        until(lambda: not session.lives(), "nothing of it stays")
    until(lambda: bench.head.state()["resting"], "the whiskers are retracted")


@pytest.mark.parametrize(("number", "sent"), [(0, 2), *(soak(k, n) for k in range(52) for n in (2, 15))])
def test_an_interrupt_ends_the_session(bench: Bench, number: int, sent: int) -> None:
    """At any moment, sent to all of its processes: a controlled stop, and a complete recording up to then."""
    with bench.session(waypoints=[(0.63, 0.45, 0.0), (0.7, 0.45, 0.0)]) as session:
        session.wait_for("disk:")
        time.sleep(float(stream(number, "interrupted").uniform(0.0, 5.0)))
        at = bench.moment()
        session.send_to_all(sent)
        code = session.code()
        bench.stands()
        until(lambda: not session.lives(), "nothing of it stays")
        assert "Traceback" not in session.output()
        if session.directory.exists() and (session.directory / "session.mcap").exists():
            outcome = session.report()["outcome"]
            assert (outcome, code) in {("interrupted", 128 + sent), ("complete", 0)}
            if outcome == "interrupted":
                bench.ended(session, outcome, at)
        else:
            assert code == 128 + sent
            assert "interrupted" in session.output()
            assert "recording" not in session.output()
        assert bench.arm.state()["watchdog_stops"] == bench.starved


def test_a_second_interrupt_stops_the_arm_by_the_dashboard(bench: Bench) -> None:
    """The second interrupt waits for the arm only."""
    with bench.in_motion() as session:
        for _ in range(3):  # the third is ignored
            session.send(signal.SIGTERM)
            time.sleep(0.005)
        assert session.code() == 143
        assert "Traceback" not in session.output()
        bench.stands()
        until(lambda: bench.arm.state()["runtime"] == "STOPPED", "its program is ended")
        recovered(session)


def test_interrupts_while_its_mapper_finishes_leave_the_report(bench: Bench) -> None:
    with bench.session(mapper=0.5, whisks=4) as session:
        session.wait_for("4/4")
        for _ in range(3):
            session.send(signal.SIGINT)
            time.sleep(0.1)
        assert session.code() in (0, 130)
        assert session.report()["outcome"] in ("complete", "interrupted")
        assert "Traceback" not in session.output()
        assert "nothing to do" not in session.output()
        until(lambda: not session.lives(), "nothing of it stays")


@pytest.mark.parametrize("number", [1, soak(0), *map(soak, range(2, 32))])
def test_a_killed_session_is_mapped_again_to_the_same_bits(bench: Bench, number: int, tmp_path: Path) -> None:
    """With its mapper, or alone: the mapper then completes the run. Of the latter, some are localised in a
    map, which stays as it is."""
    map_file = ROOT / "tests" / "data" / "maps" / "ratslam-map-1.npz"
    before, again = map_file.read_bytes(), tmp_path / "again"
    order = {"options": ["--localise", str(map_file)] if number % 4 == 1 else []}
    with bench.session(None, order, waypoints=[(0.63, 0.45, 0.0), (0.7, 0.45, 0.0)] * 3) as session:
        session.wait_for("armed")
        time.sleep(float(stream(number, "mapped").uniform(0.0, 8.0)))
        (session.send if number % 2 else session.send_to_all)(signal.SIGKILL)
        until(lambda: not session.lives(), "nothing of it stays")
        live = session.directory
        recorded, mapped = session.recorded(), (live / "online.tum").read_text()
        assert recorded.broken in ("", UNCLOSED)  # "": it was complete
        assert len(recorded.samples) >= mapped.count("\n")
        names = ["online.tum", "odometry.tum", "steps.csv", *["localisation.csv"] * (number % 4 == 1)]
        if recorded.samples:
            assert main(["run", str(live / "config.yaml"), "-o", str(again)]) == 0
            for name in names:
                assert (again / name).read_text().startswith((live / name).read_text()), name
        if names[3:] and len(recorded.samples) > 1:
            # The emulated head is too low for its whiskers to touch walls, so there is nothing to find it by.
            rows = list(csv.DictReader((again / "localisation.csv").read_text().splitlines()))
            assert [row["state"] for row in rows] == ["searching"] * len(recorded.samples)
            assert float(rows[-1]["sd"]) > float(rows[0]["sd"])
        print(f"{len(recorded.samples)} samples recorded, {mapped.count(chr(10))} mapped live")
    assert map_file.read_bytes() == before


def test_the_disk_is_full(bench: Bench) -> None:
    with bench.in_motion() as session:
        at, size = bench.moment(), (session.directory / "session.mcap").stat().st_size
        resource.prlimit(session.pid, resource.RLIMIT_FSIZE, (size + 5000, size + 5000))
        assert session.code() == 2
        assert "disk_full: " in session.output()
        assert "Traceback" not in session.output()
        bench.stands()
        assert recovered(session).lost(at) <= LOST
