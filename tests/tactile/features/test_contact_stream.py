"""Contacts in a stream: drift, vibration, creep, bent whiskers; the same live and in replay."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile.base.random_streams import stream
from tactile.calibration import FreeBaseline
from tactile.contact_stream import (
    ContactStreamConfig,
    StreamPlan,
    StreamState,
    Touch,
    date_back,
    find_contacts,
    find_fixed_contacts,
    start_stream,
)

RATE = 200.0
FREE = FreeBaseline(np.array([[5.0, -3.0, 0.0], [0.0, 1.0, 2.0]]), np.array([[1.0, 2.0, 0.5]] * 2), {})
SEEDS = st.integers(0, 10_000)


def begin(**settings: float) -> tuple[StreamPlan, StreamState]:
    return start_stream(ContactStreamConfig(**settings), FREE, RATE)


def noise(seed: int, rows: int) -> np.ndarray:
    """[rows, 2, 3] samples of two free whiskers."""
    return FREE.mean + FREE.noise * stream(seed, "stream").standard_normal((rows, 2, 3))


def press(samples: np.ndarray, first: int, last: int, sds: float, whisker: int = 0) -> None:
    """Presses a whisker, along the second channel, within ten rows by `sds` of its noise."""
    row = np.arange(len(samples))
    push = np.clip(np.minimum(row - first, last - row) / 10, 0, 1)
    samples[:, whisker, 1] += sds * FREE.noise[whisker, 1] * push


def run(samples: np.ndarray, **settings: float) -> np.ndarray:
    return find_contacts(*begin(**settings), samples)[1]


@settings(max_examples=12)
@given(SEEDS, st.lists(st.integers(1, 60), min_size=1, max_size=8))
def test_pieces_of_any_lengths_give_the_same_bits(seed: int, lengths: list[int]) -> None:
    samples = noise(seed, sum(lengths))
    press(samples, len(samples) // 3, len(samples), 60)
    plan, state = begin(bent_time=0.2)
    whole = find_contacts(plan, state, samples)
    parts, first = [], 0
    for length in lengths:
        state, touch = find_contacts(plan, state, samples[first : first + length])
        parts.append(touch)
        first += length
    np.testing.assert_array_equal(np.concatenate(parts), whole[1])
    for one, other in zip(state, whole[0], strict=True):
        np.testing.assert_array_equal(one, other)


@settings(max_examples=12)
@given(SEEDS, st.floats(25, 5000), st.integers(100, 300), st.integers(40, 400), st.sampled_from([-1, 1]))
def test_a_contact_is_found_and_ends(seed: int, sds: float, first: int, length: int, sign: int) -> None:
    samples = noise(seed, 900)
    press(samples, first, first + length, sign * sds)
    touch = run(samples)
    assert (touch[: first - 5] == Touch.FREE).all()
    assert (touch[first + 15 : first + length - 15, 0] == Touch.CONTACT).all()
    assert (touch[first + length + 1 :, 0] == Touch.FREE).all()
    assert (touch[:, 1] == Touch.FREE).all()


@settings(max_examples=12)
@given(SEEDS, st.floats(-4, 4))
def test_drift_is_followed_where_the_fixed_rule_crosses(seed: int, rate: float) -> None:
    samples = noise(seed, 2400)
    samples += rate * FREE.noise * np.arange(2400)[:, None, None] / RATE
    assert (run(samples) == Touch.FREE).all()
    crossed = find_fixed_contacts(noise(1, 200), samples).any()
    assert crossed == (abs(rate) > 2) or 1 < abs(rate) <= 2


@settings(max_examples=12)
@given(SEEDS, st.floats(10, 300), st.floats(100, 2000))
def test_vibration_and_creep_after_a_contact_are_no_contact(seed: int, sds: float, pressed: float) -> None:
    shaken, crept, row = noise(seed, 600), noise(seed, 1200), np.arange(800)
    ringing = sds * np.exp(-row[:400] / 100) * np.sin(2 * np.pi * row[:400] / 4 + 0.3)
    shaken[200:, 0] += FREE.noise[0] * ringing[:, None]
    assert (run(shaken) == Touch.FREE).all()
    assert sds < 30 or find_fixed_contacts(noise(1, 200), shaken).any()
    press(crept, 200, 400, pressed)
    crept[400:, 0, 1] += 0.012 * pressed * FREE.noise[0, 1] * np.exp(-row / 100)
    assert (run(crept)[405:] == Touch.FREE).all()


def test_a_bent_whisker_is_named_still_feels_and_is_free_when_it_returns() -> None:
    samples, returned = noise(0, 1600), noise(0, 2000)
    press(samples, 200, 10_000, 80)
    press(samples, 1000, 1100, 60)
    touch = run(samples, bent_time=2.0)[:, 0]
    for rows, kind in (
        (slice(215, 590), Touch.CONTACT),
        (slice(630, 990), Touch.BENT),
        (slice(1015, 1090), Touch.CONTACT),
        (slice(1110, None), Touch.BENT),
    ):
        assert (touch[rows] == kind).all()
    press(returned, 200, 1200, 80)
    touch = run(returned, bent_time=2.0)[:, 0]
    assert (touch[630:1180] == Touch.BENT).all()
    assert (touch[1240:] == Touch.FREE).all()


def test_contacts_are_dated_back_to_their_first_row() -> None:
    samples = np.repeat(FREE.mean[None], 300, axis=0)
    samples[100:200, 0, 0] += 50 * FREE.noise[0, 0]
    plan, state = begin()
    touch = find_contacts(plan, state, samples)[1]
    assert np.flatnonzero(touch[:, 0])[[0, -1]].tolist() == [100 + plan.window - 1, 199]
    dated = date_back(plan, touch)
    assert np.flatnonzero(dated[:, 0])[[0, -1]].tolist() == [100, 199]
    assert not dated[:, 1].any()
