"""The rule by which closure sequences join two pieces of a map.

A sequence between pieces that nothing else joins strains nothing: no odometry contradicts a false one. So it
needs more evidence than a sequence within a piece, and no other place may be nearly as likely. The rule is
ours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tactile.base.se2 import compose, wrap

EVIDENCE = 30.0
"""Least evidence of a sequence that joins two pieces: log-likelihood ratio."""
MARGIN = 12.0
"""Least evidence by which it exceeds every sequence that contradicts it."""
NEAR, FACING = 3.0, 0.5
"""Largest difference of the places, cells, and headings, rad, that sequences claim if they agree."""


class TieClaim(NamedTuple):
    """What one closure sequence says of two pieces.

    Attributes:
        sequence: its number. evidence: log-likelihood ratio. pose: [3] of its middle keyframe in the later
            piece. motion: [3] brings the later piece to where the sequence claims it.
    """

    sequence: int
    evidence: float
    pose: np.ndarray
    motion: np.ndarray


def ties_of_pieces(claims: Sequence[TieClaim], cell: float) -> list[int]:
    """The sequences that join two pieces, of all those between them; none if the pieces stay apart.

    Args:
        cell: size of a pose cell, m.
    """
    if not claims:
        return []
    best = max(claims, key=lambda claim: claim.evidence)
    against = (claim.evidence for claim in claims if not _agree(best, claim, cell))
    if best.evidence < EVIDENCE or best.evidence < max(against, default=-np.inf) + MARGIN:
        return []
    return [best.sequence]


def _agree(one: TieClaim, other: TieClaim, cell: float) -> bool:
    """Whether two sequences claim the same place."""
    here, there = compose(one.motion, one.pose), compose(other.motion, one.pose)
    turned = abs(float(wrap(here[2] - there[2])))
    return bool(np.hypot(*(here - there)[:2]) <= NEAR * cell and turned <= FACING)
