"""The proposals and what cheaper steps cost, as text, and as YAML for the configuration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import yaml

from ratslam.config.strict_yaml.dumper import Dumper
from ratslam.experiments.sizing.recommendation import Proposal
from ratslam.experiments.sizing.trial_runs import Tried
from ratslam.experiments.studies.metrics import HEADINGS
from ratslam.experiments.studies.records import RunRecord
from ratslam.experiments.studies.report import align, number

ERRORS = ("energy_all", "ate_final", "exm_arr", "exm_arcr_strict", "map_error")
"""Columns of errors."""


def proposed_text(found: Sequence[Proposal]) -> str:
    """Every setting: what it is, what is proposed, why."""
    rows = [["setting", "now", "proposed", "why"]]
    rows += [[each.key, _plain(each.now), _plain(each.value), each.why] for each in found]
    return align(rows, "<>><")


def tried_text(found: Sequence[Tried]) -> str:
    """What each step costs and saves, beside the first."""
    first = found[0].result.value("step_time")
    names = [name for name in ERRORS if any(one.result.value(name) is not None for one in found)]
    rows = [["", "us a cycle", "99 %", "of proposed", "whole run", *(HEADINGS[name] for name in names)]]
    for step, result in found:
        if result.error is not None:
            rows.append([step.name, "-", "-", "-", "-", *("-" for _ in names)])
            continue
        time = result.value("step_time")
        share = f"{time / first:.2f}" if time and first else "-"
        errors = [number(result.value(name)) for name in names]
        rows.append([step.name, number(time), number(result.value("step_time_p99")), share,
                     number(result.value("run_time")), *errors])  # fmt: skip
    failed = [f"{step.name}: {result.error}" for step, result in found if result.error is not None]
    return "\n".join([align(rows, "<" + ">" * (len(rows[0]) - 1)), *failed])


def length_text(result: RunRecord, whole: int) -> str:
    """Of how much of the session that is."""
    return f"{result.steps} of {whole} cycles, one seed (`study --preset pareto` shows what is chance)"


def snippet(found: Sequence[Proposal]) -> str:
    """YAML of what the configuration has otherwise; '' if there is nothing."""
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
