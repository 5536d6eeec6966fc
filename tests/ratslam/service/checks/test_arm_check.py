"""The bench checks of an arm and of its whisker head: made records, an arm in virtual time, emulators."""

import json
from contextlib import ExitStack

import numpy as np
import pytest

from ratslam.cli import main
from ratslam.runs.settings.run_config import load_config
from ratslam.service.arm_check import judge_arm, judge_head
from ratslam.service.robot_check import RobotReport, RobotRequest, check_arm, check_head
from robot.drivers.head.usb_protocol import frame_values
from robot.emulators.ur10.emulator_config import WallConfig
from robot.live import live_rig
from robot.live.arm_bench import FreeWhisks, poke_in_air, record_of_text, record_to_text
from robot.live.arm_route import arm_routes, plan_path
from robot.live.live_config import LiveConfig
from robot.live.live_emulator_config import arm_emulator_config
from robot.live.live_rig import ArmRig
from robot.live.poke_loop import FreePokes, record_free_pokes
from robot.live.whisk_loop import follow_route
from tactile.base.errors import InputError
from tactile.frontend import TouchConfig
from tactile.pokes import PokeConfig
from tactile.whisker_geometry import HeadConfig, ur10_head
from tests.helpers.live import HEAD_FAULTS, ROOT, UR_FAULTS, started
from tests.helpers.virtual_arm import VirtualArm, in_virtual_time
from tests.ratslam.live.live_session import raise_priority
from tests.ratslam.live.test_complete_session import PATIENT

FORCE = LiveConfig.model_validate({"arm": {"touch": "force"}})
UNKNOWN = "cannot tell"
NO_MARKS = {"turned_deg": None, "drove_m": None}


def found(verdicts):
    return {each.question: each.found for each in verdicts}


def pokes_of(
    noise=1.0, drift=2.0, hz=125.0, age=0.004, back=1e-4, touched=None, pokes=10, seconds=13.5, seed=0
):
    """A made record; `touched`: depth of the first poke, m."""
    random, count = np.random.default_rng(seed), round(seconds * hz)
    time = np.arange(count) / hz
    push = noise * random.standard_normal((pokes, count)) + drift * np.sin(0.3 * time)
    depth = np.full(pokes, np.nan)
    if touched is not None:
        depth[0] = touched
    robot = (time + 100.0 * np.arange(pokes)[:, None]).ravel()
    return FreePokes(
        angle=2 * np.pi * np.arange(pokes) / pokes,
        touched=depth,
        back=np.full(pokes, back),
        states=np.full(pokes, count),
        push=push.ravel(),
        robot=robot,
        host=robot + 7.0 + random.exponential(1e-3, len(robot)),
        ages=np.full(1000, age),
    )


def test_an_arm_without_faults_is_fine_and_nothing_has_to_be_set():
    verdicts, rig = judge_arm(FORCE, TouchConfig(), pokes_of())
    assert set(found(verdicts).values()) == {"fine"}
    assert rig.included() == {}
    assert "nothing has to be set" in rig.render()
    value = {each.name: each.value for each in rig.quantities}
    assert value["force, noise"] == pytest.approx(1.0, rel=0.05)
    assert value["force, drift over a poke"] == pytest.approx(4.0, abs=0.7)
    assert value["states"] == pytest.approx(125.0, rel=0.01)


@pytest.mark.parametrize(
    ("fault", "question", "named"),
    [
        ({"noise": 3.5}, "force", "too uneven"),
        ({"hz": 90.0}, "states", "slow stream"),
        ({"age": 0.08}, "latency", "late states"),
        ({"back": 8e-4}, "position", "comes back elsewhere"),
        ({"touched": 0.12}, "free air", "contact"),
    ],
)
def test_a_fault_of_an_arm_is_named_alone(fault, question, named):
    verdicts, rig = judge_arm(FORCE, TouchConfig(), pokes_of(**fault))
    assert {q: f for q, f in found(verdicts).items() if f != "fine"} == {question: named}
    assert RobotReport(verdicts, rig, {}).faulty


def test_a_lower_threshold_is_set_only_if_it_is_above_all_rises_in_free_air():
    set_lower, refused = (judge_arm(FORCE, TouchConfig(), pokes_of(noise))[1] for noise in (2.9, 6.0))
    sds = set_lower.included()["touch"]["pokes"]["sds"]
    assert 6.0 <= sds < 8.0
    assert refused.included() == {}


def test_the_pokes_of_an_arm_with_a_head_have_no_threshold():
    verdicts, rig = judge_arm(LiveConfig(), TouchConfig(), pokes_of(noise=6.0))
    assert "force" not in found(verdicts)
    assert "check robot head" in rig.render()


def test_a_contact_that_ends_all_pokes_at_once_leaves_the_force_unknown():
    verdicts, _ = judge_arm(FORCE, TouchConfig(), pokes_of(seconds=0.5))
    assert found(verdicts)["force"] == UNKNOWN


