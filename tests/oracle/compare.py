"""Comparison of the stock engine with a recorded trace."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from tests.oracle.cells import Cell, NetworkDied, Pose, truncated
from tests.oracle.engine import Step, StockEngine
from tests.oracle.trace import Array, Trace, TraceError

POSE, ACTIVITY, ERROR = 1e-9, 1e-12, 1e-12
KNIFE = 1e-6  # coordinates this close to an integer may truncate to either cell
DUST = 1e-12  # smaller activity may be exactly 0 in another order of additions
OUTPUTS = (
    "vt", "vt_err", "rel_rad", "inj_energy", "inj_x", "inj_y", "inj_th", "best_x", "best_y", "best_th",
    "max_act", "total", "min_act", "nnz", "vt_delta_pc_th", "delta_pc", "action", "src", "dest", "pc_exp",
    "em_exp", "em_x", "em_y", "em_th", "acc_dx", "acc_dy", "acc_facing", "n_vt", "n_exp", "n_links",
)  # fmt: skip
NEEDED = {f"out_{name}" for name in OUTPUTS}
NEEDED |= {"cells_final_idx_kyx", "cells_final_val", "map_final", "links", "vt_final"}
HUGE = 1e300  # matching error where nothing was compared


@dataclass
class Report:
    """The largest deviation of each kind, and the first decision that differs."""

    name: str
    tolerances: dict[str, float]
    steps: int = 0
    knife_edges: int = 0
    dusty: int = 0
    deviations: dict[str, float] = field(default_factory=dict)
    differing: int = 0
    first: str = ""

    def decide(self, step: int | str, what: str, ours: object, theirs: object) -> bool:
        """Note a decision; true if it is the same."""
        same = ours == theirs
        if not same:
            self.differing += 1
            self.first = self.first or f"{what} at {step}: {ours}, expected {theirs}"
        return same

    def measure(self, kind: str, ours: Array | float, theirs: Array | float, ring: float = 0.0) -> None:
        """Note a deviation; around a ring where one is given. A NaN on one side only is infinitely far."""
        a, b = np.asarray(ours, float), np.asarray(theirs, float)
        if a.shape != b.shape:
            self.deviations[kind] = math.inf
            return
        if not a.size:
            return
        d = np.abs(a - b)
        if ring:
            d = np.abs(np.minimum(d, np.abs(ring - d)))
        d = np.where(np.isnan(a) & np.isnan(b), 0.0, np.where(np.isnan(d), math.inf, d))
        self.deviations[kind] = max(self.deviations.get(kind, 0.0), float(d.max()))

    @property
    def agrees(self) -> bool:
        """Every decision equal and every deviation within its tolerance."""
        within = all(
            self.deviations[k] <= limit for k, limit in self.tolerances.items() if k in self.deviations
        )
        return within and not self.differing

    def line(self) -> str:
        """All of it in one line."""
        parts = [f"{self.name}: {'ok' if self.agrees else 'DIFFERS'}, {self.steps} steps"]
        parts += [f"{kind} {value:.1e}" for kind, value in self.deviations.items()]
        parts.append(f"knife edges followed {self.knife_edges}")
        parts.append(
            f"decisions differing {self.differing}" + (f" (first: {self.first})" if self.first else "")
        )
        return ", ".join(parts)


TOLERANCES = {
    "packet": POSE,
    "map": POSE,
    "links": POSE,
    "templates": POSE,
    "activity": ACTIVITY,
    "error": ERROR,
}


class Follower:
    """Chooses the cell of an injection: the recorded one where truncation is ambiguous (Q2)."""

    def __init__(self, trace: Trace) -> None:
        names = ("out_inj_x", "out_inj_y", "out_inj_th")
        self.recorded = np.stack([trace.arrays[name] for name in names], axis=1).astype(int)
        p = trace.parameters
        self.rings = (p.pc_dim_xy, p.pc_dim_xy, p.pc_dim_th)
        self.followed = 0
        self.step = 0

    def __call__(self, pose: Pose) -> Cell:
        own = truncated(pose)
        chosen = []
        recorded = self.recorded[self.step]
        outside = bool((recorded < 0).any())
        for coordinate, cell, theirs, n in zip(pose, own, recorded, self.rings, strict=True):
            near = round(coordinate)
            if abs(coordinate - near) < KNIFE:
                if outside and near % n == 0:
                    cell = n  # lost: a coordinate of exactly n lies outside
                elif not outside and theirs in (near % n, (near - 1) % n):
                    cell = int(theirs)
            chosen.append(cell)
        self.followed += tuple(chosen) != own
        return chosen[0], chosen[1], chosen[2]


def stock(trace: Trace, steps: int | None = None) -> Report:
    """Compares the stock engine with (the first `steps` of) a trace."""
    if missing := sorted(NEEDED - trace.arrays.keys()):
        raise TraceError(f"{trace.name}: nothing to compare with: no {', '.join(missing)} in the file")
    engine, follow = StockEngine(trace.parameters), Follower(trace)
    report = Report(trace.name, TOLERANCES)
    for index, row in enumerate(trace.rows()):
        if index == steps:
            break
        follow.step = index
        try:
            step = engine.step(row, follow)
        except (NetworkDied, ValueError) as error:
            report.decide(index, "the engine stopped", str(error), "a whole run")
            break
        row_of(report, trace, engine, step, index, row.seen, row.odometry)
        if f"cells_{index}_val" in trace.arrays:
            cells(report, trace, engine, str(index))
        if f"map_{index}" in trace.arrays:
            nodes(report, trace, engine, str(index))
        report.steps = index + 1
    if report.steps == len(trace):
        final(report, trace, engine)
    report.knife_edges = follow.followed
    return report


def row_of(
    report: Report, trace: Trace, engine: StockEngine, step: Step, index: int, seen: bool, odometry: bool
) -> None:
    """Compare one row's outputs."""
    out = {n.removeprefix("out_"): float(a[index]) for n, a in trace.arrays.items() if n.startswith("out_")}
    activity, places, graph = engine.cells.activity, engine.places, engine.map
    n, headings = trace.parameters.pc_dim_xy, trace.parameters.pc_dim_th
    decisions: dict[str, float] = {
        "action": step.action,
        "pc_exp": places.experience,
        "em_exp": graph.current,
        "n_vt": len(places.memories),
        "n_exp": len(places.experiences),
        "n_links": len(graph.links),
    }
    count = int(np.count_nonzero(activity))
    if count != out["nnz"] and dusty(activity, int(out["nnz"])):
        report.dusty += 1
    else:
        decisions["nnz"] = count
    if odometry:
        decisions |= {"src": step.source, "dest": step.target}
    if step.match is not None:
        decisions["vt"] = step.match.template
        injected = step.injected or (-1, -1, -1)
        decisions |= dict(zip(("inj_x", "inj_y", "inj_th"), injected, strict=True))
        report.measure("activity", step.energy, out["inj_energy"])
        report.measure("packet", step.match.relative, out["rel_rad"], ring=2 * math.pi)
        if not trace.labelled and not (step.match.error > HUGE and out["vt_err"] > HUGE):
            report.measure("error", step.match.error, out["vt_err"])
    for what, ours in decisions.items():
        report.decide(index, what, ours, out[what])
    for value, name, ring in zip(
        engine.cells.best, ("best_x", "best_y", "best_th"), (n, n, headings), strict=True
    ):
        report.measure("packet", value, out[name], ring)
    report.measure("packet", places.turned, out["vt_delta_pc_th"])
    if odometry:
        report.measure("packet", step.delta, out["delta_pc"])
    for value, name in ((activity.max(), "max_act"), (activity.sum(), "total"), (activity.min(), "min_act")):
        report.measure("activity", value, out[name])
    here = graph.current
    pose = (graph.x[here], graph.y[here], graph.th[here]) if graph.x else (math.nan,) * 3
    report.measure("map", np.array(pose[:2]), np.array([out["em_x"], out["em_y"]]))
    report.measure("map", pose[2], out["em_th"], ring=2 * math.pi)
    report.measure("map", np.array([graph.dx, graph.dy]), np.array([out["acc_dx"], out["acc_dy"]]))
    report.measure("map", graph.facing, out["acc_facing"], ring=2 * math.pi)


