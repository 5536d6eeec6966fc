"""The scorecard of a run: values, reasons for missing ones, maps in pieces, JSON and table."""

import json
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.artifacts.run_reader import read_run, write_pieces
from evaluation.metrics.energy_metric import Relations
from evaluation.metrics.exm import ExmConfig
from evaluation.metrics.metric import Finding, Metric
from evaluation.metrics.metric_registry import METRICS, MetricEntry, build_metrics
from evaluation.metrics.run_metrics import PIECES, Layers, RunArrays, arrange_pieces, ate_within_pieces
from evaluation.metrics.scorecard import Scorecard, render_scorecard, score_log, score_run
from evaluation.metrics.trajectory import ate, write_tum
from evaluation.plots.map_plot import draw_changes, draw_map, map_headline
from evaluation.report.verdict import describe_score
from ratslam.core.estimates import Localisation, pieces_of, write_course
from tactile.base.errors import InputError
from tactile.base.plugins import PluginConfig
from tactile.base.se2 import between, compose, integrate
from tactile.base.settings import Settings

AWAY = np.array([170.0, 30.0, 2.0])


def values(card):
    return {name: quantity.value for name, quantity in card.quantities.items()}


def test_a_perfect_map_has_no_errors_and_odometry_has(circle):
    card = score_run(circle, "circle")
    found = values(card)
    for name, quantity in card.quantities.items():
        if name.startswith(("ate", "anytime", "rpe", "energy")):
            assert quantity.value == pytest.approx(0, abs=1e-6), name
            assert quantity.odometry is not None, name
    assert min(card.quantities[name].odometry for name in ("ate_final", "energy_all")) > 0.01
    assert found["exm_arr"] == found["exm_arcr_strict"] == 1.0
    assert (found["exm_base"], found["path"]) == (36, pytest.approx(10.7))
    notes = [card.quantities[name].note for name in ("energy_all", "energy_gap")]
    assert notes == [f"{108 * 107 // 2} pairs", "k = 10; 98 pairs"]
    (final,) = (line.split() for line in render_scorecard(card).splitlines() if "ATE, final" in line)
    assert (final[3], len(final)) == ("m", 5)


def test_undefined_values_are_null_with_a_reason_and_rows_without_truth_left_out(circle):
    blind = circle._replace(truth=None)
    card = score_run(blind, "no truth")
    assert Scorecard.model_validate(json.loads(card.model_dump_json())) == card
    assert (values(card)["ate_final"], values(card)["steps"]) == (None, 108)
    assert card.quantities["ate_final"].note == "no ground truth"
    assert all(quantity.value is not None or quantity.note for quantity in card.quantities.values())
    assert "no base set" in card.quantities["exm_arr"].note
    card = score_run(blind, exm=ExmConfig(base=36))
    assert values(card)["exm_arr"] == 1.0
    assert card.quantities["exm_arcr_strict"].note == "no ground truth"
    truth = circle.truth.copy()
    truth[::7] = np.nan
    card = score_run(circle._replace(truth=truth), exm=ExmConfig(base=36))
    found = values(card)
    assert card.quantities["steps"].note == f"{108 - len(truth[::7])} of them with a true pose"
    assert [found["ate_final"], found["energy_links"]] == pytest.approx([0, 0], abs=1e-9)
    assert (found["exm_base"], found["exm_arcr_strict"]) == (30, 1.0)


