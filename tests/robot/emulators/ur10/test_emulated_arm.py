"""The emulated arm: geometry, motions, walls; its controller: commands, safety stops, sessions of clients."""

import contextlib
import math
import struct

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robot.drivers.ur10 import rtde_protocol as rtde
from robot.emulators.ur10 import kinematics as poses
from robot.emulators.ur10.controller import EmulatedController, RobotMode, Runtime, SafetyMode
from robot.emulators.ur10.emulated_arm import EmulatedArm, MoveL, Profile, StopL, Unreachable, parse_moves
from robot.emulators.ur10.emulator_config import UrEmulatorConfig, WallConfig
from robot.emulators.ur10.kinematics import UR10, UR10E
from robot.emulators.ur10.server import Claims, DashboardSession, RtdeSession, ScriptSession

ANGLE = st.floats(-3.1, 3.1)
JOINTS = st.tuples(*[ANGLE] * 6)
POSE = st.tuples(*[st.floats(-2, 2)] * 3, *[st.floats(-1.8, 1.8)] * 3)
ARMS = pytest.mark.parametrize("arm", [UR10, UR10E], ids=["UR10", "UR10e"])


def chain(arm, joints):
    """The flange's frame [4, 4] as a product of one matrix per joint."""
    frame = np.eye(4)
    lengths = (arm.d1, 0, 0, arm.d4, arm.d5, arm.d6), (0, arm.a2, arm.a3, 0, 0, 0)
    for q, d, a, alpha in zip(joints, *lengths, np.radians([90, 0, 0, 90, -90, 0]), strict=True):
        c, s, ca, sa = math.cos(q), math.sin(q), math.cos(alpha), math.sin(alpha)
        step = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        frame = frame @ np.array(step)
    return frame


def frame_of(pose):
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_rotvec(np.array(pose[3:])).as_matrix()
    frame[:3, 3] = pose[:3]
    return frame


@ARMS
@given(joints=JOINTS)
def test_every_solution_reaches_the_pose_and_includes_the_joints(arm, joints):
    pose = arm.forward(joints)
    found = arm.solutions(pose, joints[5])
    assert 2 <= len(found) <= 8
    for solution in found:
        np.testing.assert_allclose(chain(arm, solution), chain(arm, joints), atol=1e-5)
    nearest = arm.backward(pose, joints)
    np.testing.assert_allclose(chain(arm, nearest), chain(arm, joints), atol=1e-5)
    if abs(math.sin(joints[4])) > 0.01 and abs(math.sin(joints[2])) > 0.01:
        assert np.abs(np.array(nearest) - joints).max() < 1e-4


@ARMS
@given(joints=JOINTS, turns=st.tuples(*[st.sampled_from([-1, 0, 1])] * 6))
def test_the_nearest_joints_stay_within_two_turns(arm, joints, turns):
    near = tuple(q + math.tau * n for q, n in zip(joints, turns, strict=True))
    assert max(map(abs, arm.backward(arm.forward(joints), near))) <= math.tau


@pytest.mark.parametrize("pose", [(3.0, 0, 0.3, 0, 0, 0), (0, 0, 0.3, math.pi, 0, 0), (math.nan,) * 6])
def test_a_pose_out_of_reach_has_no_solution(pose):
    assert UR10.solutions(pose) == []
    assert UR10.backward(pose, (0.0,) * 6) is None


@given(first=POSE, second=POSE)
def test_poses_compose_as_frames_do(first, second):
    both = frame_of(poses.compose_poses(first, second))
    np.testing.assert_allclose(both, frame_of(first) @ frame_of(second), atol=1e-9)
    np.testing.assert_allclose(frame_of(poses.invert_pose(first)), np.linalg.inv(frame_of(first)), atol=1e-9)


@given(first=POSE, second=POSE)
def test_a_rotation_between_poses_is_the_shortest(first, second):
    vector = poses.rotation_between(first, second)
    assert math.hypot(*vector) <= math.pi + 1e-12
    arrived = (*first[:3], *poses.rotate_by(first, vector))
    np.testing.assert_allclose(frame_of(arrived)[:3, :3], frame_of(second)[:3, :3], atol=1e-9)


