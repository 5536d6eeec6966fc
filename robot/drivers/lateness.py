"""Lateness of a loop: tells whether this machine was late, or a device."""

from __future__ import annotations

WINDOW = 1.0
"""Time for which the largest delay counts, s."""


class LatenessMeter:
    """Measures by how much the turns of a loop come later than planned.

    Args:
        period: planned time between two turns, s. now: s.
    """

    def __init__(self, period: float, now: float) -> None:
        self._period, self._turned = period, now
        self._late, self._since = 0.0, now

    def turn(self, now: float) -> float:
        """Notes a turn of the loop; returns the largest delay of a turn within the last `WINDOW`, s."""
        late = now - self._turned - self._period
        self._turned = now
        if late > self._late or now - self._since > WINDOW:
            self._late, self._since = max(late, 0.0), now
        return self._late
