"""Training of strain templates, with a test on held-out drives."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from robot.simulation.create.simulated_session import (
    CreateSimulationConfig,
    drive_into_wall,
    train_strain_templates,
)
from tactile.base.files import require_new_file
from tactile.base.random_streams import stream
from tactile.base.types import StepEnd
from tactile.wall_estimation.estimators import WallContact, contact_points, fused_wall
from tactile.wall_estimation.report_frontend import ReportFrontendConfig
from tactile.wall_estimation.strain_templates import (
    StrainTemplates,
    filter_strain,
    fit_tip_model,
    match_template,
)

DURATIONS = (0.5, 1.0, 2.0)
"""Durations of the tested drives after first contact, s; in arenas mostly 1 to 2 s."""
ESTIMATORS = ("winner", "between", "fused")
"""Eq. 5; the minimum of a parabola through the best template and its neighbours; ours."""
LARGE_ERROR_DEG = 10.0
"""Errors above this are marked, degrees: the step between templates."""


class HeldOutDrive(NamedTuple):
    """One drive into a wall, not used in the training.

    Attributes:
        angle: direction of the wall in base_link, degrees. known: whether there are templates of that angle.
        error: [S, 3] degrees, by `DURATIONS` and `ESTIMATORS`; NaN without an estimate.
    """

    angle: float
    known: bool
    error: np.ndarray


def train_to_file(config: CreateSimulationConfig, path: Path) -> StrainTemplates:
    """Trains the templates of a session's robot and writes them to a file.

    Raises:
        InputError: the file exists, or the whiskers have no contact.
    """
    require_new_file(path, parents=True)
    templates = train_strain_templates(config)
    path.parent.mkdir(parents=True, exist_ok=True)
    templates.write(path)
    return templates


def drive_held_out(config: CreateSimulationConfig, templates: StrainTemplates) -> list[HeldOutDrive]:
    """Tests templates on one more drive at each angle and one half-way between neighbours."""
    random = stream(config.seed, "templates.held out")
    angles = np.sort(np.concatenate([templates.angle, (templates.angle[1:] + templates.angle[:-1]) / 2]))
    mounts = tuple((mount.x, mount.y, mount.direction_deg) for mount in config.whiskers.mounts)
    settings = ReportFrontendConfig(mounts=mounts, length=config.whiskers.length)
    points = contact_points(settings.feelers, settings.contact_radius)
    tip = fit_tip_model(templates, settings.feelers)
    found = []
    for angle in angles.tolist():
        report = drive_into_wall(config, angle, random)
        strain = filter_strain(templates.training, report.strain)
        first = np.arange(strain.shape[1]) == np.abs(strain[0, :, 0]).argmax()
        errors = []
        for seconds in DURATIONS:
            part = strain[: max(round(seconds * config.whiskers.rate), 1)]
            match = match_template(templates, part, report.alive)
            travel = np.array([config.behaviour.slow * seconds, 0.0, 0.0])
            contact = WallContact(first, first, travel, StepEnd.ABORT, part, report.alive)
            wall = fused_wall(tip, points, contact)
            ways = match.angle, match.refined, wall.direction if wall.known else np.nan
            errors.append([_apart(way, angle) for way in ways])
        known = bool(np.isclose(templates.angle, angle).any())
        found.append(HeldOutDrive(float(np.degrees(angle)), known, np.array(errors)))
    return found


def render_drives(drives: Sequence[HeldOutDrive], repeats: int) -> str:
    """The results as text: a line for each drive, and the means."""
    heads = [f"{way}, {seconds:g} s" for seconds in DURATIONS for way in ESTIMATORS]
    lines = [
        f"Error of the wall direction on drives without training, degrees ({repeats} drives a template)",
        f"{'wall':>8}" + "".join(f"{head:>16}" for head in heads),
    ]
    for one in drives:
        cells = "".join(f"{_cell(error):>16}" for error in one.error.reshape(-1))
        lines.append(f"{one.angle:>6.0f}{' ' if one.known else '~'} {cells}")
    for name, known in (("trained", True), ("~ between", False)):
        errors = np.array([one.error.reshape(-1) for one in drives if one.known == known])
        if len(errors):
            lines.append(f"{name:<9}".ljust(8) + "".join(f"{_mean(column):>16}" for column in errors.T))
    lines.append(
        f"~ between two trained angles; ! off by more than {LARGE_ERROR_DEG:g}; - no wall was found. "
        "Winner: eq. 5 of Fox et al. 2012; between: the\nminimum of a parabola through it and its "
        "neighbours; fused: from the sliding tip of the first whisker (`touch.reports.walls`)."
    )
    return "\n".join(lines)


def _apart(one: float, other: float) -> float:
    """Angle between two wall directions, degrees: 0 to 90."""
    off = (one - other + np.pi / 2) % np.pi - np.pi / 2
    return float(np.degrees(abs(off)))


def _cell(error: float) -> str:
    return "-" if np.isnan(error) else f"{'! ' if error > LARGE_ERROR_DEG else ''}{error:.1f}"


def _mean(errors: np.ndarray) -> str:
    known = errors[np.isfinite(errors)]
    return f"{known.mean():.1f}" if len(known) else "-"
