"""Metrics of other packages, computed for a run where a configuration names them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from evaluation.metrics.metric import Metric
from evaluation.metrics.run_metrics import RUN_METRICS
from tactile.base.errors import InputError
from tactile.base.plugins import PluginConfig, Registry, read_settings
from tactile.base.settings import Settings


class MetricEntry(NamedTuple):
    """A registered metric.

    Attributes:
        config_class: its settings. build: makes the metric from these; its `compute` gets a `RunData`.
    """

    config_class: type[Settings]
    build: Callable[[Any], Metric]


METRICS: Registry[MetricEntry] = Registry("ratslam.metrics", "metric", MetricEntry, {})
"""Metrics by the name in `score.metrics`."""


def build_metrics(chosen: Iterable[PluginConfig]) -> tuple[Metric, ...]:
    """The registered metrics that a configuration chooses.

    Raises:
        InputError: there is no such metric, its settings are wrong, or its quantity has the name of another.
    """
    taken = {metric.name for metric in RUN_METRICS}
    built = []
    for k, one in enumerate(chosen):
        where = f"score.metrics.{k}"
        entry = METRICS.get(one.plugin, f"{where}.plugin")
        metric = entry.build(read_settings(entry.config_class, one.settings, f"{where}.settings"))
        if metric.name in taken:
            raise InputError(where, f"a second quantity named '{metric.name}'", "another name")
        taken.add(metric.name)
        built.append(metric)
    return tuple(built)
