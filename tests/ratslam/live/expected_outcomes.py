"""Expected state of arm, report and recording after a session."""

from __future__ import annotations

import time
from typing import Any

from tests.helpers.live import PATIENCE, until
from tests.ratslam.live.bench import Bench
from tests.ratslam.live.live_session import Session
from tests.ratslam.live.recorded_data import Moment, RecordedData

LOST = 1.5
"""s of a recording that may be lost on a busy machine."""
STRICT = 0.4
"""The same on an idle machine, where soak tests run; also s until an arm is at rest."""


def ended(bench: Bench, session: Session, outcome: str, at: Moment) -> tuple[dict[str, Any], RecordedData]:
    """The report and the recording of a session that ended by itself, with that outcome and nothing lost.

    Args:
        at: moment of the event.
    """
    code = session.code()
    report = session.report()
    assert report["outcome"] == outcome, session.output()
    assert code in {"complete": (0,), "interrupted": (130, 143)}.get(outcome, (2,))
    assert f"{outcome}: " in session.output()
    assert "Traceback" not in session.output(), session.output()
    stands(bench)
    recorded = session.recorded()
    assert not recorded.broken
    assert recorded.lost(at) <= LOST
    return report, recorded


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
