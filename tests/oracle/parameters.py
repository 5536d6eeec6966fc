"""OpenRatSLAM's parameters as settings of this engine."""

from __future__ import annotations

from typing import Any

from ratslam.methods.config import ClassicBackendConfig


def settings_of(params: dict[str, Any], labels: bool) -> ClassicBackendConfig:
    """The configuration of a reference stream's parameters (`ratslam/classic/README.md` has the table).

    Args:
        params: names and values of OpenRatSLAM's [ratslam] section; missing ones take its defaults.
        labels: whether the stream gives template ids instead of views.
    """
    names = {
        "pose_cells": {
            "pc_dim_xy": "cells_xy",
            "pc_dim_th": "cells_heading",
            "pc_cell_x_size": "cell_size",
        },
        "attractor": {
            "pc_w_e_dim": "excite_width",
            "pc_w_e_var": "excite_sigma",
            "pc_w_i_dim": "inhibit_width",
            "pc_w_i_var": "inhibit_sigma",
            "pc_global_inhib": "global_inhibition",
        },
        "templates": {
            "vt_shift_match": "shift",
            "vt_step_match": "shift_step",
            "vt_panoramic": "panoramic",
            "vt_match_threshold": "threshold",
            "vt_active_decay": "habituation",
            "pc_vt_restore": "recovery",
            "pc_vt_inject_energy": "energy",
        },
    }
    defaults = {
        "pc_dim_xy": 21,
        "pc_dim_th": 36,
        "pc_cell_x_size": 1.0,
        "vt_shift_match": 25,
        "vt_step_match": 5,
        "vt_match_threshold": 0.03,
        "vt_panoramic": 0,
        "exp_delta_pc_threshold": 2.0,
    }
    given = defaults | {name: float(value) for name, value in params.items()}
    whole = {
        "pc_dim_xy",
        "pc_dim_th",
        "pc_w_e_dim",
        "pc_w_i_dim",
        "vt_shift_match",
        "vt_step_match",
        "vt_panoramic",
    }
    given = {name: int(value) if name in whole else value for name, value in given.items()}
    parts: dict[str, dict[str, Any]] = {
        part: {ours: given[theirs] for theirs, ours in table.items() if theirs in given}
        for part, table in names.items()
    }
    parts["templates"] |= {
        "source": "labels" if labels else "views",
        "panoramic": bool(given["vt_panoramic"]),
    }
    radius = given["exp_delta_pc_threshold"]
    return ClassicBackendConfig.model_validate(
        {**parts, "places": {"radius": radius, "radius_heading": radius}}
    )
