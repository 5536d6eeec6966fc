"""How sessions must end."""

from __future__ import annotations

import time
from typing import Any

from tests.ratslam.live.bench import Bench, Kept, Moment, Session

LOST = 0.4
"""s of a recording that may be lost."""
HUNGRY = 0.3
"""s after which the controller's watchdog has stopped an arm whose session is gone."""


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
    """The arm moves no more after so many s; one that stands between two ways may still be on its way."""
    if bench.arm.process.poll() is not None:
        return  # so does an arm without a controller
    began = moved = now = time.monotonic()
    place = bench.arm.state()["tcp"]
    while now - moved < HUNGRY:
        time.sleep(0.01)
        now, before, place = time.monotonic(), place, bench.arm.state()["tcp"]
        if place != before:
            moved = now
            assert now - began < within, "the arm moves"
