"""Expected state of arm, report and recording after a session."""

from __future__ import annotations

import time
from typing import Any

from tests.helpers.live import PATIENCE, until
from tests.ratslam.live.bench import Bench, Kept, Moment, Session

LOST = 1.5
"""s of a recording that may be lost on a busy machine."""
STRICT = 0.4
"""The same of an idle machine, where soak tests run; also s after which an arm stands."""


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


def stands(bench: Bench, within: float = PATIENCE) -> None:
    """The program on the controller has ended and the arm stands, so that nothing can move it any more.

    Args:
        within: s that this may take.
    """
    if bench.arm.process.poll() is not None:
        return  # the controller is gone
    until(lambda: bench.arm.state()["runtime"] == "STOPPED" and bench.still(), "the arm stands", within)
    place = bench.arm.state()["tcp"]
    time.sleep(0.1)
    assert bench.arm.state()["tcp"] == place
