"""Faults of the head are counted or end the session with their outcome; short ones are waited for."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from tests.helpers.live import until
from tests.ratslam.live.bench import LEGS, START, Bench
from tests.ratslam.live.expected_outcomes import ended
from tests.ratslam.live.recorded_data import RecordedData


def gaps(recorded: RecordedData) -> int:
    """Frames that are missing between the first and the last one of a recording."""
    known = np.unique(recorded.sequence)
    return int(known[-1] - known[0] + 1 - len(known))


@pytest.mark.parametrize(
    ("fault", "outcome"),
    [
        ({"do": "unplug"}, "head_gone"),
        ({"do": "silence", "seconds": 60}, "head_silent"),
        pytest.param({"do": "corrupt", "frames": 10**6}, "head_garbled", marks=pytest.mark.soak),
    ],
    ids=lambda value: value["do"] if isinstance(value, dict) else "",
)
def test_a_head_that_stays_away_ends_the_session(bench: Bench, fault: dict, outcome: str) -> None:
    with bench.in_motion(head={"patience": 1.5, "silence": 1.0}) as session:
        at = bench.moment()
        bench.head(**fault)
        until(bench.still, "the arm stands while the head sends nothing")
        report, recorded = ended(bench, session, outcome, at)
        assert report["standing"]
        assert recorded.names()[-2:] == ["held", "fault"]
        if fault["do"] == "corrupt":
            assert report["head"]["bad"] > 1000
    if fault["do"] == "corrupt":
        bench.replace_head()


@pytest.mark.parametrize(
    "fault",
    [
        {"do": "unplug"},
        {"do": "stall", "seconds": 2.5},
        pytest.param({"do": "silence", "seconds": 2.5}, marks=pytest.mark.soak),
    ],
    ids=lambda fault: fault["do"],
)
def test_the_session_continues_when_the_head_is_back(bench: Bench, fault: dict) -> None:
    leg = LEGS[0], LEGS[3]  # of 4.2 s, so that the head's silence ends the motion before the leg ends
    with bench.in_motion(head={"silence": 1.0}, waypoints=leg) as session:
        bench.head(**fault)
        until(bench.still, "the arm stands")
        bench.head(do="plug")
        report, recorded = ended(bench, session, "complete", bench.moment()._replace(robot=0.0, sample=0))
        assert report["standing"]
        names = [name for name in recorded.names() if name != "dropped"]
        assert names == ["held", "resumed"]
        assert report["head"]["restarts"] == (fault["do"] == "unplug")
        assert (report["head"]["stalls"] > 0) == (fault["do"] == "stall")
        assert len(recorded.samples) == report["whisks"]
        goal = START[:2] + np.subtract(leg[1][:2], leg[0][:2])
        np.testing.assert_allclose(bench.arm.state()["tcp"][:2], goal, atol=1e-3)
        # The arm was stopped meanwhile; the odometry includes this motion.
        travelled = sum(float(np.hypot(*sample.reading.odometry[:2])) for sample in recorded.samples)
        truth = [sample.truth for sample in recorded.samples]
        way = sum(float(np.hypot(*(b - a)[:2])) for a, b in pairwise(truth))
        assert travelled == pytest.approx(way, abs=1e-6)


def test_damaged_frames_are_counted(bench: Bench) -> None:
    """Exact counts of damaged, skipped and swapped frames and of garbage; the session continues."""
    with bench.in_motion(whisks=12) as session:
        before = bench.head(do="counts")
        bench.head(do="corrupt", frames=7)
        bench.head(do="garbage", bytes=100_000)
        bench.head(do="skip", frames=30)
        bench.head(do="swap", frames=5)
        at = bench.moment()
        report, recorded = ended(bench, session, "complete", at._replace(robot=0.0, sample=0))
        after = bench.head(do="counts")
        counts = report["head"]
        assert counts["bad"] >= 7  # random bytes may spell the magic
        lost = after["lost"] - before["lost"]
        assert counts["missing"] == 37 + lost
        assert counts["skipped_bytes"] == 7 * 128 + 100_000
        assert counts["duplicates"] == counts["restarts"] == 0
        assert gaps(recorded) == 37 + lost
        assert report["dropped"] == recorded.names().count("dropped") >= 1
        assert report["missing"] == 37 + lost


def test_frames_lost_to_an_overrun_are_counted(bench: Bench) -> None:
    with bench.in_motion(whisks=16) as session:
        before = bench.head(do="counts")
        bench.head(do="silence", seconds=2.4)  # more than its FIFO holds
        report, recorded = ended(bench, session, "complete", bench.moment()._replace(robot=0.0, sample=0))
        lost = bench.head(do="counts")["lost"] - before["lost"]
        assert lost > 100
        assert report["head"]["missing"] == gaps(recorded) == lost
        assert report["missing"] >= lost  # and frames that arrived too late
        assert report["head"]["overruns"] >= 1
        assert report["head"]["bad"] == 0


@pytest.mark.parametrize("jump", [500_000, pytest.param(-200_000, marks=pytest.mark.soak)])
def test_a_clock_jump_ends_the_session(bench: Bench, jump: int) -> None:
    with bench.in_motion() as session:
        at = bench.moment()
        bench.head(do="clock", jump_us=jump)
        report, _ = ended(bench, session, "clock_jumped", at)
        assert "head" in report["detail"]
        assert report["standing"]
    bench.head(do="clock", jump_us=-jump)


def test_an_overloaded_whisker_ends_the_session(bench: Bench) -> None:
    with bench.in_motion() as session:
        at = bench.moment()
        bench.head(do="saturate", whisker=11, seconds=0.3)
        furthest = until(lambda: bench.still() and bench.arm.state()["tcp"], "a standstill")
        report, _ = ended(bench, session, "contact", at)
        assert "whisker 11" in report["detail"]
        back = np.linalg.norm(np.subtract(bench.arm.state()["tcp"], furthest))
        assert back == pytest.approx(0.01, abs=0.001)
