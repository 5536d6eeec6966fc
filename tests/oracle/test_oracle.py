"""Slow reference implementations of the classic backend in NumPy and Python, written from its specification.

The *stock* engine follows `openratslam.md`, sections 1 to 5, with all deviations of section 7, and must
reproduce the reference traces. The *plain* engine follows "Semantics of the classic backend" in
`ratslam/classic/README.md`, and must agree with the JAX engine.
"""

import json
import math
from itertools import islice

import numpy as np
import pytest

from ratslam.core.session import Session
from ratslam.methods.classic import ClassicBackend
from ratslam.methods.config import ClassicBackendConfig
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from tests.oracle.plain import Input, PlainEngine, Settings
from tests.oracle.stock import StockEngine
from tests.oracle.trace import Parameters, changed, golden, real

SHORT = "a_square3", "e_kidnap", "j_reverse_stop"
LONG = "b_figure8_alias", "c_corridor_wrap", "d1_rotation_generic"
INTEL = "f_real_intel_laser3x6"
POSE, ACTIVITY = 1e-9, 1e-12
FINE = {"max_act", "total", "min_act", "inj_energy", "vt_err"}
HUGE = 1e300  # matching error where nothing was compared
TURN = 2 * math.pi

NAMES = {
    "pose_cells": {"cells_xy": "pc_dim_xy", "cells_heading": "pc_dim_th", "cell_size": "pc_cell_x_size"},
    "attractor": {
        "excite_width": "pc_w_e_dim", "excite_sigma": "pc_w_e_var", "inhibit_width": "pc_w_i_dim",
        "inhibit_sigma": "pc_w_i_var", "global_inhibition": "pc_global_inhib",
    },
    "templates": {
        "shift": "vt_shift_match", "shift_step": "vt_step_match", "panoramic": "vt_panoramic",
        "threshold": "vt_match_threshold", "habituation": "vt_active_decay", "recovery": "pc_vt_restore",
        "energy": "pc_vt_inject_energy",
    },
    "places": {"radius": "exp_delta_pc_threshold", "radius_heading": "exp_delta_pc_threshold"},
}  # fmt: skip
OURS = ("pc_w_", "pc_global", "pc_vt", "vt_active")
"""Parameters whose defaults are ours too: missing ones are left to ours, which the comparison checks."""


def settings_of(params, labels):
    """The configuration of a reference stream of these parameters of OpenRatSLAM's [ratslam] section, with
    its defaults for missing ones, whose views are template ids if it has `labels`."""
    values = Parameters.from_strings(params)._asdict()
    values["vt_panoramic"] = bool(values["vt_panoramic"])
    ours = {theirs for theirs in values if theirs.startswith(OURS)} - params.keys()
    parts = {
        part: {name: values[theirs] for name, theirs in names.items() if theirs not in ours}
        for part, names in NAMES.items()
    }
    parts["templates"]["source"] = "labels" if labels else "views"
    return ClassicBackendConfig.model_validate(parts)


def assert_close(ours, theirs, within, where, ring=math.inf):
    """Around a ring where one is given; NaN equals NaN."""
    a, b = np.asarray(ours, float), np.asarray(theirs, float)
    assert a.shape == b.shape, where
    d = np.abs(a - b)
    d = np.minimum(d, np.abs(ring - d))
    assert ((d <= within) | (np.isnan(a) & np.isnan(b))).all(), f"{where}: {a}, expected {b}"


def rings_of(trace):
    p = trace.parameters
    return p.pc_dim_xy, p.pc_dim_xy, p.pc_dim_th


