"""The mapper of a session, as its loops see it."""

from __future__ import annotations

from typing import Protocol

from robot.drivers.outcome import SessionOutcome
from robot.live.polling import session_fault
from robot.sources.source import Sample


class AsyncMapper(Protocol):
    """Asynchronous mapper interface."""

    @property
    def alive(self) -> bool:
        """Whether the mapper runs."""
        ...

    @property
    def failure(self) -> str:
        """Reason for the end of the mapper."""
        ...

    def behind(self) -> float:
        """Waiting time of the oldest unmapped sample, s."""
        ...

    def offer(self, sample: Sample) -> None:
        """Passes the next sample; returns at once."""
        ...


def check_mapper(mapper: AsyncMapper) -> None:
    """Raises the `SessionFault` of a mapper that has ended."""
    if not mapper.alive:
        raise session_fault(SessionOutcome.MAPPER_GONE, mapper.failure)
