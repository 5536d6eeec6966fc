"""Settings that were renamed: the error for an old configuration names the new key."""

from __future__ import annotations

RENAMED: dict[str, str] = {
    "roving": "create_simulation",
    "matcher": "write backend: recall or backend: classic",
    "lost": "min_fit_share",
    "frames": "keyframes",
    "recall.fan": "recall.sector_fov",
    "recall.leave": "recall.mode_decay",
    "recall.nothing": "recall.miss_weight",
    "keyframes.length": "keyframes.min_length",
    "keyframes.score": "keyframes.min_score",
    "keyframes.distance": "keyframes.max_distance",
    "keyframes.gap": "keyframes.max_gap",
    "keyframes.certain": "keyframes.candidate_posterior",
    "keyframes.whole": "keyframes.sequence_agreement",
    "keyframes.doubt": "keyframes.sequence_cost",
    "keyframes.stray": "keyframes.closure_cost_limit",
    "keyframes.facing": "keyframes.max_turn",
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
}
"""Old dotted path of a setting to the new one, or to a sentence that says what to write instead.

A renamed section maps the keys in it as well; only those with new names of their own need a line."""
