"""The scorecard of a run: values, reasons for missing ones, JSON and table."""

from __future__ import annotations

import json

import numpy as np
import pytest

from evaluation.metrics.energy_metric import Relations
from evaluation.metrics.exm import ExmConfig
from evaluation.metrics.metric import Finding, Metric
from evaluation.metrics.metric_registry import METRICS, MetricEntry, build_metrics
from evaluation.metrics.scorecard import Scorecard, render_scorecard, score_run
from tactile.base.errors import InputError
from tactile.base.plugins import PluginConfig
from tactile.base.settings import Settings


def values(card):
    return {name: quantity.value for name, quantity in card.quantities.items()}


def test_a_perfect_map_has_no_errors_and_odometry_has(circle):
    card = score_run(circle, "circle")
    for name, quantity in card.quantities.items():
        if name.startswith(("ate", "anytime", "rpe", "energy")):
            assert quantity.value == pytest.approx(0, abs=1e-6), name
            assert quantity.odometry is not None, name
    assert card.quantities["ate_final"].odometry > 0.01
    assert card.quantities["energy_all"].odometry > 0.01
    assert values(card)["exm_arr"] == values(card)["exm_arcr_strict"] == 1.0
    assert values(card)["exm_base"] == 36
    assert values(card)["path"] == pytest.approx(10.7)
    assert card.quantities["energy_all"].note == f"{108 * 107 // 2} pairs"
    assert card.quantities["energy_gap"].note == "k = 10; 98 pairs"


def test_undefined_values_are_null_with_a_reason(circle):
    card = score_run(circle._replace(truth=None), "no truth")
    again = json.loads(card.model_dump_json())
    assert again["quantities"]["ate_final"]["value"] is None
    assert again["quantities"]["ate_final"]["note"] == "no ground truth"
    assert again["quantities"]["steps"]["value"] == 108
    assert Scorecard.model_validate(again) == card
    assert all(quantity.value is not None or quantity.note for quantity in card.quantities.values())


def test_without_truth_a_given_base_set_still_gives_arr(circle):
    card = score_run(circle._replace(truth=None), exm=ExmConfig(base=36))
    assert values(card)["exm_arr"] == 1.0
    assert values(card)["exm_arcr_strict"] is None
    assert card.quantities["exm_arcr_strict"].note == "no ground truth"
    assert "no base set" in score_run(circle._replace(truth=None)).quantities["exm_arr"].note


def test_rows_without_truth_are_left_out(circle):
    truth = circle.truth.copy()
    truth[::7] = np.nan
    card = score_run(circle._replace(truth=truth), exm=ExmConfig(base=36))
    assert card.quantities["steps"].note == f"{108 - len(truth[::7])} of them with a true pose"
    assert values(card)["ate_final"] == pytest.approx(0, abs=1e-9)
    assert values(card)["energy_links"] == pytest.approx(0, abs=1e-9)
    assert values(card)["exm_base"] == 30
    assert values(card)["exm_arcr_strict"] == 1.0


def test_a_backend_without_places_has_no_experience_metric(circle):
    none = circle._replace(
        experience=np.full(108, -1),
        created=np.zeros(0, int),
        nodes=np.zeros((0, 3)),
        links=np.zeros((0, 2), int),
    )
    card = score_run(none)
    assert values(card)["exm_arr"] is None
    assert card.quantities["exm_arr"].note == "no experiences"
    assert card.quantities["energy_change"].note == "0 pairs"
    assert values(card)["ate_final"] == pytest.approx(0, abs=1e-9)


def test_a_run_without_a_loop_has_the_reason_as_note(circle):
    half = circle._replace(
        **{
            name: getattr(circle, name)[:30]
            for name in ("time", "truth", "online", "final", "odometry", "experience")
        },
        **{"created": np.arange(30), "nodes": circle.nodes[:30], "links": circle.links[:29]},
    )
    card = score_run(half)
    assert values(card)["exm_arcr_paper"] is None
    assert "never returns" in card.quantities["exm_arcr_paper"].note
    assert "as above" in render_scorecard(card)


def test_relations_are_scored_where_there_are_some(circle):
    relations = Relations(np.array([101.0]), np.array([101.5]), np.array([[0.1, 0, 2 * np.pi / 36]]))
    card = score_run(circle, relations=relations)
    assert values(card)["relations_translation"] == pytest.approx(0, abs=1e-9)
    assert card.quantities["relations_rotation_deg"].odometry == pytest.approx(0.3)
    assert "relations_translation" not in score_run(circle).quantities


def test_the_table_has_units_and_raw_odometry(circle):
    lines = render_scorecard(score_run(circle, "circle")).splitlines()
    assert lines[0].split() == ["circle", "value", "unit", "odometry"]
    (final,) = (line for line in lines if "ATE, final" in line)
    assert final.split()[3:][0] == "m"
    assert len(final.split()) == 5
    assert max(map(len, lines)) < 130


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"final": np.zeros((3, 3))}, r"run\.final: shape \(3, 3\)"),
        ({"online": np.full((108, 3), np.nan)}, r"run\.online: a NaN or infinite value"),
        ({"experience": np.full(108, 36)}, r"run\.experience: 36 to 36; expected -1 to 35"),
        ({"links": np.zeros(3, int)}, r"run\.links"),
        ({"truth": np.zeros((3, 3))}, r"run\.truth"),
    ],
)
def test_arrays_of_inconsistent_shapes_are_refused(circle, change, message):
    with pytest.raises(InputError, match=message):
        score_run(circle._replace(**change))


class LastConfig(Settings):
    row: int = -1


def last_x(config):
    return Metric(
        "my_last", "my last x", "m", "low", "Mine", lambda data: Finding(data.run.final[config.row, 0])
    )


@pytest.fixture
def registered(monkeypatch):
    monkeypatch.setattr(METRICS, "_registered", {"last": MetricEntry(LastConfig, last_x)})


def test_a_registered_metric_is_on_the_scorecard(circle, registered):
    (metric,) = build_metrics([PluginConfig(plugin="last", settings={"row": 3})])
    card = score_run(circle, metrics=[metric])
    assert card.quantities["my_last"].value == circle.final[3, 0]
    assert "Registered metrics\n  my last x" in render_scorecard(card)
    assert "my_last" not in score_run(circle).quantities


def test_a_quantity_has_one_metric(registered):
    with pytest.raises(InputError, match=r"score.metrics.1: a second quantity named 'my_last'"):
        build_metrics([PluginConfig(plugin="last")] * 2)
