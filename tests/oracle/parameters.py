"""OpenRatSLAM's parameters as settings of this engine (`ratslam/classic/README.md` has the table)."""

from ratslam.methods.config import ClassicBackendConfig
from tests.oracle.trace import Parameters

NAMES = {
    "pose_cells": {"cells_xy": "pc_dim_xy", "cells_heading": "pc_dim_th", "cell_size": "pc_cell_x_size"},
    "attractor": {
        "excite_width": "pc_w_e_dim", "excite_sigma": "pc_w_e_var", "inhibit_width": "pc_w_i_dim",
        "inhibit_sigma": "pc_w_i_var", "global_inhibition": "pc_global_inhib",
    },
    "templates": {
        "shift": "vt_shift_match", "shift_step": "vt_step_match", "panoramic": "vt_panoramic",
        "threshold": "vt_match_threshold", "habituation": "vt_active_decay", "recovery": "pc_vt_restore",
        "energy": "pc_vt_inject_energy",
    },
    "places": {"radius": "exp_delta_pc_threshold", "radius_heading": "exp_delta_pc_threshold"},
}  # fmt: skip
OURS = ("pc_w_", "pc_global", "pc_vt", "vt_active")
"""Parameters whose defaults are ours too: missing ones are left to ours, which the comparison checks."""


def settings_of(params, labels):
    """The configuration of a reference stream of these parameters of OpenRatSLAM's [ratslam] section, with
    its defaults for missing ones, whose views are template ids if it has `labels`."""
    values = Parameters.from_strings(params)._asdict()
    values["vt_panoramic"] = bool(values["vt_panoramic"])
    ours = {theirs for theirs in values if theirs.startswith(OURS)} - params.keys()
    parts = {
        part: {name: values[theirs] for name, theirs in names.items() if theirs not in ours}
        for part, names in NAMES.items()
    }
    parts["templates"]["source"] = "labels" if labels else "views"
    return ClassicBackendConfig.model_validate(parts)
