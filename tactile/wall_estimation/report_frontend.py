"""From reports of the Create's steps to observations: what each step felt, and how the wall lies that it met.

A wall takes two reports or more: HIT1, and the slow drive (FWD2) up to HIT2 or ABORT. That is all that is
kept from one report to the next.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from tactile.base.config import Settings
from tactile.base.errors import InputError
from tactile.base.se2 import compose
from tactile.base.types import MotionKind, Observation, Odometry, Report, StepEnd, observation
from tactile.wall_estimation.estimators import (
    Wall,
    WallContact,
    contact_points,
    fused_wall,
    geometric_wall,
    no_wall,
    template_wall,
)
from tactile.wall_estimation.sliding_tip import fit_tip_model
from tactile.wall_estimation.strain_templates import (
    StrainTemplates,
    filter_strain,
    match_template,
    read_templates,
    strain_sample_rate,
)
from tactile.whiskers.head_geometry import Degrees
from tactile.whiskers.planar_whiskers import PlanarWhiskers

WhiskerMount = tuple[float, float, Degrees]
RATE_TOLERANCE = 1e-2
"""By which sample rates may differ from the templates', as a share: clocks are never the same."""


class ReportFrontendConfig(Settings):
    """How reports of a Create become observations."""

    walls: Literal["none", "geometric", "template", "fused"] = "fused"
    """Where walls' directions come from: `geometric` the line through two contacts; `template` the nearest
    template of their strain; `fused` how the first whisker's tip slides, and the second contact. Without
    templates `fused` is `geometric`."""
    templates: Path | None = None
    """File of strain templates; null: those of the source if it has any."""
    flat: PositiveFloat | None = 0.3
    """Error of the nearest template, as a share of the strain's power, from which `template` knows no wall;
    null: it always does, as in the paper."""
    contact_radius: PositiveFloat = 0.13
    """Where along a whisker a contact is taken to be, m (Fox et al. 2012, II-D)."""
    mounts: Annotated[tuple[WhiskerMount, ...], Field(min_length=1)] = (
        (0.10, 0.08, 50.0),
        (0.13, 0.03, 15.0),
        (0.13, -0.03, -15.0),
        (0.10, -0.08, -50.0),
    )
    """Of each whisker, from left to right: x (m), y (m) of its base in base_link, and the direction in which
    it points, degrees counter-clockwise from ahead."""
    length: PositiveFloat = 0.14
    """Of a whisker, m."""
    fold_back: bool = False
    """Whether a BACK is no observation of its own but added to the motion of the next one, as in the paper,
    which reports none."""

    @model_validator(mode="after")
    def _within(self) -> Self:
        if self.contact_radius > self.length:
            raise ValueError(
                f"contact_radius: {self.contact_radius:g} m is beyond a whisker of {self.length:g} m"
            )
        return self

    def resolved(self, folder: Path) -> ReportFrontendConfig:
        """The same with every relative path taken from the folder (of the configuration file, say)."""
        if self.templates is None:
            return self
        return self.model_copy(update={"templates": folder / self.templates})

    @property
    def feelers(self) -> PlanarWhiskers:
        """The whiskers."""
        base = np.array([mount[:2] for mount in self.mounts], np.float64)
        angle = np.radians([mount[2] for mount in self.mounts])
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return PlanarWhiskers(base, direction, np.full(len(base), self.length))


class _Slow(NamedTuple):
    """FWD2 so far: first, the contacts [W] at HIT1; travel [3] since; the strain of its steps."""

    first: np.ndarray
    travel: np.ndarray
    strain: tuple[np.ndarray, ...]


