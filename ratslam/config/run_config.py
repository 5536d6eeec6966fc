"""The whole configuration of a run, each part kept beside the code it configures."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, NonNegativeInt, ValidationInfo, field_validator

from evaluation.metrics.experience_metric import ExmConfig
from ratslam.backends.config import ClassicBackendConfig, GridBackendConfig, RecallBackendConfig
from ratslam.config.renamed_keys import RENAMED
from ratslam.config.strict_yaml import load, override, validate
from robot.live.config import LiveConfig
from robot.recordings.formats import RecordingConfig
from robot.simulation.create.session import CreateSimulationConfig
from robot.simulation.head.session import SimulationConfig
from robot.sources.odometry import odometry_extent
from robot.sources.source import Source
from robot.touch_source import head_config_of
from tactile.base.config import Settings
from tactile.frontend import TouchConfig

TOUCH: dict[str, dict[str, Any]] = {
    "pose_cells": {"cell_size": 0.05, "cells_xy": 21},
    "recall": {"sector_fov": "whiskers", "mode_decay": 0.003, "miss_weight": 0.01, "modes": 4},
    "keyframes": {
        "noise": {"per_cell": 0.22, "heading_per_cell": 0.1, "heading_per_radian": 0.2},
        "bias_sd": 0.001,
        "min_score": 12.0,
        "max_distance": 60.0,
        "sequence_agreement": 0.2,
        "breaks": False,
        "select_every": 50,
        "solve_every": 20,
        "max_turn": 0.6,
        "place_radius": 1.3,
        "place_heading": 0.17,
    },
}
"""What is set for sessions with whiskers unless the configuration says otherwise: the odometry of Salman &
Pearson's arm (2016, III-C), images of which many look alike, and so all runs weighed against each other."""

ARM: dict[str, dict[str, Any]] = {
    "grid": {
        "particles": 300,
        "cell": 0.02,
        "body": 0.0,
        "drift": {"run": 0.0, "move": 0.0, "step": 0.27, "heading": 2e-3},
        "stamps": {"blob_sd": 0.015, "along": 0.05, "across": 0.015},
    }
}
"""The same for the grid filter: an arm stands nowhere, errs anew in each sample, and feels walls of 12 mm."""
MARGIN = 1.15, 0.6
"""A map covers so many times what odometry covers, for its drift, and so much more, for whiskers, m."""


class SessionConfig(Settings):
    """How the engine runs."""

    precision: Literal["float64", "float32"] = "float64"
    """Of the kernel."""
    seed: NonNegativeInt = 0
    """Of every random stream."""
    reserve: Annotated[int, Field(ge=0, le=2**24)] = 0
    """Rows of memory made room for at the start; 0 grows as needed and compiles anew at each power of two."""


class ScoreConfig(Settings):
    """How a run is judged when truth is known."""

    experience_metric: ExmConfig = ExmConfig()
    """Of the Experience Metric."""
    relations: Path | None = None
    """Relative true poses to judge by (t1,t2,x,y,z,roll,pitch,yaw); none: all but these figures."""


class SourceConfig(Settings):
    """What a run reads: exactly one source, and how its whiskers become views."""

    recording: RecordingConfig | None = None
    """What to run on: a recording, or a session simulated as one of the two below say."""
    simulation: SimulationConfig | None = None
    """Of an arm with a whisker head in a maze."""
    create_simulation: CreateSimulationConfig | None = None
    """Of a whiskered Create in an arena."""
    live: Annotated[LiveConfig | None, Field(validate_default=True)] = None
    """Or a session on an arm, for `python -m ratslam live`."""
    touch: TouchConfig = TouchConfig()
    """How whiskers become views."""

    @field_validator("live", mode="after")
    @classmethod
    def _one_source(cls, live: LiveConfig | None, info: ValidationInfo) -> LiveConfig | None:
        names = ("recording", "simulation", "create_simulation")
        sources = {name: info.data.get(name) for name in names} | {"live": live}
        given = [name for name, source in sources.items() if source is not None]
        if all(name in info.data for name in names) and len(given) != 1:
            there = (
                " and ".join(given) if given else "neither recording, simulation, create_simulation nor live"
            )
            raise ValueError(f"{there}; give one of these four, and null for the others")
        return live