def test_without_places_or_a_loop_a_reason_is_noted_and_relations_are_scored_where_there_are_some(circle):
    nodes, links = np.zeros((0, 3)), np.zeros((0, 2), int)
    none = {"experience": np.full(108, -1), "created": np.zeros(0, int), "nodes": nodes, "links": links}
    card = score_run(circle._replace(**none))
    assert values(card)["exm_arr"] is None
    notes = [card.quantities[name].note for name in ("exm_arr", "energy_change")]
    assert notes == ["no experiences", "0 pairs"]
    assert values(card)["ate_final"] == pytest.approx(0, abs=1e-9)
    names = ("time", "truth", "online", "final", "odometry", "experience", "nodes")
    half = {name: getattr(circle, name)[:30] for name in names}
    card = score_run(circle._replace(**half, created=np.arange(30), links=circle.links[:29]))
    assert values(card)["exm_arcr_paper"] is None
    assert "never returns" in card.quantities["exm_arcr_paper"].note
    assert "as above" in render_scorecard(card)
    relations = Relations(np.array([101.0]), np.array([101.5]), np.array([[0.1, 0, 2 * np.pi / 36]]))
    card = score_run(circle, relations=relations)
    assert values(card)["relations_translation"] == pytest.approx(0, abs=1e-9)
    assert card.quantities["relations_rotation_deg"].odometry == pytest.approx(0.3)
    assert "relations_translation" not in score_run(circle).quantities


@pytest.mark.parametrize(("change", "message"), [
    ({"final": np.zeros((3, 3))}, r"run\.final: shape \(3, 3\)"),
    ({"online": np.full((108, 3), np.nan)}, r"run\.online: a NaN or infinite value"),
    ({"experience": np.full(108, 36)}, r"run\.experience: 36 to 36; expected -1 to 35"),
    ({"links": np.zeros(3, int)}, r"run\.links"),
    ({"truth": np.zeros((3, 3))}, r"run\.truth"),
])  # fmt: skip
def test_arrays_of_inconsistent_shapes_are_refused(circle, change, message):
    with pytest.raises(InputError, match=message):
        score_run(circle._replace(**change))


def test_a_registered_metric_is_on_the_scorecard(circle, monkeypatch):
    class LastConfig(Settings):
        row: int = -1

    def last_x(config):
        measure = lambda given: Finding(given.run.final[config.row, 0])  # noqa: E731
        return Metric("my_last", "my last x", "m", "low", "Mine", measure)

    monkeypatch.setattr(METRICS, "_registered", {"last": MetricEntry(LastConfig, last_x)})
    (metric,) = build_metrics([PluginConfig(plugin="last", settings={"row": 3})])
    card = score_run(circle, metrics=[metric])
    assert card.quantities["my_last"].value == circle.final[3, 0]
    assert "Registered metrics\n  my last x" in render_scorecard(card)
    assert "my_last" not in score_run(circle).quantities
    with pytest.raises(InputError, match=r"score.metrics.1: a second quantity named 'my_last'"):
        build_metrics([PluginConfig(plugin="last")] * 2)


def test_a_log_is_scored_in_all_modes(square):
    ids, truth = square(3, 4)
    ids[64:][ids[64:] == 3] = 7
    found = values(score_log((np.arange(96.0), ids, truth), "my system"))
    assert (found["exm_base"], found["exm_arr"], found["duration"]) == (32, 1.0, 95)
    rates = [found[f"exm_arcr_{mode}"] for mode in ("strict", "paper", "or", "literal")]
    assert rates == [0.9375, 0.875, 0.96875, 0]


