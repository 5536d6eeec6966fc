"""The JAX engine against the plain engine: recorded traces, changed ones, other shapes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from tests.oracle import compare, counterpart
from tests.oracle.trace import load
from tests.oracle.trace_cases import GOLDEN, INTEL, SYNTHETIC, changed, real

LONG = {"b_figure8_alias", "c_corridor_wrap", "d1_rotation_generic"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.soak) if name in LONG else name for name in SYNTHETIC]
)
def test_engine_agrees(name: str) -> None:
    path = GOLDEN / f"{name}.npz"
    report = counterpart.plain(load(path), path)
    assert report.agrees, report.line()
    assert report.steps == len(load(path))


@pytest.mark.soak
def test_engine_agrees_on_intel() -> None:
    path = real(INTEL)
    report = counterpart.plain(load(path), path, steps=300)
    assert report.agrees, report.line()


def test_rows_without_a_view_or_odometry(tmp_path: Path) -> None:
    """Flags 1 and 2 and NaN views; the clock does not advance in rows without odometry."""
    golden = load(GOLDEN / "j_reverse_stop.npz")
    flags, views = golden.arrays["in_flags"].copy(), golden.arrays["in_view"].copy()
    flags[3:9] = (1, 2, 1, 2, 3, 2)
    views[flags == 2] = np.nan
    path = changed(tmp_path, in_flags=flags, in_view=views)
    rows = list(load(path).rows())[3:9]
    assert [(row.seen, row.odometry) for row in rows] == [
        (True, False), (False, True), (True, False), (False, True), (True, True), (False, True)
    ]  # fmt: skip
    report = counterpart.plain(load(path), path)
    assert report.agrees, report.line()


def test_templates_given_as_labels(tmp_path: Path) -> None:
    """A view of two columns is a template id and its turn."""
    golden = load(GOLDEN / "j_reverse_stop.npz")
    ids = np.stack([golden.arrays["out_vt"], np.zeros(len(golden))], axis=1)
    path = changed(tmp_path, in_view=ids)
    report = compare.stock(load(path))
    assert report.agrees, report.line()
    report = counterpart.plain(load(path), path)
    assert report.agrees, report.line()


@pytest.mark.parametrize(
    "parameters",
    [
        pytest.param(
            {"template_x_size": 60, "template_y_size": 20, "vt_shift_match": 4, "vt_step_match": 1},
            marks=pytest.mark.soak,
        ),
        pytest.param(
            {"template_x_size": 12, "template_y_size": 2, "vt_panoramic": 1, "vt_step_match": 1},
            marks=pytest.mark.soak,
        ),
        {"template_x_size": 6, "template_y_size": 3, "vt_shift_match": 0, "pc_dim_xy": 14, "pc_dim_th": 20},
    ],
    ids=["camera", "panoramic", "small grid"],
)
def test_engine_agrees_on_other_shapes(tmp_path: Path, parameters: dict[str, int]) -> None:
    """Views that come back shifted, steps of 1.7 cells, turns by whole cells, another grid."""
    rng = np.random.default_rng(5)
    shape = (parameters["template_y_size"], parameters["template_x_size"])
    scenes = rng.random((14, *shape))
    steps = 90
    seen = [np.roll(scenes[k // 2 % 14], k // 28, axis=1).ravel() for k in range(steps)]
    path = changed(
        tmp_path,
        in_t=10.0 + 0.5 * np.arange(steps),
        in_v=np.where(np.arange(steps) % 3, 3.4, 0.9),
        in_w=np.where(np.arange(steps) % 5, 0.0, 2 * 2 * math.pi / 36),
        in_flags=np.full(steps, 3.0),
        in_view=np.array(seen),
        truth=np.full((steps, 3), 0.0),
        params_json=np.array(json.dumps({name: str(value) for name, value in parameters.items()})),
    )
    report = counterpart.plain(load(path), path)
    assert report.agrees, report.line()
