"""Reasons not to arm the arm, each with its cure; the stream of poses; the states in shared memory."""

import os
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing, contextmanager, nullcontext, suppress

import numpy as np
import pytest

from robot.drivers.ur10 import dashboard
from robot.drivers.ur10.arm import Arm
from robot.drivers.ur10.dashboard import PORT, Dashboard, DashboardSilent
from robot.drivers.ur10.driver_config import ArmConfig, BoxConfig
from robot.drivers.ur10.rtde_protocol import PoseListener
from robot.drivers.ur10.safety import StartupRefused, TargetRefused, check_controller, check_states
from robot.drivers.ur10.shared_state import ARM_STATE, SLOTS, SharedState
from tests.helpers.live import ROOT, moves, until
from tests.robot.drivers.ur10.conftest import HOME, settings

GOOD = {
    "PolyscopeVersion": "URSoftware 5.11.0.108249 (Apr 01 2021)", "robotmode": "Robotmode: RUNNING",
    "safetymode": "Safetymode: NORMAL", "is in remote control": "true",
    "running": "Program running: false", "stop": "Stopped",
}  # fmt: skip


@contextmanager
def serve_answers(host, answers):
    """A dashboard server with these answers; it does not answer other commands."""
    with socket.create_server((host, PORT)) as server:

        def serve():
            with suppress(OSError):
                while True:
                    connection, _ = server.accept()
                    with connection, suppress(OSError):
                        connection.sendall(b"Connected: Universal Robots Dashboard Server\n")
                        for line in connection.makefile("r"):
                            if line.strip() in answers:
                                connection.sendall(answers[line.strip()].encode() + b"\n")

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield
        server.shutdown(socket.SHUT_RDWR)
        thread.join(60)


@pytest.fixture
def elsewhere(loopback):
    return loopback.replace("127.0.0.", "127.0.1.")


@pytest.mark.parametrize(
    ("question", "answer", "found"),
    [("PolyscopeVersion", "URSoftware 3.3.4.310 (May 09 2017)", "PolyScope 3.3"),
     ("PolyscopeVersion", "what?", "PolyScope 0.0"), ("is in remote control", "false", "under local control"),
     ("robotmode", "Robotmode: POWER_OFF", "robot mode POWER_OFF"),
     ("safetymode", "Safetymode: PROTECTIVE_STOP", "safety mode PROTECTIVE_STOP"),
     ("running", "Program running: true", "a program runs")],
)  # fmt: skip
def test_start_is_refused(elsewhere, question, answer, found):
    with serve_answers(elsewhere, GOOD | {question: answer}):
        with pytest.raises(StartupRefused, match=found) as refusal:
            check_controller(ArmConfig(host=elsewhere))
        assert refusal.value.cure or refusal.value.expected


def test_controllers_of_all_versions_pass(elsewhere):
    with serve_answers(elsewhere, GOOD):
        assert check_controller(ArmConfig(host=elsewhere)).remote is True
    old = GOOD | {"PolyscopeVersion": "URSoftware 3.4.5.100 (Jan 01 2018)"}
    del old["is in remote control"]  # a CB3 lacks this command
    with serve_answers(elsewhere, old):
        controller = check_controller(ArmConfig(host=elsewhere))
        assert (controller.version, controller.remote) == ((3, 4), None)


def test_a_silent_dashboard_times_out_and_silent_other_ports_are_refused(elsewhere):
    with pytest.raises(StartupRefused, match="no dashboard server answers"):
        check_controller(ArmConfig(host=elsewhere))
    assert dashboard.stop_program(elsewhere) == ""
    silence = pytest.raises(DashboardSilent, match="robotmode")
    with serve_answers(elsewhere, {}), Dashboard(elsewhere, timeout=0.2) as connection, silence:
        connection.ask("robotmode")
    with serve_answers(elsewhere, GOOD), Arm(ArmConfig(host=elsewhere)) as arm, pytest.raises(StartupRefused):
        arm.start()


def check_refusal(controller, **others):
    """Checks that an arm does not start, move or leave a process; returns the refusal."""
    before = len(controller.state()["targets"])
    with Arm(settings(controller.host, **others)) as arm:
        with pytest.raises(StartupRefused) as refusal:
            arm.start()
        assert (arm.process, arm.fault) == (None, None)
    assert moves(controller, before) == []
    np.testing.assert_array_equal(controller.state()["tcp"], HOME)
    return refusal.value


def test_a_tool_outside_the_box(controller):
    box = BoxConfig(low=tuple(HOME[:3] + 0.1), high=tuple(HOME[:3] + 0.2))
    assert "outside the box" in check_refusal(controller, box=box).found


@pytest.mark.parametrize(("hz", "refused"), [(125, False), (113, False), (112, True), (0.1, True)])
def test_a_slow_stream(hz, refused):
    states = np.zeros(60, ARM_STATE)
    states["host"], states["tcp"] = np.arange(60) / hz, HOME
    with pytest.raises(StartupRefused, match=f"stream at {hz:.0f} of 125 Hz") if refused else nullcontext():
        check_states(ArmConfig(connect=0.01), lambda: states)