def follow(trace, steps=None):
    """Asserts that the stock engine makes (the first `steps` of) a trace."""
    engine = StockEngine(trace.parameters)
    for index, row in enumerate(trace.rows()):
        if index == steps:
            return
        compare_row(trace, engine, engine.step(row), index, row)
        if f"cells_{index}_val" in trace.arrays:
            compare_cells(trace, engine, index)
        if f"map_{index}" in trace.arrays:
            compare_nodes(trace, engine, index)
    compare_cells(trace, engine, "final")
    compare_nodes(trace, engine, "final")
    links = [(k.start, k.end, k.distance, k.heading, k.facing, k.time) for k in engine.map.links]
    compare_table(links, trace.arrays["links"], [0, 1], {3: TURN, 4: TURN})
    n, _, headings = rings_of(trace)
    templates = [(t, *m.packet, m.decay, len(m.experiences)) for t, m in enumerate(engine.places.memories)]
    compare_table(templates, trace.arrays["vt_final"], [0, 5], {1: n, 2: n, 3: headings})


def compare_row(trace, engine, step, index, row):
    activity, places, graph = engine.cells.activity, engine.places, engine.map
    here = graph.current
    x, y, th = (graph.x[here], graph.y[here], graph.th[here]) if graph.x else (math.nan,) * 3
    best = dict(zip(("best_x", "best_y", "best_th"), engine.cells.best, strict=True))
    ours = best | {
        "action": step.action, "pc_exp": places.experience, "em_exp": here, "n_vt": len(places.memories),
        "n_exp": len(places.experiences), "n_links": len(graph.links), "vt_delta_pc_th": places.turned,
        "max_act": activity.max(), "total": activity.sum(), "min_act": activity.min(),
        "em_x": x, "em_y": y, "em_th": th,
        "acc_dx": graph.dx, "acc_dy": graph.dy, "acc_facing": graph.facing,
    }  # fmt: skip
    if row.odometry:
        ours |= {"src": step.source, "dest": step.target, "delta_pc": step.delta}
    if step.match is not None:
        ours |= {"vt": step.match.template, "inj_energy": step.energy, "rel_rad": step.match.relative}
        ours |= dict(zip(("inj_x", "inj_y", "inj_th"), step.injected or (-1, -1, -1), strict=True))
        if not trace.labelled:
            ours["vt_err"] = min(step.match.error, HUGE)
    rings = dict.fromkeys(("em_th", "acc_facing", "rel_rad"), TURN)
    rings |= dict(zip(best, rings_of(trace), strict=True))
    for name, value in ours.items():
        theirs = min(float(trace.arrays[f"out_{name}"][index]), HUGE)
        within = ACTIVITY if name in FINE else POSE
        assert_close(value, theirs, within, (index, name), rings.get(name, math.inf))


def compare_cells(trace, engine, name):
    expected = np.zeros_like(engine.cells.activity)
    expected[tuple(trace.arrays[f"cells_{name}_idx_kyx"].T.astype(int))] = trace.arrays[f"cells_{name}_val"]
    assert_close(engine.cells.activity, expected, ACTIVITY, name)


def compare_table(ours, theirs, exact, rings):
    """Rows of the file: the `exact` columns equal, the others within the tolerance, some around a ring."""
    table = np.array(ours, float).reshape(len(ours), theirs.shape[1])
    assert np.array_equal(table[:, exact], theirs[:, exact])
    ring = np.array([rings.get(k, math.inf) for k in range(table.shape[1])])
    assert_close(table, theirs, POSE, "table", ring)


def compare_nodes(trace, engine, name):
    graph, (n, _, headings) = engine.map, rings_of(trace)
    nodes = [
        (e, graph.x[e], graph.y[e], graph.th[e], *place.packet, place.template)
        for e, place in enumerate(engine.places.experiences)
    ]
    compare_table(nodes, trace.arrays[f"map_{name}"], [0, 7], {3: TURN, 4: n, 5: n, 6: headings})


@pytest.mark.parametrize("name", [*SHORT, *LONG])
def test_the_stock_engine_makes_the_synthetic_traces(name):
    follow(golden(name))


@pytest.mark.parametrize("steps", [300, pytest.param(None, marks=pytest.mark.soak)])
def test_the_stock_engine_makes_a_real_trace(steps):
    follow(real(INTEL), steps)


PACKET = 1e-12
BOUND_STEPS = 1000  # rounding grows along a stream; beyond this many steps only decisions are compared


