"""The quantities of a run by name: label, unit, and which values are better; the columns of tables."""

from __future__ import annotations

from difflib import get_close_matches

from evaluation.metrics.grid_metrics import GRID_METRICS
from evaluation.metrics.metric import Direction, Finding, Metric, Quantity
from evaluation.metrics.run_metrics import RUN_METRICS
from tactile.base.errors import InputError


def _metric(name: str, label: str, unit: str = "", direction: Direction = "low") -> Metric:
    return Metric(name, label, unit, direction, "Study", lambda _: None)


MEASURED = (
    _metric("step_time", "time per step, median", "us"),
    _metric("step_time_p99", "time per step, 99 % quantile", "us"),
    _metric("run_time", "time per step with simulation, sensing and scoring", "us"),
    _metric("compile_time", "time of compilation", "s"),
    _metric("memory", "peak memory", "MiB"),
)
"""Quantities that depend on the machine and its load."""
STUDY_METRICS = (
    _metric("recognition_error", "steps not recognised correctly, 1 - ARR x ARCR"),
    _metric("map_error", "map error, eq. 6"),
    _metric("error_online", "position error, online", "m"),
    _metric("error_final", "position error, final", "m"),
    _metric("closures", "loop closures", "", None),
    _metric("false_closures", "false loop closures"),
    _metric("lost_share", "share of steps lost"),
    _metric("simulation_time", "simulation per second", "us"),
    _metric("contact_difference", "contact pixels unlike the reference tier"),
    _metric("height_difference", "height unlike the reference tier", "mm"),
)
"""Quantities of a run beside those of its scorecard."""
METRICS = {metric.name: metric for metric in (*RUN_METRICS, *GRID_METRICS, *STUDY_METRICS, *MEASURED)}
"""All quantities."""
COLUMNS = {
    "means": ("energy_all", "exm_arr", "exm_arcr_strict", "ate_final", "anytime_late", "map_error", "map_auc",
              "step_time", "step_time_p99", "compile_time", "memory"),
    "pareto": (*(metric.name for metric in MEASURED), "exm_arr", "exm_arcr_strict", "energy_all",
               "ate_final", "map_error"),
    "medians": ("error_online", "error_final", "ate_final", "energy_all", "anytime_median", "anytime_late",
                "closures", "false_closures", "lost_share", "map_error", "step_time", "compile_time"),
    "differences": ("ate_final", "ate_online", "anytime_median", "anytime_late", "closures", "false_closures",
                    "lost_share"),
    "tiers": ("simulation_time", "contact_difference", "height_difference", "exm_arr", "exm_arcr_strict",
              "energy_all", "ate_final"),
    "costs": ("step_time", "step_time_p99", "run_time", "energy_all", "ate_final", "exm_arr",
              "exm_arcr_strict", "map_error"),
}  # fmt: skip
"""Columns of each kind of report, in order; those without a value are left out."""
ERRORS = {
    "em": "energy_all", "ate": "ate_final", "online": "ate_online", "late": "anytime_late",
    "arr": "exm_arr", "arcr": "exm_arcr_strict", "exm": "recognition_error", "map": "map_error",
    "auc": "map_auc", "relations": "relations_translation",
}  # fmt: skip
"""Short names of quantities for `--error`."""
DEFAULT_ERRORS = ("energy_all", "ate_final", "map_error", "relations_translation", "recognition_error")
"""Errors of a Pareto front, tried in this order if none is named."""


def quantity(name: str, finding: Finding) -> dict[str, Quantity]:
    """A finding under its name, with label and unit."""
    return {name: METRICS[name].quantity(finding)}


def find_error(name: str) -> str:
    """The quantity that a short or full name of `--error` means; an `InputError` if it names no error."""
    found = ERRORS.get(name, name)
    if found not in METRICS or METRICS[found].direction is None or METRICS[found] in MEASURED:
        every = [*ERRORS, *(each.name for each in METRICS.values() if each.direction)]
        near = get_close_matches(name, every, n=1)
        cure = f"did you mean {near[0]!r}?" if near else ""
        raise InputError("--error", repr(name), f"one of {', '.join(ERRORS)}, ...", cure)
    return found
