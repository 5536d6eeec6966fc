"""The raw tiers: mechanics compared with theory, agreement; noise and drift; errors of simulated odometry."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.simulation.head import odometry_errors as reckoning
from robot.simulation.head import whisk_stream
from robot.simulation.head.baseline import HALL_BASELINE, Baseline, BaselineConfig, make_baseline
from robot.simulation.head.beam import StreamConfig, make_beam
from robot.simulation.head.kinematic import HeadSetup, MechanicsConfig
from robot.simulation.head.odometry_errors import OdometryConfig, OdometryErrors
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig, simulate_dynamic
from robot.simulation.head.whisk_stream import MechanicsModel, WallSweep, simulate_cycles
from robot.world.maze import random_loop, random_maze, wall_boxes
from robot.world.scene import HeadPath, MotionConfig, plan_path
from robot.world.walls import NO_CONTACT, Surroundings, Walls
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import between, integrate, wrap
from tactile.base.types import Cycle, Whisk
from tactile.calibration import Calibration, CalibrationConfig, calibrate
from tactile.contact_threshold import ContactConfig, ShaftConfig, detect_contacts, stiffness
from tactile.frontend import Frontend, TouchConfig
from tactile.whisker_geometry import HeadConfig, ur10_head
from tactile.whisking import WhiskDrive, WhiskingConfig, whisk_command

HEAD = ur10_head(HeadConfig())
STREAM, MECHANICS = StreamConfig(), MechanicsConfig()
OPEN, RCP = WhiskingConfig(mode="open"), WhiskingConfig()
QUASISTATIC = whisk_stream.simulate_quasistatic
TIERS = pytest.mark.parametrize("tier", [QUASISTATIC, simulate_dynamic])
LOW = Surroundings(Walls(np.array([[-1.0, -1.0, 1.0, 1.0]]), np.array([0.05])), HEAD)
"""A plate under the head: every whisker touches it with its tip."""
TOUCH = LOW.contact(np.zeros((1, 3))).angle[0]
STILL = HeadPath(np.array([0.0, 100.0]), np.zeros((2, 3)))
LIMIT = np.full(18, 0.04)
SAMPLES, CYCLES, NOISE = 80, 3, 2e-3
KINDS = ("white", "gated", "telescoping")


def maze(count: int) -> tuple[Surroundings, HeadPath, np.ndarray]:
    loop = random_loop(4, 3, 8, stream(0, "maze.loop"))
    built = wall_boxes(random_maze(4, 3, loop, 0.6, stream(0, "maze.walls")), stream(0, "maze.heights"))
    path = plan_path(MotionConfig(), loop, stream(0, "motion"))
    return Surroundings(built, HEAD), path, np.arange(count) * 1.0


def calibration(tier: MechanicsModel, setup: HeadSetup) -> Calibration:
    record = whisk_stream.simulate_free_cycles(tier, setup, 4, stream(9, "calibration"))
    return calibrate(CalibrationConfig(), record)


def one(tier: MechanicsModel, whisking: WhiskingConfig, path: HeadPath = STILL, **mechanics: float) -> Cycle:
    setup = HeadSetup(HEAD, STREAM, MechanicsConfig(noise=0.0, **mechanics), whisking)
    return next(simulate_cycles(tier, setup, LOW, path, np.zeros(1), stream(0, "sensor"), LIMIT))


def detected_contacts(tier: MechanicsModel, count: int, whisking: WhiskingConfig, rate=2000.0) -> Whisk:
    setup = HeadSetup(HEAD, StreamConfig(rate=rate), MECHANICS, whisking)
    known = calibration(tier, setup)
    raw = simulate_cycles(tier, setup, *maze(count), stream(1, "sensor"), known.threshold[:, 1])
    whisks = [detect_contacts(ContactConfig(), known, cycle) for cycle in raw]
    return Whisk(*(np.array(column) for column in zip(*whisks, strict=True)))


def test_a_beam_has_the_stiffness_of_theory_and_the_modes_of_a_cantilever():
    for taper, reach in itertools.product((0.1, 0.2, 0.6), (1.0, 0.65)):
        model = make_beam(ShaftConfig(taper=taper))
        shape = model.at(np.array(reach))
        loads = np.linalg.solve(model.stiffness, shape)
        hard = reach**2 / (shape @ loads) / model.unit
        assert hard == pytest.approx(stiffness(ShaftConfig(taper=taper), reach), rel=2e-3)
        assert model.moment @ loads == pytest.approx(reach, rel=2e-3)
    first, second = make_beam(ShaftConfig(taper=1.0)).modes
    # Two shapes are an upper bound of the stiffness (Rayleigh and Ritz).
    assert 1.8751**2 <= first < 1.01 * 1.8751**2
    assert 4.6941**2 <= second < 1.1 * 4.6941**2


@TIERS
def test_free_whiskers_follow_the_command_and_calibration_refuses_contacts(tier):
    found = calibration(tier, HeadSetup(ur10_head(HeadConfig(dead=(3, 7))), STREAM, MECHANICS, OPEN))
    assert np.flatnonzero(~found.alive).tolist() == [3, 7]
    np.testing.assert_allclose(found.free[found.alive], np.radians(65), atol=0.02)
    # Tolerance: the sensor's noise and the inertia of the long whiskers.
    assert ((found.sd > 0.97 * 2e-3) & (found.sd < 1.25 * 2e-3))[found.alive].all()
    np.testing.assert_allclose(found.mean, 0.0, atol=3e-4)
    setup = HeadSetup(HEAD, STREAM, MECHANICS, OPEN)
    raw = simulate_cycles(tier, setup, *maze(4), stream(1, "s"), np.full(18, np.inf))
    with pytest.raises(InputError, match="contacts of whisker"):
        calibrate(CalibrationConfig(), list(raw))


@TIERS
def test_drive_and_whisker_share_the_command_beyond_contact_until_it_slips_off(tier):
    for servo in (0.2, 1.0):
        cycle = one(tier, WhiskingConfig(mode="open", rate=0.25), servo=servo, slip=1.0)
        hard = stiffness(ShaftConfig(), 1.0)
        bend, half = servo / (servo + hard) * (np.radians(65) - TOUCH), len(cycle.time) // 2
        np.testing.assert_allclose(cycle.angle[half], TOUCH + bend, atol=0.01)
        np.testing.assert_allclose(cycle.deflection[half, :, 1], hard * bend, atol=0.01)
        assert (np.abs(cycle.deflection[..., 0]) < 1e-9).all()
    cycle = one(tier, OPEN, slip=0.1)
    early, half = TOUCH < 0.9, len(cycle.time) // 2
    assert early.any()
    np.testing.assert_allclose(cycle.angle[half, early], np.radians(65), atol=0.02)
    np.testing.assert_allclose(cycle.deflection[half, early, 1], 0.0, atol=0.02)


@TIERS
def test_readings_do_not_depend_on_the_batch_size_and_stay_the_same(tier):
    setups = [HeadSetup(HEAD, StreamConfig(batch=n), MECHANICS, RCP) for n in (2, 5)]
    runs = [list(simulate_cycles(tier, setup, *maze(5), stream(1, "s"), LIMIT)) for setup in setups]
    for a, b in zip(*runs, strict=True):
        for part in ("time", "angle", "deflection"):
            np.testing.assert_allclose(getattr(a, part), getattr(b, part), rtol=0, atol=1e-9)
    found = [(abs(c.angle).mean(), *abs(c.deflection).mean(axis=(0, 1))) for c in (runs[1][0], runs[1][4])]
    known = {
        QUASISTATIC: [[0.5357699, 0.00304992, 0.009217382], [0.5528546, 0.002619151, 0.005415424]],
        simulate_dynamic: [[0.533394, 0.002933946, 0.009578027], [0.5520067, 0.002504011, 0.005603496]],
    }
    np.testing.assert_allclose(found, known[tier], rtol=1e-5)


SOAK_MODES = [pytest.param(mode, marks=pytest.mark.soak) for mode in ("rcp", "spread")]


@pytest.mark.parametrize("mode", ["open", *SOAK_MODES])
def test_both_raw_tiers_agree_on_contacts(mode):
    whisking = WhiskingConfig(mode=mode)
    slow, quick = (detected_contacts(tier, 30, whisking) for tier in (simulate_dynamic, QUASISTATIC))
    assert slow.contact.mean() > 0.1
    assert (slow.contact != quick.contact).mean() < 0.02
    assert (slow.held != quick.held).mean() < 0.03
    assert np.abs(slow.touched - quick.touched)[slow.contact & quick.contact].mean() < 0.015


@TIERS
def test_contacts_do_not_depend_on_the_sample_rate(tier):
    usual, other = (detected_contacts(tier, 10, RCP, rate) for rate in (2000.0, 1000.0))
    assert (usual.contact != other.contact).sum() <= 1
    off = (usual.touched - other.touched)[usual.contact & other.contact]
    assert np.sqrt((off**2).mean()) < 2e-3 * np.pi * np.radians(65)


def sweep() -> WallSweep:
    """Walls that enter, leave and slide."""
    random = stream(0, "walls")
    size = (SAMPLES, CYCLES, 18)
    wall = np.repeat(random.uniform(0.2, 1.4, (8, CYCLES, 18)), SAMPLES // 8, axis=0)
    wall = np.where(random.random((1, CYCLES, 18)) < 0.3, NO_CONTACT, wall)
    noise = 2e-3 * random.standard_normal((CYCLES, SAMPLES, 18, 3))
    reach, drift = random.uniform(0.3, 1.0, size), random.normal(0, 0.2, size)
    return WallSweep(np.arange(SAMPLES) / SAMPLES, wall, reach, drift, noise)


CUTS = st.lists(st.integers(1, SAMPLES - 1), max_size=6, unique=True)


@given(CUTS, st.sampled_from(["open", "rcp", "spread"]))
def test_a_quasistatic_cycle_in_any_parts_equals_the_whole_to_the_bit(cuts, mode):
    config, mechanics, whole = StreamConfig(rate=SAMPLES), MechanicsConfig(slip=0.1), sweep()
    whisking = WhiskingConfig(mode=mode)

    def law(drive: WhiskDrive, time: float, reading: np.ndarray) -> tuple[np.ndarray, WhiskDrive]:
        return whisk_command(whisking, drive, time, reading, LIMIT, HEAD.shape)

    start = balance = whisk_stream.whiskers_at_rest(CYCLES, 18)
    parts = []
    for first, last in itertools.pairwise([0, *sorted(cuts), SAMPLES]):
        piece = WallSweep(*[column[first:last] for column in whole[:-1]], whole.noise[:, first:last])
        found, balance = whisk_stream.advance_balance(config, mechanics, law, piece, balance)
        parts.append(found)
    once = QUASISTATIC(HeadSetup(HEAD, config, mechanics, whisking), whole, LIMIT)
    assert (once[2] > 0).any()
    assert balance.slipped.any()
    assert not (start.touching | start.slipped).any()  # a state can be continued twice
    for k, column in enumerate(once):
        assert np.array_equal(np.concatenate([found[k] for found in parts]), column)


def drive_and_turn(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Repeats 20 s ahead at 30 mm/s and 5 s of turning on the spot at 0.4 rad/s."""
    turns = np.arange(count) % 25 >= 20
    motion = np.column_stack([np.where(turns, 0, 0.03), np.zeros(count), np.where(turns, 0.4, 0)])
    motion[0] = 0
    pose = integrate(motion)
    pose[:, 2] = np.cumsum(motion[:, 2])
    return np.arange(count, dtype=float), pose