class RunConfig(RecallBackendConfig, ClassicBackendConfig, GridBackendConfig, SourceConfig):
    """A run: `python -m ratslam run config.yaml`. `ratslam.backends.config` has the methods' sections."""

    renamed_keys = RENAMED
    backend: Literal["recall", "classic", "grid"] = "recall"
    """The method: RatSLAM with Bayesian recall and a keyframe map, RatSLAM as published, or a grid particle
    filter."""
    session: SessionConfig = SessionConfig()
    """Precision, seed and memory."""
    score: ScoreConfig = ScoreConfig()
    """Judgement."""

    def with_absolute_paths(self, folder: Path) -> RunConfig:
        """The same with relative paths taken from `folder`, so that it can be used from anywhere."""
        relations = self.score.relations
        parts = {
            name: part and part.resolved(folder)
            for name in ("recording", "simulation", "create_simulation", "live")
            for part in [getattr(self, name)]
        }
        parts["touch"] = self.touch.model_copy(update={"reports": self.touch.reports.resolved(folder)})
        parts["score"] = self.score.model_copy(update={"relations": relations and folder / relations})
        return self.model_copy(update=parts)

    def completed(self, source: Source) -> RunConfig:
        """The same, with what it leaves open and the source knows: head, cell size, given place ids.

        Raises:
            InputError: the recording's head is none.
        """
        parts: dict[str, Settings] = {}
        info = source.info
        head = head_config_of(info, self.touch.head)
        if head != self.touch.head:
            parts["touch"] = self.touch.model_copy(update={"head": head})
        if "cell_size" not in self.pose_cells.model_fields_set and info.cell_size is not None:
            parts["pose_cells"] = self.pose_cells.model_copy(update={"cell_size": info.cell_size})
        if "source" not in self.templates.model_fields_set and info.labels_only:
            parts["templates"] = self.templates.model_copy(update={"source": "labels"})
        completed = self.model_copy(update=parts)
        if completed.backend == "grid":
            return completed._charted(source)
        if source.whiskers and (
            "sector_fov" not in self.recall.model_fields_set or self.recall.sector_fov == "whiskers"
        ):
            return _filled(completed, TOUCH)
        return completed

    def _charted(self, source: Source) -> RunConfig:
        """The same, with what the grid filter should know of the source."""
        completed = self if source.info.planar_whiskers is not None else _filled(self, ARM)
        if completed.grid.side is not None or source.length is None:
            return completed
        return completed.covering(odometry_extent(source))

    def covering(self, reach: float) -> RunConfig:
        """The same with a grid that covers so many metres from the start, unless it says how large it is."""
        if self.grid.side is not None:
            return self
        share, more = MARGIN
        return _filled(self, {"grid": {"side": round(2 * (share * reach + more), 2)}})


def load_config(path: str | os.PathLike[str], assignments: Sequence[str] = ()) -> RunConfig:
    """Reads a configuration file; its relative paths start at its folder.

    Args:
        assignments: settings to replace, each `a.b=value`.

    Raises:
        InputErrors: everything that is wrong with it, each with file, line and column.
    """
    config = validate(override(load(path), assignments), RunConfig)
    return config.with_absolute_paths(Path(path).parent.resolve())


def _filled(settings: Any, values: dict[str, Any]) -> Any:
    """The settings with these values in the place of all that nobody has set."""
    update = {}
    for name, value in values.items():
        if isinstance(value, dict):
            update[name] = _filled(getattr(settings, name), value)
        elif name not in settings.model_fields_set:
            update[name] = value
    return settings.model_copy(update=update)
