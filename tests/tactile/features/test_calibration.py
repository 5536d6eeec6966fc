"""Calibration from free records, records that are refused or repaired, and estimates of noise and drift; what
is found again of rigs: noise, drift and faults of whiskers, rest angle and radii of heads."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.world.walls import Surroundings
from tactile import calibration as rest
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.types import Cycle, Odometry
from tactile.calibration import Calibration, CalibrationConfig, DirtyRecordConfig, calibrate, calibrate_free
from tactile.rig_signals import SignalRecord, fit_head, fit_signals
from tactile.whisker_geometry import HeadConfig, ur10_head

CONFIG = CalibrationConfig()
REPAIR = CONFIG.model_copy(update={"on_dirty": "repair"})
FREE, FREE_REPAIR = DirtyRecordConfig(), DirtyRecordConfig(on_dirty="repair")
WAVE = 0.05 * np.sin(2 * np.pi * np.arange(1000) / 1000)


def record(count=5, rate=1000.0, sd=2e-3, seed=0, where=np.s_[:0], change=None):
    """Cycles of 1 s in free air; whisker w's deflections rest at w / 100 and -w / 100; those at `where`
    are changed."""
    time, noise = np.arange(int(rate)) / rate, stream(seed, "calibration").standard_normal
    noise = sd * noise((count, len(time), 6, 3))
    angle = 1.1 * (1 - np.cos(2 * np.pi * time))[:, None] / 2 + noise[..., 0]
    deflection = np.arange(6)[:, None] / 100 * [1, -1] + noise[..., 1:]
    deflection[where] = change(deflection[where]) if change else deflection[where]
    return [Cycle(k + time, angle[k], deflection[k], Odometry(0, 0, 0, 1)) for k in range(count)]


def refused(cycles, match, config=CONFIG):
    with pytest.raises(InputError, match=match):
        calibrate(config, cycles)


@given(st.integers(0, 50), st.floats(1e-4, 1e-2))
def test_mean_noise_and_amplitude_are_estimated(seed, sd):
    found = calibrate(CONFIG, record(sd=sd, seed=seed))
    np.testing.assert_allclose(found.mean, np.arange(6)[:, None] / 100 * [1, -1], atol=sd / 10)
    np.testing.assert_allclose(found.sd, sd, rtol=0.06)
    np.testing.assert_allclose(found.threshold, 20 * found.sd)
    np.testing.assert_allclose(found.free, 1.1, atol=5 * sd)
    assert found.alive.all()
    assert found.rate == pytest.approx(1000)


@pytest.mark.parametrize(("axis", "size"), [(0, 0.05), (1, 0.05), (1, -0.2)])
def test_a_record_with_a_contact_is_refused_and_its_cycle_left_out_by_the_repair(axis, size):
    cycles = record(where=np.s_[2, 400:420, 3, axis], change=lambda free: free + size)
    refused(cycles, "contacts of whisker 3")
    found = calibrate(REPAIR, cycles)
    clean = np.concatenate([cycle.deflection[:, 3] for k, cycle in enumerate(cycles) if k != 2])
    np.testing.assert_allclose(found.sd[3], clean.std(axis=0), rtol=1e-9)
    np.testing.assert_allclose(found.mean[3], clean.mean(axis=0), rtol=1e-9)


LIMITS = "whisker 5 are constant or at their limits"


@pytest.mark.parametrize(
    ("where", "change", "message"),
    [
        (np.s_[:3, 400:440, 3, 1], lambda free: free + 0.1, r"whisker 3.*most of its cycles"),
        (np.s_[:, :, 1, 1], lambda free: free + WAVE, "contacts of whisker 1"),
        (np.s_[:, :, 5, 1], lambda free: 0.2 + 0 * free, LIMITS),
        (np.s_[:, :, 5, 1], lambda free: np.minimum(free, -0.05), LIMITS),
        (np.s_[:, 10, 5, 1], lambda free: -1.5 + 0 * free, LIMITS),
        (np.s_[1, 5, 2], lambda free: free * np.nan, "whisker 2: NaN"),
        (np.s_[:], lambda free: 0 * free, "no whisker has a signal"),
    ],
)
def test_contacts_in_most_of_a_record_and_broken_channels_are_refused(where, change, message):
    refused(record(where=where, change=change), message, REPAIR if "most" in message else CONFIG)


def test_all_whiskers_that_touched_something_are_named_and_one_spike_is_no_contact():
    cycles = record(where=np.s_[2, 400:420, 3], change=lambda free: free + 0.05)
    cycles[1].deflection[:, 5] += WAVE[:, None]
    refused(cycles, "whisker 3: .*% of its samples are further than 6 robust .* whisker 5: .*%")
    assert calibrate(CONFIG, record(where=np.s_[0, 77, 2, 0], change=lambda free: free + 0.5)).alive.all()


def test_dead_whiskers_are_found():
    cycles = record()
    for cycle in cycles:
        cycle.deflection[:, 0] = 0.0
        cycle.angle[:, 4], cycle.deflection[:, 4] = 0.3, 0.1
    found = calibrate(CONFIG, cycles)
    assert found.alive.tolist() == [False, True, True, True, False, True]
    assert np.isinf(found.threshold[[0, 4]]).all()


def test_records_that_cannot_be_used_are_refused():
    refused([], "empty")
    refused(record(count=3), "3 s.*at least 4 s")
    cycles = record()
    cycles[1].angle[5, 2] = np.nan
    refused(cycles, "whisker 2: NaN")
    refused(record(rate=500.0), "500 samples per second.*at least 800")
    assert calibrate(CONFIG, record(rate=500.0), slope_window=0.016).rate == pytest.approx(500)
    first, *others = record()
    refused([first._replace(time=first.time[::-1]), *others], "not increasing")
    cut = [part[np.r_[:400, 450:1000]] for part in first[:3]]
    refused([Cycle(*cut, first.odometry), *others], "a gap of")


@pytest.mark.parametrize("name", Calibration._fields)
def test_fields_read_back_equal_and_missing_ones_and_wrong_shapes_are_refused(name):
    found = calibrate(CONFIG, record())
    stored = found.to_json()
    assert np.array_equal(getattr(Calibration.from_json(stored), name), getattr(found, name))
    with pytest.raises(InputError, match=name):
        Calibration.from_json({key: value for key, value in stored.items() if key != name})
    if name != "alive":
        with pytest.raises(InputError, match=name):
            Calibration.from_json(stored | {name: [0.0] * 7})


def resting(seed=0):
    """[400, 5, 3] white noise of 2 around whisker w's rest at 100 w."""
    return 100.0 * np.arange(5)[:, None] + 2 * stream(seed, "free").standard_normal((400, 5, 3))


