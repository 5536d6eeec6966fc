"""Sessions that are refused: the error has a cure, and nothing moves."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from ratslam.cli import main
from ratslam.runs.settings.run_config import load_config
from tests.helpers.live import ROOT, moves
from tests.ratslam.live.bench import LEGS, Bench

NOWHERE = "127.0.0.200"
CREATE = {"create": {"port": "/dev/ttyNONE"}, "room": 0.0}
TOUCH = ROOT / "tests" / "data" / "maps" / "ratslam-map-1.npz"
"""A map by the whiskers of the emulated head."""


@pytest.fixture
def said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """What the program says with a configuration (FILE in its words), after it ended with an exit code."""

    def run(code: int, words: str, config: object = None) -> str:
        file = tmp_path / "config.yaml"
        file.write_text(yaml.safe_dump(config))
        assert main(words.replace("FILE", str(file)).split()) == code
        assert list(tmp_path.iterdir()) == [file]
        output = capsys.readouterr()
        return output.err + output.out

    return run


def orders(bench: Bench) -> tuple[object, object]:
    """What the controller was told so far."""
    state = bench.arm.state()
    return state["targets"], state["programs"]


def test_invalid_configurations_are_refused(bench: Bench, said) -> None:
    for settings, messages in (
        ({"waypoints": [*LEGS[:2], (3.0, 0.45, 0.0)]}, ["live.waypoints", "outside the box"]),
        ({"waypoints": [*LEGS[:2], (0.63, float("nan"), 0.0)]}, ["live.waypoints.2.1", "finite"]),
        ({"arm": {"speed": 0.26}}, ["live.arm.speed", "0.25"]),
        ({"lift": 0.6}, ["outside the box"]),
        ({"room": 1e15}, ["GB free", "-o"]),
    ):
        before = orders(bench)
        output = said(2, "live FILE -o FILE.run", {"live": bench.quick(**settings)})
        assert all(text in output for text in messages), output
        assert orders(bench) == before


@pytest.mark.parametrize(
    ("order", "settings", "messages"),
    [
        ({"without": "rtde_control"}, {}, ["ur_rtde", "pip install 'ratslam[live]'"]),
        ({}, {"head": {"address": NOWHERE}}, [f"no head at {NOWHERE}", "plug it in"]),
        ({"registers": True}, {}, ["registers in use", "EtherNet/IP"]),
        ({"rate_check": True}, {}, ["head: 0 of 2000 samples per second", "check the USB hub and cable"]),
        (
            {"options": ["--localise", str(TOUCH), "--set", "touch.image.tallest=0.04"]},
            {"mapper": None},
            ["touch.image.tallest is 0.04 and was 0.05 when the map was made"],
        ),
    ],
    ids=["library", "head", "registers", "rate", "map"],
)
def test_a_session_that_cannot_start_moves_nothing(
    bench: Bench, tmp_path: Path, order: dict, settings: dict, messages: list[str]
) -> None:
    """A head that streams nothing of what it samples is below its rate however busy the machine is."""
    sent = len(bench.arm.state()["targets"])
    if hidden := order.pop("without", ""):  # from the processes that the session starts
        (tmp_path / f"{hidden}.py").write_text("raise ImportError('hidden')")
        order["environment"] = {"PYTHONPATH": str(tmp_path)}
    if order.pop("registers", False):
        bench.arm(do="registers")
    if "rate_check" in order:
        bench.head(do="skip", frames=10**9)
    with bench.session(order=order, **settings) as session:
        code, output = session.code(), session.output()
    assert (code, "Traceback" in output, session.directory.exists()) == (2, False, False), output
    assert all(text in output for text in messages), output
    assert moves(bench.arm, sent) == []
    if "rate_check" in order:
        assert bench.head(do="counts")["skipped"] > 0
        bench.replace_head()


def test_doctor_finds_both_devices_or_names_what_is_missing_and_moves_nothing(
    bench: Bench, said, monkeypatch
) -> None:
    monkeypatch.setattr("robot.live.selftest.LISTEN_TIME", 0.3)
    monkeypatch.setattr("robot.live.selftest.MIN_RATE_SHARE", 0.0)  # a busy machine may be late
    before, output = orders(bench), said(0, "doctor --live FILE", {"live": bench.quick()})
    for text in ("disk: ", "route: ", "head: ", "arm: ", "clocks: ", "nothing was moved"):
        assert text in output
    missing = said(1, "doctor --live FILE", {"live": bench.quick(head={"address": NOWHERE})})
    assert "cannot start" in missing
    assert f"no head at {NOWHERE}" in missing
    assert orders(bench) == before
    assert "no section `live`" in said(2, "doctor --live square")


LIVE, GRID = "live FILE -o FILE.run", {"live": CREATE, "backend": "grid"}
SLOW = {"create": {"port": "/dev/ttyNONE", "speed": 0.04}}


@pytest.mark.parametrize(
    ("words", "config", "messages"),
    [
        (LIVE, {"live": CREATE | {"arm": {"speed": 0.1}}}, ["create and arm", "one robot"]),
        (LIVE, {"live": CREATE | {"whisks": 3}}, ["create and whisks", "one robot"]),
        (LIVE, {"live": CREATE}, ["backend", "recognises views", "--set backend=grid"]),
        (LIVE, GRID | {"backend": "classic"}, ["backend", "classic, which recognises views"]),
        (LIVE, GRID, ["/dev/ttyNONE", "no such port"]),
        (LIVE, GRID | {"live": SLOW}, ["live.create.plan.behaviour", "0.05 m/s", "0.04"]),
        ("live FILE -o FILE/run", GRID, ["config.yaml: not a folder"]),  # before the devices are opened
        ("emulate create live_create --set live.create.port=/dev/ttyUSB0", GRID, ["live.create.port"]),
        ("emulate create live_create --set live.head.address=usb", GRID, ["live.head.address"]),
    ],
)
def test_sessions_of_a_create_and_emulators_that_do_not_fit_are_refused(
    said, words: str, config: dict, messages: list[str]
) -> None:
    pytest.importorskip("serial", reason="needs pyserial")
    output = said(2, words, config)
    assert all(text in output for text in messages), output
    assert output.count("error: ") == 1


def test_the_packaged_session_of_a_create_is_complete() -> None:
    config = load_config("live_create")
    assert config.live is not None
    assert (config.live.create is not None, config.backend) == (True, "grid")
