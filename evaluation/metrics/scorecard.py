"""Everything that is measured on one run, in one record for a program and one table for a reader."""

from __future__ import annotations

from math import isfinite
from typing import NamedTuple

import numpy as np

from evaluation.metrics.energy_metric import (
    Energy,
    Relations,
    energy,
    energy_all_pairs,
    relation_errors,
    successive_pairs,
)
from evaluation.metrics.experience_log import ExperienceLog, change_rows
from evaluation.metrics.experience_metric import (
    DEFAULT_EXM,
    EXM_MODES,
    ExmConfig,
    base_end,
    experience_metric,
)
from evaluation.metrics.run_arrays import RunArrays, check_run, truth_rows
from evaluation.metrics.trajectory import ate, online_error, rpe, summarize_errors
from tactile.base.config import Settings
from tactile.base.errors import InputError


class Quantity(Settings):
    """One measured value."""

    label: str
    """What it is, in words."""
    value: float | int | None
    """The value; None (null in JSON) where there is none, and `note` says why."""
    unit: str
    """SI, or degrees as `deg`; '' for a ratio or a count."""
    odometry: float | int | None = None
    """The same of raw odometry, where that makes sense."""
    note: str = ""
    """Why there is no value, or what to know about it."""


class Scorecard(Settings):
    """All quantities of one run, by name; `model_dump_json` writes it."""

    name: str
    """What was scored."""
    exm: ExmConfig
    """Thresholds and base set of the Experience Metric (every mode and kind of log is scored)."""
    quantities: dict[str, Quantity]
    """In the order of the table."""


class _Found(NamedTuple):
    value: float | int
    odometry: float | int | None = None
    note: str = ""


_Findings = dict[str, _Found]

_PAIRS = {
    "change": "successive experience changes",
    "consecutive": "consecutive steps",
    "gap": "steps at a gap",
    "links": "linked experiences",
    "all": "all pairs of steps",
}
_SECTIONS: dict[str, dict[str, tuple[str, str]]] = {
    "Extent": {
        "steps": ("steps", ""),
        "duration": ("duration", "s"),
        "path": ("length of the true path", "m"),
        "experiences": ("experiences", ""),
        "links": ("links", ""),
    },
    "Trajectory": {
        "ate_final": ("ATE, final", "m"),
        "ate_online": ("ATE, online", "m"),
        "anytime_median": ("anytime error, median", "m"),
        "anytime_late": ("anytime error, rms of the second half", "m"),
        "anytime_jump": ("anytime error, largest jump", "m"),
        "rpe_translation": ("RPE over one step, translation", "m"),
        "rpe_rotation_deg": ("RPE over one step, rotation", "deg"),
        "relations_translation": ("relations file, translation", "m"),
        "relations_rotation_deg": ("relations file, rotation", "deg"),
    },
    "Energy Metric": {
        name + suffix: (label + part, unit)
        for name, label in ((f"energy_{pairs}", label) for pairs, label in _PAIRS.items())
        for suffix, part, unit in (
            ("", "", "m2+rad2"),
            ("_trans2", ", trans", "m2"),
            ("_rot2", ", rot", "rad2"),
        )
    },
    "Experience Metric": {
        "exm_base": ("base set", "entries"),
        "exm_arr": ("ARR", ""),
        **{f"exm_arcr_{mode}": (f"ARCR, {mode}", "") for mode in EXM_MODES},
        "exm_action_arr": ("ARR, per action", ""),
        "exm_action_arcr_strict": ("ARCR, strict, per action", ""),
    },
}
_QUANTITIES = {name: words for names in _SECTIONS.values() for name, words in names.items()}


def score_run(
    run: RunArrays,
    name: str = "run",
    *,
    exm: ExmConfig = DEFAULT_EXM,
    relations: Relations | None = None,
    gap: int = 10,
) -> Scorecard:
    """Scores one run; what cannot be told (no truth, no places, no way back) is None with a reason.

    Args:
        relations: true relative motions of the same recording, if there are any.
        gap: steps between the two ends of a pair of the gap set.

    Raises:
        InputError: when the arrays do not fit each other.
    """
    check_run(run)
    rows = truth_rows(run)
    findings = _extent(run, rows)
    if run.truth is None or len(rows) == 0:
        findings |= _experience(run.experience, None, exm)
    else:
        findings |= _trajectories(run, run.truth, rows) | _energies(run, run.truth, rows, gap)
        base = None if exm.base is None else int(np.searchsorted(rows, exm.base))
        inside = exm.model_copy(update={"base": base})
        findings |= _experience(run.experience[rows], run.truth[rows], inside)
    if relations is not None:
        findings |= _relations(run, relations)
    names = [each for each in _QUANTITIES if relations is not None or not each.startswith("relations_")]
    return _card(name, exm, names, findings)


