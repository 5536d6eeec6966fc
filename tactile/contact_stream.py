"""Contact of whiskers in a continuous stream of signals whose baseline drifts.

A whisker that touches is deflected to one side of its baseline for longer than a period of its own vibration;
one that was let go, or is shaken, swings through it. So the departure of a channel is the least of the last
period's deviations on one side. The baseline follows the signal while the whisker is free and stands still
during a contact. After a contact a whisker does not return to its baseline at once (creep of its mount): a
share of the largest departure is allowed for, and the drift since the contact began; both fade. It creeps
towards a second, slow baseline, and between the two it is free.

`find_contacts` is a pure function of a state and the next samples, however many: the decisions are the same
bit for bit for a live stream and for its recording. Baselines and allowances change at the ends of blocks, at
fixed numbers of samples since the start.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from tactile.base.settings import Settings
from tactile.calibration import FreeBaseline


class ContactStreamConfig(Settings):
    """Contact decision; `_sds` are in standard deviations of each channel's noise."""

    on_sds: PositiveFloat = 6.0
    """Departure from the baseline at which a contact begins."""
    off_sds: PositiveFloat = 4.0
    """Departure below which it ends."""
    vibration_period: PositiveFloat = 0.02
    """Period of a free whisker's vibration, s; a contact is noticed this long after it begins."""
    creep: Annotated[float, Field(ge=0, lt=1)] = 0.02
    """Share of a contact's largest departure that may remain when it ends."""
    creep_time: PositiveFloat = 0.5
    """Time in which that remainder fades to 1/e, s."""
    drift_sds: NonNegativeFloat = 4.5
    """Change of the baseline in a second of contact that is allowed for when the contact ends; it grows with
    the square root of time. Three standard deviations of a random walk of 1.5 in a second."""
    tracking_time: PositiveFloat = 0.1
    """Time constant of the baseline of a free whisker, s. A departure slower than `on_sds` in this time is
    taken for drift."""
    home_time: PositiveFloat = 5.0
    """Time constant of a second, slow baseline, s. A whisker that creeps back after contacts moves towards
    it; between the two baselines it is free."""
    block: PositiveFloat = 0.05
    """Interval at which baselines change, s."""
    bent_time: PositiveFloat = 30.0
    """A whisker that stays away from its baseline for this long counts as bent, s."""


class Touch(IntEnum):
    """State of a whisker."""

    FREE = 0
    CONTACT = 1
    BENT = 2
    """It has stayed away from its baseline; contacts are found relative to where it stays."""


class StreamPlan(NamedTuple):
    """Settings in samples, and the noise: what does not change during a stream.

    Attributes:
        noise: [W, K] in the unit of the signal. on, off: departures, in noise. window: samples of a
            vibration. block: samples between changes of the baselines.
        gain, home_gain: the way that the baseline and the slow one go in a block, as shares.
        creep: share of a departure that may remain. drift: departure that may come about in a contact of one
            sample, in noise. fading: decrease of both in a block. bent: samples.
    """

    noise: np.ndarray
    on: float
    off: float
    window: int
    block: int
    gain: float
    home_gain: float
    creep: float
    drift: float
    fading: float
    bent: int


class StreamState(NamedTuple):
    """All that a stream remembers.

    Attributes:
        row: samples so far in this block. recent: [window - 1, W, K] last samples.
        baseline: [W, K]. home: [W, K] slow baseline; of a bent whisker, that before it was bent.
        contact, bent: [W] bool. allowance: [W] departure that creep and drift explain, in noise.
        held: [W] samples of contact so far. away: [W] of these, since its baseline was last moved to it.
        total, touched, largest: of this block, [W, K] sum of the deviations, [W] whether there was a contact,
            [W] departure in contact.
    """

    row: int
    recent: np.ndarray
    baseline: np.ndarray
    home: np.ndarray
    contact: np.ndarray
    bent: np.ndarray
    allowance: np.ndarray
    held: np.ndarray
    away: np.ndarray
    total: np.ndarray
    touched: np.ndarray
    largest: np.ndarray


def start_stream(
    config: ContactStreamConfig, free: FreeBaseline, rate: float
) -> tuple[StreamPlan, StreamState]:
    """The plan of a stream and its first state, all whiskers free.

    Args:
        rate: samples per second.
    """
    window, block = (max(round(time * rate), 1) for time in (config.vibration_period, config.block))
    plan = StreamPlan(
        noise=free.noise,
        on=config.on_sds,
        off=min(config.off_sds, config.on_sds),
        window=window,
        block=block,
        gain=1 - float(np.exp(-block / (config.tracking_time * rate))),
        home_gain=1 - float(np.exp(-block / (config.home_time * rate))),
        creep=config.creep,
        drift=config.drift_sds / float(np.sqrt(rate)),
        fading=float(np.exp(-block / (config.creep_time * rate))),
        bent=round(config.bent_time * rate),
    )
    whiskers = len(free.mean)
    no, zero = np.zeros(whiskers, bool), np.zeros(whiskers)
    recent = np.repeat(free.mean[None], window - 1, axis=0)
    count, total = np.zeros(whiskers, int), np.zeros_like(free.mean)
    return plan, StreamState(0, recent, free.mean, free.mean, no, no, zero, count, count, total, no, zero)


