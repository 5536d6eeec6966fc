"""The result of a reproduction as text: metrics of paths and maps, then equation 6 under all conventions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evaluation.metrics.grid_error import MAIN_CONVENTION
from evaluation.metrics.grid_score import pool_grids
from evaluation.metrics.grid_score import render_grid_scores as full
from ratslam.experiments.fox2012.mapper_ranking import render_rankings
from ratslam.experiments.fox2012.metrics import CLOSED_GAP, eq6_column
from ratslam.experiments.fox2012.protocols import FILTERED, PAPERS, PATHS, RECKONED, TRUE, Protocol
from ratslam.experiments.fox2012.trials import MapperResult

HEAD = (
    f"{'':<30}{'online':>7}{'final':>7}{'heading':>9}{'/ dead r.':>11}{'better in':>11}{'gap':>7}"
    f"{'closed':>8}{'eq. 6':>8}{'Brier sk.':>11}{'AUC':>7}{'Chamfer':>15}"
)
LEGEND = (
    "online, final: mean position error of the online and the final poses, m, with known start, not aligned; "
    "heading: online,\ndegrees; / dead r.: online error over dead reckoning's, and in how many sets it is "
    "smaller; gap, closed: error of the final path\nbetween the visits of a place, m, and share of the "
    f"revisits with less than {CLOSED_GAP:g} m (- without revisits); eq. 6: all cells, unknown\n"
    "outside, raw; Brier skill, wall AUC and Chamfer (map to walls, walls to map, m): over the cells that "
    "whiskers can sense. Means over sets."
)

_ALONG = {RECKONED: "on dead reckoning", TRUE: "on the true path"}


def render_results(protocol: Protocol, found: Sequence[MapperResult], sets: int) -> str:
    """All metrics of a reproduction, then the tests of the paper's order of mappers."""
    done = len({one.number for one in found})
    lines = [f"{protocol.title} ({protocol.source}); {done} of {sets} sets", ""]
    for world in protocol.worlds:
        of = [one for one in found if one.world == world.name]
        for stop in range(len(protocol.stops)):
            lines += _metric_lines(world.name, [one for one in of if one.stop == stop], protocol)
    lines += [LEGEND, ""]
    if set(PAPERS) <= set(protocol.mappers) and done > 1:
        for method in protocol.methods:
            scores = [
                pool_grids([one.score for one in _select(found, method, mapper, FILTERED)], mapper)
                for mapper in protocol.mappers
            ]
            lines += [f"{method.capitalize()}:", full(scores), "", *render_rankings(method, found), ""]
    return "\n".join([*lines, protocol.note])


def _metric_lines(world: str, found: Sequence[MapperResult], protocol: Protocol) -> list[str]:
    if not found:
        return []
    counts = sorted({one.reports for one in found})
    spread = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    lines = [f"{world}, {spread} reports", HEAD]
    for method in protocol.methods:
        for along in PATHS:
            for mapper in protocol.mappers:
                name = f"{method}, {mapper}" if along == FILTERED else f"  {_ALONG[along]}, {mapper}"
                these = _select(found, method, mapper, along)
                lines += [_line(name, these)] if these else []
    return [*lines, ""]


def _select(found: Sequence[MapperResult], method: str, mapper: str, along: str) -> list[MapperResult]:
    return [one for one in found if (one.method, one.mapper, one.along) == (method, mapper, along)]


def _line(name: str, found: Sequence[MapperResult]) -> str:
    def mean(key: str, digits: int = 3) -> str:
        values = [v for one in found if (v := one.values.get(key)) is not None]
        return f"{np.mean(values):.{digits}f}" if values else "-"

    keys = ("online_error", "odometry_error")
    online, odometry = (np.array([one.values[key] for one in found], float) for key in keys)
    filtered = found[0].along == FILTERED
    ratio = f"{online.mean() / odometry.mean():.2f}" if filtered and odometry.mean() > 0 else "-"
    better = f"{(online < odometry).sum()} of {len(found)}" if filtered else "-"
    ways = f"{mean('map_chamfer_map')}, {mean('map_chamfer_walls')}"
    error = eq6_column(MAIN_CONVENTION)
    heading = mean("online_heading_error_deg", 1)
    return (
        f"{name:<30}{mean('online_error'):>7}{mean('final_error'):>7}{heading:>9}{ratio:>11}{better:>11}"
        f"{mean('revisit_gap'):>7}{mean('revisits_closed', 2):>8}{mean(error):>8}"
        f"{mean('map_brier_skill', 2):>11}"
        f"{mean('map_auc', 2):>7}{ways:>15}"
    )