def measured(scene: tuple[np.ndarray, np.ndarray], seed=0, hidden=None, **config) -> np.ndarray:
    return reckoning.simulate_odometry(OdometryConfig(**config), *scene, stream(seed, "odometry"), hidden)


def errors(kind: str, scene: tuple[np.ndarray, np.ndarray], seed: int = 0, **biases: float) -> np.ndarray:
    """[N - 1, 3] measured motion minus true motion."""
    error = measured(scene, seed, noise=kind, **biases)[1:, :3] - between(scene[1][:-1], scene[1][1:])
    return np.column_stack([error[:, :2], wrap(error[:, 2])])


def test_errors_of_each_kind_follow_from_their_seed():
    assert np.abs(errors("none", drive_and_turn(100))).max() < 1e-12
    known = {
        "white": [[-0.073578, 0.108129], [-0.083586, -0.004056], [-0.011004, -0.447488]],
        "gated": [[-0.073578, 0.042215], [-0.073578, -0.069970], [-0.015004, -0.179417]],
        "telescoping": [[0.002793, 0.224927], [0.006571, 0.039339], [0.043138, 0.210314]],
        "none": [[0.017395, 0.042215], [0.017395, 0.042215], [0.044861, 0.108869]],
    }
    for kind, sums in known.items():
        error = errors(kind, drive_and_turn(60), 3, length_bias=0.02, heading_bias=0.1)
        np.testing.assert_allclose(np.cumsum(error[:, [0, 2]], axis=0)[[18, 22, 58]], sums, atol=1e-6)


