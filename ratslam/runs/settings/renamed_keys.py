"""Settings that were renamed: the error for an old configuration names the new key.

Those that moved with their values are read from what an earlier version wrote, so that its map files and run
folders still open.
"""

from __future__ import annotations

import copy

from ratslam.runs.settings.yaml_document import Document

MOVED: dict[str, str] = {
    "pose_cells.excite_width": "attractor.excite_width",
    "pose_cells.excite_sigma": "attractor.excite_sigma",
    "pose_cells.inhibit_width": "attractor.inhibit_width",
    "pose_cells.inhibit_sigma": "attractor.inhibit_sigma",
    "pose_cells.global_inhibition": "attractor.global_inhibition",
    "pose_cells.settle_steps": "attractor.settle_steps",
    "pose_cells.engine": "attractor.engine",
}
"""Old dotted path of a setting to the new one, where it means the same."""

DROPPED = ("mode_decay", "miss_weight", "reach", "reach_heading", "modes", "energy")
"""Settings in the section `recall` of an earlier filter, whose values mean nothing to the pose cells."""
RENAMED: dict[str, str] = {
    "roving": "create_simulation",
    "matcher": "write backend: recall or backend: classic",
    "lost": "min_fit_share",
    "frames": "keyframes",
    "recall.fan": "recall.sector_fov",
    "recall.leave": "recall.leak",
    "recall.nothing": "recall.miss",
    "keyframes.length": "keyframes.min_length",
    "keyframes.score": "keyframes.min_score",
    "keyframes.distance": "keyframes.max_distance",
    "keyframes.gap": "keyframes.max_gap",
    "keyframes.certain": "keyframes.candidate_posterior",
    "keyframes.whole": "keyframes.sequence_agreement",
    "keyframes.doubt": "keyframes.sequence_cost",
    "keyframes.stray": "keyframes.closure_cost_limit",
    "keyframes.facing": "keyframes.max_turn",
    "keyframes.breaks": "keyframes.may_be_carried",
    "keyframes.weigh_every": "keyframes.select_every",
    "keyframes.weigh_score": "keyframes.select_score",
    "keyframes.weigh_length": "keyframes.select_length",
    "touch.contact.steep": "touch.contact.onset_sds",
    "touch.contact.rise": "touch.contact.rise_time",
    "touch.contact.least": "touch.contact.contact_sds",
    "touch.reports.flat": "touch.reports.max_template_error",
    "simulation.calibration.sds": "simulation.calibration.threshold_sds",
    "simulation.calibration.shortest": "simulation.calibration.min_duration",
    "simulation.calibration.tail_sds": "simulation.calibration.outlier_sds",
    "simulation.calibration.tail": "simulation.calibration.max_outlier_share",
    "simulation.calibration.louder": "simulation.calibration.max_sd_ratio",
    "keyframes.verify": "only the ablation study turns verification off",
    "keyframes.robust": "only the ablation study turns robust weights off",
    "keyframes.bias_in_map": "only the ablation study turns the heading bias off",
    "grid.stamps": "grid.footprint",
    "grid.stamps.fan": "grid.footprint.sector",
    "grid.stamps.most": "grid.footprint.max_log_odds",
    "grid.drawing.edge_fan": "grid.drawing.edge_sector",
    "grid.drawing.most": "grid.drawing.max_log_odds",
    "grid.drawing.fusion": "maps are always fused by adding log-odds",
    "grid.drift.run": "grid.drift.session",
    "grid.likelihood.compass": "grid.likelihood.wall_direction_prior",
    "grid.resampling.when": "grid.resampling.schedule",
    "grid.resampling.how": "grid.resampling.scheme",
    "grid.resampling.effective": "grid.resampling.min_effective_share",
    **MOVED,
    "recall.mode_decay": "recall.leak",
    "recall.miss_weight": "recall.miss",
    "recall.reach": "recall.excite",
    "recall.reach_heading": "recall.excite_heading",
    "recall.modes": "the pose cells hold any number of packets",
    "recall.energy": "views multiply activity, they add none",
}
"""Old dotted path of a setting to the new one, or to a sentence with the replacement.

A renamed section maps the keys in it as well; only those with new names of their own need a line."""


def with_moved_settings(document: Document) -> Document:
    """A configuration that the program wrote, read with the settings of `MOVED` under their new names.

    The program writes every setting, so only a document with all the old names is one: the few in a user's
    own file are reported with their new names, and so are those of `--set`. A value under the new name stays.
    """
    moves = [(*old.split("."), *new.split(".")) for old, new in MOVED.items()]
    data, places = copy.deepcopy(document.data), dict(document.places)
    if all(("recall", key) in places for key in DROPPED):
        for key in DROPPED:
            del data["recall"][key], places["recall", key]
    if not all((old, key) in document.places for old, key, *_ in moves):
        return Document(data, places)
    for old, key, new, name in moves:
        section = data.setdefault(new, {})
        if places[old, key].key == "--set" or not isinstance(section, dict):
            continue
        section.setdefault(name, data[old].pop(key))
        place = places.pop((old, key))
        places.setdefault((new,), place)
        places.setdefault((new, name), place)
    return Document(data, places)
