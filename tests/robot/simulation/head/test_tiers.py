"""The raw tiers: mechanics compared with theory, and agreement between the tiers."""

from __future__ import annotations

import numpy as np
import pytest

from robot.simulation.head.beam import StreamConfig, make_beam
from robot.simulation.head.kinematic import HeadSetup, MechanicsConfig
from robot.simulation.head.simulated_session import simulate_dynamic
from robot.simulation.head.whisk_stream import (
    MechanicsModel,
    simulate_cycles,
    simulate_free_cycles,
    simulate_quasistatic,
)
from robot.world.maze import random_loop, random_maze, wall_boxes
from robot.world.scene import HeadPath, MotionConfig, plan_path
from robot.world.walls import Surroundings, Walls
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.types import Cycle, Whisk
from tactile.calibration import Calibration, CalibrationConfig, calibrate
from tactile.contact_threshold import ContactConfig, ShaftConfig, detect_contacts, stiffness
from tactile.whisker_geometry import HeadConfig, ur10_head
from tactile.whisking import WhiskingConfig

HEAD = ur10_head(HeadConfig())
STREAM, MECHANICS, OPEN, RCP = (
    StreamConfig(),
    MechanicsConfig(),
    WhiskingConfig(mode="open"),
    WhiskingConfig(),
)
TIERS = pytest.mark.parametrize("tier", [simulate_quasistatic, simulate_dynamic])


def calibration(
    tier: MechanicsModel, mechanics: MechanicsConfig = MECHANICS, config: StreamConfig = STREAM
) -> Calibration:
    record = simulate_free_cycles(tier, HeadSetup(HEAD, config, mechanics, OPEN), 4, stream(9, "calibration"))
    return calibrate(CalibrationConfig(), record)


def still(wall: Walls) -> tuple[Surroundings, HeadPath]:
    return Surroundings(wall, HEAD), HeadPath(np.array([0.0, 100.0]), np.zeros((2, 3)))


def one(
    tier: MechanicsModel,
    wall: Walls,
    whisking: WhiskingConfig,
    mechanics: MechanicsConfig,
    path: HeadPath | None = None,
) -> Cycle:
    there, stays = still(wall)
    limit = np.full(18, 0.04)
    start, random = np.zeros(1), stream(0, "sensor")
    setup = HeadSetup(HEAD, STREAM, mechanics, whisking)
    return next(simulate_cycles(tier, setup, there, path or stays, start, random, limit))


LOW = Walls(np.array([[-1.0, -1.0, 1.0, 1.0]]), np.array([0.05]))
"""A plate under the head: every whisker touches it with its tip."""


def maze(count: int) -> tuple[Surroundings, HeadPath, np.ndarray]:
    loop = random_loop(4, 3, 8, stream(0, "maze.loop"))
    built = wall_boxes(random_maze(4, 3, loop, 0.6, stream(0, "maze.walls")), stream(0, "maze.heights"))
    return (
        Surroundings(built, HEAD),
        plan_path(MotionConfig(), loop, stream(0, "motion")),
        np.arange(count) * 1.0,
    )


def detected_contacts(
    tier: MechanicsModel, count: int, whisking: WhiskingConfig, rate: float = 2000.0
) -> Whisk:
    config = StreamConfig(rate=rate)
    there, path, start = maze(count)
    known = calibration(tier, config=config)
    setup = HeadSetup(HEAD, config, MECHANICS, whisking)
    raw = simulate_cycles(tier, setup, there, path, start, stream(1, "sensor"), known.threshold[:, 1])
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
    found = calibration(tier)
    np.testing.assert_allclose(found.free, np.radians(65), atol=0.02)
    # Tolerance: the sensor's noise and the inertia of the long whiskers.
    assert (found.sd > 0.97 * 2e-3).all()
    assert (found.sd < 1.25 * 2e-3).all()
    np.testing.assert_allclose(found.mean, 0.0, atol=3e-4)


@TIERS
@pytest.mark.parametrize("servo", [0.2, 1.0])
def test_drive_and_whisker_share_the_command_beyond_contact(tier: MechanicsModel, servo: float) -> None:
    mechanics = MechanicsConfig(servo=servo, noise=0.0, slip=1.0)
    whisking = WhiskingConfig(mode="open", rate=0.25)
    cycle = one(tier, LOW, whisking, mechanics)
    angle = still(LOW)[0].contact(np.zeros((1, 3))).angle[0]
    hard = stiffness(ShaftConfig(), 1.0)
    bend = servo / (servo + hard) * (np.radians(65) - angle)
    half = len(cycle.time) // 2
    np.testing.assert_allclose(cycle.angle[half], angle + bend, atol=0.01)
    np.testing.assert_allclose(cycle.deflection[half, :, 1], hard * bend, atol=0.01)
    assert (np.abs(cycle.deflection[..., 0]) < 1e-9).all()