def test_noise_does_not_depend_on_the_row_rate_and_a_kidnap_repeats_the_motion_before():
    time, pose = drive_and_turn(200)
    fine = np.arange(0, 199.5, 0.5)
    finely = np.column_stack([np.interp(fine, time, column) for column in pose.T])
    for kind in KINDS:
        coarse, halves = errors(kind, (time, pose)), errors(kind, (fine, finely))
        assert np.allclose(halves[:, [0, 2]].reshape(-1, 2, 2).sum(axis=1), coarse[:, [0, 2]], atol=1e-9)
    time, pose = drive_and_turn(100)
    pose[50:] += [0.7, -0.4, 2.0]
    noisy = measured((time, pose), hidden=np.arange(100) == 50, noise="none")
    plain = measured((time, pose), noise="none")
    assert np.allclose(noisy[50, :3], noisy[49, :3])
    assert np.hypot(*plain[50, :2]) > 0.5
    assert (np.delete(noisy, 50, 0) == np.delete(plain, 50, 0)).all()


RATES = st.sampled_from([0.3, 1.0, 3.7])


@given(st.integers(0, 10**6), st.sampled_from([*KINDS, "none"]), RATES, st.floats(0.2, 2.5))
def test_errors_of_a_growing_path_are_those_of_the_path_so_far(seed, kind, rate, period):
    """To the bit, whatever follows: a live session gives its motions one by one. Row 0 sets the clock."""
    given = {"noise": kind, "rate": rate, "length_bias": 0.02, "heading_bias": 0.1}
    _, pose = drive_and_turn(30)
    time = 0.4 + np.cumsum(period * stream(seed, "times").uniform(0.5, 1.0, len(pose)))
    growing = OdometryErrors(OdometryConfig(**given), stream(seed, "odometry"))
    for row in range(len(pose)):
        whole = measured((time[: row + 1], pose[: row + 1]), seed, **given)
        assert (whole[0] == 0).all()
        if row:
            motion = reckoning.motions_between(pose[row - 1 : row + 1])
            (step,) = growing.add_to(time[row - 1 : row + 1], motion)
            assert (*step, time[row] - time[row - 1]) == tuple(whole[-1]), row