def score_log(log: ExperienceLog, name: str = "log", *, exm: ExmConfig = DEFAULT_EXM) -> Scorecard:
    """The Experience Metric, in all modes, of any SLAM system's log
    (`evaluation.metrics.experience_log.read_experience_log`)."""
    findings = {
        "steps": _Found(len(log.time)),
        "duration": _Found(float(log.time[-1] - log.time[0])),
        "path": _Found(_length(log.truth)),
        "experiences": _Found(len(np.unique(log.experience[log.experience != -1]))),
        **_experience(log.experience, log.truth, exm),
    }
    return _card(name, exm, [each for each in _QUANTITIES if each in findings], findings)


def render_scorecard(card: Scorecard) -> str:
    """The scorecard as plain text: quantity, value, unit, raw odometry beside it, note."""
    width = max(len(quantity.label) for quantity in card.quantities.values()) + 2
    lines = [f"{card.name:<{width + 2}}{'value':>9}  {'unit':<8} {'odometry':>9}"]
    for section, names in _SECTIONS.items():
        shown = [card.quantities[name] for name in names if name in card.quantities]
        lines += ["", section] if shown else []
        for above, q in zip([None, *shown], shown, strict=False):
            raw = "" if q.odometry is None else _text(q.odometry)
            note = "as above" if above and q.note and q.note == above.note else q.note
            lines.append(f"  {q.label:<{width}}{_text(q.value):>9}  {q.unit:<8} {raw:>9}  {note}".rstrip())
    return "\n".join(lines)


def _extent(run: RunArrays, rows: np.ndarray) -> _Findings:
    some = f"{len(rows)} of them with a true pose" if 0 < len(rows) < len(run.time) else ""
    path = {}
    if run.truth is not None and len(rows):
        path["path"] = _Found(_length(run.truth[rows]), _length(run.odometry[rows]))
    return {
        "steps": _Found(len(run.time), note=some),
        "duration": _Found(float(run.time[-1] - run.time[0])),
        **path,
        "experiences": _Found(len(run.nodes)),
        "links": _Found(len(run.links)),
    }


def _trajectories(run: RunArrays, truth: np.ndarray, rows: np.ndarray) -> _Findings:
    truth, online, final, odometry = (poses[rows] for poses in (truth, run.online, run.final, run.odometry))
    raw_ate, raw_rpe, raw_now = ate(odometry, truth), rpe(odometry, truth), online_error(odometry, truth)
    now, step = (
        summarize_errors(run.online_error) if len(run.online_error) else online_error(online, truth),
        rpe(final, truth),
    )
    note = "in the map so far" if len(run.online_error) else "of the poses told"
    return {
        "ate_final": _Found(ate(final, truth), raw_ate),
        "ate_online": _Found(ate(online, truth), raw_ate),
        "anytime_median": _Found(now.median, raw_now.median, note),
        "anytime_late": _Found(now.late, raw_now.late, note),
        "anytime_jump": _Found(now.jump, raw_now.jump, note),
        "rpe_translation": _Found(step.translation, raw_rpe.translation),
        "rpe_rotation_deg": _Found(float(np.degrees(step.rotation)), float(np.degrees(raw_rpe.rotation))),
    }


def _relations(run: RunArrays, relations: Relations) -> _Findings:
    ours = relation_errors(run.time, run.final, relations)
    raw = relation_errors(run.time, run.odometry, relations)
    note = f"{ours.used} relations" + (f", {ours.dropped} outside the recording" if ours.dropped else "")
    return {
        "relations_translation": _Found(ours.translation, raw.translation, note),
        "relations_rotation_deg": _Found(ours.rotation_deg, raw.rotation_deg, note),
    }