def dusty(activity: Array, count: int) -> bool:
    """Whether a count of nonzero cells differs from ours only by cells that rounding decides."""
    solid = np.abs(activity) > DUST
    reach = solid
    for axis in range(3):
        reach = reach | np.roll(reach, 1, axis) | np.roll(reach, -1, axis)
    return int(solid.sum()) <= count <= int(reach.sum())


def cells(report: Report, trace: Trace, engine: StockEngine, name: str) -> None:
    """Compare the whole network."""
    expected = np.zeros_like(engine.cells.activity)
    expected[tuple(trace.arrays[f"cells_{name}_idx_kyx"].T.astype(int))] = trace.arrays[f"cells_{name}_val"]
    report.measure("activity", engine.cells.activity, expected)


def columns(
    report: Report, what: str, ours: list[tuple[float, ...]], theirs: Array, exact: int
) -> Array | None:
    """Our rows as an array, if their number and their first `exact` columns are the file's."""
    if not report.decide(what, "number of rows", len(ours), len(theirs)):
        return None
    table = np.array(ours, float).reshape(len(ours), theirs.shape[1])
    for row, (a, b) in enumerate(zip(table[:, :exact].tolist(), theirs[:, :exact].tolist(), strict=True)):
        report.decide(f"{what} row {row}", "ids", a, b)
    return table