@given(vector=st.tuples(*[st.floats(-10, 10)] * 3))
def test_a_rotation_vector_survives_its_quaternion(vector):
    back = np.array(poses.rotation_vector(poses.quaternion(vector)))
    there = Rotation.from_rotvec(np.array(vector))
    assert (there.inv() * Rotation.from_rotvec(back)).magnitude() < 1e-7
    assert np.linalg.norm(back) <= math.pi + 1e-12


DOWN = (math.pi, 0.0, 0.0)
SPEED, RATE = st.floats(0.03, 0.5), st.floats(0.05, 5.0)
PLACE = st.tuples(st.floats(0.4, 0.8), st.floats(-0.3, 0.3), st.floats(0.2, 0.5))


def run(arm, seconds, dt=0.008):
    """Tool pose and speed [T, 12] at every step, until the arm rests or the time has passed."""
    rows = []
    for _ in range(round(seconds / dt)):
        arm.step(dt)
        rows.append([*arm.state.tcp, *arm.state.speed])
        if not arm.busy:
            break
    return np.array(rows)


@given(length=st.floats(1e-4, 10), speed=SPEED, rate=RATE, share=st.floats(0, 1))
def test_speed_profile_limits_and_derivative(length, speed, rate, share):
    profile = Profile(length, speed, rate)
    duration = profile.duration
    assert profile.at(0.0) == (0.0, 0.0)
    assert profile.at(duration) == (length, 0.0)
    assert duration >= length / speed * (1 - 1e-12)
    time, step = share * duration, duration * 1e-6
    (before, _), (here, now), (after, _) = (profile.at(time + d) for d in (-step, 0.0, step))
    assert 0 <= here <= length * (1 + 1e-12)
    assert 0 <= now <= speed * (1 + 1e-9)
    if step < time < duration - step:
        assert (after - before) / (2 * step) == pytest.approx(now, abs=rate * step + 1e-6 * speed)


@settings(max_examples=30)
@given(place=PLACE, heading=st.floats(-1.5, 1.5), speed=SPEED, rate=RATE)
def test_linear_move_is_straight_within_its_limits_and_arrives(place, heading, speed, rate):
    config = UrEmulatorConfig()
    arm = EmulatedArm(config)
    start = arm.state.tcp
    goal = (*place, math.pi * math.cos(heading / 2), math.pi * math.sin(heading / 2), 0.0)
    arm.order([MoveL(goal, speed, rate)])
    try:
        rows = run(arm, 120.0)
    except Unreachable:
        assume(False)
    assert (arm.moving, arm.busy) == (False, False)
    np.testing.assert_allclose(arm.state.tcp[:3], goal[:3], atol=1e-12)
    assert math.hypot(*poses.rotation_between(arm.state.tcp, goal)) < 1e-9
    way, off = np.subtract(goal[:3], start[:3]), rows[:, :3] - start[:3]
    if way.any():
        np.testing.assert_allclose(off, (off @ way / (way @ way))[:, None] * way, atol=1e-12)
    fast = np.linalg.norm(rows[:, 6:9], axis=1)
    assert fast.max() <= speed * (1 + 1e-9)
    assert np.linalg.norm(rows[:, 9:], axis=1).max() <= speed * config.turn_ratio * (1 + 1e-9)
    assert np.abs(np.diff(fast[:-1], prepend=0.0)).max() <= rate * 0.008 * (1 + 1e-6) + 1e-12


@settings(max_examples=30)
@given(other=PLACE, after=st.floats(0.05, 2.0), rate=st.floats(0.2, 3.0))
def test_a_move_that_replaces_another_has_no_jumps(other, after, rate):
    arm = EmulatedArm(UrEmulatorConfig())
    arm.order([MoveL((0.6, 0.25, 0.3, *DOWN), 0.1, rate)])
    first = run(arm, after)
    arm.order([MoveL((*other, *DOWN), 0.1, rate)])
    try:
        rows = np.concatenate([first, run(arm, 60.0)])
    except Unreachable:
        assume(False)
    np.testing.assert_allclose(rows[-1, :3], other, atol=1e-12)
    jumps = np.linalg.norm(np.diff(rows[:, 6:9], axis=0), axis=1)
    assert jumps.max() <= 2 * rate * 0.008 + 1e-9  # the last step of a move is cut short
    steps = np.linalg.norm(np.diff(rows[:, :3], axis=0), axis=1)
    assert steps.max() <= 0.1 * 0.008 * (1 + 1e-9)


