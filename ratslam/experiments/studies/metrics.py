"""The quantities of a run by name: label, unit, and which values are better."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from difflib import get_close_matches
from typing import NamedTuple

from evaluation.metrics.grid_metrics import GRID_METRICS
from evaluation.metrics.metric import Direction
from evaluation.metrics.run_metrics import RUN_METRICS
from ratslam.experiments.studies.records import RunRecord
from tactile.base.errors import InputError

MEASURED = ("step_time", "step_time_p99", "run_time", "compile_time", "memory")
"""Quantities that depend on the machine and its load."""
DIRECTIONS: dict[str, Direction] = {
    **{metric.name: metric.direction for metric in (*RUN_METRICS, *GRID_METRICS)},
    **dict.fromkeys(("map_error", "error_online", "error_final", "false_closures", "lost_share"), "low"),
    **dict.fromkeys(("simulation_time", "contact_difference", "height_difference", *MEASURED), "low"),
    "closures": None,
}
"""All quantities: whether low or high values are better; None where neither is."""
HEADINGS = {
    "step_time": "us/step",
    "step_time_p99": "99 %",
    "run_time": "whole run",
    "compile_time": "compile s",
    "memory": "MiB",
    "simulation_time": "sim us/s",
    "contact_difference": "contact",
    "height_difference": "height mm",
    "exm_arr": "ARR",
    "exm_arcr_strict": "ARCR",
    "energy_all": "EM",
    "ate_final": "ATE m",
    "ate_online": "online m",
    "anytime_median": "anytime m",
    "anytime_late": "late m",
    "error_online": "err online",
    "error_final": "err final",
    "closures": "closures",
    "false_closures": "false",
    "lost_share": "lost",
    "map_error": "map error",
    "map_auc": "map AUC",
}
"""Table headings."""
_SPEED = ("step_time", "step_time_p99", "run_time", "compile_time", "memory")
COLUMNS = {
    "means": ("energy_all", "exm_arr", "exm_arcr_strict", "ate_final", "anytime_late", "map_error", "map_auc",
              "step_time", "step_time_p99", "compile_time", "memory"),
    "pareto": (*_SPEED, "exm_arr", "exm_arcr_strict", "energy_all", "ate_final", "map_error"),
    "medians": ("error_online", "error_final", "ate_final", "energy_all", "anytime_median", "anytime_late",
                "closures", "false_closures", "lost_share", "map_error", "step_time", "compile_time"),
    "differences": ("ate_final", "ate_online", "anytime_median", "anytime_late", "closures", "false_closures",
                    "lost_share"),
    "tiers": ("simulation_time", "contact_difference", "height_difference", "exm_arr", "exm_arcr_strict",
              "energy_all", "ate_final"),
}  # fmt: skip
"""Columns of each kind of report, in order; those without a value are left out."""


class ErrorMetric(NamedTuple):
    """The error of a Pareto front; small values are good.

    Attributes:
        name: as in `--error`. label: description with unit. quantity: the quantity shown, or whose difference
            to 1 is shown; None if the error combines several. of: its value in a record, None if missing.
    """

    name: str
    label: str
    quantity: str | None
    of: Callable[[RunRecord], float | None]


ERRORS = {
    "em": ("energy_all", "Energy Metric, all pairs (m2 + rad2)"),
    "ate": ("ate_final", "ATE, final (m)"),
    "online": ("ate_online", "ATE, online (m)"),
    "late": ("anytime_late", "error of the present pose, second half (m)"),
    "arr": ("exm_arr", "ARR"),
    "arcr": ("exm_arcr_strict", "ARCR, strict"),
    "map": ("map_error", "map error, eq. 6"),
    "auc": ("map_auc", "wall AUC"),
    "relations": ("relations_translation", "error of relations (m)"),
}
"""Short names for `--error`: quantity and label."""
DEFAULT_ERRORS = ("em", "ate", "map", "relations", "exm")
"""Errors tried in this order if none is named."""


def find_error(name: str) -> ErrorMetric:
    """The error of a name: a short one, `exm` (1 - ARR x ARCR), or a quantity with a known direction.

    A quantity that is better high is subtracted from 1.

    Raises:
        InputError: there is no such error.
    """
    if name == "exm":
        return ErrorMetric(name, "steps not recognised correctly (1 - ARR x ARCR)", None, _unrecognised)
    quantity, label = ERRORS.get(name, (name, name))
    if quantity in MEASURED or DIRECTIONS.get(quantity) is None:
        every = [*ERRORS, "exm", *(each for each in DIRECTIONS if DIRECTIONS[each] and each not in MEASURED)]
        near = get_close_matches(name, every, n=1)
        cure = f"did you mean {near[0]!r}?" if near else ""
        raise InputError("--error", repr(name), f"one of {', '.join(every[: len(ERRORS) + 1])}, ...", cure)
    if DIRECTIONS[quantity] == "high":
        return ErrorMetric(name, f"1 - {label}", quantity, lambda record: _complement(record.value(quantity)))
    return ErrorMetric(name, label, quantity, lambda record: record.value(quantity))


def default_error(groups: Sequence[Sequence[RunRecord]]) -> ErrorMetric | None:
    """The first default error that most groups have in all of their records; None if no group has any."""

    def count(error: ErrorMetric) -> int:
        return sum(all(error.of(record) is not None for record in group) for group in groups if group)

    best = max(map(find_error, DEFAULT_ERRORS), key=count)  # the first of equals
    return best if count(best) else None


def _complement(value: float | None) -> float | None:
    return None if value is None else 1 - value


def _unrecognised(record: RunRecord) -> float | None:
    arr, arcr = record.value("exm_arr"), record.value("exm_arcr_strict")
    if arr is None:
        return None
    return 1.0 if arr == 0 else None if arcr is None else 1 - arr * arcr
