"""The rig from the record of a configuration: wheels, head and whiskers, as far as they are in it."""

from __future__ import annotations

from typing import Any

import numpy as np

from ratslam.config.completion import complete
from ratslam.config.run_config import RunConfig
from ratslam.fit.head import fit_head_of
from ratslam.fit.revisits import fit_revisits
from ratslam.fit.rig import Quantity, Rig, join_rigs
from ratslam.fit.stage import fit_stage_of, is_stage
from ratslam.fit.wheels import LEAST_TURNED, WheelFit, fit_wheels
from ratslam.fit.whiskers import fit_signals_of, has_signals_only
from ratslam.pipeline.source import open_source
from robot.sources.odometry_correction import UNCORRECTED, OdometryCorrection
from robot.sources.source import Sample
from tactile.base.errors import InputError
from tactile.base.types import Observation


def fit_record(config: RunConfig, seed: int = 0) -> Rig:
    """All that the record of a configuration tells of its rig.

    Args:
        config: with absolute paths. seed: of the bootstrap.

    Raises:
        InputError: the record cannot be read.
    """
    if is_stage(config):
        return fit_stage_of(config)
    if has_signals_only(config):
        return fit_signals_of(config, [])
    plain = without_correction(config)
    with open_source(plain) as source:
        completed = complete(plain, source)
        samples = list(source)
        info = source.info
    parts = [fit_wheels_of(config, completed, samples, seed)]
    if info.raw_whiskers and info.planar_whiskers is None:
        parts += [fit_signals_of(config, samples), fit_head_of(completed, samples, info)]
    return join_rigs(parts)


def without_correction(config: RunConfig) -> RunConfig:
    """The configuration with the odometry as recorded."""
    if config.recording is None:
        return config
    recording = config.recording.model_copy(update={"odometry": UNCORRECTED})
    return config.model_copy(update={"recording": recording})


def fit_wheels_of(config: RunConfig, completed: RunConfig, samples: list[Sample], seed: int) -> Rig:
    """Scales, drift and noise of the odometry, from true poses, or else from revisits."""
    assumed = UNCORRECTED if config.recording is None else config.recording.odometry
    time = np.array([sample.time for sample in samples])
    motion = np.array([[*sample.reading.odometry][:3] for sample in samples], float).reshape(-1, 3)
    unknown = np.full(3, np.nan)
    truth = np.array([unknown if sample.truth is None else sample.truth for sample in samples])
    if not np.isfinite(truth).any():
        return _from_revisits(without_correction(config), samples, assumed)
    try:
        fit = fit_wheels(time, motion, truth, seed)
    except InputError as error:
        return Rig(unknown=(f"wheels: {error.found}; {error.expected} are needed",))
    rig = _from_truth(fit, assumed, completed)
    return rig if config.recording is not None else _without_settings(rig)


def _from_truth(fit: WheelFit, assumed: OdometryCorrection, completed: RunConfig) -> Rig:
    noise, cell = completed.keyframes.noise, completed.pose_cells.cell_size
    quantities = [_scale("length", assumed.length_scale, fit.length_scale)]
    unknown = []
    if fit.turn_scale is None:
        turned = f"the robot turns {fit.turned:.2g} rad in all"
        unknown.append(f"turn scale: {turned}; at least {LEAST_TURNED:.2g} rad are needed")
    else:
        quantities.append(_scale("turn", assumed.turn_scale, fit.turn_scale))
    quantities += [
        _bias(assumed.heading_bias, fit.heading_bias),
        Quantity("heading noise", noise.heading_per_cell / np.sqrt(cell), *fit.heading_noise, "rad/sqrt(m)"),
        Quantity("turn noise", noise.heading_per_radian, *fit.turn_noise, "rad/sqrt(rad)"),
        Quantity("position noise", noise.per_cell * np.sqrt(cell), *fit.position_noise, "m/sqrt(m)"),
        Quantity("distance spread in 10 s", None, 100 * fit.length_noise[0], 100 * fit.length_noise[1], "%"),
    ]
    note = (
        f"wheels: {fit.windows} windows of 10 s with true poses, {fit.path:.4g} m, {fit.turned:.4g} rad; "
        f"in {fit.slips} of them the wheels slip or the truth jumps (beyond 5 sd)"
    )
    return Rig(tuple(quantities), notes=(note,), unknown=tuple(unknown))


def _from_revisits(config: RunConfig, samples: list[Sample], assumed: OdometryCorrection) -> Rig:
    if config.recording is None:
        return Rig(unknown=("wheels: the record has no true poses",))
    scale = "length scale: no true poses, and a map closes its loops at any scale"
    if not any(shows_place(sample.reading) for sample in samples):
        return Rig(
            unknown=(scale, "turn scale, heading bias: no true poses, and no views that tell revisits")
        )
    found = fit_revisits(config)
    if found is None:
        reason = "no true poses, and the map closes no loops or is doubted"
        return Rig(unknown=(scale, f"turn scale, heading bias: {reason}"))
    quantities = [_bias(assumed.heading_bias, found.heading_bias)]
    if found.turn_scale is not None:
        quantities.insert(0, _scale("turn", assumed.turn_scale, found.turn_scale))
    note = (
        f"wheels: from the {found.closures} loop closures of a map (doubt {found.doubt:.2f}); the standard "
        "deviations take these closures as true"
    )
    return Rig(tuple(quantities), notes=(note,), unknown=(scale,))


def shows_place(reading: Any) -> bool:
    """Whether a place may be recognised by a reading."""
    return not isinstance(reading, Observation) or bool(reading.view_seen) or int(reading.label) >= 0


def _scale(name: str, assumed: float, found: tuple[float, float]) -> Quantity:
    unit = {"length": "m/m", "turn": "rad/rad"}[name]
    return Quantity(f"{name} scale", assumed, *found, unit, f"recording.odometry.{name}_scale")


def _bias(assumed: float, found: tuple[float, float]) -> Quantity:
    return Quantity("heading bias", assumed, *found, "rad/m", "recording.odometry.heading_bias")


def _without_settings(rig: Rig) -> Rig:
    """The rig of a source whose odometry no setting corrects."""
    plain = tuple(quantity._replace(setting="") for quantity in rig.quantities)
    return rig._replace(quantities=plain)