@settings(max_examples=15)
@given(st.integers(0, 200), st.integers(0, 4), st.integers(60, 200))
def test_a_resting_record_gives_mean_and_noise_also_when_repaired(seed, whisker, first):
    baseline = calibrate_free(FREE, resting(seed))
    assert baseline.dirty == {}
    np.testing.assert_allclose(baseline.mean[:, 0], 100.0 * np.arange(5), atol=0.6)
    np.testing.assert_allclose(baseline.noise, 2.0, rtol=0.35)
    pressed = resting(seed)
    pressed[:, whisker, 1] += push(400, first, first + 120, 300)[:, 0]
    baseline = calibrate_free(FREE_REPAIR, pressed)
    assert [*baseline.dirty] == [whisker]
    np.testing.assert_allclose(baseline.mean[whisker], 100 * whisker, atol=2.0)
    np.testing.assert_allclose(baseline.noise[whisker], 2.0, rtol=0.45)


def test_contacts_in_a_resting_record_are_refused_with_whisker_and_reason():
    pressed, moving, still = resting(), resting(), resting()
    pressed[:, 3, 1] += push(400, 250, 400, 300)[:, 0]
    moving[:, 1] += 300 * np.sin(np.arange(400) / 7)[:, None]
    reason = r"^(?!.*whisker 2).*whisker 3: its standard deviation is [\d.]+ times its noise"
    with pytest.raises(InputError, match=reason):
        calibrate_free(FREE, pressed)
    with pytest.raises(InputError, match=r"whisker 1: its noise .* no clean stretch"):
        calibrate_free(FREE_REPAIR, moving)
    still[:, :2] = 7.0  # without a signal they are no standard for the others
    assert calibrate_free(FREE, still).dirty == {}


