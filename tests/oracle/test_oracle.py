"""The stock engine against recorded traces, and the JAX engine against the plain engine."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest

from tests.oracle import compare, counterpart
from tests.oracle.__main__ import main
from tests.oracle.cells import Attractor, StockCells, circular_mean, decoded, rotated, translated_leaky
from tests.oracle.map import StockMap
from tests.oracle.places import CREATE, EDGE, NONE, SET, StockPlaces
from tests.oracle.plain import Input, PlainCells, PlainPlaces, PlainTemplates, Settings, around, shifted
from tests.oracle.trace import Parameters, load
from tests.oracle.views import StockTemplates, wrapped

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden"
SYNTHETIC = (
    "a_square3", "b_figure8_alias", "c_corridor_wrap", "d1_rotation_generic", "e_kidnap", "j_reverse_stop"
)  # fmt: skip
INTEL, LECTURE_HALL = "f_real_intel_laser3x6", "f_real_tuc_lecture_hall"
SETTINGS = Settings(recent=10, settle_steps=10, column_angle=0.0)


def real(name: str) -> Path:
    """A real trace, which is not part of the project."""
    data = Path(os.environ.get("RATSLAM_DATA") or ROOT.parent / "shared" / "reference")
    path = data / "traces" / f"{name}.npz"
    if not path.is_file():
        pytest.skip(f"no {path}: set RATSLAM_DATA to the folder that holds traces/")
    return path


@pytest.mark.parametrize("name", SYNTHETIC)
def test_stock_synthetic(name: str) -> None:
    report = compare.stock(load(GOLDEN / f"{name}.npz"))
    assert report.agrees, report.line()
    assert report.knife_edges == 0


def test_stock_intel() -> None:
    report = compare.stock(load(real(INTEL)), steps=600)
    assert report.agrees, report.line()


@pytest.mark.soak
def test_stock_intel_whole() -> None:
    report = compare.stock(load(real(INTEL)))
    assert report.agrees, report.line()


def test_stock_lecture_hall() -> None:
    """At step 235 truncation is ambiguous, and the file decides the cell of the injection."""
    report = compare.stock(load(real(LECTURE_HALL)), steps=400)
    assert report.agrees, report.line()
    assert report.knife_edges == 1


@pytest.mark.soak
def test_stock_lecture_hall_whole() -> None:
    report = compare.stock(load(real(LECTURE_HALL)))
    assert report.agrees, report.line()
    assert report.steps == 13838


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


def changed(folder: Path, **changes: object) -> Path:
    """The smallest golden trace with some of its arrays replaced."""
    arrays = dict(load(GOLDEN / "j_reverse_stop.npz").arrays) | changes
    path = folder / "changed.npz"
    np.savez(path, **arrays)
    return path


def test_the_program_prints_one_line_per_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit codes 0, 1 and 2."""
    golden = GOLDEN / "j_reverse_stop.npz"
    assert main([str(golden)]) == 0
    actions = load(golden).arrays["out_action"].copy()
    actions[-1] = 7
    assert main([str(changed(tmp_path, out_action=actions))]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(",")[0] for line in lines] == ["j_reverse_stop: ok", "changed: DIFFERS"]
    assert "action at 160" in lines[1]
    best = load(golden).arrays["out_best_x"].copy()
    best[-1] += 1e-6
    assert main([str(changed(tmp_path, out_best_x=best))]) == 1
    capsys.readouterr()

    broken = tmp_path / "broken.npz"
    broken.write_bytes(b"PK no archive")
    for path in (tmp_path / "missing.npz", broken):
        assert main([str(path)]) == 2
        output = capsys.readouterr()
        assert output.err.startswith(f"error: {path}") or str(path) in output.err
        assert output.err.count("\n") == 1
        assert not output.out


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


def test_parameters_are_read_from_text() -> None:
    """Strings, with the defaults of the specification."""
    parameters = Parameters.from_strings(
        {"pc_dim_xy": "11", "exp_initial_em_deg": "-26.5", "camera_hz": "10"}
    )
    assert (parameters.pc_dim_xy, parameters.exp_initial_em_deg) == (11, -26.5)
    assert (parameters.vt_shift_match, parameters.exp_loops, parameters.pc_w_i_var) == (25, 10, 2)