@TIERS
def test_whiskers_bent_too_far_slip_off(tier: MechanicsModel) -> None:
    cycle = one(tier, LOW, OPEN, MechanicsConfig(noise=0.0, slip=0.1))
    angle = still(LOW)[0].contact(np.zeros((1, 3))).angle[0]
    half = len(cycle.time) // 2
    assert (angle < 0.9).any()
    np.testing.assert_allclose(cycle.angle[half, angle < 0.9], np.radians(65), atol=0.02)
    np.testing.assert_allclose(cycle.deflection[half, angle < 0.9, 1], 0.0, atol=0.02)


@TIERS
def test_feedback_reduces_deflections(tier: MechanicsModel) -> None:
    quiet = MechanicsConfig(noise=0.0, slip=1.0)
    most = [one(tier, LOW, whisking, quiet).deflection[..., 1].max(axis=0) for whisking in (OPEN, RCP)]
    assert (most[1] < 0.8 * most[0]).all()
    assert (most[1] > 0.04).all()


@TIERS
def test_a_moving_head_bends_whiskers_sideways_up_to_the_friction_limit(tier: MechanicsModel) -> None:
    ahead = HeadPath(np.array([0.0, 1.0]), np.array([[0.0, 0, 0], [0.05, 0, 0]]))
    cycle = one(tier, LOW, OPEN, MechanicsConfig(noise=0.0, slip=1.0), ahead)
    x, y = np.abs(cycle.deflection[1000]).T
    across = np.abs(HEAD.swing[:, 1]) > 0.1
    assert (x[across] > 0.01).all()
    assert (x[~across] < 1e-6).all()
    assert (x <= STREAM.beam.friction * y * 1.2 + 1e-9).all()


@TIERS
def test_readings_do_not_depend_on_the_batch_size(tier: MechanicsModel) -> None:
    there, path, start = maze(5)
    limit = np.full(18, 0.04)
    runs = [
        list(simulate_cycles(tier, setup, there, path, start, stream(1, "s"), limit))
        for setup in (HeadSetup(HEAD, StreamConfig(batch=n), MECHANICS, RCP) for n in (2, 5))
    ]
    for a, b in zip(*runs, strict=True):
        assert np.array_equal(a.time, b.time)
        np.testing.assert_allclose(a.angle, b.angle, atol=1e-9)
        np.testing.assert_allclose(a.deflection, b.deflection, atol=1e-9)


@pytest.mark.parametrize(
    "mode", ["open", *(pytest.param(mode, marks=pytest.mark.soak) for mode in ("rcp", "spread"))]
)
def test_both_raw_tiers_agree_on_contacts(mode: str) -> None:
    slow, quick = (
        detected_contacts(tier, 40, WhiskingConfig(mode=mode))
        for tier in (simulate_dynamic, simulate_quasistatic)
    )
    assert slow.contact.mean() > 0.1
    assert (slow.contact != quick.contact).mean() < 0.02
    assert (slow.held != quick.held).mean() < 0.03
    both = slow.contact & quick.contact
    assert np.abs(slow.touched - quick.touched)[both].mean() < 0.015


@TIERS
def test_contacts_do_not_depend_on_the_sample_rate(tier: MechanicsModel) -> None:
    usual = detected_contacts(tier, 16, RCP)
    for rate in (1000.0, 4000.0):
        other = detected_contacts(tier, 16, RCP, rate)
        assert (usual.contact != other.contact).sum() <= 1
        both = usual.contact & other.contact
        off = (usual.touched - other.touched)[both]
        assert np.sqrt((off**2).mean()) < 2e-3 * np.pi * np.radians(65)


def test_feedback_helps_only_with_stiff_drives() -> None:
    def held_contacts(servo: float, whisking: WhiskingConfig) -> np.ndarray:
        mechanics = MechanicsConfig(servo=servo)
        there, path, start = maze(30)
        known = calibration(simulate_quasistatic, mechanics)
        setup, limit = HeadSetup(HEAD, STREAM, mechanics, whisking), known.threshold[:, 1]
        raw = simulate_cycles(simulate_quasistatic, setup, there, path, start, stream(1, "sensor"), limit)
        return np.array([detect_contacts(ContactConfig(), known, cycle).held for cycle in raw])

    soft, stiff = (
        held_contacts(servo, RCP).mean() - held_contacts(servo, OPEN).mean() for servo in (0.3, 3.0)
    )
    assert abs(soft) < 0.03
    assert stiff > 0.05


def test_calibration_finds_dead_whiskers() -> None:
    head = ur10_head(HeadConfig(dead=(3, 7)))
    setup = HeadSetup(head, STREAM, MECHANICS, OPEN)
    record = simulate_free_cycles(simulate_quasistatic, setup, 4, stream(0, "calibration"))
    assert np.flatnonzero(~calibrate(CalibrationConfig(), record).alive).tolist() == [3, 7]


@TIERS
def test_calibration_refuses_a_record_with_contacts(tier: MechanicsModel) -> None:
    there, path, start = maze(6)
    setup = HeadSetup(HEAD, STREAM, MECHANICS, OPEN)
    raw = simulate_cycles(tier, setup, there, path, start, stream(1, "s"), np.full(18, np.inf))
    with pytest.raises(InputError, match="contacts of whisker"):
        calibrate(CalibrationConfig(), list(raw))
