"""Training of strain templates, with a test on held-out drives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot.simulation.create.simulated_session import CreateSimulationConfig, drive_into_wall
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
"""Eq. 5; the minimum of a parabola through the best template and its neighbours; of the sliding tip."""
_LARGE_ERROR_DEG = 10.0
"""Errors above this are marked, degrees: the step between templates."""


HeldOutDrive = tuple[float, bool, np.ndarray]
"""One drive into a wall, not used in the training: direction of the wall in base_link, degrees; whether there
are templates of that angle; errors [S, 3], degrees, by `DURATIONS` and `ESTIMATORS`, NaN without estimate."""


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
            off = [(way - angle + np.pi / 2) % np.pi - np.pi / 2 for way in ways]
            errors.append([float(np.degrees(abs(each))) for each in off])
        known = bool(np.isclose(templates.angle, angle).any())
        found.append((float(np.degrees(angle)), known, np.array(errors)))
    return found


def render_drives(drives: Sequence[HeldOutDrive], repeats: int) -> str:
    """The results as text: a line for each drive, and the means."""
    heads = [f"{way}, {seconds:g} s" for seconds in DURATIONS for way in ESTIMATORS]
    lines = [
        f"Error of the wall direction on drives without training, degrees ({repeats} drives a template)",
        f"{'wall':>8}" + "".join(f"{head:>16}" for head in heads),
    ]
    for angle, known, error in drives:
        cells = [
            "-" if np.isnan(one) else f"{'! ' if one > _LARGE_ERROR_DEG else ''}{one:.1f}"
            for one in error.flat
        ]
        lines.append(f"{angle:>6.0f}{' ' if known else '~'} {''.join(f'{cell:>16}' for cell in cells)}")
    for name, trained in (("trained", True), ("~ between", False)):
        errors = np.array([error.reshape(-1) for _, known, error in drives if known == trained])
        if len(errors):
            there = [column[np.isfinite(column)] for column in errors.T]
            means = [f"{column.mean():.1f}" if len(column) else "-" for column in there]
            lines.append(f"{name:<9}".ljust(8) + "".join(f"{mean:>16}" for mean in means))
    lines.append(
        f"~ between two trained angles; ! off by more than {_LARGE_ERROR_DEG:g}; - no wall was found. "
        "Winner: eq. 5 of Fox et al. 2012; between: the\nminimum of a parabola through it and its "
        "neighbours; fused: from the sliding tip of the first whisker (`touch.reports.walls`)."
    )
    return "\n".join(lines)
