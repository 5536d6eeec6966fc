"""The figures of Fox et al. 2012: worlds, mappers and two filters, run, scored, ranked and drawn.

A set is a session: an arena, a start, the behaviour of the robot and the errors of its odometry, all from one
seed. All mappers and methods run on the same sets, so their differences are paired.

The paper ranks its mappers by one number (equation 6). Two baselines show what that number means: the best
constant map, which needs no contact, and the same marks drawn along dead reckoning and along the true path. A
ranking that holds there too is one of the marks, not of the filters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from evaluation.metrics import occupancy_score
from evaluation.metrics.occupancy_grid import OccupancyGrid, mean_grid
from evaluation.metrics.occupancy_score import DISTINCT_CONVENTIONS, MAIN_CONVENTION, Convention, score_grid
from evaluation.metrics.statistics import bootstrap
from evaluation.metrics.trajectory import position_error
from evaluation.papers import trial_sessions as trials
from evaluation.papers.paper_sets import Paper, ResultRow, column, count_sets, run_with_progress
from evaluation.plots import style
from evaluation.plots.grid_plot import GridPanel, draw_grids
from ratslam.runs.run_directory import true_grid
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import override, parse, validate
from robot.touch_source import report_config_of
from robot.world.arena import Arena, wall_segments
from tactile.base.random_streams import stream
from tactile.base.se2 import wrap

MAPPERS = {"blob": "none", "geometric": "geometric", "template": "template", "fused": "fused"}
"""`touch.reports.walls` of the paper's three mappers (II-E to II-G), and a fourth that fuses them."""
PAPERS = ("blob", "geometric", "template")  # the paper's mappers from worst to best as printed (III)
METHODS: dict[str, tuple[str, ...]] = {
    "as printed": (
        "touch.reports.max_template_error=null",
        "grid.likelihood={model: literal}",
        "grid.resampling={schedule: always, scheme: multinomial, length: 0.0, heading: 0.0, scale: 0.0}",
        "grid.drift={session: 0.0, move: 0.0, heading: 0.0}",
        "grid.footprint={wall: edge, edge: 1.386, blob: 1.386, along: 0.25, free: 0.405, body: 0.405,"
        " max_log_odds: 3.5}",
        "grid.drawing={contact: 0.8, blob_sd: 0.05, edge_sd: 0.25, edge_sector: 0.2617993877991494}",
    ),
    "ours": (),
}
"""As printed (Algorithm 1, eq. 1 to 5), except where the printed form cannot work: each cell counts once in
eq. 2 and not as free where the contact is (`distinct_cells`), footprints are neutral far away, and
resampled particles have moved. Footprints are the log-odds of 0.8 and 0.4. All templates are used. Ours are
the defaults."""
FILTERED, RECKONED, TRUE = "filter", "dead reckoning", "true path"
"""Paths along which a method's marks are drawn: the filter's, a lower bound and an upper bound."""


class _Protocol(NamedTuple):
    """A figure of the paper.

    Attributes:
        source: section and figure. worlds: by name, the level of the odometry noise, which the printed filter
            uses as the noise of each step, and overrides. stops: numbers of reports after which the result is
            scored; 0: all. one_arena: whether all sets share an arena. note: printed below the table.
    """

    title: str
    source: str
    worlds: Mapping[str, tuple[float, tuple[str, ...]]]
    note: str
    mappers: tuple[str, ...] = tuple(MAPPERS)
    stops: tuple[int, ...] = (0,)
    one_arena: bool = True


_SMALL: dict[str, tuple[float, tuple[str, ...]]] = {"1.25 m arena": (0.05, ())}
_LARGE = ("create_simulation.arena.side=2.5", "create_simulation.reports=1500")

