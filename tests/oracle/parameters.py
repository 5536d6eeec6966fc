"""OpenRatSLAM's parameters as settings of this engine."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from ratslam.methods.config import ClassicBackendConfig
from tests.oracle.trace import Parameters

NAMES = {
    "pose_cells.cells_xy": "pc_dim_xy",
    "pose_cells.cells_heading": "pc_dim_th",
    "pose_cells.cell_size": "pc_cell_x_size",
    "attractor.excite_width": "pc_w_e_dim",
    "attractor.excite_sigma": "pc_w_e_var",
    "attractor.inhibit_width": "pc_w_i_dim",
    "attractor.inhibit_sigma": "pc_w_i_var",
    "attractor.global_inhibition": "pc_global_inhib",
    "templates.shift": "vt_shift_match",
    "templates.shift_step": "vt_step_match",
    "templates.panoramic": "vt_panoramic",
    "templates.threshold": "vt_match_threshold",
    "templates.habituation": "vt_active_decay",
    "templates.recovery": "pc_vt_restore",
    "templates.energy": "pc_vt_inject_energy",
    "places.radius": "exp_delta_pc_threshold",
    "places.radius_heading": "exp_delta_pc_threshold",
}


OURS = ("pc_w_", "pc_global", "pc_vt", "vt_active")
"""Parameters whose defaults are ours too: missing ones are left to ours, which the comparison checks."""


def settings_of(params: dict[str, Any], labels: bool) -> ClassicBackendConfig:
    """The configuration of a reference stream's parameters (`ratslam/classic/README.md` has the table).

    Args:
        params: names and values of OpenRatSLAM's [ratslam] section; missing ones take its defaults.
        labels: whether the stream gives template ids instead of views.
    """
    given = asdict(Parameters.from_strings(params))
    parts: dict[str, dict[str, Any]] = {"templates": {"source": "labels" if labels else "views"}}
    for path, theirs in NAMES.items():
        part, name = path.split(".")
        if theirs in params or not theirs.startswith(OURS):
            parts.setdefault(part, {})[name] = given[theirs]
    parts["templates"]["panoramic"] = bool(given["vt_panoramic"])
    return ClassicBackendConfig.model_validate(parts)
