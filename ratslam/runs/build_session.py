"""Makes the session of a configuration and its source."""

from __future__ import annotations

from ratslam.core.precision import prepare_precision
from ratslam.core.session import Session
from ratslam.mapping.config import FULL, Ablation
from ratslam.methods.method_registry import Sensors, build
from ratslam.runs.cell_plan import plan_recording, probe_of
from ratslam.runs.settings.run_config import RunConfig
from robot.sources.source import Source
from robot.touch_source import planar_whiskers_of

RESERVED = 4096
"""Longest source, in steps, that has its rows reserved from the start, so that the kernel is compiled once.
Longer sources seldom fill their rows, and a step takes time for each row, in use or not."""


def build_session(config: RunConfig, source: Source, ablation: Ablation = FULL) -> Session:
    """A new session for a completed configuration and its source of observations; prepares JAX's precision.

    Args:
        ablation: parts of the keyframe map to switch off.

    A configuration that reserves no rows reserves those of the source (`RESERVED`): equal sources and
    configurations give equal capacities, and so equal bits. A configuration with `cells` gives steps with
    the records of `probe_of`.

    Raises:
        InputError: see `ratslam.methods.method_registry.build` and `plan_recording`.
    """
    prepare_precision(config.session.precision)
    sensors = Sensors(source.view_shape, planar_whiskers_of(source, config.touch))
    backend = build(config.backend, config, sensors, config.session.precision, ablation)
    plan, length = plan_recording(config, source, backend), source.length
    rows = length if length is not None and length <= RESERVED else 0  # a step adds at most one
    return Session(
        backend,
        seed=config.session.seed,
        reserve=config.session.reserve or rows,
        precision=config.session.precision,
        probe=None if plan is None else probe_of(plan),
    )