def test_an_arm_that_was_not_started_refuses_and_closes(loopback):
    with Arm(ArmConfig(host=loopback)) as arm:
        with pytest.raises(TargetRefused, match="not armed"):
            arm.move(HOME)
        assert (arm.latest(), arm.age()) == (None, float("inf"))
        assert (arm.still(), arm.arrived()) == (False, False)


def test_a_second_session_is_refused_and_the_first_continues(controller):
    with Arm(settings(controller.host)) as first:
        first.start()
        refusal = check_refusal(controller)
        assert refusal.found == "a program runs on the controller"
        first.move(HOME + [0.003, 0, 0, 0, 0, 0])
        until(first.arrived, "arrival")
        assert first.fault is None


def test_poses_are_streamed_beside_a_program(controller):
    with PoseListener(controller.host) as poses:
        _, tcp, speed, _ = until(poses.latest)
        np.testing.assert_allclose(tcp, HOME)
        assert not speed.any()
        place = ",".join(map(repr, (HOME + [0, 0.02, 0, 0, 0, 0]).tolist()))
        with socket.create_connection((controller.host, 30003)) as script:
            script.sendall(f"movel(p[{place}],a=1,v=0.02)\n".encode())
            until(lambda: poses.latest().speed[1] == pytest.approx(0.02))
            first = poses.latest()
            then = until(lambda: (new := poses.latest()) is not first and new)
            steps = (then.robot_time - first.robot_time) / 0.008
            assert steps == pytest.approx(round(steps), abs=1e-6)
            assert then.tcp[1] - first.tcp[1] == pytest.approx(0.02 * (then.robot_time - first.robot_time))
            until(lambda: poses.latest().tcp[1] == pytest.approx(HOME[1] + 0.02))
        assert poses.latest().time <= time.monotonic()


@pytest.mark.parametrize("fault", ["close", "malformed"])
def test_a_lost_stream_of_poses_is_restored(controller, fault):
    with PoseListener(controller.host, patience=0.3) as poses:
        before = until(poses.latest)
        controller(do=fault)
        until(lambda: poses.latest().robot_time > before.robot_time + 0.1)


def test_poses_stop_during_a_stall_and_resume(controller):
    with PoseListener(controller.host, patience=30.0) as poses:
        until(poses.latest)
        controller(do="stall", seconds=600)
        time.sleep(0.3)  # states sent before the stall
        stood = poses.latest()
        time.sleep(0.2)
        assert poses.latest() is stood
        controller(do="clear")
        until(lambda: poses.latest() is not stood)


def test_without_a_controller_there_is_no_pose():
    with PoseListener("127.0.0.1", port=1, patience=0.2) as poses:
        time.sleep(0.1)
        assert poses.latest() is None


WRITER = """
import sys, numpy as np
from robot.drivers.ur10.shared_state import ARM_STATE, SharedState
shared = SharedState(int(sys.argv[1]))
state = np.zeros((), ARM_STATE)
for k in range(1, int(sys.argv[2]) + 1):
    for name in ("host", "robot", "tcp", "speed", "force", "joints", "mode", "safety", "runtime"):
        state[name] = k
    shared.publish(state)
"""


def write(shared, count):
    state = np.zeros((), ARM_STATE)
    for _ in range(count):
        state["robot"] = shared.newest + 1
        shared.publish(state)


@pytest.fixture
def shared():
    with closing(SharedState()) as shared:
        yield shared


def test_states_come_in_order_and_once(shared):
    assert shared.latest() is None
    assert len(shared.since(0)) == 0
    write(shared, 10)
    assert shared.since(0)["counter"].tolist() == list(range(1, 11))
    assert shared.since(7)["counter"].tolist() == [8, 9, 10]
    assert len(shared.since(10)) == len(shared.since(99)) == 0
    write(shared, SLOTS)
    states = shared.since(3)
    assert states["counter"].tolist() == list(range(12, SLOTS + 11))
    np.testing.assert_array_equal(states["counter"], states["robot"])


def test_a_reader_beside_a_writer_sees_whole_states_only(shared):
    count = 20_000
    words = [sys.executable, "-c", WRITER, str(shared.fd), str(count)]
    writer = subprocess.Popen(words, cwd=ROOT, pass_fds=[shared.fd])
    try:
        seen, end = 0, time.monotonic() + 60
        while seen < count and time.monotonic() < end:
            states = shared.since(seen)
            if not len(states):
                continue
            counters = states["counter"].astype(float)
            for name in ("host", "robot", "mode", "safety", "runtime"):
                np.testing.assert_array_equal(states[name], counters)
            for name in ("tcp", "speed", "force", "joints"):
                np.testing.assert_array_equal(states[name], np.repeat(counters[:, None], 6, axis=1))
            assert counters[0] > seen
            assert (np.diff(counters) > 0).all()
            seen = int(counters[-1])
        assert seen == count
        assert writer.wait(30) == 0
        assert int(shared.since(count - 1)["counter"][-1]) == count
    finally:
        writer.kill()
        writer.wait()


def test_the_memory_has_no_name_and_is_released_on_close():
    shared = SharedState()
    fd = shared.fd
    assert os.readlink(f"/proc/self/fd/{fd}").endswith("(deleted)")
    write(shared, 3)
    states = shared.since(0)
    shared.close()
    with pytest.raises(OSError, match="descriptor"):
        os.fstat(fd)
    assert states["counter"].tolist() == [1, 2, 3]