def test_wall_force_is_stiffness_times_penetration():
    arm = EmulatedArm(UrEmulatorConfig(walls=(WallConfig(axis="x", at=0.65, stiffness=2000.0),)))
    assert arm.force == (0.0,) * 6
    for x, force in ((0.66, -20.0), (0.6, 0.0)):
        arm.order([MoveL((x, 0.0, 0.3, *DOWN), 0.05, 1.0)])
        run(arm, 10.0)
        assert arm.force[0] == pytest.approx(force)
        assert arm.penetration_max == pytest.approx(0.01)


def test_an_unreachable_goal_raises_and_the_arm_stands():
    arm = EmulatedArm(UrEmulatorConfig())
    arm.order([MoveL((-0.6, 0.0, 0.3, *DOWN), 0.5, 5.0)])  # through the axis of the base
    with pytest.raises(Unreachable):
        run(arm, 10.0)
    assert not arm.busy


def test_the_speed_slider_slows_moves_and_not_stops():
    arm = EmulatedArm(UrEmulatorConfig())
    arm.scale = 0.1
    arm.order([MoveL((0.6, 0.3, 0.3, *DOWN), 0.2, 1.0)])
    rows = run(arm, 3.0)
    assert np.linalg.norm(rows[:, 6:9], axis=1).max() <= 0.02 * (1 + 1e-9)
    arm.order([StopL(1.0)])
    assert len(run(arm, 1.0)) * 0.008 <= 0.05
    assert (arm.moving, arm.busy) == (False, False)


def test_linear_moves_are_read_from_a_script():
    lines = "\tmovel(p[0.6,0.1,1e-05,3.14159,0,0],a=0.5,v=0.1,r=0.02)", "sync()", "movel(p[1,2],a=1)"
    moves = parse_moves("\n".join([*lines, "movel(p[1,2,3,4,5,6])"]))
    assert moves == [MoveL((0.6, 0.1, 1e-5, 3.14159, 0, 0), 0.1, 0.5), MoveL((1, 2, 3, 4, 5, 6), 0.25, 1.2)]


@given(text=st.text())
def test_any_text_can_be_read(text):
    parse_moves(text)
    parse_moves(f"movel(p[{text}],a={text})\nstopl({text})")


PROGRAM = b"def rtde_control():\n    global reg_offset_int = # int register offset\n0\nend\n"
HERE = (0.6, 0.0, 0.3, math.pi, 0.0, 0.0)
THERE = (0.6, 0.1, 0.3, math.pi, 0.0, 0.0)
RUNNING = 1 << 15


class Bench:
    """A controller, its clock, and a client that writes registers as the library does."""

    def __init__(self, **settings):
        self.controller, self.host = EmulatedController(UrEmulatorConfig.model_validate(settings)), 0.0
        self.script, self.dashboard = ScriptSession(self.controller), DashboardSession(self.controller)
        self.upload()

    def upload(self):
        self.script.receive(PROGRAM, self.host)
        self.ticks(0.1)

    def ticks(self, seconds):
        for _ in range(round(seconds / self.controller.dt)):
            self.host += self.controller.dt
            self.controller.tick(self.host)

    def write(self, command, doubles=(), asynchronous=0):
        registers = self.controller.registers
        for index, number in enumerate(doubles):
            registers.write(f"input_double_register_{index}", (number,), self.host)
        registers.write("input_int_register_1", (asynchronous,), self.host)
        registers.write("input_int_register_0", (command,), self.host)

    def out(self, index):
        return int(self.controller.registers.fields[f"output_int_register_{index}"][0])

    def command(self, number, doubles=(), asynchronous=0):
        """Sends a command and clears it when it is done; False if the program ends, or without an answer."""
        assert self.out(0) == 1
        self.write(number, doubles, asynchronous)
        end = self.host + 30
        while self.out(0) != 2 and self.controller.runtime is Runtime.PLAYING and self.host < end:
            self.ticks(self.controller.dt)
        done = self.out(0) == 2
        self.write(0)
        self.ticks(0.02 * done)
        return done

    def move(self, pose, speed=0.1, asynchronous=0):
        return self.command(3, (*pose, speed, 1.0), asynchronous)

    @property
    def progress(self):
        """Whether an asynchronous operation is under way, and the number of the last one."""
        return bool(self.out(2) & RUNNING), self.out(2) >> 24

    @property
    def tcp(self):
        return self.controller.arm.state.tcp

    def ask(self, line):
        return self.dashboard.receive(line.encode() + b"\n", self.host).decode().strip()