def nodes(report: Report, trace: Trace, engine: StockEngine, name: str) -> None:
    """Compare the nodes of the map and the experiences behind them."""
    theirs = np.asarray(trace.arrays[f"map_{name}"], float)
    graph, n, headings = engine.map, trace.parameters.pc_dim_xy, trace.parameters.pc_dim_th
    ours = [
        (e, graph.x[e], graph.y[e], graph.th[e], *place.packet, place.template)
        for e, place in enumerate(engine.places.experiences)
    ]
    table = columns(report, f"map_{name}", ours, theirs, exact=1)
    if table is None or not len(table):
        return
    for node, (a, b) in enumerate(zip(table[:, 7], theirs[:, 7], strict=True)):
        report.decide(f"map_{name} node {node}", "template", a, b)
    report.measure("map", table[:, 1:3], theirs[:, 1:3])
    report.measure("map", table[:, 3], theirs[:, 3], ring=2 * math.pi)
    report.measure("packet", table[:, 4:6], theirs[:, 4:6], ring=n)
    report.measure("packet", table[:, 6], theirs[:, 6], ring=headings)


def final(report: Report, trace: Trace, engine: StockEngine) -> None:
    """Compare the final network, map, links and templates."""
    cells(report, trace, engine, "final")
    nodes(report, trace, engine, "final")
    theirs = np.asarray(trace.arrays["links"], float)
    links = [(k.start, k.end, k.distance, k.heading, k.facing, k.time) for k in engine.map.links]
    table = columns(report, "links", links, theirs, exact=2)
    if table is not None:
        report.measure("links", table[:, [2, 5]], theirs[:, [2, 5]])
        report.measure("links", table[:, 3:5], theirs[:, 3:5], ring=2 * math.pi)
    theirs = np.asarray(trace.arrays["vt_final"], float)
    templates = [(t, *m.packet, m.decay, len(m.experiences)) for t, m in enumerate(engine.places.memories)]
    table = columns(report, "vt_final", templates, theirs, exact=1)
    if table is not None and len(table):
        for template, (a, b) in enumerate(zip(table[:, 5], theirs[:, 5], strict=True)):
            report.decide(f"vt_final template {template}", "experiences", a, b)
        n, headings = trace.parameters.pc_dim_xy, trace.parameters.pc_dim_th
        report.measure("templates", table[:, 1:3], theirs[:, 1:3], ring=n)
        report.measure("templates", table[:, 3], theirs[:, 3], ring=headings)
        report.measure("templates", table[:, 4], theirs[:, 4])
