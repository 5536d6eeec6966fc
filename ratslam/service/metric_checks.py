"""Conformance checks of a metric on synthetic runs: with truth, with half of it, without, and rare runs."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from evaluation.metrics.metric import Finding, Metric
from evaluation.metrics.metric_registry import METRICS, MetricEntry
from evaluation.metrics.run_metrics import RUN_METRICS, RunArrays, run_data
from ratslam.service.check_results import Result, Trial, Violation, check, find_parts, require, require_equal
from tactile.base.se2 import integrate

LAPS, PLACES = 3, 36
ENTRY, VALUES = range(2)
"""Groups of checks, in their order."""


def check_metric(name: str, assignments: Sequence[str] = ()) -> Iterator[Result]:
    """Checks the metric of a name, with its settings as assignments `settings.key=value`; raises as
    `find_parts`."""
    entry, settings = find_parts({"settings": (METRICS, name, "check metric")}, assignments)["settings"]
    return MetricTrial(entry, settings).run_checks()


class MetricTrial(Trial[MetricEntry]):
    """A metric with settings, and its checks."""

    @cached_property
    def metric(self) -> Metric:
        return self.entry.build(self.settings)

    @check(ENTRY, "name, label and unit are well-formed", "scorecard.json and tables show them")
    def is_named(self) -> str:
        metric = self.metric
        require(isinstance(metric, Metric), f"build gave a {type(metric).__name__}", "Metric")
        named = isinstance(metric.name, str) and re.fullmatch(r"[a-z][a-z0-9_]*", metric.name)
        require(bool(named), f"name {metric.name!r}", "small letters, digits and _")
        taken = any(one.name == metric.name and one is not metric for one in RUN_METRICS)
        require(not taken, f"name {metric.name!r} of one of our metrics", "another name")
        for name in ("label", "section"):
            value = getattr(metric, name)
            one_line = isinstance(value, str) and value.strip() != "" and "\n" not in value
            require(one_line, f"{name} {value!r}", "a few words in one line")
        unit = metric.unit
        require(isinstance(unit, str) and not re.search(r"\s", unit), f"unit {unit!r}", "SI, 'deg', or ''")
        found = f"direction {metric.direction!r}"
        require(metric.direction in ("low", "high", None), found, "'low', 'high' or None")
        require(callable(metric.compute), f"compute {metric.compute!r}", "a function of a RunData")
        return f"{metric.name}, {metric.label}{unit and f', {unit}'}"

    @check(VALUES, "it computes with truth", "a scorecard holds numbers")
    def computes_with_truth(self) -> str:
        what = "a run with truth"
        result = self.metric.compute(run_data(_synthetic_run()))
        require(result is not None, f"None for {what}", "a Finding; None means that there is no truth")
        found = _require_finding(result, what)
        self.metric.quantity(found)
        return f"{found.value:.4g}{self.metric.unit and f' {self.metric.unit}'}"

    @check(VALUES, "it does without truth", "most recordings have none")
    def computes_without_truth(self) -> str:
        result = self.metric.compute(run_data(_synthetic_run()._replace(truth=None)))
        if result is None:
            return "no ground truth"
        found = _require_finding(result, "a run without truth")
        known = np.isfinite(found.value) or found.note != ""
        require(bool(known), f"{found.value} without a note", "None, or the reason in `note`")
        return f"{found.value:.4g} {found.note}".rstrip()

    @check(VALUES, "it computes on rare runs", "a run would end without its scorecard")
    def computes_on_rare_runs(self) -> None:
        run = _synthetic_run()
        half = run.truth[: len(run.time) // 2] if run.truth is not None else np.zeros((0, 3))
        unknown = np.full((len(run.time) - len(half), 3), np.nan)
        none, no_links = np.zeros(0, int), np.zeros((0, 2), int)
        names = ("time", "truth", "online", "final", "odometry", "experience")
        first: dict[str, Any] = {name: getattr(run, name)[:1] for name in names}
        first |= {"created": np.zeros(1, int), "nodes": run.nodes[:1], "links": no_links}
        empty: dict[str, Any] = {"created": none, "nodes": np.zeros((0, 3)), "links": no_links}
        rare = {
            "a run whose second half has no truth": run._replace(truth=np.concatenate([half, unknown])),
            "a run without experiences": run._replace(experience=np.full(len(run.time), -1), **empty),
            "a run of one step": run._replace(**first),
        }
        for what, one in rare.items():
            result = self.metric.compute(run_data(one))
            if result is not None:
                _require_finding(result, what)

    @check(VALUES, "it does not change the run", "later metrics would see other arrays")
    def changes_no_run(self) -> None:
        data = run_data(_synthetic_run())
        before = copy.deepcopy(data)
        self.metric.compute(data)
        require_equal(before, data, "the run before and after `compute`")

    @check(VALUES, "it is deterministic", "a score could not be reproduced")
    def is_deterministic(self) -> None:
        first = self.metric.compute(run_data(_synthetic_run()))
        second = self.entry.build(self.settings).compute(run_data(_synthetic_run()))
        require_equal(first, second, "the findings of one run computed twice")


def _synthetic_run() -> RunArrays:
    """Laps of a circle with a map that is a little wrong, and odometry that drifts."""
    count = LAPS * PLACES
    stream = np.random.default_rng(0)
    motion = np.stack([np.full(count, 0.1), np.zeros(count), np.full(count, 2 * np.pi / PLACES)], axis=1)
    truth = integrate(motion)
    final = truth + stream.normal(0, 0.01, truth.shape)
    links = np.stack([np.arange(PLACES), (np.arange(PLACES) + 1) % PLACES], axis=1)
    return RunArrays(
        time=100.0 + np.arange(count) / 2,
        truth=truth,
        online=truth + stream.normal(0, 0.02, truth.shape),
        final=final,
        odometry=integrate(motion * np.array([1.0, 1.0, 1.03])),
        experience=np.arange(count) % PLACES,
        created=np.arange(PLACES),
        nodes=final[:PLACES],
        links=links,
    )


def _require_finding(found: Any, what: str) -> Finding:
    if not isinstance(found, Finding):
        raise Violation(f"{what} gave a {type(found).__name__}", "Finding(value)")
    for name, value in (("value", found.value), ("odometry", found.odometry)):
        number = isinstance(value, float | int) and not isinstance(value, bool)
        none = value is None and name == "odometry"
        require(number or none, f"{name} {value!r} of type {type(value).__name__} in {what}", "a number")
    require(isinstance(found.note, str), f"note {found.note!r} in {what}", "text")
    return found
