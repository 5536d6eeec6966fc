"""Front end of the Create: from reports of its steps to observations with contacts and wall directions.

A wall is estimated from the reports of HIT1 and of the slow drive (FWD2) up to HIT2 or ABORT; the front end
stores only that between reports.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from tactile.base.errors import InputError
from tactile.base.se2 import compose
from tactile.base.settings import Settings
from tactile.base.types import MotionKind, Observation, Odometry, Report, StepEnd, observation
from tactile.wall_estimation.estimators import (
    Wall,
    WallContact,
    contact_points,
    fused_wall,
    geometric_wall,
    template_wall,
)
from tactile.wall_estimation.strain_templates import (
    TRAIN_HINT,
    StrainTemplates,
    filter_strain,
    fit_tip_model,
    match_template,
    strain_sample_rate,
)
from tactile.whisker_geometry import Degrees, PlanarWhiskers

WhiskerMount = tuple[float, float, Degrees]
RATE_TOLERANCE = 1e-2
"""Largest relative difference of the sample rate from that of the templates (clocks differ slightly)."""


class ReportFrontendConfig(Settings):
    """Front end of the Create's reports."""

    walls: Literal["none", "geometric", "template", "fused"] = "fused"
    """Estimator of wall directions: `geometric` uses the line through two contacts; `template` the nearest
    strain template; `fused` the sliding tip of the first whisker and the second contact. Without templates
    `fused` equals `geometric`."""
    templates: Path | None = None
    """File of strain templates; null: those of the source, if any."""
    max_template_error: PositiveFloat | None = 0.3
    """Error of the nearest template, as a share of the strain's power, above which `template` gives no wall;
    null: no limit, as in the paper."""
    contact_radius: PositiveFloat = 0.13
    """Assumed distance of contacts from the whisker's base, m (Fox et al. 2012, II-D)."""
    mounts: Annotated[tuple[WhiskerMount, ...], Field(min_length=1)] = (
        (0.10, 0.08, 50.0),
        (0.13, 0.03, 15.0),
        (0.13, -0.03, -15.0),
        (0.10, -0.08, -50.0),
    )
    """For each whisker, from left to right: x (m), y (m) of its base in base_link, and its direction, degrees
    counter-clockwise from ahead."""
    length: PositiveFloat = 0.14
    """Length of the whiskers, m."""
    fold_back: bool = False
    """Whether the motion of a BACK step is added to the next observation instead of making an observation of
    its own (the paper does not report BACK)."""

    @model_validator(mode="after")
    def _within(self) -> Self:
        if self.contact_radius > self.length:
            found = f"contact_radius: {self.contact_radius:g} m"
            raise ValueError(f"{found} exceeds the whisker length of {self.length:g} m")
        return self

    @property
    def feelers(self) -> PlanarWhiskers:
        """The whiskers in the plane."""
        base = np.array([mount[:2] for mount in self.mounts], np.float64)
        angle = np.radians([mount[2] for mount in self.mounts])
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return PlanarWhiskers(base, direction, np.full(len(base), self.length))


