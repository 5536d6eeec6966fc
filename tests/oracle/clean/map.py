"""What the map is told: links in the body frame of the node they leave (semantics, part 5)."""

from __future__ import annotations

from typing import NamedTuple

from tests.oracle.circle import wrap
from tests.oracle.clean.cells import turned
from tests.oracle.clean.places import Action


class Move(NamedTuple):
    """A pose in the frame of another: m, m, rad."""

    x: float = 0.0
    y: float = 0.0
    th: float = 0.0

    def then(self, other: Move) -> Move:
        """This move, and another from where it ends."""
        x, y = turned(other.x, other.y, self.th)
        return Move(self.x + x, self.y + y, wrap(self.th + other.th))


class Links:
    """Every way travelled from node to node, as it was measured."""

    def __init__(self) -> None:
        self.moved = Move()
        self.node = -1
        self.travelled: list[tuple[int, int, Move]] = []

    def step(self, move: Move, action: Action, node: int, relative: float) -> None:
        """Adds a step's motion; at another node, closes the link and starts anew."""
        self.moved = self.moved.then(move)
        if action == Action.NONE:
            return
        if self.node >= 0:
            self.travelled.append((self.node, node, self.moved.then(Move(th=-relative))))
        self.node, self.moved = node, Move(th=relative)

    def once(self) -> dict[tuple[int, int], Move]:
        """The links between nodes joined by a single journey."""
        pairs = [frozenset(link[:2]) for link in self.travelled]
        return {(a, b): move for a, b, move in self.travelled if pairs.count(frozenset((a, b))) == 1}