def _energies(run: RunArrays, truth: np.ndarray, rows: np.ndarray, gap: int) -> _Findings:
    at = rows[change_rows(run.experience[rows])]
    steps = successive_pairs(len(rows)), successive_pairs(len(rows), gap)
    final, odometry, true = run.final[rows], run.odometry[rows], truth[rows]
    links = run.links[np.isin(run.created, rows)[run.links].all(axis=1)]
    born, raw_born = truth[run.created], run.odometry[run.created]
    moves = successive_pairs(len(at))
    return {
        **_energy(
            "change",
            energy(run.nodes[run.experience[at]], truth[at], moves),
            energy(run.odometry[at], truth[at], moves),
        ),
        **_energy("consecutive", energy(final, true, steps[0]), energy(odometry, true, steps[0])),
        **_energy("gap", energy(final, true, steps[1]), energy(odometry, true, steps[1]), f"k = {gap}; "),
        **_energy("links", energy(run.nodes, born, links), energy(raw_born, born, links)),
        **_energy("all", energy_all_pairs(final, true), energy_all_pairs(odometry, true)),
    }


def _energy(pairs: str, ours: Energy, raw: Energy, note: str = "") -> _Findings:
    return {
        f"energy_{pairs}": _Found(ours.total, raw.total, f"{note}{ours.pairs} pairs"),
        f"energy_{pairs}_trans2": _Found(ours.trans2, raw.trans2),
        f"energy_{pairs}_rot2": _Found(ours.rot2, raw.rot2),
    }


def _experience(experience: np.ndarray, truth: np.ndarray | None, config: ExmConfig) -> _Findings:
    """The Experience Metric in all modes; without truth only ARR, and that only with a given base set."""
    names = _SECTIONS["Experience Metric"]
    if np.all(experience == -1):
        return {name: _Found(np.nan, note="no experiences") for name in names}
    if truth is None and config.base is None:
        return {name: _Found(np.nan, note="no ground truth, and no base set given") for name in names}
    if truth is None:  # ARR asks for no poses, so any will do
        found = _experience(experience, np.zeros((len(experience), 3)), config)
        return {name: value for name, value in found.items() if "arcr" not in name}
    try:
        base = base_end(truth, config.position, config.heading_deg) if config.base is None else config.base
    except InputError as error:
        return {name: _Found(np.nan, note=str(error)) for name in names}
    step = {mode: config.model_copy(update={"base": base, "log": "step", "mode": mode}) for mode in EXM_MODES}
    results = {mode: experience_metric(experience, truth, step[mode]) for mode in EXM_MODES}
    strict = results["strict"]
    action = experience_metric(experience, truth, step["strict"].model_copy(update={"log": "action"}))
    return {
        "exm_base": _Found(strict.base, note="per-step log"),
        "exm_arr": _Found(strict.arr, note=f"{strict.relocalisations} of {strict.entries} entries"),
        **{f"exm_arcr_{mode}": _Found(result.arcr, note=result.note) for mode, result in results.items()},
        "exm_action_arr": _Found(action.arr, note=f"{action.relocalisations} of {action.entries} entries"),
        "exm_action_arcr_strict": _Found(action.arcr, note=action.note),
    }


def _card(name: str, exm: ExmConfig, names: list[str], findings: _Findings) -> Scorecard:
    """The quantities of these names, in their order; those nobody found lack the truth."""
    missing = _Found(np.nan, note="no ground truth")
    quantities = {quantity: _quantity(quantity, findings.get(quantity, missing)) for quantity in names}
    return Scorecard(name=name, exm=exm, quantities=quantities)


def _quantity(name: str, found: _Found) -> Quantity:
    label, unit = _QUANTITIES[name]
    value = found.value if isfinite(found.value) else None
    odometry = found.odometry if found.odometry is not None and isfinite(found.odometry) else None
    note = found.note if value is not None or found.note else "undefined"
    return Quantity(label=label, value=value, unit=unit, odometry=odometry, note=note)


def _length(pose: np.ndarray) -> float:
    """Length of a path [N, 3], m."""
    return float(np.sum(np.hypot(*np.diff(pose[:, :2], axis=0).T)))


def _text(value: float | int | None) -> str:
    if value is None:
        return "-"
    return f"{value:.0f}" if isinstance(value, int) or abs(value) >= 1000 else f"{value:.4g}"
