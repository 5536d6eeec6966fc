"""The result of a reproduction as text: metrics of paths and maps, then equation 6 under all conventions."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from evaluation.metrics.grid_error import MAIN_CONVENTION
from evaluation.metrics.grid_score import pool_grids, render_grid_scores
from evaluation.metrics.revisits import CLOSED_GAP
from ratslam.experiments.fox2012.mapper_ranking import render_rankings
from ratslam.experiments.fox2012.protocols import FILTERED, PAPERS, RECKONED, TRUE, Protocol
from ratslam.experiments.trials.reproduction import ResultRow

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

PREFIXES = {FILTERED: "{}, ", RECKONED: "  on dead reckoning, ", TRUE: "  on the true path, "}


def render_results(protocol: Protocol, rows: Sequence[ResultRow], sets: int) -> str:
    """All metrics of a reproduction, then the tests of the paper's order of mappers."""
    done = len({row.number for row in rows})
    lines = [f"{protocol.title} ({protocol.source}); {done} of {sets} sets", ""]
    for world, stop in product(protocol.worlds, range(len(protocol.stops))):
        these = [row for row in rows if row.key[0] == world.name and row.session.stop == stop]
        lines += _metric_lines(world.name, these, protocol)
    lines += [LEGEND, ""]
    if set(PAPERS) <= set(protocol.mappers) and done > 1:
        for method in protocol.methods:
            scores = [
                pool_grids(
                    [row.session.score for row in rows if row.key[1:] == (method, mapper, FILTERED)], mapper
                )
                for mapper in protocol.mappers
            ]
            lines += [f"{method.capitalize()}:", render_grid_scores(scores), ""]
            lines += [*render_rankings(method, rows), ""]
    return "\n".join([*lines, protocol.note])


def _metric_lines(world: str, rows: Sequence[ResultRow], protocol: Protocol) -> list[str]:
    if not rows:
        return []
    counts = [row.values["reports"] for row in rows]
    spread = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
    lines = [f"{world}, {spread} reports", HEAD]
    for method, along, mapper in product(protocol.methods, PREFIXES, protocol.mappers):
        these = [row for row in rows if row.key[1:] == (method, mapper, along)]
        lines += [_line(PREFIXES[along].format(method) + mapper, these)] if these else []
    return [*lines, ""]


def _line(name: str, rows: Sequence[ResultRow]) -> str:
    def mean(field: str, digits: int = 3) -> str:
        values = [value for row in rows if (value := row.values.get(field)) is not None]
        return f"{np.mean(values):.{digits}f}" if values else "-"

    fields = ("online_error", "odometry_error")
    online, odometry = (np.array([row.values[field] for row in rows], float) for field in fields)
    filtered = rows[0].key[3] == FILTERED
    ratio = f"{online.mean() / odometry.mean():.2f}" if filtered and odometry.mean() > 0 else "-"
    better = f"{(online < odometry).sum()} of {len(rows)}" if filtered else "-"
    ways = f"{mean('map_chamfer_map')}, {mean('map_chamfer_walls')}"
    error, heading = mean(MAIN_CONVENTION.column), mean("online_heading_error_deg", 1)
    return (
        f"{name:<30}{mean('online_error'):>7}{mean('final_error'):>7}{heading:>9}{ratio:>11}{better:>11}"
        f"{mean('revisit_gap'):>7}{mean('revisits_closed', 2):>8}{error:>8}"
        f"{mean('map_brier_skill', 2):>11}{mean('map_auc', 2):>7}{ways:>15}"
    )
