"""The checks of a metric: ours pass, and each broken one is told what is wrong."""

from __future__ import annotations

from itertools import count

import numpy as np
import pytest

from evaluation.metrics.metric import Finding, Metric
from evaluation.metrics.metric_registry import MetricEntry
from evaluation.metrics.run_metrics import RUN_METRICS
from ratslam.service.metric_checks import MetricTrial
from tactile.base.plugins import NoSettings


def trial_of(metric):
    return MetricTrial(MetricEntry(NoSettings, lambda settings: metric), NoSettings())


@pytest.mark.parametrize(
    "metric",
    [
        one
        for one in RUN_METRICS
        if not one.name.startswith("relations_") and one.section != "Pieces"  # of other runs
    ],
    ids=lambda one: one.name,
)
def test_our_metrics_pass(metric):
    results = list(trial_of(metric).run_checks())
    assert [result.line() for result in results if result.status != "ok"] == []
    assert [result.check for result in results] == list(MetricTrial.checks())


def last_error(data):
    """A sound metric: distance of the last pose from the true one."""
    if not len(data.rows):
        return None
    k = data.rows[-1]
    return Finding(float(np.hypot(*(data.run.final[k] - data.run.truth[k])[:2])))


SOUND = Metric("last_error", "error of the last pose", "m", "low", "Mine", last_error)
CALLS = count()


def computing(compute):
    return SOUND._replace(compute=compute)


def overwrites(data):
    data.run.final[:] -= data.run.final[0]
    return last_error(data)


def needs_links(data):
    return Finding(float(len(data.run.links) / len(data.run.nodes))) if len(data.rows) else None


BROKEN = {
    "name": (SOUND._replace(name="Last Error"), "name, label and unit are well-formed", "'Last Error'"),
    "taken": (SOUND._replace(name="ate_final"), "name, label and unit are well-formed", "one of our metrics"),
    "direction": (SOUND._replace(direction="down"), "name, label and unit are well-formed", "'down'"),
    "label": (SOUND._replace(label=""), "name, label and unit are well-formed", "label ''"),
    "number": (computing(lambda data: 1.0), "it computes with truth", "a run with truth gave a float"),
    "none": (computing(lambda data: None), "it computes with truth", "None for a run with truth"),
    "value": (computing(lambda data: Finding(np.zeros(1))), "it computes with truth", "value array([0.])"),
    "truth": (
        computing(lambda data: Finding(float(data.run.truth[-1, 0]))), "it does without truth", "TypeError"
    ),
    "reason": (
        computing(lambda data: last_error(data) or Finding(np.nan)), "it does without truth", "without a note"
    ),
    "rare": (computing(needs_links), "it computes on rare runs", "ZeroDivisionError"),
    "overwrites": (computing(overwrites), "it does not change the run", ".run.final float64 (108, 3)"),
    "random": (
        computing(lambda data: Finding(next(CALLS)) if len(data.rows) else None),
        "it is deterministic", ".value",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("metric", "check", "words"), BROKEN.values(), ids=BROKEN)
def test_a_broken_metric_is_told_what_is_wrong(metric, check, words):
    failed = next(result for result in trial_of(metric).run_checks() if result.status == "FAIL")
    assert (failed.check.name, words in failed.text) == (check, True), failed.line()


def test_a_sound_metric_passes():
    results = list(trial_of(SOUND).run_checks())
    assert [result.line() for result in results if result.status != "ok"] == []
