"""The classic oracle against what the compiled reference recorded for the same stream."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice
from math import inf, pi

import numpy as np

from tests.oracle.cells import Array, Pose
from tests.oracle.classic.engine import Engine, Outcome
from tests.oracle.classic.places import Cell, truncated
from tests.oracle.trace import Row, Trace

KNIFE_EDGE = 1e-6  # a coordinate this close to a whole number may be truncated either way (Q2)
DUST = 1e-12  # activity that rounding alone can make or unmake

DECISIONS = ("vt", "action", "src", "dest", "pc_exp", "em_exp", "n_vt", "n_exp", "n_links")
TOLERANCE = {"view": 1e-12, "cells": 1e-9, "activity": 1e-12, "map": 1e-9, "links": 1e-9, "templates": 1e-9}


@dataclass
class Report:
    """How far two runs of a stream lie apart.

    Attributes:
        name: of the stream.
        steps: rows compared.
        differing: rows in which a decision differs.
        first: the first of them, in words.
        deviation: the largest of each kind.
        counts: rows whose number of active cells differs by more than dust.
        dusty: rows whose number of active cells differs by dust.
        followed: knife edges where the recorded cell was taken.
        stopped: why a run ended early.
    """

    name: str
    steps: int = 0
    differing: int = 0
    first: str = ""
    deviation: dict[str, float] = field(default_factory=lambda: dict.fromkeys(TOLERANCE, 0.0))
    counts: int = 0
    dusty: int = 0
    followed: int = 0
    stopped: str = ""

    @property
    def ok(self) -> bool:
        """Every decision equal, every deviation tolerable."""
        close = all(self.deviation[kind] <= limit for kind, limit in TOLERANCE.items())
        return close and not (self.differing or self.counts or self.stopped)

    def note(self, kind: str, ours: float | Array, theirs: float | Array, ring: float = inf) -> None:
        """Keeps the largest difference of a kind; tables of different shapes are infinitely far apart."""
        a, b = np.asarray(ours, dtype=float), np.asarray(theirs, dtype=float)
        if a.shape != b.shape:
            self.deviation[kind] = inf
            return
        apart = np.abs(a - b)
        apart = np.minimum(apart, np.abs(ring - apart))
        apart = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, apart)
        worst = float(np.nan_to_num(apart, nan=inf).max(initial=0.0))
        self.deviation[kind] = max(self.deviation[kind], worst)

    def line(self) -> str:
        """The comparison in one line."""
        parts = [f"{self.name}: {self.steps} steps", f"{self.differing} decisions differ"]
        parts += [f"{kind} {worst:.1e}" for kind, worst in self.deviation.items()]
        parts.append(f"active counts differ {self.counts}")
        parts += [f"by dust {self.dusty}"] if self.dusty else []
        parts += [f"knife edges followed {self.followed}"] if self.followed else []
        parts += [f"first at {self.first}"] if self.first else []
        parts += [self.stopped] if self.stopped else []
        return ", ".join(parts) + (": ok" if self.ok else ": DIFFERS")


class Follower:
    """Chooses the injected cell: truncation, or the recorded cell where rounding alone decides (Q2).

    One cell taken differently moves the packet for the rest of the run.
    """

    def __init__(self, trace: Trace) -> None:
        self.recorded = [trace.arrays[f"out_inj_{axis}"].astype(int) for axis in ("th", "y", "x")]
        self.sizes = (trace.params.pc_dim_th, trace.params.pc_dim_xy, trace.params.pc_dim_xy)
        self.row = 0
        self.followed = 0

    def __call__(self, pose: Pose) -> Cell:
        own = truncated(pose)
        th, y, x = (int(column[self.row]) for column in self.recorded)
        recorded = (th, y, x)
        if recorded == own:
            return own
        exact = (pose.th, pose.y, pose.x)
        if min(recorded) < 0:  # recorded as lost: only possible beyond the last cell
            recorded = self.sizes if any(_seam(c, n) for c, n in zip(exact, self.sizes, strict=True)) else own
        elif not all(map(_possible, recorded, exact, self.sizes)):
            return own
        self.followed += recorded != own
        return recorded


def _seam(coordinate: float, n: int) -> bool:
    """Whether rounding can put a coordinate on either side of the ring's seam."""
    return min(coordinate, abs(n - coordinate)) < KNIFE_EDGE


def _possible(cell: int, coordinate: float, n: int) -> bool:
    """Whether a coordinate can be truncated to a cell, give or take rounding."""
    if _seam(coordinate, n):
        return cell in (0, n - 1, n)
    return cell in (int(coordinate - KNIFE_EDGE), int(coordinate + KNIFE_EDGE))