SEEDS, LAW = st.integers(0, 10_000), settings(max_examples=15)


def coloured(seed, length, coefficient=0.45, channels=3):
    """[length, channels] autoregressive noise with standard deviation 1."""
    white = stream(seed, "noise").standard_normal((length + 100, channels))
    return lfilter([np.sqrt(1 - coefficient**2)], [1, -coefficient], white, axis=0)[100:]


def push(length, first, last, size):
    """[length, 1] a contact: rises over the first third, holds, and falls over the last."""
    rise = max((last - first) // 3, 1)
    row = np.arange(length)
    return size * np.clip(np.minimum(row - first, last - row) / rise, 0, 1)[:, None]


@LAW
@given(SEEDS, st.sampled_from([0.0, 0.45, 0.7]), st.floats(1e-6, 1e6), st.floats(-1e3, 1e3))
def test_it_is_the_marginal_sd_of_coloured_noise_at_any_scale_and_level(seed, coefficient, scale, level):
    np.testing.assert_allclose(rest.estimate_noise(coloured(seed, 4000, coefficient)), 1.0, atol=0.12)
    record = coloured(seed, 400)
    noise = rest.estimate_noise(record)
    np.testing.assert_allclose(noise, 1.0, atol=0.34)
    np.testing.assert_allclose(rest.estimate_noise(scale * (record + level)), scale * noise, rtol=1e-6)


@LAW
@given(SEEDS, st.floats(0.02, 0.6), st.floats(0, 0.4), st.floats(1, 1e5))
def test_one_contact_cannot_fool_it(seed, share, start, size):
    length = 2000
    contact = push(length, int(start * length), int((start + share) * length), size)
    noise = rest.estimate_noise(coloured(seed, length) + contact)
    assert ((noise > 0.7) & (noise < 1.5)).all()


@LAW
@given(SEEDS)
def test_a_slow_drift_adds_little(seed):
    still, drift = coloured(seed, 2000), np.linspace(0, 20, 2000)[:, None]
    np.testing.assert_allclose(rest.estimate_noise(still + drift), rest.estimate_noise(still), rtol=0.05)


def test_channels_are_independent_and_a_constant_one_has_no_noise():
    record = np.concatenate([coloured(1, 500), np.full((500, 1), 7.0)], axis=1)
    noise = rest.estimate_noise(record)
    assert noise[3] == 0
    np.testing.assert_array_equal(noise[:3], rest.estimate_noise(record[:, :3]))


@LAW
@given(SEEDS, st.floats(0.02, 0.5))
def test_drift_of_a_random_walk_beneath_noise(seed, rate):
    steps = rate * stream(seed, "walk").standard_normal((40_000, 6))
    drift = rest.estimate_drift(coloured(seed, 40_000, channels=6) + np.cumsum(steps, axis=0))
    assert 0.75 * rate < np.median(drift) < 1.3 * rate
    still = coloured(seed, 20_000) + push(20_000, 4000, 4400, 1e4)  # a contact does not raise it
    assert (rest.estimate_drift(still) < 0.02).all()


@pytest.mark.parametrize("estimate", [rest.estimate_noise, rest.estimate_drift])
def test_short_and_broken_records_are_refused(estimate):
    with pytest.raises(InputError, match="at least"):
        estimate(np.zeros((20, 3)))
    record = coloured(0, 2000)
    record[5, 1] = np.nan
    with pytest.raises(InputError, match="NaN"):
        estimate(record)


WHISKERS, RATE, BLOCK = 5, 200.0, 100
NOISE, COLOUR, DRIFT = 3.0, 0.5, 0.8  # unit, correlation, unit per root second
BASE = np.array([40.0, -7.0, 300.0])


def rig(seed=0):
    walk = np.cumsum(np.random.default_rng(seed).standard_normal((20000, WHISKERS, 3)), axis=0)
    noise = coloured(seed, 20000, COLOUR, 3 * WHISKERS).reshape(walk.shape)
    return BASE + NOISE * noise + walk * DRIFT / np.sqrt(RATE)


def fitted(signal, contact=(0.0,) * WHISKERS):
    names, seconds = tuple(f"w{k}" for k in range(WHISKERS)), BLOCK / RATE
    record = SignalRecord(signal[:4000], signal, BLOCK, seconds, np.array(contact), names, "counts")
    return fit_signals(record)


def test_noise_colour_and_drift_are_found_in_any_unit():
    found, other = fitted(rig()), fitted(1e-3 * rig())
    np.testing.assert_allclose(found.noise, NOISE, rtol=0.1)
    np.testing.assert_allclose(found.white, NOISE * np.sqrt(1 - COLOUR), rtol=0.1)
    np.testing.assert_allclose(found.correlation, COLOUR, atol=0.1)
    assert abs(np.median(found.drift) - DRIFT) < 0.2 * DRIFT
    np.testing.assert_allclose(found.baseline, np.broadcast_to(BASE, (WHISKERS, 3)), atol=6)
    assert not found.dead.any()
    assert found.dirty == {}
    for a, b in zip(found[:3], other[:3], strict=True):
        np.testing.assert_allclose(1e-3 * a, b, rtol=1e-9)
    np.testing.assert_allclose(found.correlation, other.correlation, rtol=1e-9)


def test_dead_and_dirty_whiskers_are_named_and_the_drift_of_one_in_contact_is_unknown():
    signal = rig(2)
    signal[:, 1] = 12.5  # a broken wire
    signal[1000:1800, 3, 0] += 400  # a contact in the free record
    found = fitted(signal, contact=[0, 0.05, 0.3, 0, 0])
    assert np.isnan(found.drift).any(axis=1).tolist() == [False, False, True, False, False]
    assert np.flatnonzero(found.dead).tolist() == [1]
    assert [*found.dirty] == [3]
    assert "standard deviation" in found.dirty[3]
    np.testing.assert_allclose(found.noise[3], NOISE, rtol=0.3)
    assert (found.noise[1] == 0).all()
    with pytest.raises(InputError, match="samples"):
        fitted(rig()[:30])


ASSUMED = HeadConfig()
DELAY_DEG = np.degrees(0.015)  # dead zone of the simulated sensors, which delays contacts


def head(rest, factor):
    rings = tuple(ring.model_copy(update={"radius": factor * ring.radius}) for ring in ASSUMED.rings)
    return HeadConfig(rest_deg=rest, rings=rings)


@cache
def session(true, seed=3):
    settings = {"path": {"explore": 100}, "maze": {"heights": [0.03, 0.05]}, "seed": seed}
    return HeadSimulation(SimulationConfig.model_validate(settings), true)


def fitted_head(true, seed_of_walls=3):
    source, walls = session(true), session(true, seed_of_walls).scene.surroundings.walls
    touches = source.features.contact, source.features.touched
    return fit_head(
        ASSUMED, *touches, lambda config: Surroundings(walls, ur10_head(config)).contact(source.truth).angle
    )


@pytest.mark.parametrize(("rest", "factor"), [(60, 1.2), (75, 1.0)])
def test_the_geometry_is_found(rest, factor):
    true = head(rest, factor)
    (found, _), radii, _, errors = fitted_head(true)
    assert abs(found - rest - DELAY_DEG) < 0.3
    assert radii[0] is None  # the inner ring touches nothing
    for ring, (radius, sd) in zip(true.rings[1:], radii[1:], strict=True):
        assert abs(radius / ring.radius - 1) < 0.01
        assert 0 < sd < 0.01 * ring.radius
    assert errors[0] < 0.02
    assert (rest, factor) == (75, 1.0) or errors[1] > 3 * errors[0]  # with the head that was assumed


def test_wrong_walls_fit_badly_and_few_contacts_are_refused():
    *_, (error, _) = fitted_head(head(60, 1.2), seed_of_walls=4)
    assert error > 0.05
    with pytest.raises(InputError, match="0 contacts"):
        fit_head(ASSUMED, np.zeros((5, 18), bool), np.zeros((5, 18)), lambda config: np.zeros((5, 18)))
