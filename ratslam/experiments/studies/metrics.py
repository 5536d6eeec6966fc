"""What a job measures, by name, and which way each is better."""

from __future__ import annotations

from evaluation.metrics.grid_metrics import GRID_METRICS
from evaluation.metrics.metric import Direction
from evaluation.metrics.run_metrics import RUN_METRICS

MEASURED: dict[str, tuple[str, str]] = {
    "step_time": ("time per step, median", "us"),
    "step_time_p99": ("time per step, 99 %", "us"),
    "compile_time": ("compiling", "s"),
    "memory": ("peak memory", "MiB"),
}
"""What depends on the machine and on what else runs there: label and unit."""
DIRECTIONS: dict[str, Direction] = {
    **{metric.name: metric.direction for metric in (*RUN_METRICS, *GRID_METRICS)},
    "map_error": "low",
    **dict.fromkeys(MEASURED, "low"),
}
"""Every quantity: whether low or high values are better; None where neither is."""
MAIN = (
    "energy_all", "exm_arr", "exm_arcr_strict", "ate_final", "anytime_late", "map_error", "map_auc",
    *MEASURED,
)  # fmt: skip
"""Shown in tables, in this order, where anything has them."""
