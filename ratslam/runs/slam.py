"""Localisation and mapping in a loop of one's own: readings go in one at a time, estimates come out."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from ratslam.core.backend import Map
from ratslam.core.compilation import keep_kernels
from ratslam.methods.method_registry import BACKENDS
from ratslam.runs.build_session import ConfigLike, build_session, open_source, resolve_config
from ratslam.runs.estimate import START, PoseEstimate
from ratslam.runs.localise import localising
from ratslam.runs.saved_map import describe_readings, is_map, read_map, write_map
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig
from robot.sources.in_memory import NO_ODOMETRY
from robot.sources.source import Sample, Source, SourceDescription, SourceInfo
from robot.touch_source import TouchSource, head_config_of, open_touch_source
from tactile.base.bounded import malformed
from tactile.base.errors import InputError
from tactile.base.files import require_new_file
from tactile.base.types import Cycle, Observation, Odometry, Report, Whisk, observation
from tactile.frontend import TouchConfig
from tactile.whisker_geometry import ur10_head
from tactile.whisker_image import view_shape


class Slam:
    """A session with its configuration and its touch front end. The kernel is compiled when it is made.

    Steps equal those of `ratslam.run` to the bit if the configuration names the source or `info` is the
    source: rows of memory are reserved by its length.

    Args:
        config: a configuration, its file, or its name; of a run, or without a source.
        info: the source of the readings, or a `SourceDescription`, or the `SourceInfo` of whiskers. None: the
            source of the configuration, which is opened and closed again.

    Attributes:
        config: completed for the source. source: description of the readings. session: the backend's session.
        estimate: of the last step. warnings: about the source of the configuration, a sentence each.
        cells: [C] float32 activity of the chosen pose cells (`cells.chosen`) after the last step; None before
            the first, without `cells` in the configuration, and of a loaded map. A loop makes no sums.

    Raises:
        InputErrors: the configuration has errors.
        InputError: the configuration names no source and there is no `info`, or they do not fit each other.
    """

    def __init__(self, config: ConfigLike, info: Source | SourceInfo | None = None) -> None:
        config = resolve_config(config, source_required=False)
        if info is None:
            found: list[str] = []
            with open_source(config, warnings=found) as source:
                self._build(complete(config, source), source, found)
        else:
            source = _describe_whiskers(info, config.touch) if isinstance(info, SourceInfo) else info
            self._build(complete(config, source), source)
        self.session.warm(self._blank)

    def _build(self, config: RunConfig, source: Source, warnings: Sequence[str] = ()) -> None:
        keep_kernels()
        observed = open_touch_source(source, config.touch)
        self.config, self.source = config, describe_readings(observed)
        self.warnings = tuple(dict.fromkeys(warnings))
        # Sums of the cells need the true poses, which a loop does not use.
        cells = config.cells and config.cells.model_copy(update={"sums": None})
        self.session = build_session(config.model_copy(update={"cells": cells}), observed)
        self.estimate = START
        self.cells: np.ndarray | None = None
        self._frontend = observed.start() if isinstance(observed, TouchSource) else None
        self._blank = observation(NO_ODOMETRY, view_shape=observed.view_shape, whiskers=observed.whiskers)

    @property
    def map(self) -> Map:
        """The map of the session."""
        return self.session.map

    @property
    def steps(self) -> int:
        """Number of observations so far."""
        return self.session.steps

    def step(self, reading: Sample | Observation | Cycle | Whisk | Report) -> PoseEstimate:
        """Folds the next reading into the map; whisker readings go through the touch front end.

        Args:
            reading: of the described source. The truth and the time of a `Sample` are not used.

        Returns:
            the estimate after it; that of the step before if the front end adds the motion of the reading to
            the next one (`touch.reports.fold_back`).

        Raises:
            InputError: the reading has other shapes or types than described, or numbers that are not finite;
                the session is then as before.
        """
        given = reading.reading if isinstance(reading, Sample) else reading
        observed: Observation | None
        if isinstance(given, Observation) and self.config.touch.frontend is None:
            observed = given  # a registered front end may take observations
        elif self._frontend is None:
            cure = "describe the whiskers in SourceInfo, with raw_whiskers=True"
            raise InputError("reading", f"a {type(given).__name__}", "an Observation", cure)
        else:
            observed = self._frontend.observe(given)
        if observed is not None:
            step = self.session.step(_match_observation(observed, self._blank))
            entry = BACKENDS.get(self.config.backend, "backend")
            self.estimate = PoseEstimate.of_step(step, entry.outcome(step.evidence), self.warnings)
            self.cells = step.probed
        return self.estimate

    def trajectory(self) -> np.ndarray:
        """[T, 3] poses of all steps, best estimate at this time: the optimised map, or odometry if that is
        doubted; x m, y m, heading rad."""
        return self.map.trajectory() if self.steps else np.zeros((0, 3))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the map (`ratslam.runs.saved_map`), with which a run continues too, as with
        another recording (`ratslam.runs.continuation`).

        Args:
            path: of the file; its folder is made, and an older map is replaced.

        Raises:
            InputError: something else is there.
        """
        file = Path(path)
        if file.is_symlink() or not is_map(file):
            require_new_file(file, parents=True)
        file.parent.mkdir(parents=True, exist_ok=True)
        frontend = {} if self._frontend is None else self._frontend.arrays()
        write_map(file, self.session, self.config, self.source, estimate=self.estimate, frontend=frontend)

    @classmethod
    def load(cls, path: str | os.PathLike[str], mode: Literal["continue", "localise"] = "continue") -> Slam:
        """Continues from a map to the same bits, or localises in it; the first step compiles.

        Args:
            path: of a map written by `save`, or of a run directory or its map.npz; the touch front end of a
                run starts anew.
            mode: `localise`: the map stays as it is, and the robot may stand anywhere in it or elsewhere;
                `slam.map.localisation()` tells whether and where it was found
                (`ratslam.core.estimates.LocalisedPose`), `estimate.lost` whether it was not.

        Raises:
            InputError: there is no map, or it cannot be used (`read_map`).
        """
        saved = read_map(Path(path), warnings.warn)
        slam = cls.__new__(cls)
        if mode == "localise":
            slam._build(localising(saved.config, saved), saved.source)
            slam.session.warm(slam._blank)
            return slam
        slam._build(saved.config, saved.source)
        saved.restore(slam.session, saved.config)
        slam.estimate = saved.estimate
        if slam._frontend is not None and saved.frontend:
            found = "the front end's arrays do not fit it ({})"
            with malformed(saved.path, "a map of this front end", found=found):
                slam._frontend.restore(dict(saved.frontend))
        return slam