@pytest.mark.parametrize("wall", [False, True])
def test_an_arm_in_virtual_time_is_checked(monkeypatch, wall):
    pokes = PokeConfig(directions=4, reach=0.08, speed=0.05)
    plan = {"path": {"circuits": "C"}, "force": {"noise": 0.8}, "seed": 5}
    config = LiveConfig.model_validate({"arm": {"touch": "force"}, "plan": plan})
    monkeypatch.setattr(VirtualArm, "emulated", arm_emulator_config(config, HeadConfig()))
    monkeypatch.setattr(live_rig, "Arm", VirtualArm)
    rig = ArmRig(config, lambda: False)
    arm = in_virtual_time(monkeypatch, rig)
    arm.start()
    with rig:
        follow_route(rig, arm_routes(config, plan_path(config, ur10_head(HeadConfig())))[0])
        if wall:
            at = float(arm.latest()["tcp"][0]) + 0.03
            arm.controller.arm.walls.append(WallConfig(axis="x", at=at, stiffness=3000.0))
        record = record_free_pokes(rig, pokes)
    record = record_of_text(FreePokes, record_to_text(record))
    verdicts, rig = judge_arm(config, TouchConfig(pokes=pokes), record)
    assert len(record.angle) == 4
    assert {q for q, f in found(verdicts).items() if f != "fine"} == ({"free air"} if wall else set())
    if wall:
        assert np.isfinite(record.touched).sum() == 1
        assert np.nanmax(record.touched) == pytest.approx(0.033, abs=0.004)
    assert {each.name: each.value for each in rig.quantities}["force, noise"] == pytest.approx(0.8, rel=0.1)


def whisks_of(whisks=10, seed=0, **fault):
    """A made record of 18 whiskers at 1000 Hz, whose first whisker has a fault."""
    random, rate = np.random.default_rng(seed), 1000
    time = np.arange(whisks * rate) / rate
    angle = np.repeat(0.5 - 0.5 * np.cos(2 * np.pi * time)[:, None], 18, axis=1)
    deflection = random.normal(0, 2e-3, (len(time), 18, 2))
    if "dead" in fault:
        angle[:, 0], deflection[:, 0] = 0.0, 0.0
    deflection[:, 0] += fault.get("bent", 0.0)
    deflection[:, 0] *= fault.get("louder", 1.0)
    deflection[:, 0] += fault.get("drift", 0.0) * np.cumsum(random.standard_normal((len(time), 2)), axis=0)
    kept = np.full(len(time), True)
    kept[2000 : 2000 + fault.get("lost", 0)] = False
    return FreeWhisks(
        samples=kept.reshape(whisks, rate).sum(axis=1),
        whole=np.array(rate),
        time=time[kept],
        values=frame_values(angle, deflection)[kept],
        late=np.full(whisks, fault.get("late", 0.02)),
        bad=np.array(fault.get("bad", 0)),
        residual=np.array(fault.get("residual", 1e-3)),
    )


def test_a_head_without_faults_is_fine():
    verdicts, rig = judge_head(LiveConfig(), TouchConfig(), whisks_of())
    assert found(verdicts) == dict.fromkeys(
        ("samples", "clock", "latency", "whiskers", "calibration", "drift"), "fine"
    )
    assert rig.included() == {}
    value = {each.name: each.value for each in rig.quantities}
    assert value["noise, median channel"] == pytest.approx(2e-3, rel=0.1)


@pytest.mark.parametrize(
    ("fault", "question", "named"),
    [
        ({"lost": 3}, "samples", "samples lost"),
        ({"bad": 1}, "samples", "samples lost"),
        ({"residual": 8e-3}, "clock", "clock uneven"),
        ({"late": 0.08}, "latency", "late samples"),
        ({"dead": True}, "whiskers", "dead whiskers"),
        ({"bent": 0.4}, "whiskers", "bent whiskers"),
        ({"louder": 10.0}, "calibration", "refused"),
    ],
)
def test_a_fault_of_a_head_is_named_alone(fault, question, named):
    verdicts, rig = judge_head(LiveConfig(), TouchConfig(), whisks_of(**fault))
    assert {q: f for q, f in found(verdicts).items() if f not in ("fine", UNKNOWN)} == {question: named}
    expected = {"dead": {"touch": {"head": {"dead": [0]}}}, "late": {"live": {"grace": 0.12}}}
    assert rig.included() == expected.get(next(iter(fault)), {})


def test_a_whisker_that_drifts_is_named():
    verdicts, _ = judge_head(LiveConfig(), TouchConfig(), whisks_of(drift=8e-4))
    assert found(verdicts)["drift"] == "drifts"
    assert "whisker 0, " in next(each.detail for each in verdicts if each.question == "drift")


def test_dead_whiskers_that_the_configuration_knows_are_fine():
    touch = TouchConfig.model_validate({"head": {"dead": [0]}})
    verdicts, rig = judge_head(LiveConfig(), touch, whisks_of(dead=True))
    assert set(found(verdicts).values()) == {"fine"}
    assert rig.included() == {}


def test_records_survive_as_text():
    for record in (pokes_of(), whisks_of()):
        again = record_of_text(type(record), record_to_text(record))
        assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(record, again, strict=True))


