"""The stage-to-signal map of a whisker, from a record in which a stage touches it at known places."""

from __future__ import annotations

import numpy as np

from ratslam.config.run_config import RunConfig
from ratslam.fit.rig import Quantity, Rig
from robot.recordings.whiskers.stage import StageCalibration, StageConfig, read_stage_calibration
from tactile.base.errors import InputError
from tactile.base.plugins import read_settings
from tactile.wall_estimation.signal_map import fit_signal_map, predict_signal

PLUGIN = "whisker_stage"
FOLDS, BLOCK = 3, 10
"""Parts of the rows held out in turn, and consecutive rows held out together: neighbours are alike."""


def is_stage(config: RunConfig) -> bool:
    """Whether the record of a configuration is of a whisker on a stage."""
    return config.source is not None and config.source.plugin == PLUGIN


def fit_stage_of(config: RunConfig) -> Rig:
    """How well signals follow from the place of the touch, on rows held out.

    Raises:
        InputError: the record cannot be read.
    """
    assert config.source is not None
    settings = read_settings(StageConfig, config.source.settings, "source.settings")
    record = read_stage_calibration(settings.file)
    try:
        errors = held_out_errors(record)
    except InputError as reason:
        return Rig(unknown=(f"stage-to-signal map: {reason}",))
    size = float(np.sqrt((record.signal**2).mean()))
    error, control = (float(np.median(part)) for part in errors)
    share = [100 * float(np.median(errors[0][fold])) / size for fold in _folds(len(record.signal))]
    quantities = (
        Quantity("signal, rms", None, size, None, "counts"),
        Quantity("error of the map, held out", None, 100 * error / size, float(np.std(share)), "% of rms"),
        Quantity("error without a map (the mean)", None, 100 * control / size, None, "% of rms"),
    )
    note = (
        f"map: {len(record.signal)} touches at known places; median error of rows held out, in {FOLDS} parts"
    )
    unknown = ("noise, drift: a stage rests between its rows, and the file has no time",)
    return Rig(quantities, notes=(note,), unknown=unknown)


def held_out_errors(record: StageCalibration) -> tuple[np.ndarray, np.ndarray]:
    """Root mean square errors [N] over the channels, of the map and of the mean signal, each row held out."""
    error, control = np.zeros(len(record.signal)), np.zeros(len(record.signal))
    for fold in _folds(len(record.signal)):
        known = fit_signal_map(record.position[~fold], record.signal[~fold], record.base)
        for out, mean in (
            (error, predict_signal(known, record.position[fold])),
            (control, record.signal[~fold].mean(axis=0)),
        ):
            out[fold] = np.sqrt(((record.signal[fold] - mean) ** 2).mean(axis=1))
    return error, control


def _folds(rows: int) -> list[np.ndarray]:
    """[N] bool for each part."""
    part = np.arange(rows) // BLOCK % FOLDS
    return [part == k for k in range(FOLDS)]
