"""The arrays of one run that metrics and plots use."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tactile.base.errors import InputError

FOUND = "found"
"""State of a step whose pose in the map is known."""
NOT_JUDGED = "not judged by this method"
UNFINISHED = "not judged before the end of the run"
"""Why a map is not judged; another reason is given in its run directory."""


class RunArrays(NamedTuple):
    """Poses, experiences and truth of a run with N steps, M experiences and L links.

    Attributes:
        time: [N] s, increasing.
        truth: [N, 3] true poses (m, m, rad), NaN in rows without one; or None.
        online: [N, 3] online pose at each step. final: [N, 3] pose of each step in the final map.
        odometry: [N, 3] dead reckoning of raw odometry from any start.
        experience: [N] current experience, an index into `nodes`, -1 for none.
        created: [M] step at which each experience was first visited, -1: not in this run.
        nodes: [M, 3] poses of the experiences in the final map, in the frame of `final`.
        links: [L, 2] linked experiences.
        doubt: probability, by the map itself, that its error is worse than odometry's; NaN if there is none.
        unjudged: why there is none. warnings: about the input, a sentence each.
        online_error: [A] position errors of the current pose in the map of that time, m; empty if unknown.
        piece: [N] the piece of the map in which each step is, see `evaluation.metrics.run_metrics`; empty:
            all steps are in one.
        node_piece: [M] the piece of each experience, which may have no steps; empty: that of its first visit.
        state: [N] of a session localised in a map: found, searching, ... ; empty for others.
    """

    time: np.ndarray
    truth: np.ndarray | None
    online: np.ndarray
    final: np.ndarray
    odometry: np.ndarray
    experience: np.ndarray
    created: np.ndarray
    nodes: np.ndarray
    links: np.ndarray
    online_error: np.ndarray = np.zeros(0)
    doubt: float = np.nan
    unjudged: str = NOT_JUDGED
    warnings: tuple[str, ...] = ()
    piece: np.ndarray = np.zeros(0, int)
    node_piece: np.ndarray = np.zeros(0, int)
    state: np.ndarray = np.zeros(0, str)

    @property
    def has_pieces(self) -> bool:
        """Whether the map is in several pieces, whose poses cannot be compared."""
        return len(np.unique(self.piece)) > 1

    @property
    def found(self) -> np.ndarray:
        """[N] bool, which steps are known in the frame of the map: all where nothing was localised."""
        return self.state == FOUND if len(self.state) else np.ones(len(self.time), bool)

    @property
    def main(self) -> int:
        """The piece in whose frame pictures and commands give places: the one that was found in its map
        (-1 if none was), else the largest."""
        if not len(self.piece):
            return 0
        numbers, steps = np.unique(self.piece[self.found], return_counts=True)
        return int(numbers[steps.argmax()]) if len(numbers) else -1

    @property
    def truth_rows(self) -> np.ndarray:
        """The steps [K] with a true pose."""
        if self.truth is None:
            return np.zeros(0, int)
        return np.flatnonzero(np.isfinite(self.truth).all(axis=1))

    def ranked_pieces(self) -> list[tuple[int, int]]:
        """Rank and number of each piece: `main` first, with rank 0, then by the number of their steps."""
        numbers, sizes = np.unique(self.piece, return_counts=True)
        ranks = np.argsort(-sizes - len(self.piece) * (numbers == self.main), kind="stable")
        return list(enumerate(numbers[ranks].tolist(), start=self.main < 0))

    def name_piece(self, number: int) -> str:
        """A piece in words."""
        rows = np.flatnonzero(self.piece == number)
        if len(self.state) and len(rows):
            return f"{self.state[rows[-1]].replace('_', ' ')}, {len(rows):,} steps"
        return f"piece {number + 1}, {len(rows):,} steps"

    def check(self) -> None:
        """Raises `InputError` if an array has a wrong shape, an unknown value or an index out of range."""
        steps, nodes = len(self.time), len(self.nodes)
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("time", "experience"), (steps,))
        shapes |= dict.fromkeys(("online", "final", "odometry"), (steps, 3))
        shapes |= {"created": (nodes,), "nodes": (nodes, 3), "links": (len(self.links), 2)}
        if self.truth is not None:
            shapes["truth"] = (steps, 3)
        for name, shape in shapes.items():
            array = np.asarray(getattr(self, name))
            if array.shape != shape:
                raise InputError(f"run.{name}", f"shape {array.shape}", str(shape))
            if name != "truth" and not np.isfinite(array).all():
                raise InputError(f"run.{name}", "a NaN or infinite value", "finite numbers")
        if steps == 0:
            raise InputError("run.time", "no steps", "at least one")
        for name, low, high in (("experience", -1, nodes), ("created", -1, steps), ("links", 0, nodes)):
            index = np.asarray(getattr(self, name))
            if index.size and not (low <= index.min() and index.max() < high):
                raise InputError(f"run.{name}", f"{index.min()} to {index.max()}", f"{low} to {high - 1}")