RECORD = {"format": "ratslam-bench-1", "robot": "arm", "settings": {"live": {}, "touch": {}}}


@pytest.mark.parametrize(
    "stored", [{}, {"record": "AAAA"}, {"record": "?"}, {"record": 1}, {"robot": "head"}, {"settings": {}}]
)
def test_a_record_of_something_else_is_refused(stored, tmp_path):
    (tmp_path / "bench.json").write_text(json.dumps(RECORD | stored))
    with pytest.raises(InputError, match="a check of `arm`"):
        check_arm(RobotRequest(tmp_path / "bench.json", [], NO_MARKS))


@pytest.mark.parametrize(
    ("check", "config", "marks", "message"),
    [
        (check_arm, "live_create", NO_MARKS, "settings of an arm"),
        (check_head, "live_poke", NO_MARKS, "check robot arm"),
        (check_arm, "live_poke", {"turned_deg": 3.0, "drove_m": None}, "check robot create"),
    ],
)
def test_what_cannot_be_checked_is_refused(check, config, marks, message):
    with pytest.raises(InputError, match=message):
        check(RobotRequest(ROOT / "configs" / f"{config}.yaml", [], marks))


POKES = {"directions": 2, "reach": 0.05, "speed": 0.05}


def emulated(stack, loopback, folder, name, devices, settings):
    """The configuration of a check of emulated devices, and their fault ports."""
    words = [word for setting in settings for word in ("--set", setting)]
    hosts = [f"configs/{name}.yaml", "--host", loopback, "--ur-host", loopback]
    ports = {"ur10": UR_FAULTS, "head": HEAD_FAULTS}
    faults = [
        stack.enter_context(
            started(["-m", "ratslam", "emulate", what, *hosts, *words], ports[what], loopback)
        )
        for what in devices
    ]
    for device in faults:
        raise_priority(device.process.pid)
    config = folder / "config.yaml"
    config.write_text(f"include: [{ROOT}/configs/{name}.yaml]\n")
    hosts = [f"live.arm.host={loopback}", *([f"live.head.address={loopback}"] * ("head" in devices))]
    return config, [*settings, *hosts], faults


def written(report, robot, folder):
    """The folder of a report, whose record is judged again alike."""
    report.write(folder / "bench", "config.yaml")
    again = ["check", "robot", robot, str(folder / "bench/bench.json"), "-o", str(folder / "again")]
    assert main(again) == int(report.faulty)
    first, second = (json.loads((folder / name / "bench.json").read_text()) for name in ("bench", "again"))
    assert first == second
    return folder / "bench"


def test_an_emulated_arm_is_checked(loopback, tmp_path):
    settings = [name for name in PATIENT if not name.startswith(("live.head", "live.grace", "live.residual"))]
    settings += [f"touch.pokes.{name}={value}" for name, value in POKES.items()]
    with ExitStack() as stack:
        config, settings, (arm,) = emulated(stack, loopback, tmp_path, "live_poke", ["ur10"], settings)
        report = check_arm(RobotRequest(config, settings, NO_MARKS), trials=2)
        assert not arm.state()["moving"]
        live = load_config(config, settings).live

        def strike(text):
            if "pokes" in text:
                arm(do="protective")

        with pytest.raises(InputError, match="protective_stop"):
            poke_in_air(live, HeadConfig(), PokeConfig(**POKES), lambda: False, strike, 2)
        assert not arm.state()["moving"]
    named = found(report.verdicts)
    del named["states"]  # of a busy machine
    assert named == dict.fromkeys(("free air", "force", "latency", "position"), "fine")
    folder = written(report, "arm", tmp_path)
    assert "nothing has to be set" in (folder / "page.txt").read_text()
    assert "2 pokes touched nothing" in (folder / "page.txt").read_text()


def test_an_emulated_head_with_a_dead_whisker_is_checked(loopback, tmp_path):
    settings = [*PATIENT, "live.plan.whisking.rate=4", "live.plan.calibration.min_duration=2"]
    with ExitStack() as stack:
        devices = ["ur10", "head"]
        dead = [*settings, "touch.head.dead=[4]"]
        config, _, (arm, head) = emulated(stack, loopback, tmp_path, "live_maze", devices, dead)
        hosts = [f"live.arm.host={loopback}", f"live.head.address={loopback}"]
        report = check_head(RobotRequest(config, [*settings, *hosts], NO_MARKS), trials=8)
        assert not arm.state()["moving"]
        assert head(do="counts")["lost"] == 0
    named = found(report.verdicts)
    assert named["whiskers"] == "dead whiskers"
    assert {f for q, f in named.items() if q not in ("whiskers", "latency")} == {"fine"}
    folder = written(report, "head", tmp_path)
    assert "no signal of whisker 4" in (folder / "page.txt").read_text()
    (tmp_path / "head.yaml").write_text(f"include: [bench/rig.yaml, {ROOT}/configs/live_maze.yaml]\n")
    assert load_config(tmp_path / "head.yaml").touch.head.dead == (4,)