def test_the_attractor_equals_the_dense_one() -> None:
    """Computing the occupied box alone is exact, also across the edges of the torus."""
    p = Parameters(pc_dim_xy=12, pc_dim_th=16)
    activity = np.zeros((16, 12, 12))
    activity[15, 0, 11], activity[1, 3, 10] = 0.7, 0.3
    dense = activity

    def gaussian(width: int, sigma: float) -> dict[tuple[int, int, int], float]:
        reach = range(-(width // 2), width // 2 + 1)
        cube = {
            (a, b, c): math.exp(-(a * a + b * b + c * c) / (2 * sigma**2))
            for a in reach
            for b in reach
            for c in reach
        }
        total = sum(cube.values())
        return {o: weight / total for o, weight in cube.items()}

    def convolved(kernel: dict[tuple[int, int, int], float]) -> np.ndarray:
        return sum(weight * np.roll(dense, o, axis=(0, 1, 2)) for o, weight in kernel.items())

    dense = convolved(gaussian(7, 1))
    dense = dense - convolved(gaussian(5, 2))
    dense = np.where(dense >= 2e-5, dense - 2e-5, 0.0)
    ours = Attractor(p).inhibited(activity)
    np.testing.assert_allclose(ours, dense, atol=1e-15)
    assert np.array_equal(ours != 0, dense != 0)


def test_translation_is_mirrored_and_leaks() -> None:
    """x moves with the sine and y with the cosine of the heading; the corner loses activity."""
    activity = np.zeros((36, 11, 11))
    activity[0, 5, 5] = activity[9, 5, 5] = 1.0
    moved = translated_leaky(activity, 1.0)
    assert moved[0, 6, 5] == pytest.approx(1.0)
    assert moved[9, 5, 6] == pytest.approx(1.0)
    assert translated_leaky(activity, -1.0)[0, 4, 5] == pytest.approx(1.0)

    corner = np.zeros((36, 11, 11))
    corner[4, 10, 0] = 1.0
    assert 0.2 < translated_leaky(corner, 0.8).sum() < 0.9
    middle = np.zeros((36, 11, 11))
    middle[4, 5, 5] = 1.0
    assert translated_leaky(middle, 0.8).sum() == pytest.approx(1.0)
    assert translated_leaky(middle, 1.7).min() < 0


def test_rotation() -> None:
    """Shifts by cells are exact, shifts by parts of cells interpolate, in both directions."""
    activity = np.zeros((8, 3, 3))
    activity[0, 1, 1] = 1.0
    cell = math.pi / 4
    assert rotated(activity, 2 * cell)[2, 1, 1] == 1.0
    assert rotated(activity, -0.25 * cell)[7, 1, 1] == pytest.approx(0.25)
    assert rotated(activity, 0.0) is activity


def test_decoding() -> None:
    """The first of equal peaks, and a mean that can reach the ring's length but not exceed it."""
    activity = np.zeros((9, 9, 9))
    activity[8, 8, 8] = activity[0, 0, 0] = 0.5
    assert decoded(activity) == pytest.approx((8.5, 8.5, 8.5))
    assert circular_mean(np.array([1.0]), np.array([3]), 9) == pytest.approx(3.0)


def test_injection_truncates_the_pose() -> None:
    """Energy goes to the cell below, and out of the grid at its upper edge."""
    p = Parameters(pc_dim_xy=9, pc_dim_th=12)
    cells = StockCells(p)
    truncate = compare.truncated
    assert cells.inject(0.5, (2.9, 3.1, 11.999), truncate) == (2, 3, 11)
    assert cells.activity[11, 3, 2] == 0.5
    assert cells.inject(0.5, (9.0, 3.0, 0.0), truncate) is None

    plain = PlainCells(p, SETTINGS)
    plain.activity[:] = 0.0
    plain.deposit(1.0, (8.5, 3.0, 11.25))
    assert plain.activity[11, 3, 8] == pytest.approx(0.375)
    assert plain.activity[0, 3, 0] == pytest.approx(0.125)


def test_recent_templates() -> None:
    """With fewer than ten templates all pass the unsigned comparison, with ten none."""
    places = StockPlaces(Parameters())
    pose = (1.0, 1.0, 1.0)
    for template in range(9):
        assert places.see(template, 0.0, pose) is None
    assert places.see(7, 0.0, pose) is not None
    assert places.see(9 - 1, 0.0, pose) is not None
    places.see(9, 0.0, pose)
    assert places.see(0, 0.0, pose) is None
    with pytest.raises(ValueError, match="skips ids"):
        places.see(12, 0.0, pose)


def test_energy_falls_with_consecutive_matches() -> None:
    """0.889 and 0.633 of the full energy, then 0."""
    places = StockPlaces(Parameters(pc_vt_inject_energy=1.0))
    for template in range(2):
        places.see(template, 0.0, (1.0, 1.0, 1.0))
    energies = [recalled[0] if (recalled := places.see(0, 0.0, (0.0, 0.0, 0.0))) else 0.0 for _ in range(3)]
    assert energies == pytest.approx([0.8893, 0.6326, 0.0], abs=1e-4)


def test_actions() -> None:
    """Create, go back by an edge, and nothing without both messages."""
    places = StockPlaces(Parameters())
    places.see(0, 0.0, (1.0, 1.0, 1.0))
    assert places.act((1.0, 1.0, 1.0)) == NONE
    expected = [(0, CREATE), (1, CREATE), (1, NONE), (0, EDGE)]
    for template, action in expected:
        places.see(template, 0.0, (1.0, 1.0, 1.0))
        places.moved = True
        assert places.act((1.0, 1.0, 1.0)) == action


def test_map_double_counts_its_first_link() -> None:
    """Reaching node 0 does not reset the accumulators, so the first link is too long."""
    graph = StockMap(Parameters(exp_initial_em_deg=0.0, exp_loops=0))
    for target in range(3):
        graph.move(1.0, 0.0, 1.0)
        graph.act(CREATE, max(target - 1, 0), target, 0.0)
    assert [link.distance for link in graph.links] == [2.0, 1.0]
    graph.link(1, 0, 0.0)
    assert len(graph.links) == 2


def test_relaxation_halves_a_contradiction() -> None:
    """One link of the wrong length, half corrected from both ends, fits afterwards."""
    graph = StockMap(Parameters(exp_initial_em_deg=0.0, exp_loops=1))
    graph.act(CREATE, 0, 0, 0.0)
    graph.move(2.0, 0.0, 1.0)
    graph.act(CREATE, 0, 1, 0.0)
    graph.x[1] = 3.0
    graph.relax()
    assert graph.x == pytest.approx([0.5, 2.5])


def test_template_gate() -> None:
    """Preselection by the mean misses a shifted match; the plain engine does not preselect."""
    p = Parameters(template_x_size=6, template_y_size=1, vt_shift_match=1, vt_step_match=1)
    first = np.array([[0.0, 0.5, 0.2, 0.6, 0.1, 0.0]])
    second = first.copy()
    second[0, 5] = 0.9
    stock, plain = StockTemplates(p), PlainTemplates(p, SETTINGS)
    stock.see(first)
    plain.see(Input((0.0, 0.0, 0.0), first, None))
    assert stock.see(second).novel
    assert not plain.see(Input((0.0, 0.0, 0.0), second, None)).novel


def test_panoramic_turn() -> None:
    """A view that turned is the same template at an angle."""
    p = Parameters(template_x_size=8, template_y_size=1, vt_panoramic=1, vt_step_match=1)
    view = np.linspace(0.0, 1.0, 8)[None]
    templates = StockTemplates(p)
    templates.see(view)
    match = templates.see(np.roll(view, -2, axis=1))
    assert (match.template, match.relative) == (0, pytest.approx(math.pi / 2))
    assert wrapped(-math.pi) == math.pi


def test_plain_shift_is_circular() -> None:
    """Activity is conserved at the edges, in both directions."""
    layers = np.zeros((2, 5, 5))
    layers[:, 0, 4] = 1.0
    moved = shifted(layers, np.array([0.25, -0.25]), 2)
    assert moved[0, 0, 0] == 0.25
    assert moved[1, 0, 3] == 0.25
    assert moved.sum(axis=(1, 2)) == pytest.approx([1.0, 1.0])
    assert around(4.5, 5) == pytest.approx(-0.5)


def test_plain_network_restarts() -> None:
    """Uniform activity dies out and is reseeded at the last decoded pose."""
    cells = PlainCells(Parameters(pc_dim_xy=9, pc_dim_th=12), SETTINGS)
    cells.activity[:] = 1.0 / cells.activity.size
    cells.best = (3.0, 4.0, 5.0)
    cells.move((0.0, 0.0, 0.0), injected=False)
    assert cells.best == pytest.approx((3.0, 4.0, 5.0))
    assert cells.activity[5, 4, 3] == 1.0
    assert cells.lag == (0.0, 0.0, 0.0)


def test_plain_places() -> None:
    """Created, linked once, and set when it is joined already."""
    places = PlainPlaces(Parameters(pc_dim_xy=20))
    a, b, c = (1.0, 1.0, 1.0), (6.0, 1.0, 1.0), (11.0, 1.0, 1.0)
    actions = [places.act(*at) for at in ((a, 0), (a, 0), (b, 1), (c, 2), (a, 0), (c, 2))]
    assert actions == [CREATE, NONE, CREATE, CREATE, EDGE, SET]