@pytest.fixture
def parted(circle):
    """The circle with its last third in another piece, which lies elsewhere."""
    count = len(circle.time)
    piece = (np.arange(count) >= 2 * count // 3).astype(int)
    of_node = piece[circle.created] == 1
    final, nodes = circle.final.copy(), circle.nodes.copy()
    final[piece == 1] = compose(AWAY, final[piece == 1])
    nodes[of_node] = compose(AWAY, nodes[of_node])
    return circle._replace(final=final, nodes=nodes, piece=piece)


def test_the_score_of_pieces_does_not_depend_on_where_they_lie_and_each_is_aligned_by_itself(circle, parted):
    whole, one = score_run(circle), circle._replace(piece=np.zeros(len(circle.time), int))
    assert score_run(one) == whole
    assert PIECES not in whole.lines()
    assert arrange_pieces(one) is one
    card, near = score_run(parted).quantities, score_run(parted._replace(final=circle.final)).quantities
    assert card["pieces"].value == 2
    assert card["unjoined_share"].value == pytest.approx(1 / 3)
    for name in ("energy_within_pieces", "ate_within_pieces"):
        assert card[name].value == pytest.approx(near[name].value, abs=1e-9)
    assert card["ate_final"].value is card["energy_all"].value is None
    assert card["energy_all"].odometry == whole.quantities["energy_all"].odometry
    noise = np.random.default_rng(0).normal(0, 0.01, circle.final.shape)
    final, piece = compose(parted.final, noise), parted.piece
    parts = [ate(final[piece == k], circle.truth[piece == k]) ** 2 * (piece == k).sum() for k in (0, 1)]
    found = ate_within_pieces(final, circle.truth, piece)
    assert found == pytest.approx(np.sqrt(sum(parts) / len(piece)))
    assert found < ate(final, circle.truth)
    assert ate_within_pieces(circle.final, circle.truth, 0 * piece) == ate(circle.final, circle.truth)


def test_a_piece_that_was_tied_is_remarked_beside_errors_of_online_poses(circle):
    tied = len(circle.time) // 3
    online = circle.online.copy()
    online[:tied] = compose(AWAY, online[:tied])
    note = f"m at t = {circle.time[tied]:.1f} s, as where a new piece is tied"
    whole, card = score_run(circle).quantities, score_run(circle._replace(online=online)).quantities
    assert card["ate_online"].value > 1
    assert card["ate_online"].note.endswith(note)
    assert card["ate_final"] == whole["ate_final"]
    killed = score_run(circle._replace(online=online, final=online)).quantities
    assert killed["ate_final"].note.endswith(note)
    assert whole["ate_online"].note == ""


def jump(online: np.ndarray, odometry: np.ndarray) -> tuple[float, float] | None:
    """Distance and time, s, of the jump that a scorecard notes of a run with a step a second."""
    rows = len(online)
    none = np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 2), int)
    run = RunArrays(np.arange(float(rows)), odometry, online, odometry, odometry, np.full(rows, -1), *none)
    found = re.match(r"with a jump of (\S+) m at t = (\S+) s", score_run(run).quantities["ate_online"].note)
    return (float(found[1]), float(found[2])) if found else None


@settings(max_examples=30)
@given(st.integers(0, 99), st.integers(1, 79), st.floats(50, 1000), st.floats(0, 1))
def test_a_piece_that_is_tied_jumps_and_a_correction_within_a_piece_does_not(seed, at, apart, share):
    """It moves a pose by the drift at most, which is not more than dead reckoning went."""
    rng = np.random.default_rng(seed)
    way, turn = rng.uniform(0, 0.1, 80), rng.normal(0, 0.3, 80)
    odometry = integrate(np.column_stack([way, np.zeros(80), turn]))
    online, corrected = odometry.copy(), odometry.copy()
    online[:at, 0] += apart
    corrected[at:, :2] -= share * odometry[at, :2]
    assert jump(online, odometry) == (pytest.approx(apart, abs=0.2), at)
    assert jump(corrected, odometry) is None
    assert jump(odometry[:at], odometry[:at]) is None