PROTOCOLS = {
    "fox-fig4": _Protocol(
        "Mean maps of three mappers",
        "Fox et al. 2012, III, Fig. 4",
        _SMALL,
        note="One arena, six minutes from a different start in each trial. The paper does not print its "
        "arena, whisker mounts and likelihood constants: compare rankings, not values.",
    ),
    "fox-fig5": _Protocol(
        "Maps of single trials",
        "Fox et al. 2012, IV, Fig. 5",
        _SMALL,
        note="The trials of fox-fig4 with the same numbers.",
    ),
    "fox-fig6": _Protocol(
        "A larger arena at two levels of odometry noise",
        "Fox et al. 2012, III, Fig. 6",
        {"2 % noise": (0.02, _LARGE), "5 % noise": (0.05, _LARGE)},
        note="The paper: tracked for 200 steps at 2 %, loops not closed at 5 %. The noise is one scale error "
        "for each straight line or turn; each set has its own arena.",
        mappers=("geometric",),
        stops=(200, 1500),
        one_arena=False,
    ),
}


LEAVE_DISTANCE = 0.5
"""Distance that the robot must have been away in between, m."""
_CLOSED_GAP = 0.1
"""A revisit is closed if the path gives the offset of the two visits to this error, m."""


def path_metrics(online: np.ndarray, path: np.ndarray, truth: np.ndarray) -> dict[str, float | None]:
    """Metrics of online, final and true poses [T, 3].

    Returns:
        online_error, final_error: mean position errors, m. online_heading_error_deg: mean, degrees. revisits:
        number of reports at an earlier place. revisits_closed: share of these whose offset from the earlier
        visit the path gives to `_CLOSED_GAP`. revisit_gap: mean error of that offset, m.
    """
    later, earlier = find_revisits(truth).T
    gap = np.hypot(*((path[later] - path[earlier]) - (truth[later] - truth[earlier]))[:, :2].T)
    return {
        "online_error": position_error(online, truth),
        "final_error": position_error(path, truth),
        "online_heading_error_deg": float(np.degrees(np.abs(wrap(online[:, 2] - truth[:, 2])).mean())),
        "revisits": len(gap),
        "revisits_closed": float((gap < _CLOSED_GAP).mean()) if len(gap) else None,
        "revisit_gap": float(gap.mean()) if len(gap) else None,
    }


def find_revisits(truth: np.ndarray) -> np.ndarray:
    """[L, 2] each report at an earlier place, and the nearest of the earlier reports there."""
    found = []
    for k, here in enumerate(truth[:, :2]):
        apart = np.hypot(*(truth[:k, :2] - here).T)
        left = np.flatnonzero(apart > LEAVE_DISTANCE)
        before = apart[: left[-1]] if len(left) else apart[:0]
        if len(before) and before.min() < 0.1:  # m: two cells
            found.append((k, int(before.argmin())))
    return np.array(found, int).reshape(-1, 2)


KEY = ("world", "method", "mapper", "along")
"""Names of a result; the map is drawn `along` the scored path: `FILTERED`, `RECKONED` or `TRUE`."""
_MAP_METRICS = (
    "map_brier_skill", "map_brier_skill_free", "map_log_loss", "map_auc", "map_auc_free", "map_chamfer_map",
    "map_chamfer_walls",
)  # fmt: skip
FIELDS = (
    "reports", "online_error", "final_error", "online_heading_error_deg", "revisits", "revisits_closed",
    "revisit_gap", "odometry_error", *(each.column for each in occupancy_score.CONVENTIONS), *_MAP_METRICS,
)  # fmt: skip
"""Columns of metrics in NAME.csv."""

HEAD = (
    f"{'':<30}{'online':>7}{'final':>7}{'heading':>9}{'/ dead r.':>11}{'better in':>11}{'gap':>7}"
    f"{'closed':>8}{'eq. 6':>8}{'Brier sk.':>11}{'AUC':>7}{'Chamfer':>15}"
)
_LEGEND = (
    "online, final: mean position error of the online and the final poses, m, with known start, not aligned; "
    "heading: online,\ndegrees; / dead r.: online error over dead reckoning's, and in how many sets it is "
    "smaller; gap, closed: error of the final path\nbetween the visits of a place, m, and share of the "
    f"revisits with less than {_CLOSED_GAP:g} m (- without revisits); eq. 6: all cells, unknown\n"
    "outside, raw; Brier skill, wall AUC and Chamfer (map to walls, walls to map, m): over the cells that "
    "whiskers can sense. Means over sets."
)