@given(st.floats(0.001, 0.5), st.floats(0.05, 3), st.sampled_from([200.0, 2000.0]), st.floats(-1, 1))
def test_creep_tends_to_its_share_of_a_deflection_and_returns_to_zero(share, time, rate, bend):
    whisker = Baseline(BaselineConfig(creep=share, creep_time=time), NOISE, rate, 1, 0)
    count = round(rate * time)
    bent = whisker.wander(np.full((1, count, 1, 2), bend))[0, :, 0, 0]
    grown = share * bend * (1 - np.exp(-count / (rate * time)))
    assert bent[-1] == pytest.approx(grown)
    after = whisker.wander(np.zeros((1, 12 * count, 1, 2)))[0, :, 0, 0]
    assert after[count - 1] == pytest.approx(grown * np.exp(-count / (rate * time)))
    assert (np.diff(np.abs(after)) <= 0).all()


@given(st.lists(st.integers(1, 119), max_size=6, unique=True))
def test_the_parts_into_which_the_samples_are_cut_make_no_difference(cuts):
    deflection = stream(1, "bends").standard_normal((1, 120, 2, 2))

    def samples(ends: list[int]) -> np.ndarray:
        made = make_baseline(HALL_BASELINE, NOISE, 100.0, 2, 5)
        assert made is not None
        parts = [deflection[:, a:b] for a, b in itertools.pairwise([0, *sorted(ends), 120])]
        return np.concatenate([made.colour(part) + made.wander(part) for part in parts], axis=1)

    assert np.array_equal(samples(cuts), samples([]))
    assert make_baseline(BaselineConfig(), NOISE, 2000.0, 18, 0) is None


