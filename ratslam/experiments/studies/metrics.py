"""What a job measures, by name, and which way each is better."""

from __future__ import annotations

from typing import Literal

Direction = Literal["low", "high"] | None

_ENERGIES = [
    f"energy_{pairs}{part}"
    for pairs in ("change", "consecutive", "gap", "links", "all")
    for part in ("", "_trans2", "_rot2")
]
_ARCR = [f"exm_arcr_{mode}" for mode in ("strict", "paper", "or", "literal")]
MEASURED: dict[str, tuple[str, str]] = {
    "step_time": ("time per step, median", "us"),
    "step_time_p99": ("time per step, 99 %", "us"),
    "compile_time": ("compiling", "s"),
    "memory": ("peak memory", "MiB"),
}
"""What depends on the machine and on what else runs there: label and unit."""
DIRECTIONS: dict[str, Direction] = {
    **dict.fromkeys(("steps", "duration", "path", "experiences", "links", "exm_base")),
    **dict.fromkeys(("ate_final", "ate_online", "anytime_median", "anytime_late", "anytime_jump"), "low"),
    **dict.fromkeys(("rpe_translation", "rpe_rotation_deg"), "low"),
    **dict.fromkeys(("relations_translation", "relations_rotation_deg"), "low"),
    **dict.fromkeys(_ENERGIES, "low"),
    **dict.fromkeys(("exm_arr", *_ARCR), "high"),
    **dict.fromkeys(("exm_action_arr", "exm_action_arcr_strict"), "high"),
    **dict.fromkeys(("map_error", "map_brier", "map_log_loss"), "low"),
    **dict.fromkeys(("map_chamfer_map", "map_chamfer_walls"), "low"),
    **dict.fromkeys(("map_brier_skill", "map_brier_skill_free", "map_auc", "map_auc_free"), "high"),
    "map_log_loss_constant": None,
    **dict.fromkeys(MEASURED, "low"),
}
"""Every quantity: whether low or high values are better; None where neither is."""
MAIN = (
    "energy_all", "exm_arr", "exm_arcr_strict", "ate_final", "anytime_late", "map_error", "map_auc",
    *MEASURED,
)  # fmt: skip
"""Shown in tables, in this order, where anything has them."""