_PREFIXES = {FILTERED: "{}, ", RECKONED: "  on dead reckoning, ", TRUE: "  on the true path, "}


def _render_results(protocol: _Protocol, rows: Sequence[ResultRow], sets: int) -> str:
    """All metrics of a reproduction, then the tests of the paper's order of mappers."""
    done = len({row.number for row in rows})
    lines = [f"{protocol.title} ({protocol.source}); {done} of {sets} sets", ""]
    for world, stop in product(protocol.worlds, range(len(protocol.stops))):
        these = [row for row in rows if row.key[0] == world and row.session.stop == stop]
        if not these:
            continue
        counts = [row.values["reports"] for row in these]
        spread = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
        lines += [f"{world}, {spread} reports", HEAD]
        for method, along, mapper in product(METHODS, _PREFIXES, protocol.mappers):
            scored = [row for row in these if row.key[1:] == (method, mapper, along)]
            lines += [_line(_PREFIXES[along].format(method) + mapper, scored)] if scored else []
        lines.append("")
    lines += [_LEGEND, ""]
    if set(PAPERS) <= set(protocol.mappers) and done > 1:
        for method in METHODS:
            scores = []
            for mapper in protocol.mappers:
                found = [row.session.score for row in rows if row.key[1:] == (method, mapper, FILTERED)]
                scores.append(occupancy_score.pool_grids(found, mapper))
            lines += [f"{method.capitalize()}:", occupancy_score.render_grid_scores(scores), ""]
            lines += [*render_rankings(method, rows), ""]
    return "\n".join([*lines, protocol.note])


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


FEW = 6  # number of sets below which the intervals are too narrow


MEASURES: dict[str, tuple[str, int, float | Convention]] = {
    **{each.column: ("eq. 6  {:<5}{:<7}{}".format(*each.words), 1, each) for each in DISTINCT_CONVENTIONS},
    "map_brier_skill": ("Brier skill", -1, 0.0),
    "map_auc": ("wall AUC", -1, 0.5),
    "map_chamfer_map": ("Chamfer, map to walls", 1, 0.0),
    "map_chamfer_walls": ("Chamfer, walls to map", 1, 0.0),
}
"""All ways to score a map, by field: name; 1 if larger is worse, else -1; score of a map without information,
or the convention of which it is the best constant map's. A map without information wins either Chamfer
distance alone: with few cells, or with all."""


def rank_mappers(
    rows: Sequence[ResultRow], method: str, field: str, along: str = FILTERED
) -> tuple[str, tuple[tuple[float, float, float], ...], bool]:
    """Tests the paper's ranking for a method's marks along a path, by one of `MEASURES`.

    Returns:
        `holds`, `does not hold`, `not decided`, or "" with fewer than two complete sets; for each pair of
        neighbours from worst to best, the mean difference and its 95 % interval; whether a map without
        information is as good as the best mapper.
    """
    _, sign, trivial = MEASURES[field]
    score = sign * np.array([column(rows, (method, name, along), field) for name in PAPERS])
    score = score[:, np.isfinite(score).all(axis=0)]
    if score.shape[1] < 2:
        return "", (), False
    name = f"{method} {along} {field}"
    steps = tuple((float((a - b).mean()), *bootstrap(a - b, name)) for a, b in pairwise(score))
    holds, fails = all(low > 0 for _, low, _ in steps), any(high <= 0 for *_, high in steps)
    word = "holds" if holds else "does not hold" if fails else "not decided"
    if isinstance(trivial, Convention):
        trivial = float(np.mean([row.session.score.under(trivial).best for row in rows]))
    return word, steps, bool(sign * trivial <= score.mean(axis=1).min())


