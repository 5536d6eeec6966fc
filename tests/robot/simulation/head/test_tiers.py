"""The raw tiers: mechanics compared with theory, cycles in parts, and agreement between the tiers."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.simulation.head.beam import StreamConfig, make_beam
from robot.simulation.head.kinematic import HeadSetup, MechanicsConfig
from robot.simulation.head.simulated_session import simulate_dynamic
from robot.simulation.head.whisk_stream import (
    MechanicsModel,
    WallSweep,
    advance_balance,
    simulate_cycles,
    simulate_free_cycles,
    simulate_quasistatic,
    whiskers_at_rest,
)
from robot.world.maze import random_loop, random_maze, wall_boxes
from robot.world.scene import HeadPath, MotionConfig, plan_path
from robot.world.walls import NO_CONTACT, Surroundings, Walls
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.types import Cycle, Whisk
from tactile.calibration import Calibration, CalibrationConfig, calibrate
from tactile.contact_threshold import ContactConfig, ShaftConfig, detect_contacts, stiffness
from tactile.whisker_geometry import HeadConfig, ur10_head
from tactile.whisking import WhiskDrive, WhiskingConfig, whisk_command

HEAD = ur10_head(HeadConfig())
STREAM, MECHANICS = StreamConfig(), MechanicsConfig()
OPEN, RCP = WhiskingConfig(mode="open"), WhiskingConfig()
TIERS = pytest.mark.parametrize("tier", [simulate_quasistatic, simulate_dynamic])
LOW = Surroundings(Walls(np.array([[-1.0, -1.0, 1.0, 1.0]]), np.array([0.05])), HEAD)
"""A plate under the head: every whisker touches it with its tip."""
TOUCH = LOW.contact(np.zeros((1, 3))).angle[0]
STILL = HeadPath(np.array([0.0, 100.0]), np.zeros((2, 3)))
LIMIT = np.full(18, 0.04)
SAMPLES, CYCLES = 80, 3


def maze(count: int) -> tuple[Surroundings, HeadPath, np.ndarray]:
    loop = random_loop(4, 3, 8, stream(0, "maze.loop"))
    built = wall_boxes(random_maze(4, 3, loop, 0.6, stream(0, "maze.walls")), stream(0, "maze.heights"))
    path = plan_path(MotionConfig(), loop, stream(0, "motion"))
    return Surroundings(built, HEAD), path, np.arange(count) * 1.0


def calibration(tier: MechanicsModel, setup: HeadSetup) -> Calibration:
    return calibrate(CalibrationConfig(), simulate_free_cycles(tier, setup, 4, stream(9, "calibration")))


def one(tier: MechanicsModel, whisking: WhiskingConfig, path: HeadPath = STILL, **mechanics: float) -> Cycle:
    """A cycle above the plate."""
    setup = HeadSetup(HEAD, STREAM, MechanicsConfig(noise=0.0, **mechanics), whisking)
    return next(simulate_cycles(tier, setup, LOW, path, np.zeros(1), stream(0, "sensor"), LIMIT))


def detected_contacts(
    tier: MechanicsModel,
    count: int,
    whisking: WhiskingConfig,
    rate: float = 2000.0,
    mechanics: MechanicsConfig = MECHANICS,
) -> Whisk:
    setup = HeadSetup(HEAD, StreamConfig(rate=rate), mechanics, whisking)
    known = calibration(tier, setup)
    raw = simulate_cycles(tier, setup, *maze(count), stream(1, "sensor"), known.threshold[:, 1])
    whisks = [detect_contacts(ContactConfig(), known, cycle) for cycle in raw]
    return Whisk(*(np.array(column) for column in zip(*whisks, strict=True)))


@pytest.mark.parametrize("taper", [0.1, 0.2, 0.6])
def test_beam_stiffness_matches_theory_at_its_load_positions(taper: float) -> None:
    model = make_beam(ShaftConfig(taper=taper))
    for reach in (1.0, 0.65):
        shape = model.at(np.array(reach))
        loads = np.linalg.solve(model.stiffness, shape)
        hard = reach**2 / (shape @ loads) / model.unit
        assert hard == pytest.approx(stiffness(ShaftConfig(taper=taper), reach), rel=2e-3)
        assert model.moment @ loads == pytest.approx(reach, rel=2e-3)


def test_an_untapered_whisker_has_the_modes_of_a_cantilever() -> None:
    first, second = make_beam(ShaftConfig(taper=1.0)).modes
    # Two shapes are an upper bound of the stiffness (Rayleigh and Ritz).
    assert 1.8751**2 <= first < 1.01 * 1.8751**2
    assert 4.6941**2 <= second < 1.1 * 4.6941**2


@TIERS
def test_free_whiskers_follow_the_command_without_contact(tier: MechanicsModel) -> None:
    found = calibration(tier, HeadSetup(ur10_head(HeadConfig(dead=(3, 7))), STREAM, MECHANICS, OPEN))
    assert np.flatnonzero(~found.alive).tolist() == [3, 7]
    np.testing.assert_allclose(found.free[found.alive], np.radians(65), atol=0.02)
    # Tolerance: the sensor's noise and the inertia of the long whiskers.
    assert ((found.sd > 0.97 * 2e-3) & (found.sd < 1.25 * 2e-3))[found.alive].all()
    np.testing.assert_allclose(found.mean, 0.0, atol=3e-4)


@TIERS
@pytest.mark.parametrize("servo", [0.2, 1.0])
def test_drive_and_whisker_share_the_command_beyond_contact(tier: MechanicsModel, servo: float) -> None:
    cycle = one(tier, WhiskingConfig(mode="open", rate=0.25), servo=servo, slip=1.0)
    hard = stiffness(ShaftConfig(), 1.0)
    bend = servo / (servo + hard) * (np.radians(65) - TOUCH)
    half = len(cycle.time) // 2
    np.testing.assert_allclose(cycle.angle[half], TOUCH + bend, atol=0.01)
    np.testing.assert_allclose(cycle.deflection[half, :, 1], hard * bend, atol=0.01)
    assert (np.abs(cycle.deflection[..., 0]) < 1e-9).all()


@TIERS
def test_whiskers_bent_too_far_slip_off(tier: MechanicsModel) -> None:
    cycle = one(tier, OPEN, slip=0.1)
    early, half = TOUCH < 0.9, len(cycle.time) // 2
    assert early.any()
    np.testing.assert_allclose(cycle.angle[half, early], np.radians(65), atol=0.02)
    np.testing.assert_allclose(cycle.deflection[half, early, 1], 0.0, atol=0.02)


@TIERS
def test_readings_do_not_depend_on_the_batch_size_and_stay_the_same(tier: MechanicsModel) -> None:
    runs = [
        list(simulate_cycles(tier, setup, *maze(5), stream(1, "s"), LIMIT))
        for setup in (HeadSetup(HEAD, StreamConfig(batch=n), MECHANICS, RCP) for n in (2, 5))
    ]
    for a, b in zip(*runs, strict=True):
        assert np.array_equal(a.time, b.time)
        np.testing.assert_allclose(a.angle, b.angle, atol=1e-9)
        np.testing.assert_allclose(a.deflection, b.deflection, atol=1e-9)
    found = [(abs(c.angle).mean(), *abs(c.deflection).mean(axis=(0, 1))) for c in (runs[1][0], runs[1][4])]
    known = {
        simulate_quasistatic: [[0.5357699, 0.00304992, 0.009217382], [0.5528546, 0.002619151, 0.005415424]],
        simulate_dynamic: [[0.533394, 0.002933946, 0.009578027], [0.5520067, 0.002504011, 0.005603496]],
    }
    np.testing.assert_allclose(found, known[tier], rtol=1e-5)


@pytest.mark.parametrize(
    "mode", ["open", *(pytest.param(mode, marks=pytest.mark.soak) for mode in ("rcp", "spread"))]
)
def test_both_raw_tiers_agree_on_contacts(mode: str) -> None:
    whisking = WhiskingConfig(mode=mode)
    slow, quick = (detected_contacts(tier, 30, whisking) for tier in (simulate_dynamic, simulate_quasistatic))
    assert slow.contact.mean() > 0.1
    assert (slow.contact != quick.contact).mean() < 0.02
    assert (slow.held != quick.held).mean() < 0.03
    both = slow.contact & quick.contact
    assert np.abs(slow.touched - quick.touched)[both].mean() < 0.015


@TIERS
def test_contacts_do_not_depend_on_the_sample_rate(tier: MechanicsModel) -> None:
    usual, other = (detected_contacts(tier, 10, RCP, rate) for rate in (2000.0, 1000.0))
    assert (usual.contact != other.contact).sum() <= 1
    off = (usual.touched - other.touched)[usual.contact & other.contact]
    assert np.sqrt((off**2).mean()) < 2e-3 * np.pi * np.radians(65)


@TIERS
def test_calibration_refuses_a_record_with_contacts(tier: MechanicsModel) -> None:
    setup = HeadSetup(HEAD, STREAM, MECHANICS, OPEN)
    raw = simulate_cycles(tier, setup, *maze(4), stream(1, "s"), np.full(18, np.inf))
    with pytest.raises(InputError, match="contacts of whisker"):
        calibrate(CalibrationConfig(), list(raw))


def sweep() -> WallSweep:
    """Walls that enter, leave and slide."""
    random = stream(0, "walls")
    size = (SAMPLES, CYCLES, 18)
    wall = np.repeat(random.uniform(0.2, 1.4, (8, CYCLES, 18)), SAMPLES // 8, axis=0)
    wall = np.where(random.random((1, CYCLES, 18)) < 0.3, NO_CONTACT, wall)
    noise = 2e-3 * random.standard_normal((CYCLES, SAMPLES, 18, 3))
    reach, drift = random.uniform(0.3, 1.0, size), random.normal(0, 0.2, size)
    return WallSweep(np.arange(SAMPLES) / SAMPLES, wall, reach, drift, noise)


@given(
    st.lists(st.integers(1, SAMPLES - 1), max_size=6, unique=True), st.sampled_from(["open", "rcp", "spread"])
)
def test_a_quasistatic_cycle_in_any_parts_equals_the_whole_to_the_bit(cuts: list[int], mode: str) -> None:
    config, mechanics, whole = StreamConfig(rate=SAMPLES), MechanicsConfig(slip=0.1), sweep()
    whisking = WhiskingConfig(mode=mode)

    def law(drive: WhiskDrive, time: float, reading: np.ndarray) -> tuple[np.ndarray, WhiskDrive]:
        return whisk_command(whisking, drive, time, reading, LIMIT, HEAD.shape)

    start = balance = whiskers_at_rest(CYCLES, 18)
    parts = []
    for first, last in itertools.pairwise([0, *sorted(cuts), SAMPLES]):
        columns = [column[first:last] for column in whole[:-1]]
        piece = WallSweep(*columns, whole.noise[:, first:last])
        found, balance = advance_balance(config, mechanics, law, piece, balance)
        parts.append(found)
    once = simulate_quasistatic(HeadSetup(HEAD, config, mechanics, whisking), whole, LIMIT)
    assert (once[2] > 0).any()
    assert balance.slipped.any()
    assert not start.touching.any()  # a state can be continued twice
    assert not start.slipped.any()
    for k, column in enumerate(once):
        assert np.array_equal(np.concatenate([found[k] for found in parts]), column)
