"""Pokes: the law of contact, the arm that pokes in virtual time, and what it records."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10 import rtde_process
from robot.emulators.ur10.emulator_config import WallConfig
from robot.live import live_rig
from robot.live.arm_route import arm_routes, plan_path, plan_scene
from robot.live.live_config import LiveConfig
from robot.live.live_emulator_config import arm_emulator_config
from robot.live.live_rig import ArmRig
from robot.live.poke_loop import learn_free_pokes, poke_targets, run_poke_loop
from robot.live.polling import SessionFault
from robot.live.recorder import LiveRecorder
from robot.live.whisk_loop import follow_route
from robot.recordings.mcap_reader import Recording
from robot.recordings.mcap_writer import Recorder
from robot.simulation.head.simulated_pokes import PokeSimulation, feel, simulate_pokes
from robot.simulation.head.simulated_session import SimulationConfig
from robot.sources.source import SourceDescription
from robot.world.contact_force import ContactForceConfig, force_error, free_way, wall_distance
from robot.world.maze import table_maze
from tactile.base.errors import InputError
from tactile.base.types import Odometry
from tactile.frontend import TouchConfig, touched_points
from tactile.pokes import PokeConfig, force_rise, is_loaded, learn_threshold, poke_angles, poke_observation
from tactile.whisker_geometry import HeadConfig, ur10_head
from tests.helpers.virtual_arm import VirtualArm, in_virtual_time

HEAD, HZ = ur10_head(HeadConfig()), 125
QUICK = PokeConfig(directions=4, reach=0.095, every=0.05, speed=0.05)
boxes = st.lists(st.tuples(*[st.floats(-1, 1)] * 2, *[st.floats(0.01, 0.5)] * 2), min_size=1, max_size=5).map(
    lambda rows: np.array([(x, y, x + w, y + h) for x, y, w, h in rows])
)


@given(st.lists(st.floats(-30, 30), min_size=1, max_size=400))
def test_the_rise_is_the_newest_mean_less_the_one_before(values):
    push, config = np.array(values), PokeConfig()
    rise, late = force_rise(config, push, HZ), len(values) - 31
    assert rise.shape == push.shape
    expected = 0.0
    if late >= 4 * 5:  # 0.04 s are 5 states; the base ends 0.25 s before the newest state
        expected = push[-5:].mean() - push[max(late - 125, 0) : late].mean()
    assert rise[-1] == pytest.approx(expected, abs=1e-9)
    assert force_rise(config, push[:200], HZ) == pytest.approx(rise[:200], abs=1e-9)


@given(boxes, st.tuples(st.floats(-2, 2), st.floats(-2, 2)))
def test_the_distance_from_walls_is_that_of_their_nearest_point(walls, place):
    gap, outwards = wall_distance(walls, np.array(place))
    nearest = np.clip(place, walls[:, :2], walls[:, 2:])
    away = np.hypot(*(nearest - place).T)
    if away.min() > 1e-9:
        assert gap == pytest.approx(away.min())
        assert min(np.hypot(*(place - gap * outwards - point)) for point in nearest) < 1e-6
    else:
        assert gap <= 1e-9
    assert np.hypot(*outwards) == pytest.approx(1.0)


@given(boxes, st.tuples(st.floats(-2, 2), st.floats(-2, 2)), st.floats(-4, 4))
def test_a_tool_moves_up_to_the_first_wall(walls, start, angle):
    along = np.array([np.cos(angle), np.sin(angle)])
    way = float(free_way(walls, 0.005, np.array([start]), np.array([[angle]]), 1.0)[0, 0])
    steps = np.linspace(0.0, min(way, 1.0), 50, endpoint=False)
    gaps = wall_distance(walls, np.array(start) + steps[:, None] * along)[0]
    assert (gaps[steps < way - 1e-3] >= 0.005 - 1e-5).all()
    if np.isfinite(way):
        assert wall_distance(walls, np.array(start) + way * along)[0] <= 0.005 + 1e-4


def test_a_force_too_uneven_for_a_third_of_the_limit_is_refused():
    random, config = np.random.default_rng(0), PokeConfig()
    for noise, limit, allowed in ((1.0, 30.0, True), (1.0, 6.0, False), (0.0, 30.0, True)):
        free = [noise * random.standard_normal(2000) for _ in range(6)]
        if allowed:
            threshold = learn_threshold(config, free, HZ, limit)
            assert limit / 30 <= threshold <= limit / 3
            assert not any((force_rise(config, push, HZ) > threshold).any() for push in free)
        else:
            with pytest.raises(InputError, match=r"a third of live\.arm\.force_limit"):
                learn_threshold(config, free, HZ, limit)


@given(st.floats(0, 0.269), st.integers(0, 5))
def test_an_image_holds_the_depth_bin_of_each_contact(depth, direction):
    config, contact = PokeConfig(), np.arange(6) == direction
    seen = poke_observation(config, np.where(contact, depth, 0.27), contact, Odometry(0.0, 0.0, 0.0, 0.0))
    assert seen.view.shape == (1, 6, 1)
    assert np.flatnonzero(seen.view).tolist() == [direction]
    assert abs(seen.view[0, direction, 0] * config.reach - depth) <= config.reach / config.bins / 2 + 1e-9
    reached = np.array([np.cos(direction * np.pi / 3), np.sin(direction * np.pi / 3)]) * (
        depth + config.radius
    )
    assert np.allclose(seen.point[direction], reached)


@pytest.mark.parametrize("stiffness", [1000.0, 5000.0, 20_000.0])
def test_simulated_pokes_touch_walls_and_nothing_else(stiffness):
    config, random = PokeConfig(), np.random.default_rng(1)
    count, force = 150, ContactForceConfig(stiffness=stiffness)
    place, angle = random.uniform(-1, 1, (count, 2)), random.uniform(-3, 3, (count, 1)) + poke_angles(config)
    way = np.where(random.random((count, 6)) < 0.5, random.uniform(0.01, 0.26, (count, 6)), np.inf)
    free = simulate_pokes(config, force, place[:1], angle[:1], np.full((1, 6), np.inf), random)[1][0]
    threshold = learn_threshold(config, list(free), HZ, 30.0)
    depth, contact = feel(config, *simulate_pokes(config, force, place, angle, way, random), threshold, 30.0)
    assert not (contact & np.isinf(way)).any()
    assert (~contact & (way < config.reach - 0.01)).mean() < 0.001
    late = (depth - way)[contact]
    assert late.min() > 0
    assert np.median(late) < (0.006 if stiffness < 5000 else 0.002)


def test_a_simulated_session_is_drawn_from_its_seed():
    config = SimulationConfig(touch="force", path={"circuits": "C"}, seed=3)
    with pytest.raises(InputError, match="pokes have no whiskers"):
        PokeSimulation(config.model_copy(update={"raw": True}), QUICK)
    once, again, other = (PokeSimulation(config.model_copy(update={"seed": k}), QUICK) for k in (3, 3, 4))
    assert once.digest == again.digest != other.digest
    first, second = list(once), list(again)
    assert all(np.array_equal(a.reading.view, b.reading.view) for a, b in zip(first, second, strict=True))
    assert all(a.time < b.time for a, b in pairwise(first))
    assert once.view_shape == first[0].reading.view.shape
    assert once.whiskers == 4


def session_of(monkeypatch, pokes=QUICK, circuits="C", rings=None, **force):
    """An arm above the start of its route in virtual time: rig, route and the walls [B, 4] around it."""
    plan = {"path": {"circuits": circuits}, "force": force, "seed": 5}
    arm = {"touch": "force", "placing": {"yaw_deg": 0.0}}
    config = LiveConfig.model_validate({"arm": arm, "plan": plan, "whisks": rings})
    emulated = arm_emulator_config(config, HeadConfig(), radius=pokes.radius)
    monkeypatch.setattr(VirtualArm, "emulated", emulated)
    monkeypatch.setattr(live_rig, "Arm", VirtualArm)
    rig = ArmRig(config, lambda: False)
    arm = in_virtual_time(monkeypatch, rig)
    arm.start()
    approach, descent, route = arm_routes(config, plan_path(config, HEAD))
    follow_route(rig, approach)
    threshold = learn_free_pokes(rig, pokes)
    follow_route(rig, descent)
    return rig, route, threshold, plan_scene(config.plan, HEAD).surroundings.walls.box


class _Offered(list):
    """A mapper that only keeps what it is offered."""

    alive, failure = True, ""

    def behind(self):
        return 0.0

    def offer(self, sample, begins=False):
        self.append(sample)


def poke_along(monkeypatch, rings, pokes=QUICK, recorder=None, **force):
    """Pokes a number of rings; returns the reports, what was offered, and the true ways [N, D] to walls."""
    rig, route, threshold, walls = session_of(monkeypatch, pokes, "CCC", rings, **force)
    reports, offered = [], _Offered()
    with rig:
        rig.recorder = recorder
        run_poke_loop(rig, route, offered, pokes, threshold, reports.append)
    pose = np.array([report.pose for report in reports])
    way = free_way(walls, pokes.radius, pose[:, :2], pose[:, 2:] + poke_angles(pokes), pokes.reach)
    return reports, offered, way


def counts(reports, way, pokes=QUICK):
    """Number of pokes that touched nothing, and that missed a wall, and of walls."""
    contact = np.array([report.contact for report in reports])
    depth = np.array([report.depth for report in reports])
    assert (np.abs(depth - way)[contact] < 0.012).all()
    near = way < pokes.reach - 0.006
    return int((contact & np.isinf(way)).sum()), int((~contact & near).sum()), int(near.sum())


def test_forty_rings_touch_the_walls_and_their_recording_holds_them(monkeypatch, tmp_path):
    source = SourceDescription((1, 4, 1), 4)
    path = tmp_path / "session.mcap"
    with LiveRecorder(Recorder(path, source)) as recorder:
        reports, offered, way = poke_along(monkeypatch, 40, recorder=recorder)
    assert len(reports) == len(offered) == 40
    false, missed, walls = counts(reports, way)
    assert false == 0
    assert walls > 30
    assert missed <= 0.01 * walls
    with Recording(path) as recorded:
        replayed = list(recorded)
    assert len(replayed) == 40
    for ours, theirs in zip(offered, replayed, strict=True):
        assert ours.time == theirs.time
        assert np.array_equal(ours.truth, theirs.truth)
        for a, b in zip(ours.reading, theirs.reading, strict=True):
            assert np.array_equal(np.asarray(a), np.asarray(b))


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("stiffness", "share"), [(1000.0, 0.03), (5000.0, 0.01), (20_000.0, 0.01)])
def test_two_thousand_pokes(monkeypatch, stiffness, share):
    """Of soft walls, those are missed that the tool only grazes."""
    pokes = PokeConfig(reach=0.15)
    reports, _, way = poke_along(monkeypatch, 112, pokes, stiffness=stiffness)
    false, missed, walls = counts(reports, way, pokes)
    print(f"stiffness {stiffness:g} N/m, {6 * len(reports)} pokes: false {false}, missed {missed} of {walls}")
    assert false == 0
    assert missed <= share * walls


def press(monkeypatch, number):
    """A poke into a wall so hard, or so fast, that the force limit is exceeded; returns arm and outcome."""
    random = np.random.default_rng(number)
    stiffness = float(10 ** random.uniform(4.8, 5.1)) if number % 2 else float(random.uniform(3200, 6000))
    pokes = QUICK.model_copy(update={"reach": 0.12, "speed": 0.02 if number % 2 else 0.05})
    rig, route, threshold, _ = session_of(monkeypatch, pokes, "C", 20, stiffness=stiffness)
    arm = rig.arm
    if number % 2 == 0:  # a soft wall whose contact the law does not see
        threshold = float("inf")
        monkeypatch.setattr(rtde_process, "is_loaded", lambda push, limit: np.zeros(1, bool))
    with rig:
        with pytest.raises(SessionFault) as ended:
            run_poke_loop(rig, route, _Offered(), pokes, threshold, lambda ring: None)
        arm.sleep(2.0)  # what follows the fault: the retreat
        return ended.value.fault.outcome, arm.still(), np.linalg.norm(arm.latest()["force"][:2])


@pytest.mark.parametrize(
    "number", [0, 1, 2, 3, *(pytest.param(k, marks=pytest.mark.soak) for k in range(4, 100))]
)
def test_a_poke_that_reaches_the_force_limit_ends_the_session_after_a_retreat(monkeypatch, number):
    outcome, rested, force = press(monkeypatch, number)
    assert outcome is SessionOutcome.CONTACT
    assert rested
    assert force < 10.0  # free of the wall


def test_pokes_end_at_the_box():
    config = LiveConfig().arm
    centre = config.placing.tcp_from_pose(np.array([0.09, 0.09, 0.3]))
    for target in poke_targets(config, PokeConfig(), centre):
        assert config.box.contains(target)
        assert np.linalg.norm(target[:2] - centre[:2]) <= 0.27 + 1e-9
        assert np.array_equal(target[2:], centre[2:])


def test_the_error_of_the_force_has_its_amplitude():
    config = ContactForceConfig(drift=2.0, payload=0.2)
    error = force_error(config, np.random.default_rng(0).uniform(-2, 2, (4000, 3)))
    assert np.abs(error[:, :2]).max() == pytest.approx(2.0, rel=0.01)
    assert error[:, 2].mean() == pytest.approx(-0.2 * 9.81, abs=0.1)
    assert not is_loaded(error[:100, 0], 30.0).any()


@pytest.mark.parametrize(
    ("fault", "outcome"),
    [
        ("protective_stop", SessionOutcome.PROTECTIVE_STOP),
        ("safeguard_stop", SessionOutcome.SAFEGUARD_STOP),
        ("emergency_stop", SessionOutcome.EMERGENCY_STOP),
        ("nan", SessionOutcome.ARM_MALFORMED),
        ("freeze", SessionOutcome.CLOCK_JUMPED),
        ("ik_fails", SessionOutcome.UNREACHABLE),
        ("wall", SessionOutcome.CONTACT),
    ],
)
def test_a_fault_of_the_arm_while_it_pokes_is_named(monkeypatch, fault, outcome):
    rig, route, threshold, _ = session_of(monkeypatch, QUICK, "C", 20)
    arm, reports = rig.arm, []

    def strike():
        controller, moving = arm.controller, np.linalg.norm(arm.latest()["speed"][:3]) > 0.01
        if len(reports) != 1 or not moving or controller.targets:
            return False
        controller.targets.append({})  # once
        if fault == "nan":
            arm.spoil = lambda state: state["tcp"].fill(np.nan)
        elif fault == "freeze":
            arm.spoil = lambda state: state["robot"].fill(1.0)
        elif fault == "ik_fails":
            controller.ik_fails = True
        elif fault == "wall":  # it is already deep inside
            height = float(arm.latest()["tcp"][2])
            controller.arm.walls.append(WallConfig(axis="z", at=height - 0.01))
        else:
            getattr(controller, fault)()
        return False

    monkeypatch.setattr(rig, "poll", lambda: (strike(), ArmRig.poll(rig)))
    with rig, pytest.raises(SessionFault) as ended:
        run_poke_loop(rig, route, _Offered(), QUICK, threshold, reports.append)
    assert ended.value.fault.outcome is outcome
    assert len(reports) == 1


def test_a_contact_in_free_air_is_named(monkeypatch):
    rig, _, _, _ = session_of(monkeypatch, QUICK, "C", 1)
    x = float(rig.arm.latest()["tcp"][0])
    rig.arm.controller.arm.walls.append(WallConfig(axis="x", at=x + 0.03))
    with rig, pytest.raises(InputError, match=r"a contact in free air, 0\.03\d m towards"):
        learn_free_pokes(rig, QUICK)


def test_a_poke_whose_end_the_arm_cannot_reach_goes_less_far(monkeypatch):
    rig, route, _, _ = session_of(monkeypatch, QUICK, "C", 1)
    arm, reports = rig.arm, []
    centre, reached = arm.latest()["tcp"].copy(), []

    def within(target):
        near = np.linalg.norm(np.subtract(target, centre)[:3]) < 0.06
        reached.append(near)
        return near

    monkeypatch.setattr(arm.commands.control, "isPoseWithinSafetyLimits", within)
    with rig:
        run_poke_loop(rig, route, _Offered(), QUICK, float("inf"), reports.append)
        assert np.linalg.norm((arm.latest()["tcp"] - centre)[:3]) < 0.002
    assert arm.fault is None
    assert len(reports) == 1
    assert not reports[0].contact.any()
    assert reached.count(False) == 2 * 4  # the whole way and four fifths of it are too far, three fifths not


def test_points_of_an_image_are_where_the_tool_met_the_walls():
    config = TouchConfig()
    depth, contact = np.linspace(0.03, 0.25, 6), np.arange(6) % 2 == 0
    seen = poke_observation(config.pokes, depth, contact, Odometry(0.0, 0.0, 0.0, 0.0))
    points, there = touched_points(config, seen.view[0, :, 0])
    assert np.array_equal(there, contact)
    half_a_bin = config.pokes.reach / config.pokes.bins / 2
    assert np.abs(np.linalg.norm((points - seen.point)[contact], axis=1)).max() <= half_a_bin + 1e-9


@given(st.integers(2, 8), st.integers(2, 8), st.floats(0, 0.6), st.integers(0, 99))
def test_every_free_cell_of_a_table_can_be_reached(columns, rows, share, seed):
    maze = table_maze(columns, rows, share, np.random.default_rng(seed))
    cells = [(x, y) for y in range(rows) for x in range(columns)]
    free = [cell for cell in cells if maze.neighbours(cell)]
    reached = [(0, 0)]
    for cell in reached:
        reached += [b for b in maze.neighbours(cell) if b not in reached]
    assert set(reached) == set(free) | {(0, 0)}
    assert len(cells) - len(reached) <= share * len(cells) + 1