def moving(seconds=0.3):
    bench = Bench()
    assert bench.move(THERE, asynchronous=1)
    bench.ticks(seconds)
    return bench


def test_a_command_is_executed_once_until_its_register_is_cleared():
    bench = Bench()
    assert bench.out(0) == 1
    assert bench.move(THERE, speed=0.2)
    assert bench.tcp[:3] == pytest.approx(THERE[:3])
    bench.write(3, (*HERE, 0.2, 1.0))
    bench.ticks(5.0)  # the register is not cleared: executed once, and 2 stays
    assert bench.out(0) == 2
    assert len([t for t in bench.controller.targets if t["do"] == "movel"]) == 2


def test_operations_are_numbered_in_the_progress_register():
    bench = Bench()
    running, before = bench.progress
    assert not running
    for number, place in enumerate((THERE, HERE), before + 1):  # the second during the first move
        assert bench.move(place, asynchronous=1)
        assert bench.progress == (True, number)
    bench.ticks(5.0)
    assert bench.progress == (False, before + 2)
    assert bench.tcp[:3] == pytest.approx(HERE[:3], abs=1e-9)


def test_an_asynchronous_stop_which_is_an_operation_and_a_synchronous_move_end_a_move():
    bench = moving()
    _, operation = bench.progress
    assert bench.command(33, (1.0,), asynchronous=1)
    bench.ticks(0.5)
    assert not bench.controller.arm.moving
    assert bench.tcp[1] < 0.09
    assert bench.progress == (False, operation + 1)
    bench = moving(0.1)
    bench.write(3, (*HERE, 0.1, 1.0))
    bench.ticks(0.05)
    assert (bench.controller.arm.moving, bench.progress[0]) == (True, False)


@given(frequency=st.sampled_from([5.0, 10.0, 20.0]), kicks=st.integers(2, 12))
def test_the_watchdog_stops_the_arm_only_when_it_is_not_reset(frequency, kicks):
    bench = Bench()
    assert bench.command(35, (frequency,))
    bench.write(3, (*THERE, 0.005, 1.0), asynchronous=1)
    bench.ticks(0.008)
    for _ in range(kicks):
        bench.write(0)
        bench.ticks(0.8 / frequency)
        assert (bench.controller.runtime, bench.controller.arm.moving) == (Runtime.PLAYING, True)
    bench.ticks(0.2 / frequency + 0.1)
    assert (bench.controller.watchdog_stops, bench.controller.runtime) == (1, Runtime.STOPPED)
    assert not bench.controller.arm.moving


@pytest.mark.parametrize(("command", "name"), [(1, "moveJ"), (11, "servoJ"), (200, "an unknown function")])
def test_a_command_that_is_not_emulated_ends_the_program(command, name, capsys):
    bench = moving(0.1)
    assert not bench.command(command, HERE)
    assert bench.controller.runtime is Runtime.STOPPED
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{name} (command {command})" in line
    assert "moveL, " in line
    bench.ticks(0.5)
    assert not bench.controller.arm.moving
    bench.upload()
    assert bench.move(HERE)


def test_an_unreachable_target_ends_the_program():
    bench = Bench()
    assert not bench.move((3.0, *THERE[1:]))
    assert bench.controller.runtime is Runtime.STOPPED
    bench.upload()
    assert not bench.command(3, (math.nan,) * 8)
    bench.upload()
    bench.controller.ik_fails = True
    assert not bench.move(THERE)
    assert bench.tcp == HERE