class ReportFrontend:
    """Turns consecutive reports into observations.

    Args:
        templates: used if the configuration names no file.

    Attributes:
        feelers: the whiskers. point: [W, 2] assumed contact points in base_link, m.
        view_shape: shape of the views, one pixel per whisker. whiskers: W.

    Raises:
        InputError: templates are missing or were trained with other whiskers.
    """

    def __init__(self, config: ReportFrontendConfig, templates: StrainTemplates | None = None) -> None:
        if config.templates is not None and config.walls in ("template", "fused"):
            templates = StrainTemplates.read(config.templates)
        if config.walls == "template" and templates is None:
            expected, cure = "`templates`: a file of strain templates", f"{TRAIN_HINT}, or use `geometric`"
            raise InputError("walls", "`template` without strain templates", expected, cure)
        self.config, self.templates = config, templates
        self.feelers = config.feelers
        self.whiskers = len(config.mounts)
        self.view_shape = (1, self.whiskers, 1)
        self.point = contact_points(self.feelers, config.contact_radius)
        self._tip = fit_tip_model(templates, self.feelers) if templates and config.walls == "fused" else None
        # The current FWD2: contacts [W] at HIT1, motion [3] since, strain of each step.
        self._slow: tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]] | None = None
        self._back: Odometry | None = None

    def observe(self, report: Report) -> Observation | None:
        """The observation of a step; None for a BACK step that is added to the next one.

        The observation of a BACK step holds its motion only. Walls are in base_link at the end of the step.

        Raises:
            InputError: another number of whiskers than configured, or another sample rate than the templates.
        """
        if len(report.contact) != self.whiskers:
            found = f"a report of {len(report.contact)} whiskers"
            raise InputError("mounts", found, f"of {self.whiskers}, as configured")
        wall = self._estimate_wall(report)
        odometry = report.odometry
        if self._back is not None:  # turns are added without wrapping
            x, y, _ = compose(np.array(self._back[:3], np.float64), np.array(odometry[:3], np.float64))
            odometry = Odometry(x, y, self._back.dtheta + odometry.dtheta, self._back.dt + odometry.dt)
        self._back = None
        back = report.motion == MotionKind.BACK
        if back and self.config.fold_back:
            self._back = odometry
            return None
        contact = np.asarray(report.contact & report.alive, bool) & (not back)
        view = contact.reshape(self.view_shape).astype(np.float64) if contact.any() else None
        motion, shape = MotionKind(report.motion), self.view_shape
        plain = observation(odometry, view, view_shape=shape, motion=motion, whiskers=self.whiskers)
        if back:
            return plain._replace(alive=contact)
        return plain._replace(
            contact=contact,
            alive=np.array(report.alive, bool),
            point=self.point * contact[:, None],
            wall=np.bool_(wall.known),
            wall_point=np.array(wall.point, np.float64),
            wall_sd=np.float64(wall.sd),
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """The slow drive and the motion of the BACK step that the next report continues, for a checkpoint."""
        back = {} if self._back is None else {"back": np.array(self._back, np.float64)}
        if self._slow is None:
            return back
        first, travel, strain = self._slow
        parts = {f"strain/{k:06}": part for k, part in enumerate(strain)}
        return back | parts | {"first": first, "travel": travel}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Continues after the reports of a front end whose `arrays` these are."""
        self._back = Odometry(*arrays["back"]) if "back" in arrays else None
        strain = tuple(arrays[name] for name in sorted(arrays) if name.startswith("strain/"))
        self._slow = (arrays["first"], arrays["travel"], strain) if "first" in arrays else None

    def _estimate_wall(self, report: Report) -> Wall:
        """Estimates the wall at the end of the step and stores the state for the next one."""
        slow, self._slow = self._slow, None
        contact = np.asarray(report.contact & report.alive, bool)
        if report.moment == StepEnd.HIT1:
            self._slow = contact, np.zeros(3), ()
        if slow is None or report.motion != MotionKind.FORWARD or report.moment == StepEnd.HIT1:
            return Wall()
        first, before, strain = slow
        travel = compose(before, np.array(report.odometry[:3], np.float64))
        rate = strain_sample_rate(report)
        if self.templates is not None and rate:
            usual = self.templates.training.rate
            if abs(rate - usual) > RATE_TOLERANCE * usual:
                found, cure = f"{rate:.5g} samples per second", "train templates at this rate"
                raise InputError("strain", found, f"{usual:g}, as in the templates", cure)
        strain = (*strain, np.asarray(report.strain, np.float64))
        if report.moment == StepEnd.FREE:
            self._slow = first, travel, strain
            return Wall()
        raw = np.concatenate(strain)
        alive = np.asarray(report.alive, bool) & np.isfinite(raw).all(axis=(0, 2))
        raw = np.where(alive[:, None], raw, 0.0)
        filtered = filter_strain(self.templates.training, raw) if self.templates else raw
        return self._wall(WallContact(first, contact, travel, StepEnd(report.moment), filtered, alive))

    def _wall(self, meeting: WallContact) -> Wall:
        """The wall of a contact, by the configured estimator."""
        if not np.isfinite(meeting.travel).all() or self.config.walls == "none":
            return Wall()
        if self._tip is not None:
            return fused_wall(self._tip, self.point, meeting)
        if self.config.walls == "template" and self.templates is not None:
            if not len(meeting.strain) or not meeting.alive.any():
                return Wall()
            match = match_template(self.templates, meeting.strain, meeting.alive)
            return template_wall(self.point, match, meeting, self.config.max_template_error)
        return geometric_wall(self.point, meeting)