def observed(observation):
    motion = tuple(map(float, observation.odometry[:3]))
    view = np.asarray(observation.view, float)[:, :, 0] if observation.view_seen else None
    return Input(motion, view, int(observation.label) if observation.label >= 0 else None)


def assert_engines_agree(trace, steps=None):
    """On (the first `steps` of) a trace; templates, actions and places are equal."""
    with open_recording(RecordingConfig(file=trace.path)) as source:
        observations = [sample.reading for sample in islice(source, steps)]
        view_shape = source.view_shape
    assert len(observations) == (steps or len(trace.arrays["in_t"]))
    config = settings_of(trace.strings, labels=trace.labelled)
    templates = config.templates
    # The engine's defaults for settings that a reference stream does not have.
    rest = Settings(templates.recent, config.attractor.settle_steps, templates.column_angle)
    plain = PlainEngine(trace.parameters, rest)
    session = Session(ClassicBackend(config, view_shape), precision="float64")
    for k, (estimate, evidence, *_) in enumerate(session.replay(observations)):
        seen = observed(observations[k])
        ours = plain.step(seen)
        if seen.view is not None or seen.label is not None:
            assert ours.template == evidence.template, k
        assert (ours.action, ours.place) == (estimate.action, estimate.place), k
        if k < BOUND_STEPS:
            assert_close(ours.packet, evidence.packet, PACKET, k, np.array(rings_of(trace)))
            assert_close(ours.energy, evidence.energy, PACKET, k)


@pytest.mark.parametrize("name", [*SHORT, *(pytest.param(name, marks=pytest.mark.soak) for name in LONG)])
def test_the_engine_agrees_with_the_plain_one(name):
    assert_engines_agree(golden(name))


@pytest.mark.soak
def test_the_engine_agrees_on_intel():
    assert_engines_agree(real(INTEL), steps=300)


def test_rows_without_a_view_or_odometry(tmp_path):
    """Flags 1 and 2 and NaN views; the clock does not advance in rows without odometry."""
    arrays = golden("j_reverse_stop").arrays
    flags, views = arrays["in_flags"], arrays["in_view"]
    flags[3:9] = (1, 2, 1, 2, 3, 2)
    views[flags == 2] = np.nan
    assert_engines_agree(changed(tmp_path, in_flags=flags, in_view=views))


def test_templates_given_as_labels(tmp_path):
    """A view of two columns is a template id and its turn."""
    template = golden("j_reverse_stop").arrays["out_vt"]
    trace = changed(tmp_path, in_view=np.stack([template, np.zeros(len(template))], axis=1))
    follow(trace)
    assert_engines_agree(trace)


SHAPES = {
    "camera": {"template_x_size": 60, "template_y_size": 20, "vt_shift_match": 4, "vt_step_match": 1},
    "panoramic": {"template_x_size": 12, "template_y_size": 2, "vt_panoramic": 1, "vt_step_match": 1},
    "small grid": {
        "template_x_size": 6, "template_y_size": 3, "vt_shift_match": 0, "pc_dim_xy": 14, "pc_dim_th": 20,
    },
}  # fmt: skip


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if "grid" in n else pytest.mark.soak) for n in SHAPES]
)
def test_the_engine_agrees_on_other_shapes(tmp_path, name):
    """Views that come back shifted, steps of 1.7 cells, turns by whole cells, another grid."""
    parameters, step = SHAPES[name], np.arange(90)
    shape = 14, parameters["template_y_size"], parameters["template_x_size"]
    scenes = np.random.default_rng(5).random(shape)
    trace = changed(
        tmp_path,
        in_t=10.0 + 0.5 * step,
        in_v=np.where(step % 3, 3.4, 0.9),
        in_w=np.where(step % 5, 0.0, 2 * 2 * math.pi / 36),
        in_flags=np.full(90, 3.0),
        in_view=np.array([np.roll(scenes[k // 2 % 14], k // 28, axis=1).ravel() for k in step]),
        truth=np.zeros((90, 3)),
        params_json=np.array(json.dumps({name: str(value) for name, value in parameters.items()})),
    )
    assert_engines_agree(trace)