def compare(trace: Trace, steps: int | None = None) -> Report:
    """Runs a stream, or its first `steps` rows, and compares every number that was recorded."""
    report = Report(trace.name)
    follower = Follower(trace)
    engine = Engine(trace.params, trace.given, follower)
    for k, row in enumerate(islice(trace, steps)):
        follower.row = k
        try:
            outcome = engine.step(row)
        except (ArithmeticError, ValueError) as error:
            report.stopped = f"stopped at step {k}: {error}"
            return report
        report.steps += 1
        _compare_row(report, engine, trace, row, k, outcome)
        for kind in ("cells", "map"):
            _compare_snapshot(report, engine, trace, f"{kind}_{k}")
    if report.steps == len(trace):
        _compare_snapshot(report, engine, trace, "cells_final")
        _compare_snapshot(report, engine, trace, "map_final")
        _compare_tables(report, engine, trace)
    report.followed = follower.followed
    return report


def _compare_row(report: Report, engine: Engine, trace: Trace, row: Row, k: int, ours: Outcome) -> None:
    """One row of the `out_` columns; what a row cannot tell is not compared.

    A row without a view has no match, and one without an action no source.
    """
    params = trace.params
    theirs = Outcome(*(trace.arrays[f"out_{name}"][k] for name in Outcome._fields))
    silent = (() if row.view is not None else ("vt",)) + (() if ours.action else ("src", "dest"))
    differing = [name for name in DECISIONS if name not in silent]
    lost = max(ours.inj_th - params.pc_dim_th, max(ours.inj_x, ours.inj_y) - params.pc_dim_xy) >= 0
    if not lost:  # energy that falls outside the grid may be recorded as none
        differing += ["inj_x", "inj_y", "inj_th"]
        report.note("activity", ours.inj_energy, theirs.inj_energy)
    differing = [name for name in differing if getattr(ours, name) != getattr(theirs, name)]
    if differing:
        report.differing += 1
        name = differing[0]
        report.first = report.first or f"step {k}: {name} {getattr(ours, name)} for {getattr(theirs, name):g}"

    if row.view is not None:
        report.note("view", ours.rel_rad, theirs.rel_rad, 2 * pi)
        if not trace.given:
            huge = max(abs(ours.vt_err), 1.0)
            report.note("view", ours.vt_err / huge, theirs.vt_err / huge)
    for name in ("max_act", "total", "min_act"):
        report.note("activity", getattr(ours, name), getattr(theirs, name))
    report.note("cells", [ours.best_x, ours.best_y], [theirs.best_x, theirs.best_y], params.pc_dim_xy)
    headings = [ours.best_th, ours.vt_delta_pc_th], [theirs.best_th, theirs.vt_delta_pc_th]
    report.note("cells", *headings, params.pc_dim_th)
    if not np.isnan(ours.delta_pc):
        report.note("cells", ours.delta_pc, theirs.delta_pc)
    places = ("em_x", "em_y", "acc_dx", "acc_dy")
    report.note("map", [getattr(ours, n) for n in places], [getattr(theirs, n) for n in places])
    report.note("map", [ours.em_th, ours.acc_facing], [theirs.em_th, theirs.acc_facing], 2 * pi)
    if ours.nnz != theirs.nnz:
        explained = _only_dust(engine.places.network.P, theirs.nnz)
        report.dusty += explained
        report.counts += not explained


def _only_dust(P: Array, recorded: float) -> bool:
    """Whether cells that hold next to nothing explain another number of active cells.

    Weights that are zero but for rounding leave dust beside active cells, here or there.
    """
    near = P != 0
    for axis in range(3):
        near = near | np.roll(near, 1, axis) | np.roll(near, -1, axis)
    return bool((np.abs(P) > DUST).sum() <= recorded <= near.sum())


def _compare_snapshot(report: Report, engine: Engine, trace: Trace, name: str) -> None:
    """The whole network (`cells_`), or all nodes (`map_`), where they were recorded."""
    if name.startswith("cells") and f"{name}_val" in trace.arrays:
        P = np.zeros_like(engine.places.network.P)
        P[tuple(trace.arrays[f"{name}_idx_kyx"].astype(int).T)] = trace.arrays[f"{name}_val"]
        report.note("activity", engine.places.network.P, P)
    if name.startswith("map") and name in trace.arrays:
        N, K = trace.params.pc_dim_xy, trace.params.pc_dim_th
        rings = np.array([inf, inf, inf, 2 * pi, N, N, K, inf])
        report.note("map", engine.map_table(), trace.arrays[name], rings)


def _by_ends(links: Array) -> Array:
    """Links by their two nodes: recorded in the order they were made, kept by node."""
    return links[np.lexsort((links[:, 1], links[:, 0]))]


def _compare_tables(report: Report, engine: Engine, trace: Trace) -> None:
    """Links and templates at the end."""
    N, K = trace.params.pc_dim_xy, trace.params.pc_dim_th
    if "links" in trace.arrays:
        rings = np.array([inf, inf, inf, 2 * pi, 2 * pi, inf])
        report.note("links", _by_ends(engine.link_table()), _by_ends(trace.arrays["links"]), rings)
    if "vt_final" in trace.arrays:
        rings = np.array([inf, N, N, K, inf, inf])
        report.note("templates", engine.template_table(), trace.arrays["vt_final"], rings)