def _match_observation(given: Observation, like: Observation) -> Observation:
    """The observation with the dtypes of another one."""
    names = (*(f"odometry.{name}" for name in Odometry._fields), *Observation._fields[1:])
    values, others = (*given.odometry, *given[1:]), (*like.odometry, *like[1:])
    matched = []
    for name, found, other in zip(names, map(np.asarray, values), others, strict=True):
        if found.shape != other.shape:
            raise InputError(name, f"shape {found.shape}", f"{other.shape}, as described")
        if not np.can_cast(found.dtype, other.dtype, "same_kind"):
            raise InputError(name, f"numbers of type {found.dtype}", str(other.dtype))
        if found.dtype.kind == "f" and not np.isfinite(found).all():
            raise InputError(name, "a number that is not finite", "finite numbers", "mask what is missing")
        matched.append(found.astype(other.dtype))
    odometry = len(Odometry._fields)
    return Observation(Odometry(*matched[:odometry]), *matched[odometry:])


def _describe_whiskers(info: SourceInfo, touch: TouchConfig) -> SourceDescription:
    """The description of whiskers, whose view shape follows from their number."""
    if info.planar_whiskers is not None:
        count = len(info.planar_whiskers.mounts)
        return SourceDescription((1, count, 1), count, info=info)
    if info.head is None:
        cure = "give the source itself, or a SourceDescription with the view shape"
        expected = "one with `head` or `planar_whiskers`"
        raise InputError("info", "a SourceInfo without whiskers", expected, cure)
    head = ur10_head(head_config_of(info, touch.head))
    return SourceDescription(view_shape(touch.image, head), len(head.length), info=info)
