"""The signals of whiskers from the record of a configuration: raw whisks, or a registered source."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ratslam.runs.settings.run_config import RunConfig
from ratslam.service.fit.rig_fit import Quantity, Rig
from robot.recordings.whiskers.reach import WHISKERS, ReachConfig, find_touches, read_reach
from robot.sources.source import Sample
from tactile.base.errors import InputError
from tactile.base.plugins import PluginConfig, read_settings
from tactile.base.types import Cycle, Whisk
from tactile.features.contact_stream import Touch
from tactile.fit.signals import SignalFit, SignalRecord, fit_signals

REST_SHARE = 0.05
"""Part of a cycle, from its start, in which whiskers are at rest and free."""
MOST_CYCLES = 200
"""Cycles used at most, evenly spread over the record."""
DRIFT_BLOCK = 0.5
"""Blocks whose means tell the drift of a continuous record, s."""


def read_signals_of_reach(source: PluginConfig) -> SignalRecord:
    """The signals of an arm that reaches through clutter."""
    config = read_settings(ReachConfig, source.settings, "source.settings")
    signal = read_reach(config.file).signal
    block = max(round(DRIFT_BLOCK * config.rate), 1)
    contact = (find_touches(config, signal) == Touch.CONTACT).mean(axis=0)
    return SignalRecord(
        signal[: config.free_rows], signal, block, block / config.rate, contact, WHISKERS, "counts"
    )


SIGNALS: dict[str, Callable[[PluginConfig], SignalRecord]] = {"whisker_reach": read_signals_of_reach}
"""Registered sources whose files hold the signals of whiskers; as sources they give contacts only."""


def has_signals_only(config: RunConfig) -> bool:
    """Whether the record of a configuration is one of signals, without wheels or a head."""
    return config.source is not None and config.source.plugin in SIGNALS


def fit_signals_of(config: RunConfig, samples: list[Sample]) -> Rig:
    """Noise, drift and faults of the whiskers.

    Raises:
        InputError: the file of a registered source cannot be read.
    """
    if has_signals_only(config):
        assert config.source is not None
        record = SIGNALS[config.source.plugin](config.source)
        return signal_rig(record, fit_signals(record), registered=True)
    try:
        record = signals_of_cycles(samples)
        return signal_rig(record, fit_signals(record), registered=False)
    except InputError as error:
        dead = dead_of_whisks(samples)
        settings = {"touch": {"head": {"dead": dead}}} if dead else {}
        return Rig(settings=settings, unknown=(f"noise, drift, baseline: {error}",))


def signals_of_cycles(samples: list[Sample]) -> SignalRecord:
    """The deflections of a whisker head at rest, at the start of each cycle.

    Raises:
        InputError: there are no raw samples, or too few.
    """
    cycles = [(sample.time, sample.reading) for sample in samples if isinstance(sample.reading, Cycle)]
    if len(cycles) < 8:
        raise InputError("record", f"{len(cycles)} whisks with raw samples", "at least 8")
    some = np.unique(np.linspace(0, len(cycles) - 1, min(len(cycles), MOST_CYCLES)).astype(int))
    rest = max(int(REST_SHARE * min(len(cycle.time) for _, cycle in cycles)), 1)
    record = np.concatenate([cycles[k][1].deflection[:rest] for k in some])
    apart = (cycles[some[-1]][0] - cycles[some[0]][0]) / (len(some) - 1)
    whiskers = record.shape[1]
    names = tuple(f"whisker {k}" for k in range(whiskers))
    return SignalRecord(record, record, rest, apart, np.zeros(whiskers), names, "rad")


def dead_of_whisks(samples: list[Sample]) -> list[int]:
    """Whiskers that are alive in none of the whisks."""
    alive = [sample.reading.alive for sample in samples if isinstance(sample.reading, Whisk)]
    return np.flatnonzero(~np.any(alive, axis=0)).tolist() if alive else []


def signal_rig(record: SignalRecord, fit: SignalFit, registered: bool) -> Rig:
    """The signals as a rig: medians over the channels of live whiskers, and a line for each whisker."""
    live = ~fit.dead
    quantities = []
    for name, values, unit in (
        ("noise, median channel", fit.noise, record.unit),
        ("white noise, median channel", fit.white, record.unit),
        ("correlation of neighbours", fit.correlation, ""),
        ("drift, median channel", fit.drift, f"{record.unit}/sqrt(s)"),
    ):
        known = values[live][np.isfinite(values[live])]
        if len(known):
            spread = float(np.subtract(*np.quantile(known, [0.75, 0.25])) / 1.349)
            quantities.append(Quantity(name, None, float(np.median(known)), spread, unit))
    dead = np.flatnonzero(fit.dead).tolist()
    settings = {"touch": {"head": {"dead": dead}}} if dead and not registered else {}
    unknown = (
        "stage-to-signal map: no known touch in the record",
        *(
            f"drift of {record.names[k]}: it touches in {record.contact[k]:.0%} of the record"
            for k in np.flatnonzero(np.isnan(fit.drift).any(axis=1))
        ),
    )
    return Rig(tuple(quantities), settings, signal_lines(record, fit), unknown)


def signal_lines(record: SignalRecord, fit: SignalFit) -> tuple[str, ...]:
    """A line for each whisker: baseline, noise, correlation, drift of each channel, and its faults."""
    reasons = {one.whisker: f"dirty: {one.reason}" for one in fit.dirty}
    reasons |= {int(k): "dead: no signal" for k in np.flatnonzero(fit.dead)}
    lines = [f"each channel: baseline; noise; correlation; drift ({record.unit}, {record.unit}/sqrt(s))"]
    for k, name in enumerate(record.names):
        columns = (fit.baseline, fit.noise, fit.correlation, fit.drift)
        parts = (" ".join(map(_shown, column[k])) for column in columns)
        lines.append(f"  {name}: " + (reasons[k] if fit.dead[k] else "; ".join(parts)))
        if k in reasons and not fit.dead[k]:
            lines.append(f"    {reasons[k]}")
    return tuple(lines)


def _shown(value: float) -> str:
    """A number, or '-' where the record does not tell it."""
    return f"{value:.3g}" if np.isfinite(value) else "-"
