"""Faults of the arm end the session with their outcome, the arm at rest and all data recorded."""

from __future__ import annotations

import os
import signal

import pytest

from tests.ratslam.live.bench import Bench
from tests.ratslam.live.expected_outcomes import ended, stands

BLIND = {"stall", "malformed", "truncated", "huge", "nan", "freeze", "die"}
"""Faults after which the session gets no states of the arm."""
LATE = {"stall", "huge", "freeze"}
"""Faults that are found by the age of the newest state."""
OFTEN = pytest.mark.soak
"""Every run of the suite tests the arm alone with these (`tests/robot/drivers/ur10`),
`make soak` whole sessions."""


@pytest.mark.parametrize(
    ("fault", "outcome"),
    [
        pytest.param({"do": "stall", "seconds": 1.5}, "arm_stale", marks=OFTEN),
        ({"do": "stall", "seconds": 60}, "arm_stale"),
        ({"do": "malformed"}, "arm_malformed"),
        pytest.param({"do": "truncated"}, "arm_malformed", marks=OFTEN),
        pytest.param({"do": "huge"}, "arm_stale", marks=OFTEN),
        pytest.param({"do": "nan"}, "arm_malformed", marks=OFTEN),
        pytest.param({"do": "freeze"}, "arm_stale", marks=OFTEN),
        ({"do": "protective"}, "protective_stop"),
        pytest.param({"do": "safeguard"}, "safeguard_stop", marks=OFTEN),
        pytest.param({"do": "emergency"}, "emergency_stop", marks=OFTEN),
        pytest.param({"do": "ik_fails"}, "unreachable", marks=OFTEN),
        ({"do": "die"}, "arm_gone"),
    ],
    ids=lambda value: "-".join(map(str, value.values())) if isinstance(value, dict) else "",
)
def test_a_fault_of_the_controller(bench: Bench, fault: dict, outcome: str) -> None:
    with bench.in_motion(arm={"stale": 1.0} if fault["do"] in LATE else {}) as session:
        at = bench.moment()
        if fault["do"] == "die":
            bench.arm.die()
        else:
            bench.arm(**fault)
        report, recorded = ended(bench, session, outcome, at)
        assert report["standing"] or fault["do"] in BLIND
        assert recorded.events[-1].name == "fault"
        assert recorded.events[-1].text.startswith(outcome)
        if fault["do"] in {"safeguard", "protective", "stall", "freeze"}:
            bench.arm(do="clear")  # nothing resumes by itself
            stands(bench)


def test_the_rtde_process_crashes(bench: Bench) -> None:
    with bench.in_motion() as session:
        at = bench.moment()
        os.kill(session.child(), signal.SIGSEGV)
        report, _ = ended(bench, session, "arm_gone", at)
        assert "SIGSEGV" in report["detail"]


def test_registers_in_use(bench: Bench) -> None:
    bench.arm(do="registers")
    sent = len(bench.arm.state()["targets"])
    with bench.session() as session:
        assert session.code() == 2
        assert "registers in use" in session.output()
        assert "EtherNet/IP" in session.output()
        assert "Traceback" not in session.output()
        assert not session.directory.exists()
        assert len(bench.arm.state()["targets"]) == sent


def test_a_collision_with_a_wall(bench: Bench) -> None:
    with bench.in_motion() as session:
        at, touched = bench.moment(), bench.arm.state()["tcp"][0] + 0.02
        bench.arm(do="wall", x=touched, stiffness=20_000)
        ended(bench, session, "contact", at)
        state = bench.arm.state()
        assert 0 < state["penetration_max"] <= 0.003
        assert state["safety"] == "NORMAL"
        assert state["tcp"][0] == pytest.approx(touched + state["penetration_max"] - 0.01, abs=0.0015)