def find_contacts(
    plan: StreamPlan, state: StreamState, samples: np.ndarray
) -> tuple[StreamState, np.ndarray]:
    """The state of each whisker at each sample.

    Args:
        samples: [T, W, K] the next samples.

    Returns:
        The state after the samples, and [T, W] int8, a `Touch` each.
    """
    touch = np.empty(samples.shape[:2], np.int8)
    first = 0
    while first < len(samples):
        last = min(first + plan.block - state.row, len(samples))
        state, contact = _continue_block(plan, state, samples[first:last])
        touch[first:last] = np.where(contact, Touch.CONTACT, np.where(state.bent, Touch.BENT, Touch.FREE))
        if state.row == plan.block:
            state = _end_block(plan, state)
        first = last
    return state, touch


def date_back(plan: StreamPlan, touch: np.ndarray) -> np.ndarray:
    """[T, W] states with each contact from its first sample on.

    In a live stream a contact is known `plan.window - 1` samples after that.

    Args:
        touch: [T, W] from `find_contacts`.
    """
    dated = touch.copy()
    for earlier in range(1, min(plan.window, len(touch))):
        dated[:-earlier][touch[earlier:] == Touch.CONTACT] = Touch.CONTACT
    return dated


def find_fixed_contacts(free: np.ndarray, samples: np.ndarray, sds: float = 20.0) -> np.ndarray:
    """[T, W] bool, contact by the rule of Salman & Pearson 2016, III-E.

    A channel is further from the mean of a free record than 20 of its standard deviations.

    Args:
        free: [F, W, K] the free record. samples: [T, W, K].
    """
    return (np.abs(samples - free.mean(axis=0)) > sds * free.std(axis=0)).any(axis=-1)


def _continue_block(
    plan: StreamPlan, state: StreamState, samples: np.ndarray
) -> tuple[StreamState, np.ndarray]:
    """Decides samples within a block. Returns [T, W] bool, contact."""
    known = np.concatenate([state.recent, samples])
    deviation = (known - state.baseline) / plan.noise
    # [count, W] least deviation of a window on one side of both baselines, in noise; the largest channel.
    count = len(samples)
    low = high = deviation[plan.window - 1 :]
    for earlier in range(plan.window - 1):
        part = deviation[earlier : earlier + count]
        low, high = np.minimum(low, part), np.maximum(high, part)
    home = np.where(state.bent[:, None], 0.0, (state.home - state.baseline) / plan.noise)
    departure = np.maximum(low - np.maximum(home, 0.0), np.minimum(home, 0.0) - high).max(axis=-1)
    sums = np.concatenate([state.total[None], deviation[plan.window - 1 :]])
    total = np.add.accumulate(sums)[-1]
    later = state._replace(row=state.row + count, recent=known[count:], total=total)
    begins = departure > plan.on + state.allowance
    if not (state.contact.any() or begins.any()):
        return later, begins
    # [T, W] state that each beginning sets and each end clears, from the state [W] before.
    latest = np.where(begins | (departure < plan.off + state.allowance), np.arange(len(begins))[:, None], -1)
    latest = np.maximum.accumulate(latest, axis=0)
    contact = np.where(latest >= 0, np.take_along_axis(begins, np.maximum(latest, 0), axis=0), state.contact)
    # How long the contacts have lasted, from the last free sample on, and how far they went.
    row = np.arange(1, count + 1)
    free = np.where(contact, 0, row[:, None]).max(axis=0)
    held, away = (np.where(free, count - free, before + count) for before in (state.held, state.away))
    later = later._replace(
        contact=contact[-1],
        held=held,
        away=away,
        touched=state.touched | contact.any(axis=0),
        largest=np.maximum(state.largest, np.where(contact, departure, 0.0).max(axis=0)),
    )
    return later, contact


def _end_block(plan: StreamPlan, state: StreamState) -> StreamState:
    """Moves the baselines of free whiskers, lets allowances fade, names whiskers that are bent or back."""
    mean = state.total / plan.block
    follow = np.where(state.touched[:, None], 0.0, plan.gain * mean)
    baseline = state.baseline + follow * plan.noise
    home = state.home + plan.home_gain * (baseline - state.home)
    fading = np.where(state.contact, state.allowance, plan.fading * state.allowance)
    explained = plan.creep * state.largest + plan.drift * np.sqrt(state.held)
    later = state._replace(
        row=0,
        baseline=baseline,
        home=np.where(state.bent[:, None] | state.touched[:, None], state.home, home),
        allowance=np.maximum(fading, explained),
        total=np.zeros_like(state.total),
        touched=np.zeros_like(state.touched),
        largest=np.zeros_like(state.largest),
    )
    if state.bent.any() or (state.away >= plan.bent).any():
        return _rebase(plan, later, state.baseline + mean * plan.noise)
    return later


def _rebase(plan: StreamPlan, state: StreamState, level: np.ndarray) -> StreamState:
    """A whisker away for long is bent at its `level` [W, K]; a bent one whose level is home is free again."""
    offset = (np.abs(state.baseline - state.home) / plan.noise).max(axis=-1)
    near = (np.abs(level - state.home) / plan.noise).max(axis=-1) < plan.on + plan.creep * offset
    back = state.bent & near
    bends = ~back & (state.away >= plan.bent)
    settles = (back | bends)[:, None]
    return state._replace(
        baseline=np.where(settles, level, state.baseline),
        contact=state.contact & ~settles[:, 0],
        bent=(state.bent | bends) & ~back,
        away=np.where(settles[:, 0], 0, state.away),
        allowance=np.where(bends, 0.0, state.allowance),
    )
