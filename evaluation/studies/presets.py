"""Studies made of a configuration: functions from a configuration to the content of a study file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from evaluation.studies.scene_statistics import shortened
from evaluation.studies.study import Study, check_study, is_study_key, seed_key
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import Document, load, override, validate
from ratslam.runs.settings.yaml_document import Place
from robot.simulation.head.simulated_session import choose_tier
from tactile.base.errors import InputError

_Rows = dict[str, dict[str, Any]]
"""Settings of each row, by key path."""
PARTS: _Rows = {
    "all parts on": {},
    "classic backend": {"backend": "classic"},
    "without sector shifts": {"recall.shifts": 0},
    "without negative evidence of common views": {"recall.common": 0.0},
    "without the map's pose as a hypothesis": {"recall.local": 0.0},
    "without verification against the map": {"ablation": {"verify": False}},
    "without closure sequences": {"keyframes.min_length": 1},
    "without robust weights": {"ablation": {"robust": False}},
    "without heading bias in the map": {"ablation": {"heading_bias": False}},
    "without heading bias from views": {"keyframes.bias_from_views": False},
    "without both heading biases": {"keyframes.bias_from_views": False, "ablation": {"heading_bias": False}},
    "as a robot that may be carried": {"keyframes.may_be_carried": True},
    "without loop closures": {"experience.closures": False},
}
"""Parts that `ablate` turns off, by setting; and cuts of the odometry, which are off unless configured."""
CLASSIC: dict[str, Any] = {"backend": "classic", "templates.energy": 0.05}  # the classic backend for whiskers
CHOICES: _Rows = {
    "as configured": {},
    "9 headings": {"backend": "recall", "pose_cells.cells_heading": 9},
    "18 headings": {"backend": "recall", "pose_cells.cells_heading": 18},
    "41 cells": {"backend": "recall", "pose_cells.cells_xy": 41},
    "float32": {"session.precision": "float32"},
    "classic": CLASSIC,
}
"""Rows of `pareto`."""
PARTICLES = (30, 100, 300)  # particles of the grid filter in `pareto`, for simulated whiskers
TIERS = ("kinematic", "quasistatic", "dynamic")  # fidelities of simulation, the cheapest first
METHODS: _Rows = {"classic": CLASSIC | {"templates.threshold": 0.04}, "recall": {"backend": "recall"}}
"""Backends that `tiers` runs on the images of each tier."""


def preset_study(
    name: str, path: Path, overrides: Sequence[str] = (), *, by: float = 0.2, seconds: float = 600.0
) -> tuple[Study, list[str]]:
    """The study of a preset on a configuration file, and remarks for its report.

    An `InputError` says that the configuration is invalid or does not suit the preset.

    Args:
        name: one of `evaluation.studies.commands.PRESETS`. overrides: as for `read_study`.
        by: share that `vary` changes numbers by. seconds: length of the session of `tiers`.
    """
    document = override(load(path), [text for text in overrides if not is_study_key(text)])
    config = validate(document, RunConfig)
    content, remarks = _content(name, document, config, by, seconds)
    section, _, key = seed_key(config).partition(".")
    seed = getattr(getattr(config, section), key)
    content = {"base": str(path.resolve()), "seeds": [seed]} | content
    option = f"--preset {name}"
    made = Document(content, {(): Place(option, option)})
    overrides = [text for text in overrides if not text.startswith(f"{section}.{key}=")]
    return check_study(f"{path.stem}-{name}", made, Path(), overrides), remarks


def _content(
    name: str, document: Document, config: RunConfig, by: float, seconds: float
) -> tuple[dict[str, Any], list[str]]:
    """The content of a study file without base and seeds, and remarks."""
    rows: _Rows
    match name:
        case "ablate":
            return {"rows": PARTS, "report": "differences"}, []
        case "vary":
            moved = {f"{key} = {value:.4g}": {key: value} for key, value in variations(document, by)}
            return {"rows": {"as configured": {}, **moved}, "report": "differences"}, []
        case "spread":
            rows = {"as recorded": {"copies": 0}, "perturbed": {}}
            return {"rows": rows, "copies": 10, "report": "medians"}, []
        case "backends":
            first = "recall" if config.backend == "grid" else config.backend
            return {"rows": {each: {"backend": each} for each in (first, "grid")}, "report": "medians"}, []
        case "tiers":
            return _tiers(config, seconds)
    rows = dict(CHOICES)
    if config.recording is None:
        for count in PARTICLES:
            grid = {"backend": "grid", "grid.particles": count, "session.precision": "float32"}
            rows[f"grid, {count}"] = grid
    if config.simulation is not None:
        rows["quasistatic"] = {"simulation.fidelity": "quasistatic"}
    return {"rows": rows, "seeds": 3, "pace": "live", "report": "pareto"}, []


def _tiers(config: RunConfig, seconds: float) -> tuple[dict[str, Any], list[str]]:
    if not 0 < seconds < float("inf"):
        raise InputError("--seconds", str(seconds), "a time above 0 s")
    if config.simulation is None:
        expected = "a scene to simulate"
        raise InputError("simulation", "missing", expected, "`simulation: {}` is a whole session")
    tier, reason = choose_tier(config.simulation.model_copy(update={"fidelity": "auto"}))
    short = shortened(config, seconds).simulation
    assert short is not None
    length = {"explore": short.path.explore} if short.path.explore else {"circuits": short.path.circuits}
    rows: _Rows = {
        f"{name}, {method}": settings | {"simulation.fidelity": name, "simulation.raw": False}
        for name in TIERS
        for method, settings in METHODS.items()
    }
    content = {
        "set": {f"simulation.path.{key}": value for key, value in length.items() if value},
        "rows": rows, "report": "tiers", "reference_tier": TIERS[-1],
    }  # fmt: skip
    return content, [f"fidelity: auto takes {tier}: {reason}"]


def variations(document: Document, by: float) -> list[tuple[str, float | int]]:
    """Every number of recall and its map moved down and up by a share in (0, 1), without invalid values."""
    if not 0 < by < 1:
        raise InputError("--by", str(by), "a share between 0 and 1")
    config, found = validate(document, RunConfig), []
    for key, value in [*_numbers(config.recall, "recall."), *_numbers(config.keyframes, "keyframes.")]:
        for factor in (1 - by, 1 + by):
            moved: float | int = value * factor
            if isinstance(value, int):  # by one at least
                moved = round(moved) if round(moved) != value else value + (1 if factor > 1 else -1)
            try:
                validate(override(document, [f"{key}={moved!r}"]), RunConfig)
            except InputError:
                continue
            if moved != value:
                found.append((key, moved))
    return found


def _numbers(model: BaseModel, path: str) -> Iterator[tuple[str, float | int]]:
    for name in type(model).model_fields:
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            yield from _numbers(value, f"{path}{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield path + name, value