def render_rankings(method: str, rows: Sequence[ResultRow]) -> list[str]:
    """A line for each measure."""
    first, second, third = PAPERS
    lines = [
        f"{first} worse than {second} worse than {third}? {method}: paired differences, 95 % intervals",
        f"{'scored by':<29}{f'{first} - {second}':<29}{f'{second} - {third}':<29}{'verdict':<15}"
        f"{f'on {RECKONED}':<19}on the {TRUE}",
    ]
    for field, (name, *_) in MEASURES.items():
        word, differences, is_beaten = rank_mappers(rows, method, field)
        if not word:
            lines.append(f"{name:<29}too few sets with a score of all three")
            continue
        steps = "".join(f"{f'{d:+.4f} [{low:+.4f}, {high:+.4f}]':<29}" for d, low, high in differences)
        reckoned, true = (rank_mappers(rows, method, field, along)[0] or "-" for along in (RECKONED, TRUE))
        beaten = "a map without information is as good" if is_beaten else ""
        lines.append(f"{name:<29}{steps}{word:<15}{reckoned:<19}{true:<18}{beaten}".rstrip())
    if len({row.number for row in rows}) < FEW:
        lines.append(f"Intervals of fewer than {FEW} sets are too narrow.")
    return lines


def _draw_reproduction(name: str, protocol: _Protocol, rows: Sequence[ResultRow]) -> style.Figure:
    """The figure of a reproduction: method below method, or set below set."""
    shown = [row for row in rows if row.key[3] == FILTERED]
    first_only, lines = False, len(METHODS)
    method, mapper = tuple(METHODS).index, protocol.mappers.index
    if name == "fox-fig4":  # a mean map for each mapper
        explanation = "below each mapper: the filter, eq. 6 (mean of the trials' errors)"
        panels = []
        for key in product(METHODS, protocol.mappers):
            these = [row for row in shown if row.key[1:3] == key]
            error = np.mean([row.values[MAIN_CONVENTION.column] for row in these])
            mean = mean_grid([row.session.grid for row in these])
            panels.append(_panel(key[1], f"{key[0]}, {error:.3f}", these[0])._replace(grid=mean))
    elif name == "fox-fig5":  # a map with the paths for each mapper and set
        explanation = "below each: the filter, position error (dead reckoning's), m"
        shown.sort(key=lambda row: (method(row.key[1]), row.number, mapper(row.key[2])))
        panels = [_with_paths(f"{row.key[2]}, trial {row.number + 1}", row) for row in shown]
        lines = len(panels) // len(protocol.mappers)
    else:  # a map of the first set for each world and length
        explanation = "odometry noise, reports; position error (dead reckoning's), m"
        first_only = any(row.number for row in rows)
        first = [row for row in shown if row.number == 0]
        first.sort(key=lambda row: (method(row.key[1]), row.key[0], row.values["reports"]))
        panels = [_with_paths(f"{row.key[0]}, {row.values['reports']}", row) for row in first]
    line = f"{protocol.source}  ·  {count_sets(rows, first_only)}  ·  {explanation}"
    return draw_grids(f"{name}: {protocol.title}", line, panels, across=len(panels) // lines)


def _with_paths(name: str, row: ResultRow) -> GridPanel:
    line = f"{row.key[1]}, {row.values['online_error']:.3f} ({row.values['odometry_error']:.3f})"
    paths = (row.session.truth, row.session.online, row.session.odometry)
    return _panel(name, line, row)._replace(paths=paths)


def _panel(name: str, line: str, row: ResultRow) -> GridPanel:
    return GridPanel(name, line, row.session.grid, wall_segments(row.session.arena))


class _SessionJob(NamedTuple):
    """A session to simulate and filter.

    Attributes:
        seed: of the session. training: seed of the strain templates. stops: numbers of reports after which
            the result is scored; 0: all. variants: configurations by method and mapper.
    """

    world: str
    number: int
    seed: int
    training: int
    stops: tuple[int, ...]
    variants: Mapping[tuple[str, str], RunConfig]


class _MapResult(NamedTuple):
    """The map and the paths [T, 3] of a row, in the frame of the arena; `stop` is the index of its stop."""

    stop: int
    score: occupancy_score.GridScore
    grid: OccupancyGrid
    arena: Arena
    truth: np.ndarray
    odometry: np.ndarray
    online: np.ndarray


def plan_jobs(
    protocol: _Protocol, sets: int, seed: int, assignments: Sequence[str] = ()
) -> list[_SessionJob]:
    """All sessions of a reproduction, set by set.

    Raises:
        InputError: an invalid assignment.
    """
    jobs = []
    for number, (world, (level, overrides)) in product(range(sets), protocol.worlds.items()):
        own = int(stream(seed, f"arenas.set.{number}").integers(2**31))
        arena = seed if protocol.one_arena else own
        session, where = f"create_simulation.seed={own}", f"create_simulation.arena.seed={arena}"
        settings = (session, where, f"session.seed={own}", *assignments)
        variants = {}
        for method, mapper in product(METHODS, protocol.mappers):
            given = ["backend=grid", f"create_simulation.wheels.level={level}", *overrides, *METHODS[method]]
            if method == "as printed":
                given.append(f"grid.drift.step={level}")
            given += [f"touch.reports.walls={MAPPERS[mapper]}", *settings]
            document = parse("create_simulation: {}\n", "the reproduction")
            variants[method, mapper] = validate(override(document, given), RunConfig)
        jobs.append(_SessionJob(world, number, own, seed, protocol.stops, variants))
    return jobs


def run_job(job: _SessionJob) -> list[ResultRow]:
    """The results of all variants on a session, and of their marks along paths without a filter.

    Raises:
        InputError: the session cannot be simulated.
    """
    some = next(iter(job.variants.values()))
    assert some.create_simulation is not None
    session = trials.simulate_session(some.create_simulation)
    count = len(session.truth)
    stops = tuple(min(stop, count) if stop else count for stop in job.stops)

    def score(
        key: tuple[str, str, str], stop: int, online: np.ndarray, path: np.ndarray, grid: OccupancyGrid
    ) -> ResultRow:
        truth, odometry = session.truth[: len(path)], session.odometry[: len(path)]
        found = score_grid(grid, true_grid(session.arena._replace(start=np.zeros(3)), grid), key[1])
        values = {
            "reports": len(path),
            "odometry_error": position_error(odometry, truth),
            **path_metrics(online, path, truth),
            **{error.convention.column: error.error for error in found.errors},
            **{name: found.quantities[name].value for name in _MAP_METRICS},
        }
        result = _MapResult(stop, found, grid, session.arena, truth, odometry, online)
        return ResultRow((job.world, *key), job.number, job.seed, values, result)

    rows: list[ResultRow] = []
    for variant, config in job.variants.items():
        reports = trials.observe_session(config, session, job.training)
        marks = trials.collect_marks(reports)
        feelers = report_config_of(session.source.info, config.touch.reports).feelers
        for stop, filtered in enumerate(trials.run_filter(config, session, reports, stops)):
            ways = {FILTERED: filtered}
            for name, whole in ((RECKONED, session.odometry), (TRUE, session.truth)):
                path = whole[: stops[stop]]
                ways[name] = path, path, trials.draw_map(config.grid, feelers, session.arena, path, marks)
            rows += [score((*variant, name), stop, *way) for name, way in ways.items()]
    return rows


_run = partial(run_with_progress, run_job)
PAPER = Paper(PROTOCOLS, KEY, FIELDS, plan_jobs, _run, _draw_reproduction, _render_results)