def test_reachable_poses_are_within_safety_limits_and_the_tool_is_set_relative_to_the_flange():
    bench = Bench()
    for pose, fails, within in ((THERE, False, 1), ((3.0, *THERE[1:]), False, 0), (THERE, True, 0)):
        bench.controller.ik_fails = fails
        assert bench.command(36, pose)
        assert bench.out(1) == within
    assert bench.command(29, (0.0, 0.0, 0.1, 0.0, 0.0, 0.0))
    assert bench.tcp[:3] == pytest.approx((*HERE[:2], HERE[2] - 0.1))


def test_the_speed_slider_can_be_set_by_register_and_by_hand():
    bench = Bench()
    for name, value in (("speed_slider_mask", 1), ("speed_slider_fraction", 0.5)):
        bench.controller.registers.write(name, (value,), 0.0)
    bench.ticks(0.1)
    assert bench.controller.arm.scale == 0.5
    bench.controller.arm.scale = 0.2  # by hand
    bench.ticks(0.1)
    assert bench.controller.registers.fields["target_speed_fraction"] == (0.2,)


def test_a_protective_stop_can_be_unlocked_after_five_seconds():
    bench = moving()
    bench.controller.protective_stop()
    bench.ticks(0.3)
    assert not bench.controller.arm.moving
    assert bench.controller.safety is SafetyMode.PROTECTIVE_STOP
    assert bench.controller.registers.fields["safety_status_bits"] == (1 << 2 | 1 << 10,)
    assert bench.controller.runtime is Runtime.PAUSED
    assert bench.ask("unlock protective stop").startswith("Cannot")
    bench.upload()
    assert bench.controller.runtime is not Runtime.PLAYING  # a stop prevents a start
    bench.ticks(5.0)
    assert bench.ask("unlock protective stop") == "Protective stop releasing"
    bench.upload()
    assert bench.move(THERE)


def test_a_move_resumes_when_the_safeguard_is_closed():
    bench = moving()
    bench.controller.safeguard_stop()
    bench.ticks(1.0)
    assert not bench.controller.arm.moving
    assert 0 < bench.tcp[1] < 0.1
    bench.controller.clear()
    bench.ticks(3.0)
    assert bench.tcp[1] == pytest.approx(0.1)


def test_an_emergency_stop_cuts_the_power_until_it_is_switched_on():
    bench = moving()
    bench.controller.emergency_stop()
    bench.ticks(0.5)
    assert not bench.controller.arm.moving
    assert bench.controller.robot_mode is RobotMode.POWER_OFF
    assert bench.ask("safetymode") == "Safetymode: ROBOT_EMERGENCY_STOP"
    assert bench.controller.registers.fields["safety_status_bits"][0] & 1 << 7
    bench.controller.clear()
    bench.upload()
    assert bench.controller.runtime is Runtime.STOPPED
    assert bench.ask("power on") == "Powering on"
    assert bench.ask("brake release") == "Brake releasing"
    bench.upload()
    assert bench.move(THERE)


def test_excessive_force_causes_a_protective_stop():
    bench = Bench(walls=[{"axis": "y", "at": 0.02, "stiffness": 5000.0}], protective_force=100.0)
    bench.move(THERE, asynchronous=1)
    bench.ticks(2.0)
    assert bench.controller.safety is SafetyMode.PROTECTIVE_STOP
    assert 0.02 < bench.controller.arm.penetration_max < 0.03


@pytest.mark.parametrize(("polyscope", "modern"), [("3.4", False), ("5.5.1", False), ("5.6", True)])
def test_dashboard_commands_depend_on_the_version(polyscope, modern):
    bench = Bench(polyscope=polyscope)
    assert polyscope in bench.ask("PolyscopeVersion")
    assert bench.ask("robotmode") == "Robotmode: RUNNING"
    assert bench.ask("running") == "Program running: true"
    assert bench.ask("stop") == "Stopped"
    assert bench.ask("running") == "Program running: false"
    assert (bench.ask("is in remote control") == "true") == modern
    assert bench.ask("get serial number").isdigit() == modern
    assert bench.ask("juggle") == "could not understand: 'juggle'"


