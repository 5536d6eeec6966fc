"""A diagnosis: what something is, what it holds, what is wrong with it, and what to do next; as text."""

from __future__ import annotations

from typing import Any, NamedTuple

from ratslam.service.fit.rig_fit import aligned
from tactile.base.errors import printable


class Diagnosis(NamedTuple):
    """What was found.

    Attributes:
        what: one line. table: rows of cells, the first row the heading; may be empty. notes: facts.
            faults: what prevents a run, or speaks against a map. advice: what to do next.
            config: sections of a configuration that reads the recording, {} if there is none.
    """

    what: str
    table: tuple[tuple[str, ...], ...] = ()
    notes: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()
    config: dict[str, Any] = {}  # noqa: RUF012


def render(diagnosis: Diagnosis) -> str:
    """The diagnosis as lines of text."""
    lines = [diagnosis.what, *(f"  {line}".rstrip() for line in aligned(diagnosis.table))]
    for mark, texts in (("", diagnosis.notes), ("fault: ", diagnosis.faults), ("next: ", diagnosis.advice)):
        lines += [f"{mark}{text}" for text in texts]
    return "\n".join(map(printable, lines))
