"""Comparison of the stock engine with a recorded trace, step by step; the first difference ends it."""

from __future__ import annotations

import math

import numpy as np

from tests.oracle.stock import Cell, Step, StockEngine
from tests.oracle.trace import Array, Row, Trace

POSE, ACTIVITY = 1e-9, 1e-12
FINE = {"max_act", "total", "min_act", "inj_energy", "vt_err"}
HUGE = 1e300  # matching error where nothing was compared
TURN = 2 * math.pi


def assert_close(
    ours: object, theirs: object, within: float, where: object, ring: float | Array = math.inf
) -> None:
    """Around a ring where one is given; NaN equals NaN."""
    a, b = np.asarray(ours, float), np.asarray(theirs, float)
    assert a.shape == b.shape, where
    d = np.abs(a - b)
    d = np.minimum(d, np.abs(ring - d))
    assert ((d <= within) | (np.isnan(a) & np.isnan(b))).all(), f"{where}: {a}, expected {b}"


def rings_of(trace: Trace) -> Cell:
    p = trace.parameters
    return p.pc_dim_xy, p.pc_dim_xy, p.pc_dim_th


def follow(trace: Trace, steps: int | None = None) -> None:
    """Asserts that the stock engine makes (the first `steps` of) a trace."""
    engine = StockEngine(trace.parameters)
    for index, row in enumerate(trace.rows()):
        if index == steps:
            return
        compare_row(trace, engine, engine.step(row), index, row)
        if f"cells_{index}_val" in trace.arrays:
            compare_cells(trace, engine, str(index))
        if f"map_{index}" in trace.arrays:
            compare_nodes(trace, engine, str(index))
    compare_cells(trace, engine, "final")
    compare_nodes(trace, engine, "final")
    compare_links_and_templates(trace, engine)


def compare_row(trace: Trace, engine: StockEngine, step: Step, index: int, row: Row) -> None:
    activity, places, graph = engine.cells.activity, engine.places, engine.map
    here = graph.current
    x, y, th = (graph.x[here], graph.y[here], graph.th[here]) if graph.x else (math.nan,) * 3
    ours = {"action": step.action, "pc_exp": places.experience, "em_exp": here, "n_vt": len(places.memories)}
    ours |= {"n_exp": len(places.experiences), "n_links": len(graph.links), "vt_delta_pc_th": places.turned}
    ours |= dict(zip(("best_x", "best_y", "best_th"), engine.cells.best, strict=True))
    ours |= {"max_act": activity.max(), "total": activity.sum(), "min_act": activity.min()}
    ours |= {"em_x": x, "em_y": y, "em_th": th}
    ours |= {"acc_dx": graph.dx, "acc_dy": graph.dy, "acc_facing": graph.facing}
    if row.odometry:
        ours |= {"src": step.source, "dest": step.target, "delta_pc": step.delta}
    if step.match is not None:
        ours |= {"vt": step.match.template, "inj_energy": step.energy, "rel_rad": step.match.relative}
        ours |= dict(zip(("inj_x", "inj_y", "inj_th"), step.injected or (-1, -1, -1), strict=True))
        if not trace.labelled:
            ours["vt_err"] = min(step.match.error, HUGE)
    n, _, headings = rings_of(trace)
    rings = dict.fromkeys(("em_th", "acc_facing", "rel_rad"), TURN) | {
        "best_x": n, "best_y": n, "best_th": headings
    }  # fmt: skip
    for name, value in ours.items():
        theirs = min(float(trace.arrays[f"out_{name}"][index]), HUGE)
        within = ACTIVITY if name in FINE else POSE
        assert_close(value, theirs, within, (index, name), rings.get(name, math.inf))


def compare_cells(trace: Trace, engine: StockEngine, name: str) -> None:
    """The whole network."""
    expected = np.zeros_like(engine.cells.activity)
    expected[tuple(trace.arrays[f"cells_{name}_idx_kyx"].T.astype(int))] = trace.arrays[f"cells_{name}_val"]
    assert_close(engine.cells.activity, expected, ACTIVITY, name)


def compare_table(
    ours: list[tuple[float, ...]], theirs: Array, exact: list[int], rings: dict[int, float]
) -> None:
    """Rows of the file: the `exact` columns equal, the others within the tolerance, some around a ring."""
    table = np.array(ours, float).reshape(len(ours), theirs.shape[1])
    assert np.array_equal(table[:, exact], theirs[:, exact])
    assert_close(
        table, theirs, POSE, "table", np.array([rings.get(k, math.inf) for k in range(table.shape[1])])
    )


def compare_nodes(trace: Trace, engine: StockEngine, name: str) -> None:
    """The nodes of the map and the experiences behind them."""
    graph, n, headings = engine.map, trace.parameters.pc_dim_xy, trace.parameters.pc_dim_th
    nodes = [
        (e, graph.x[e], graph.y[e], graph.th[e], *place.packet, place.template)
        for e, place in enumerate(engine.places.experiences)
    ]
    compare_table(nodes, trace.arrays[f"map_{name}"], [0, 7], {3: TURN, 4: n, 5: n, 6: headings})


def compare_links_and_templates(trace: Trace, engine: StockEngine) -> None:
    n, _, headings = rings_of(trace)
    links = [(k.start, k.end, k.distance, k.heading, k.facing, k.time) for k in engine.map.links]
    compare_table(links, trace.arrays["links"], [0, 1], {3: TURN, 4: TURN})
    templates = [(t, *m.packet, m.decay, len(m.experiences)) for t, m in enumerate(engine.places.memories)]
    compare_table(templates, trace.arrays["vt_final"], [0, 5], {1: n, 2: n, 3: headings})
