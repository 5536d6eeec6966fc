"""Recommendations and trial runs as text, and as YAML for the configuration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import yaml

from ratslam.config.strict_yaml.dumper import Dumper
from ratslam.experiments.sizing.recommendation import Recommendation
from ratslam.experiments.sizing.trial_runs import TrialRun
from ratslam.experiments.studies.metrics import HEADINGS
from ratslam.experiments.studies.report import align, number

ERRORS = ("energy_all", "ate_final", "exm_arr", "exm_arcr_strict", "map_error")
"""Columns of errors."""


def render_recommendations(found: Sequence[Recommendation]) -> str:
    """A table of settings: present value, recommended value, reason."""
    rows = [["setting", "now", "recommended", "why"]]
    rows += [[each.key, _plain(each.now), _plain(each.value), each.why] for each in found]
    return align(rows, "<>><")


def render_trial_runs(runs: Sequence[TrialRun]) -> str:
    """A table of time and error of each step; times also relative to the recommended settings."""
    first = runs[0].record.value("step_time")
    names = [name for name in ERRORS if any(run.record.value(name) is not None for run in runs)]
    rows = [["", "us/step", "99 %", "relative", "whole run", *(HEADINGS[name] for name in names)]]
    for step, record in runs:
        if record.error is not None:
            rows.append([step.name, *("-" for _ in rows[0][1:])])
            continue
        time = record.value("step_time")
        share = f"{time / first:.2f}" if time and first else "-"
        values = [number(record.value(name)) for name in ("run_time", *names)]
        rows.append([step.name, number(time), number(record.value("step_time_p99")), share, *values])
    failed = [f"{step.name}: {record.error}" for step, record in runs if record.error is not None]
    return "\n".join([align(rows), *failed])


def changed_settings_yaml(found: Sequence[Recommendation]) -> str:
    """YAML of the settings to change; '' if there are none."""
    tree: dict[str, Any] = {}
    for each in found:
        if each.changed:
            *sections, last = each.key.split(".")
            section = tree
            for name in sections:
                section = section.setdefault(name, {})
            section[last] = each.value
    return yaml.dump(tree, Dumper=Dumper, sort_keys=False) if tree else ""


def _plain(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