def test_a_picture_shows_pieces_where_they_are_true_or_side_by_side(circle, parted):
    shown, card = arrange_pieces(parted), score_run(parted)
    assert np.abs(shown.final[:, :2] - circle.final[:, :2]).max() < 1e-6  # in the frame of the largest piece
    draw_map(parted, card)  # draws nothing outside of its frame
    assert "2 pieces, 33% of the steps unjoined" in map_headline(card)
    assert "within the pieces of the map" in describe_score(card)
    # Without truth they lie side by side.
    shown = arrange_pieces(parted._replace(truth=None, online=parted.final))
    assert np.array_equal(shown.online, shown.final)  # online poses move with their pieces
    first, second = (shown.final[shown.piece == one] for one in (0, 1))
    assert first[:, 0].max() < second[:, 0].min() < first[:, 0].max() + np.ptp(first[:, 0])
    for own, steps in ((first, parted.piece == 0), (second, parted.piece == 1)):
        before = parted.final[steps]
        assert np.allclose(between(own[:1], own)[:, :2], between(before[:1], before)[:, :2])
    names = [label.get_text() for label in draw_map(parted, card).legends[0].get_texts()]
    assert f"piece 1, {int((parted.piece == 0).sum())} steps" in names


LOCALISED = {
    "found at once": "f" * 108,
    "found late": "s" * 30 + "f" * 78,
    "carried away": "s" * 9 + "f" * 40 + "l" * 20 + "f" * 39,
    "lost at the end": "f" * 40 + "l" * 68,
    "another map": "s" * 60 + "n" * 48,
}
"""The first letters of the states of a session."""


@pytest.mark.parametrize("seen", [True, False], ids=["truth", "no truth"])
@pytest.mark.parametrize("case", LOCALISED)
def test_the_saved_map_of_a_localised_session_stays_where_it_is(circle, tmp_path, case, seen):
    names = {state.name[0].lower(): state for state in Localisation}
    states = np.array([names[letter] for letter in LOCALISED[case]])
    found, piece = states == Localisation.FOUND, pieces_of(states)
    final = circle.final.copy()
    for one in np.unique(piece[~found]):
        final[piece == one] = compose(AWAY / (1 + one), final[piece == one])
    paths = {"online": final, "trajectory": final, "odometry": circle.odometry, "truth": circle.truth}
    (tmp_path / "truth.tum").touch()
    for name, path in [*paths.items()][: 3 + seen]:
        write_tum(tmp_path / f"{name}.tum", circle.time, path)
    (tmp_path / "steps.csv").write_text("place\n" + "-1\n" * len(states))
    nodes = [{"x": x, "y": y, "heading": turn, "piece": 0} for x, y, turn in circle.nodes.tolist()]
    links = [{"source": a, "target": b} for a, b in circle.links.tolist()]
    (tmp_path / "map.json").write_text(json.dumps({"nodes": nodes, "links": links}))
    write_course(tmp_path / "localisation.csv", states, np.zeros((len(states), 3)))
    write_pieces(tmp_path / "pieces.csv", circle.time, piece)

    run = read_run(tmp_path)
    shown = arrange_pieces(run)
    assert np.array_equal(run.found, found)
    assert np.array_equal(run.piece, piece)
    assert shown.nodes == pytest.approx(circle.nodes)
    assert shown.final[found] == pytest.approx(circle.final[found], abs=1e-9)
    if seen and found.any():
        assert shown.final[:, :2] == pytest.approx(circle.final[:, :2], abs=1e-6)
        assert Layers.align(shown).truth == pytest.approx(circle.final[:, :2], abs=1e-6)
    elif not found.any():
        assert shown.final[:, 0].min() > circle.nodes[:, 0].max()
    (path,) = (line for line in draw_changes("", run, []).axes[0].lines if line.get_zorder() == 3)
    assert np.array_equal(np.isfinite(path.get_xydata()[:, 0]), found)


def test_a_run_with_too_few_pieces_is_refused(circle, tmp_path):
    for name in ("online", "odometry", "truth"):
        write_tum(tmp_path / f"{name}.tum", circle.time, circle.online)
    (tmp_path / "steps.csv").write_text("place\n" + "-1\n" * len(circle.time))
    assert (read_run(tmp_path).piece == 0).all()
    write_pieces(tmp_path / "pieces.csv", circle.time[:5], np.zeros(5, int))
    with pytest.raises(InputError, match="5 lines"):
        read_run(tmp_path)
