"""Contact detection in cycles with known contacts, and the baseline that follows drift; contacts in a stream:
drift, vibration, creep, bent whiskers, the same live and in replay."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile import contact_stream
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.types import Cycle, Odometry, Report
from tactile.calibration import Calibration, FreeBaseline, RestBaseline, RestBaselineConfig, follow_baseline
from tactile.contact_stream import ContactStreamConfig, Touch, find_contacts, find_fixed_contacts
from tactile.contact_threshold import ContactConfig, ShaftConfig, detect_contacts, radial_distance, stiffness
from tactile.frontend import Frontend, TouchConfig

AMPLITUDE, W, SD = 1.134, 18, 2e-3
CONFIG, ONES = ContactConfig(), np.ones((W, 2))
CALIBRATION = Calibration(
    0 * ONES, SD * ONES, 20 * SD * ONES, AMPLITUDE * ONES[:, 0], np.ones(W, bool), 2000.0
)
WALLS, FREE = np.linspace(0.1, 1.0, W), np.full(W, np.inf)


def whisk(wall, *, rate=2000.0, share=0.5, reach=0.75, slips=np.inf, seed=0):
    """A cycle against walls at angles [W]; whiskers bend by `share` of the commanded angle beyond them."""
    time = np.arange(int(rate)) / rate
    command = AMPLITUDE * (1 - np.cos(2 * np.pi * time))[:, None] / 2
    bend = np.where(command > wall, share * np.maximum(command - np.where(wall < np.inf, wall, 0), 0), 0.0)
    bend[np.maximum.accumulate(bend, axis=0) > slips] = 0.0
    angle = np.where(bend > 0, wall + bend, command)
    deflection = np.stack([0 * bend, stiffness(CONFIG.shaft, reach) * bend], axis=-1)
    noise = SD * stream(seed, "sensor").standard_normal((len(time), W, 3))
    return Cycle(time, angle + noise[..., 0], deflection + noise[..., 1:], Odometry(0.03, 0, 0, 1))


def detect(cycle, calibration=CALIBRATION):
    return detect_contacts(CONFIG, calibration, cycle)


def empty(cycle, rows=0):
    return Cycle(*(part[:rows] for part in cycle[:3]), cycle.odometry)


@given(st.integers(0, 100), st.floats(0.25, 0.6))
def test_angles_at_first_contact_are_those_of_the_walls(seed, share):
    features = detect(whisk(WALLS, seed=seed, share=share))
    assert features.contact.all()
    assert features.held.all()
    # Not before the wall, except for noise; late by the smallest detectable bend.
    assert (features.touched > WALLS - 0.01).all()
    assert (features.touched < WALLS + 0.04).all()
    np.testing.assert_allclose(features.highest, WALLS + share * (AMPLITUDE - WALLS), atol=3e-3)


def test_false_and_missed_contacts_are_below_one_in_a_thousand():
    at = stream(1, "walls").uniform(0.05, AMPLITUDE - 0.04, (40, W))
    assert sum((~detect(whisk(at[k], seed=k)).contact).sum() for k in range(40)) <= 0.003 * at.size
    for seed in range(40):
        features = detect(whisk(FREE, seed=seed))
        for part in (features.contact, features.held, features.touched, features.reach):
            assert not part.any()
        np.testing.assert_allclose(features.highest, AMPLITUDE, atol=3e-3)


def test_a_whisker_that_slips_off_has_a_contact_but_is_not_held():
    features = detect(whisk(np.full(W, 0.3), slips=0.2))
    assert features.contact.all()
    assert not features.held.any()
    np.testing.assert_allclose(features.touched, 0.31, atol=0.02)


@pytest.mark.parametrize("rate", [1000.0, 4000.0])
def test_contacts_do_not_depend_on_the_sample_rate(rate):
    usual = [detect(whisk(WALLS, seed=k)) for k in range(5)]
    other = [detect(whisk(WALLS, rate=rate, seed=99 + k)) for k in range(5)]
    assert all(np.array_equal(a.contact, b.contact) for a, b in zip(usual, other, strict=True))
    off = np.array([a.touched - b.touched for a, b in zip(usual, other, strict=True)])
    assert np.sqrt((off**2).mean()) < 2e-3 * np.pi * AMPLITUDE  # 2 ms of the fastest sweep


@given(st.floats(0.3, 1.0), st.floats(0.05, 1.0))
def test_the_radial_distance_inverts_the_stiffness(reach, taper):
    shaft = ShaftConfig(taper=taper)
    assert radial_distance(shaft, stiffness(shaft, reach)) == pytest.approx(reach)
    assert stiffness(shaft, shaft.reference) == pytest.approx(1)


def test_the_radial_distance_is_estimated():
    for reach in (0.5, 0.65, 0.8, 1.0):
        features = detect(whisk(np.linspace(0.1, 0.8, W), reach=reach))
        np.testing.assert_allclose(features.reach, reach, atol=0.05)


def test_sensor_offsets_are_subtracted():
    cycle, offset = whisk(WALLS), np.array([0.3, -0.2])
    shifted = cycle._replace(deflection=cycle.deflection + offset)
    there = CALIBRATION._replace(mean=np.tile(offset, (W, 1)))
    for a, b in zip(detect(cycle)[1:], detect(shifted, there)[1:], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_dead_whiskers_have_no_contacts_and_do_not_affect_others():
    plain, cycle = detect(whisk(WALLS)), whisk(WALLS)
    cycle.angle[3, 2], cycle.deflection[700, 5, 0] = np.nan, np.inf
    features = detect(cycle, CALIBRATION._replace(alive=np.arange(W) != 9))
    silent = np.isin(np.arange(W), [2, 5, 9])
    assert np.array_equal(features.alive, ~silent)
    for name in ("contact", "touched", "held", "highest", "reach"):
        assert not getattr(features, name)[silent].any()
        # Approximate: the end of the protraction follows from all whiskers together.
        np.testing.assert_allclose(getattr(features, name)[~silent], getattr(plain, name)[~silent], atol=1e-3)


def test_streams_with_gaps_and_too_low_sample_rates_are_refused():
    cycle = whisk(FREE)
    for broken, message in (
        (whisk(FREE, rate=500.0), r"500 samples per second.*slope_window"),
        (cycle._replace(time=cycle.time * 0), "not increasing"),
        (empty(cycle, 10), "cut off"),
    ):
        with pytest.raises(InputError, match=message):
            detect(broken)


FAST = CALIBRATION._replace(free=ONES[:, 0], rate=1000.0)


def short_cycle(seed, offset, push=0.0):
    """A whisk with all baselines at an offset, rad; whisker 2 is pushed in the end of the protraction."""
    time = np.arange(200) / 1000
    angle = np.repeat(0.5 - 0.5 * np.cos(2 * np.pi * time / 0.2)[:, None], W, axis=1)
    deflection = offset + SD * stream(seed, "whisk").standard_normal((200, W, 2))
    deflection[:, 2, 1] += push * np.maximum(angle[:, 2] - 0.3, 0)
    return Cycle(time, angle, deflection, Odometry(0.0, 0.0, 0.0, 0.2))


def drive(baseline, drift):
    """Contacts of 120 cycles whose baselines drift by `drift` sds a cycle; whisker 2 touches every third."""
    frontend, push = Frontend(TouchConfig(baseline=baseline), FAST), [0.5, 0.0, 0.0]
    cycles = (short_cycle(k, drift * SD * k, push[k % 3]) for k in range(120))
    return np.array([frontend.features(cycle).contact for cycle in cycles])


@settings(max_examples=3)
@given(st.sampled_from([-0.4, 0.0, 0.4]))
def test_contacts_are_found_and_only_they_while_the_baseline_drifts(drift):
    contact = drive(RestBaselineConfig(), drift)
    assert contact[::3, 2].all()
    assert contact.sum() == 40
    assert not drift or drive(None, drift)[60:].all()  # the calibration's baseline gives false ones


def test_a_bent_whisker_has_no_signal_until_it_returns():
    bent = np.zeros((W, 2))
    bent[5, 0] = 30 * SD
    frontend = Frontend(TouchConfig(baseline=RestBaselineConfig(bent_cycles=10)), FAST)
    alive = np.array([frontend.features(short_cycle(k, bent * (k < 30))).alive for k in range(60)])
    assert alive[:, 5].tolist() == [True] * 9 + [False] * 21 + [True] * 30
    assert np.delete(alive, 5, axis=1).all()


def test_a_whisker_that_drifted_unseen_is_free_again():
    """A whisker in contact at rest for 20 cycles, whose baseline drifts meanwhile by more than the allowance
    of one cycle, is not lost: a random walk explains where it is found."""
    frontend, contact = Frontend(TouchConfig(), FAST), []
    for k in range(30):
        offset = np.zeros((W, 2))
        offset[5, 0] = 200 * SD if k < 20 else 9 * SD
        contact.append(frontend.features(short_cycle(k, offset)).contact[5])
    assert contact == [True] * 20 + [False] * 10
    np.testing.assert_allclose(frontend.baseline.offset[5, 0], 9 * SD, atol=SD)


def test_the_baseline_continues_from_its_arrays_bit_for_bit():
    cycles = [short_cycle(k, 0.3 * SD * k) for k in range(20)]
    one, other = (Frontend(TouchConfig(), FAST) for _ in range(2))
    for reading in cycles[:12]:
        one.observe(reading)
    other.restore({name: array.copy() for name, array in one.arrays().items()})
    for reading in cycles[12:]:
        np.testing.assert_equal(one.observe(reading)[1:], other.observe(reading)[1:])
    np.testing.assert_equal(one.arrays(), other.arrays())


def test_cycles_without_samples_and_with_nan_change_no_baseline():
    config, start = RestBaselineConfig(), RestBaseline(np.zeros((W, 2)), np.zeros(W, int))
    broken = short_cycle(0, 0.0)
    assert follow_baseline(config, FAST, start, empty(broken)) is start
    broken.deflection[3, 7] = np.nan
    after = follow_baseline(config, FAST, start, broken)
    assert (after.offset != 0).all(axis=1).tolist() == [k != 7 for k in range(W)]
    assert (after.away < config.bent_cycles).all()


RATE = 200.0
AIR = FreeBaseline(np.array([[5.0, -3.0, 0.0], [0.0, 1.0, 2.0]]), np.array([[1.0, 2.0, 0.5]] * 2), {})
SEEDS = st.integers(0, 10_000)


def begin(**settings):
    return contact_stream.start_stream(ContactStreamConfig(**settings), AIR, RATE)


def noise(seed, rows):
    """[rows, 2, 3] samples of two free whiskers."""
    return AIR.mean + AIR.noise * stream(seed, "stream").standard_normal((rows, 2, 3))


def press(samples, first, last, sds, whisker=0):
    """Presses a whisker, along the second channel, within ten rows by `sds` of its noise."""
    row = np.arange(len(samples))
    push = np.clip(np.minimum(row - first, last - row) / 10, 0, 1)
    samples[:, whisker, 1] += sds * AIR.noise[whisker, 1] * push


def run(samples, **settings):
    return find_contacts(*begin(**settings), samples)[1]


@settings(max_examples=12)
@given(SEEDS, st.lists(st.integers(1, 60), min_size=1, max_size=8))
def test_pieces_of_any_lengths_give_the_same_bits(seed, lengths):
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
    np.testing.assert_equal(state, whole[0])


@settings(max_examples=12)
@given(SEEDS, st.floats(25, 5000), st.integers(100, 300), st.integers(40, 400), st.sampled_from([-1, 1]))
def test_a_contact_is_found_and_ends(seed, sds, first, length, sign):
    samples = noise(seed, 900)
    press(samples, first, first + length, sign * sds)
    touch = run(samples)
    assert (touch[: first - 5] == Touch.FREE).all()
    assert (touch[first + 15 : first + length - 15, 0] == Touch.CONTACT).all()
    assert (touch[first + length + 1 :, 0] == Touch.FREE).all()
    assert (touch[:, 1] == Touch.FREE).all()


@settings(max_examples=12)
@given(SEEDS, st.floats(-4, 4))
def test_drift_is_followed_where_the_fixed_rule_crosses(seed, rate):
    samples = noise(seed, 2400)
    samples += rate * AIR.noise * np.arange(2400)[:, None, None] / RATE
    assert (run(samples) == Touch.FREE).all()
    crossed = find_fixed_contacts(noise(1, 200), samples).any()
    assert crossed == (abs(rate) > 2) or 1 < abs(rate) <= 2


@settings(max_examples=12)
@given(SEEDS, st.floats(10, 300), st.floats(100, 2000))
def test_vibration_and_creep_after_a_contact_are_no_contact(seed, sds, pressed):
    shaken, crept, row = noise(seed, 600), noise(seed, 1200), np.arange(800)
    ringing = sds * np.exp(-row[:400] / 100) * np.sin(2 * np.pi * row[:400] / 4 + 0.3)
    shaken[200:, 0] += AIR.noise[0] * ringing[:, None]
    assert (run(shaken) == Touch.FREE).all()
    assert sds < 30 or find_fixed_contacts(noise(1, 200), shaken).any()
    press(crept, 200, 400, pressed)
    crept[400:, 0, 1] += 0.012 * pressed * AIR.noise[0, 1] * np.exp(-row / 100)
    assert (run(crept)[405:] == Touch.FREE).all()


def test_a_bent_whisker_is_named_still_feels_and_is_free_when_it_returns():
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


def test_contacts_are_dated_back_to_their_first_row():
    samples = np.repeat(AIR.mean[None], 300, axis=0)
    samples[100:200, 0, 0] += 50 * AIR.noise[0, 0]
    plan, state = begin()
    touch = find_contacts(plan, state, samples)[1]
    assert np.flatnonzero(touch[:, 0])[[0, -1]].tolist() == [100 + plan.window - 1, 199]
    dated = contact_stream.date_back(plan, touch)
    assert np.flatnonzero(dated[:, 0])[[0, -1]].tolist() == [100, 199]
    assert not dated[:, 1].any()


def test_a_head_has_no_reports_of_a_create():
    moved, no = Odometry(0.0, 0.0, 0.0, 0.1), np.zeros(W, bool)
    reading = Report(moved, 0, 0, ~no, no, np.zeros(0), np.zeros((0, W, 2)))
    with pytest.raises(InputError, match="reports of a Create"):
        Frontend(TouchConfig(), FAST).observe(reading)
