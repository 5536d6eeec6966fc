"""Completes a configuration: the one place where settings are filled in from the information of a source."""

from __future__ import annotations

from typing import Any

from ratslam.runs.settings.packaged import PRESETS, PresetName
from ratslam.runs.settings.run_config import RunConfig
from robot.sources.odometry import odometry_extent
from robot.sources.source import Source
from robot.touch_source import touch_config_of

EXTENT_FACTOR, EXTENT_MARGIN = 1.15, 0.6
"""On each side of the start, the grid map covers the extent of the odometry times the factor, for its drift,
plus the margin (m), for the whiskers."""


def complete(config: RunConfig, source: Source, extent_m: float | None = None) -> RunConfig:
    """The configuration completed for a source; settings that it has are kept.

    Values of the source take precedence over presets, presets over defaults. A run writes the result to its
    run directory. Completing it again changes nothing, because every setting in it is set.

    Args:
        source: raw or of observations.
        extent_m: largest distance from the start along x or y that the robot will reach, m; None: found from
            the odometry of a source of known length.

    Raises:
        InputError: the head of the source and the settings in `touch.head` do not fit.
    """
    info = source.info
    config = config.model_copy(update={"touch": touch_config_of(info, config.touch)})
    if info.cell_size is not None:
        config = _fill(config, {"pose_cells": {"cell_size": info.cell_size}})
    if info.labels_only:
        config = _fill(config, {"templates": {"source": "labels"}})
    if info.signed_views:
        config = _fill(config, {"recall": {"images": "signed"}})
    # Touch without whiskers all around the robot: what it measures has no layout that is known here.
    other_touch = config.touch.frontend is not None and not source.whiskers
    if other_touch or (info.planar_whiskers is not None and not info.raw_whiskers):
        config = _fill(config, {"recall": {"sector_fov": "none"}})
    names = _choose_presets(config, source, other_touch) if config.presets is None else config.presets
    for name in names:
        config = _fill(config, PRESETS[name])
    config = config.model_copy(update={"presets": names})
    if config.backend != "grid" or config.grid.side is not None:
        return config
    if extent_m is None and source.length is not None:
        extent_m = odometry_extent(source)
    if extent_m is None:
        return config
    return _fill(config, {"grid": {"side": round(2 * (EXTENT_FACTOR * extent_m + EXTENT_MARGIN), 2)}})


def _choose_presets(config: RunConfig, source: Source, other_touch: bool) -> tuple[PresetName, ...]:
    """The presets of a configuration that names none."""
    info, recall = source.info, config.recall
    drives = info.drives or info.planar_whiskers is not None
    if config.backend == "grid":
        return ("create",) if drives else ("arm",)
    fov = recall.sector_fov if "sector_fov" in recall.model_fields_set else "whiskers"
    if not other_touch and (not source.whiskers or fov != "whiskers"):
        return ()
    return ("create", "touch") if drives else ("touch",)


def _fill(settings: Any, values: dict[str, Any]) -> Any:
    """The settings, with these values where they are not set."""
    update = {}
    for name, value in values.items():
        if isinstance(value, dict):
            update[name] = _fill(getattr(settings, name), value)
        elif name not in settings.model_fields_set:
            update[name] = value
    return settings.model_copy(update=update)