def simulate(baseline: BaselineConfig, **changes: object) -> HeadSimulation:
    slow = {"path": {"explore": 4.0}, "stream": {"rate": 1000.0}, "whisking": {"mode": "open"}}
    mechanics = {"mechanics": {"baseline": baseline.model_dump()}}
    return HeadSimulation(SimulationConfig.model_validate(slow | mechanics | changes))


def bends(source: HeadSimulation) -> np.ndarray:
    return np.array([sample.reading.deflection for sample in source])


@pytest.mark.parametrize("fidelity", ["quasistatic", "dynamic"])
def test_a_baseline_reaches_the_deflections_of_a_session_and_nothing_else(fidelity):
    source, plain = (simulate(one, fidelity=fidelity) for one in (HALL_BASELINE, BaselineConfig()))
    for with_it, without in zip(source, plain, strict=True):
        assert np.array_equal(with_it.reading.angle, without.reading.angle)
        assert (np.abs(with_it.reading.deflection - without.reading.deflection).max(axis=0) > NOISE).all()
    assert np.array_equal(source.odometry, plain.odometry)
    assert np.array_equal(source.truth, plain.truth)
    assert np.array_equal(bends(source), bends(source))
    cut = simulate(HALL_BASELINE, fidelity=fidelity, stream={"rate": 1000.0, "batch": 2})
    assert np.array_equal(bends(cut), bends(source))


def test_drift_goes_on_through_the_free_record_and_from_whisk_to_whisk():
    source = simulate(BaselineConfig(drift=100.0), calibration={"max_outlier_share": 0.9})
    drift = bends(source) - bends(simulate(BaselineConfig(), raw=True))
    assert (drift[1:, 0] - drift[:-1, -1]).std() < 0.1 * (drift[:, -1] - drift[:, 0]).std()
    # After 4 s of free record the drift has 2 sd of a second.
    assert drift[0, 0].std() == pytest.approx(2 * 100 * NOISE, rel=0.5)


def test_a_seed_gives_the_same_noise_and_drift_for_ever():
    made = make_baseline(HALL_BASELINE, NOISE, 100.0, 200, 5)
    assert made is not None
    colour = made.colour(NOISE * stream(5, "sensor").standard_normal((1, 400, 200, 2))) / NOISE
    drift = made.wander(np.zeros((1, 400, 200, 2)))[0, -1] / NOISE
    assert colour.std() == pytest.approx(1, rel=0.02)
    correlation = (colour[0, 1:] * colour[0, :-1]).mean()
    assert correlation == pytest.approx(np.exp(-0.01 / HALL_BASELINE.colour_time), abs=0.02)
    assert drift.std() == pytest.approx(HALL_BASELINE.drift * np.sqrt(4.0), rel=0.1)
    np.testing.assert_allclose([colour[0, 9, 3, 1], drift[3, 1]], [0.150775, 0.825184], atol=1e-6)


def test_a_baseline_that_follows_holds_in_the_field_of_the_earth_and_that_of_the_calibration_does_not():
    """On a route that turns in every cell, against the same session without a field."""

    def contacts(field: float) -> list[np.ndarray]:
        parts = {"maze": {"loop": 4}, "path": {"circuits": "C"}, "mechanics": {"baseline": {"field": field}}}
        source = HeadSimulation(SimulationConfig.model_validate({"raw": True} | parts))
        cycles = [sample.reading for sample in source]
        heads = [Frontend(touch, source.calibration) for touch in (TouchConfig(), TouchConfig(baseline=None))]
        return [np.array([head.features(cycle).contact for cycle in cycles]) for head in heads]

    (free, _), threshold = contacts(0.0), ContactConfig().contact_sds
    for strength in (0.5, 2.0):
        tracked, calibrated = ((found != free).mean() for found in contacts(strength * threshold))
        assert tracked < 0.002
        assert strength < 1 or calibrated > 5 * max(tracked, 0.01)
