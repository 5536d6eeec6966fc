"""Changes of the verdicts on candidates for loop closures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

VERDICTS = {1: "accepted", 0: "open", -1: "removed"}


class Judgement(NamedTuple):
    """A new verdict on a candidate: the earlier and the later step, and the verdict by name."""

    earlier: int
    later: int
    verdict: str


class VerdictLog:
    """The last verdict on each candidate."""

    def __init__(self) -> None:
        self._verdict: dict[tuple[int, int], int] = {}

    def changes(self, closures: np.ndarray) -> list[Judgement]:
        """The judgements since the last call; `dropped` is the verdict on one that was accepted before.

        Args:
            closures: [n, 3], see `Map.judged_closures`.
        """
        found = []
        for earlier, later, sign in closures.tolist():
            before = self._verdict.get((earlier, later))
            if before == sign:
                continue
            self._verdict[earlier, later] = sign
            name = "dropped" if before == 1 else VERDICTS[sign]
            found.append(Judgement(earlier, later, name))
        return found