def names(variables, frequency=None):
    listed = ",".join(variables).encode()
    return listed if frequency is None else struct.pack(">d", frequency) + listed


def reply(session, kind, body=b""):
    ((got, answer),) = rtde.PackageSplitter().feed(session.receive(rtde.pack_package(kind, body), 0.0))
    assert got == kind
    return answer


def test_output_recipes_return_types_and_define_states():
    bench = Bench()
    session = RtdeSession(bench.controller, Claims())
    assert reply(session, rtde.PROTOCOL, b"\0\2") == b"\1"
    assert reply(session, rtde.PROTOCOL, b"\0\1") == b"\0"
    assert reply(session, rtde.CONTROLLER) == struct.pack(">4I", 3, 15, 8, 0)
    wanted = ["timestamp", "actual_TCP_pose", "robot_mode", "output_int_register_0"]
    assert reply(session, rtde.OUTPUTS, names([*wanted, "weather"], 125.0))[1:].endswith(b"NOT_FOUND")
    assert reply(session, rtde.OUTPUTS, names(wanted, 62.5)) == b"\1DOUBLE,VECTOR6D,INT32,INT32"
    assert session.every == 2
    assert reply(session, rtde.START) == b"\1"
    ((_, state),) = rtde.PackageSplitter().feed(session.state({}))
    assert struct.unpack(">Bd6dii", state) == (1, bench.controller.time, *HERE, 7, 1)


def test_an_input_variable_belongs_to_one_client():
    claims, controller = Claims(), EmulatedController(UrEmulatorConfig())
    first, second = RtdeSession(controller, claims), RtdeSession(controller, claims)
    registers = ["input_int_register_0", "input_double_register_3"]
    assert reply(first, rtde.INPUTS, names(registers)) == b"\1INT32,DOUBLE"
    assert reply(first, rtde.INPUTS, names(registers[:1])) == b"\2INT32"
    assert reply(second, rtde.INPUTS, names(registers)) == b"\0IN_USE,IN_USE"
    first.receive(rtde.pack_package(rtde.DATA, struct.pack(">Bid", 1, 7, 0.5)), 3.0)
    first.receive(rtde.pack_package(rtde.DATA, struct.pack(">Bi", 1, 8)), 4.0)  # too short for its recipe
    assert (controller.registers.ints[0], controller.registers.doubles[3]) == (7, 0.5)
    assert (controller.registers.written[0], first.ignored) == (3.0, 1)
    first.close()
    assert reply(second, rtde.INPUTS, names(registers)) == b"\1INT32,DOUBLE"
    claims.held_by_fieldbus = True
    assert reply(RtdeSession(controller, claims), rtde.INPUTS, names(registers[:1])) == b"\0IN_USE"


@given(data=st.lists(st.binary(max_size=60), max_size=8))
def test_any_bytes_leave_the_sessions_working(data):
    controller = EmulatedController(UrEmulatorConfig())
    others = ScriptSession(controller), DashboardSession(controller)
    for session in (RtdeSession(controller, Claims()), *others):
        with contextlib.suppress(ValueError):  # ends this connection
            for piece in data:
                session.receive(piece, 0.0)
        controller.tick(0.0)


KINDS = [rtde.PROTOCOL, rtde.OUTPUTS, rtde.INPUTS, rtde.START, rtde.DATA, rtde.TEXT]


@given(kind=st.sampled_from(KINDS), body=st.binary(max_size=40))
def test_any_package_body_leaves_the_session_working(kind, body):
    session = RtdeSession(EmulatedController(UrEmulatorConfig()), Claims())
    with contextlib.suppress(ValueError):
        session.receive(rtde.pack_package(kind, body), 0.0)
    session.state({})


@given(data=st.binary(max_size=300), cut=st.integers(0, 300))
def test_packages_do_not_depend_on_how_the_stream_is_split(data, cut):
    stream = b"".join(rtde.pack_package(byte, data[:byte]) for byte in data[:20])
    whole, parts = rtde.PackageSplitter(), rtde.PackageSplitter()
    assert list(whole.feed(stream)) == [*parts.feed(stream[:cut]), *parts.feed(stream[cut:])]
