"""Spoilt maps of a finished session: its sequences thinned out, all accepted, or joined by false ones.

A false sequence claims that a stretch of the session was driven where an earlier one was, far from it in
truth, along which odometry moved alike: the one of `_ATTEMPTS` random pairs that looks most alike, or any.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ratslam.mapping.loop_closures import Candidate, Verdict
from ratslam.mapping.map import KeyframeMap
from ratslam.mapping.map_state import NO_ROBUST_SCALE, MapState
from ratslam.mapping.optimizer import MapFit, System
from tactile.base.random_streams import stream
from tactile.base.se2 import between, wrap

_ATTEMPTS = 300
"""Pairs of stretches tried for one false sequence."""


_RECIPES: tuple[tuple[str, dict[str, Any], bool], ...] = (
    ("all accepted", {"least": 2.0}, False),
    ("half", {"kept": 0.5}, True),
    ("false, alike", {"choices": _ATTEMPTS}, False),
    ("false, random", {"choices": 1}, False),
    ("false, alike", {"choices": _ATTEMPTS}, False),
    ("half and three refused", {"kept": 0.5, "more": 3}, True),
    ("false, random", {"choices": 1}, False),
    ("few", {"kept": 0.15}, True),
    ("only false", {"kept": 0.0, "choices": _ATTEMPTS}, False),
    ("some and false, robust", {"kept": 0.3, "choices": _ATTEMPTS}, True),
    ("all accepted, robust", {"least": 4.0}, True),
)
"""Names, arguments of `spoil`, and whether sequences that disagree lose weight."""


def spoilt_maps(map: KeyframeMap, truth: np.ndarray, seed: int) -> Iterator[tuple[str, MapState]]:
    """The final map and a map of each recipe that has closures, by name.

    Args:
        truth: [N, 3] true poses of the keyframes, NaN where unknown.
    """
    final = map.solution()
    random = stream(seed, "spoilt_maps")
    yield "final", final
    for name, changes, robust in _RECIPES:
        spoilt = spoil(final, truth, random, **changes)
        if len(spoilt.log.accepted_rows()):
            yield name, solved_anew(spoilt, robust)


def spoil(
    final: MapState,
    truth: np.ndarray,
    random: np.random.Generator,
    *,
    kept: float = 1.0,
    more: int = 0,
    least: float = np.inf,
    choices: int = 0,
) -> MapState:
    """A final map with other verdicts and, where the session has room for them, false sequences, its poses as
    they were.

    Args:
        truth: see `spoilt_maps`. kept: share of the accepted sequences that stay. more: number of refused
            ones accepted. least: evidence from which on refused ones are accepted. choices: pairs of
            stretches of which the one that looks most alike becomes a false sequence; 0: there are none.
    """
    spoilt = final.trial()
    log = spoilt.log
    verdicts, long = log.verdicts().copy(), log.sizes() >= 2
    refused = np.flatnonzero(long & (verdicts != Verdict.ACCEPTED))
    for sequence in np.flatnonzero(verdicts == Verdict.ACCEPTED).tolist():
        if random.random() > kept:
            log.judge(sequence, Verdict.OPEN)
    chosen = random.choice(refused, min(more, len(refused)), replace=False)
    if np.isfinite(least):
        chosen = refused[log.scores()[refused] >= least]
    for sequence in chosen.tolist():
        log.judge(sequence, Verdict.ACCEPTED)
    if choices:
        # 1 to 4 false sequences of 6 to 39 candidates.
        count, length = (int(random.integers(low, high + 1)) for low, high in ((1, 4), (6, 39)))
        if final.count - length > final.guard + length + 5:
            for _ in range(count):
                _add_false_sequence(spoilt, truth, length, random, choices)
    return spoilt


def _add_false_sequence(
    state: MapState, truth: np.ndarray, length: int, random: np.random.Generator,
    choices: int,
) -> None:  # fmt: skip
    """Accepts the false sequence that looks most alike of at most `choices` pairs of stretches; none if
    there is none among `_ATTEMPTS` random pairs."""
    found: list[tuple[float, int, int]] = []
    first, reckoned = state.guard + length + 5, state.dead_reckoned()
    for _ in range(_ATTEMPTS):
        frame = int(random.integers(first, state.count - length))
        match = int(random.integers(0, frame - state.guard - length))
        if len(found) < choices and _is_false(state, reckoned, truth, frame, match, length):
            # Mean misfit of the candidates, about every sixth.
            steps = range(0, length, max(1, length // 6))
            misfits = [state.least_misfit(frame + k, np.array([match + k]), np.array([False])) for k in steps]
            found.append((float(np.mean(misfits)), frame, match))
    if not found:
        return
    _, frame, match = min(found)
    evidence = float(random.uniform(1.0, 4.0))
    for k in range(length):
        sequence = state.log.add(Candidate(frame + k, match + k, 0, 0.9, evidence), k > 0)
    state.log.judge(sequence, Verdict.ACCEPTED)


def solved_anew(state: MapState, robust: bool) -> MapState:
    """The map solved for: the cheaper one of those reached from its poses and from odometry.

    Args:
        robust: whether sequences that disagree lose weight.
    """
    problem = state.problem()
    if not robust:
        scale = np.full_like(problem.closures.scale, NO_ROBUST_SCALE)
        problem = problem._replace(closures=problem.closures._replace(scale=scale, cost_limit=np.inf))
    starts = [state.fit(), MapFit(state.dead_reckoned(), 0.0, np.zeros(0))]
    system = System(problem)
    # 40 iterations at most, to changes of 1 mm and 1 mrad.
    fit = min((system.solve(start, 40, 1e-3) for start in starts), key=system.robust_cost)
    state.log.weigh(fit.weights)
    state.take_fit(fit)
    return state


def _is_false(
    state: MapState, reckoned: np.ndarray, truth: np.ndarray, frame: int, match: int, length: int
) -> bool:
    """Whether two stretches are of other places, and odometry moved alike on both."""
    apart = truth[frame] - truth[match]
    # A place is another one beyond 5 cells or 0.7 rad; odometry is alike within 2 cells and 0.5 rad.
    if not np.hypot(*apart[:2]) > 5.0 * state.cell and not abs(wrap(apart[2])) > 0.7:
        return False
    for k in (length // 2, length):
        moved = [between(reckoned[at], reckoned[at + k]) for at in (frame, match)]
        error = moved[0] - moved[1]
        if np.hypot(*error[:2]) > 2.0 * state.cell or abs(wrap(error[2])) > 0.5:
            return False
    return True