class ReportFrontend:
    """Turns reports, in their order, into observations.

    Args:
        templates: those to use if the configuration names no file.

    Attributes:
        feelers: the whiskers. point: [W, 2] m in base_link, where they touch if they do.
        view_shape: of the views, one pixel a whisker. whiskers: W.

    Raises:
        InputError: templates that are missing or of other whiskers.
    """

    def __init__(self, config: ReportFrontendConfig, templates: StrainTemplates | None = None) -> None:
        if config.templates is not None and config.walls in ("template", "fused"):
            templates = read_templates(config.templates)
        if config.walls == "template" and templates is None:
            raise InputError(
                "walls",
                "`template` without strain templates",
                "`templates`: a file of them",
                "make one with `python -m ratslam train-templates`, or take `geometric`",
            )
        self.config, self.templates = config, templates
        self.feelers = config.feelers
        self.whiskers = len(config.mounts)
        self.view_shape = (1, self.whiskers, 1)
        self.point = contact_points(self.feelers, config.contact_radius)
        self._tip = fit_tip_model(templates, self.feelers) if templates and config.walls == "fused" else None
        self._slow: _Slow | None = None
        self._back: Odometry | None = None

    def observe(self, report: Report) -> Observation | None:
        """What an engine is given of the step; None for a BACK that is folded into the next one.

        A BACK tells of its motion alone. Walls are seen from where the robot stands at the end of the step.

        Raises:
            InputError: other whiskers than configured, or strain sampled otherwise than the templates.
        """
        if len(report.contact) != self.whiskers:
            found = f"a report of {len(report.contact)} whiskers"
            raise InputError("mounts", found, f"of {self.whiskers}, as configured")
        wall = self._met(report)
        odometry = report.odometry if self._back is None else _joined(self._back, report.odometry)
        self._back = None
        if report.motion == MotionKind.BACK:
            if self.config.fold_back:
                self._back = odometry
                return None
            blind = observation(
                odometry, view_shape=self.view_shape, motion=MotionKind.BACK, whiskers=self.whiskers
            )
            return blind._replace(alive=np.zeros(self.whiskers, bool))
        contact = np.asarray(report.contact & report.alive, bool)
        plain = observation(
            odometry,
            contact.reshape(self.view_shape).astype(np.float64) if contact.any() else None,
            view_shape=self.view_shape,
            motion=MotionKind(report.motion),
            whiskers=self.whiskers,
        )
        return plain._replace(
            contact=contact,
            alive=np.array(report.alive, bool),
            point=self.point * contact[:, None],
            wall=np.bool_(wall.known),
            wall_point=np.array(wall.point, np.float64),
            wall_sd=np.float64(wall.sd),
        )

    def _met(self, report: Report) -> Wall:
        """The wall that is known at the end of the step; keeps what the next one needs."""
        slow, self._slow = self._slow, None
        contact = np.asarray(report.contact & report.alive, bool)
        if report.moment == StepEnd.HIT1:
            self._slow = _Slow(contact, np.zeros(3), ())
        if slow is None or report.motion != MotionKind.FORWARD or report.moment == StepEnd.HIT1:
            return no_wall()
        slow = _Slow(
            slow.first,
            compose(slow.travel, np.array(report.odometry[:3], np.float64)),
            (*slow.strain, self._sampled(report)),
        )
        if report.moment == StepEnd.FREE:
            self._slow = slow
            return no_wall()
        return self._wall(slow, contact, report)

    def _sampled(self, report: Report) -> np.ndarray:
        """[T, W, 2] the strain of a step, if its samples are what templates are made of."""
        rate = strain_sample_rate(report)
        if self.templates is not None and rate:
            usual = self.templates.training.rate
            if abs(rate - usual) > RATE_TOLERANCE * usual:
                raise InputError(
                    "strain",
                    f"{rate:.5g} samples per second",
                    f"{usual:g}, as in the templates",
                    "train them anew",
                )
        return np.asarray(report.strain, np.float64)

    def _wall(self, slow: _Slow, contact: np.ndarray, report: Report) -> Wall:
        raw = np.concatenate(slow.strain)
        alive = np.asarray(report.alive, bool) & np.isfinite(raw).all(axis=(0, 2))
        raw = np.where(alive[:, None], raw, 0.0)
        strain = filter_strain(self.templates.training, raw) if self.templates else raw
        meeting = WallContact(slow.first, contact, slow.travel, StepEnd(report.moment), strain, alive)
        if not np.isfinite(slow.travel).all() or self.config.walls == "none":
            return no_wall()
        if self._tip is not None:
            return fused_wall(self._tip, self.point, meeting)
        if self.config.walls == "template" and self.templates is not None:
            if not len(strain) or not alive.any():
                return no_wall()
            match = match_template(self.templates, strain, alive)
            return template_wall(self.point, match, meeting, self.config.flat)
        return geometric_wall(self.point, meeting)


def _joined(one: Odometry, other: Odometry) -> Odometry:
    """One motion and then the other; turns are added up, not wrapped."""
    x, y, _ = compose(np.array(one[:3], np.float64), np.array(other[:3], np.float64))
    return Odometry(x, y, one.dtheta + other.dtheta, one.dt + other.dt)
