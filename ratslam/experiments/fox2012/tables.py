"""The figures of a reproduction as text: paths and maps at a glance, then equation 6 in full."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evaluation.metrics.grid_error import MAIN_CONVENTION
from evaluation.metrics.grid_score import pool_grids
from evaluation.metrics.grid_score import render_grid_scores as full
from ratslam.experiments.fox2012.mapper_ranking import orders
from ratslam.experiments.fox2012.metrics import CLOSED, word_of
from ratslam.experiments.fox2012.protocols import FILTERED, PAPERS, PATHS, RECKONED, TRUE, Protocol
from ratslam.experiments.fox2012.trials import Result

HEAD = (
    f"{'':<30}{'told':>7}{'final':>7}{'heading':>9}{'/ dead r.':>11}{'better in':>11}{'gap':>7}{'closed':>8}"
    f"{'eq. 6':>8}{'Brier sk.':>11}{'AUC':>7}{'Chamfer':>15}"
)
LEGEND = (
    "told, final: mean error of position as told at the time and as known in the end, m, start given, not "
    "aligned; heading: as told,\ndegrees; / dead r.: told over dead reckoning's, and in how many sets it is "
    "less; gap, closed: by how much the final path misses\nwhere the robot comes back, m, and the share of "
    f"these missed by less than {CLOSED:g} m (- where it never does); eq. 6: all cells, unknown\n"
    "outside, raw; Brier skill, wall AUC and Chamfer (map to walls, walls to map, m): over what whiskers can "
    "tell. Means over sets."
)

_ALONG = {RECKONED: "on dead reckoning", TRUE: "on the true path"}


def render_results(protocol: Protocol, found: Sequence[Result], sets: int) -> str:
    """All that a reproduction has to say."""
    done = len({one.number for one in found})
    lines = [f"{protocol.title} ({protocol.source}); {done} of {sets} sets", ""]
    for world in protocol.worlds:
        of = [one for one in found if one.world == world.name]
        for stop in range(len(protocol.stops)):
            lines += _glance(world.name, [one for one in of if one.stop == stop], protocol)
    lines += [LEGEND, ""]
    if set(PAPERS) <= set(protocol.mappers) and done > 1:
        for method in protocol.methods:
            scores = [
                pool_grids([one.score for one in _of(found, method, mapper, FILTERED)], mapper)
                for mapper in protocol.mappers
            ]
            lines += [f"{method.capitalize()}:", full(scores), "", *orders(method, found), ""]
    return "\n".join([*lines, protocol.note])


def _glance(world: str, found: Sequence[Result], protocol: Protocol) -> list[str]:
    if not found:
        return []
    counts = sorted({one.reports for one in found})
    spread = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    lines = [f"{world}, {spread} reports", HEAD]
    for method in protocol.methods:
        for along in PATHS:
            for mapper in protocol.mappers:
                name = f"{method}, {mapper}" if along == FILTERED else f"  {_ALONG[along]}, {mapper}"
                these = _of(found, method, mapper, along)
                lines += [_line(name, these)] if these else []
    return [*lines, ""]


def _of(found: Sequence[Result], method: str, mapper: str, along: str) -> list[Result]:
    return [one for one in found if (one.method, one.mapper, one.along) == (method, mapper, along)]


def _line(name: str, found: Sequence[Result]) -> str:
    def mean(key: str, digits: int = 3) -> str:
        values = [v for one in found if (v := one.values.get(key)) is not None]
        return f"{np.mean(values):.{digits}f}" if values else "-"

    told, reckoned = (np.array([one.values[key] for one in found], float) for key in ("told", "reckoned"))
    filtered = found[0].along == FILTERED
    ratio = f"{told.mean() / reckoned.mean():.2f}" if filtered and reckoned.mean() > 0 else "-"
    better = f"{(told < reckoned).sum()} of {len(found)}" if filtered else "-"
    ways = f"{mean('map_chamfer_map')}, {mean('map_chamfer_walls')}"
    error = word_of(MAIN_CONVENTION)
    return (
        f"{name:<30}{mean('told'):>7}{mean('final'):>7}{mean('heading', 1):>9}{ratio:>11}{better:>11}"
        f"{mean('gap'):>7}{mean('closed', 2):>8}{mean(error):>8}{mean('map_brier_skill', 2):>11}"
        f"{mean('map_auc', 2):>7}{ways:>15}"
    )
