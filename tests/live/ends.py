"""How sessions must end."""

from __future__ import annotations

import time
from typing import Any

from tests.live.bench import Bench, Kept, Moment, Session
from tests.robot.live_helpers import until

LOST = 0.4
"""s of a recording that may be lost."""


def ended(bench: Bench, session: Session, outcome: str, at: Moment) -> tuple[dict[str, Any], Kept]:
    """The report and the recording of a session that ended by itself, with that outcome and nothing lost.

    Args:
        at: when it happened.
    """
    code = session.code()
    report = session.report()
    assert report["outcome"] == outcome, session.said()
    assert code == {"complete": 0, "interrupted": 130}.get(outcome, 2)
    assert f"{outcome}: " in session.said()
    assert "Traceback" not in session.said(), session.said()
    stands(bench)
    kept = session.kept()
    assert not kept.broken
    assert kept.lost(at) <= LOST
    return report, kept


def stands(bench: Bench, within: float = 0.5) -> None:
    """The arm stands, or does soon, and goes on standing."""
    if bench.arm.process.poll() is not None:
        return  # so does an arm without a controller
    until(bench.still, within, "a standstill")
    place = bench.arm.state()["tcp"]
    time.sleep(0.1)
    assert bench.arm.state()["tcp"] == place
