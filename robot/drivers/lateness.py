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
        """Notes a turn of the loop at a time, s; returns the largest delay within the last `WINDOW`, s."""
        late = max(now - self._turned - self._period, 0.0)
        self._turned = now
        if late >= self.worst(now):
            self._late, self._since = late, now
        return self._late

    def worst(self, now: float) -> float:
        """The largest delay of a turn that ended within the last `WINDOW` before a time (s), s."""
        return self._late if now - self._since <= WINDOW else 0.0
