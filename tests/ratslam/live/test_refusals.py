"""Sessions that are refused: the error has a cure, and nothing moves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from ratslam.cli import main
from tests.helpers.live import moves
from tests.ratslam.live.bench import LEGS, Bench


def write_config(bench: Bench, folder: Path, **settings: Any) -> list[str]:
    """The arguments for a session with these settings."""
    config = folder / "config.yaml"
    config.write_text(yaml.safe_dump({"live": bench.quick(**settings)}))
    return ["live", str(config), "-o", str(folder / "run")]


@pytest.mark.parametrize(
    ("settings", "messages"),
    [
        ({"waypoints": [*LEGS[:2], (3.0, 0.45, 0.0)]}, ["live.waypoints", "outside the box"]),
        ({"waypoints": [*LEGS[:2], (0.63, float("nan"), 0.0)]}, ["live.waypoints.2.1", "finite"]),
        ({"arm": {"speed": 0.26}}, ["live.arm.speed", "0.25"]),
        ({"arm": {"speed": float("inf")}}, ["live.arm.speed"]),
        ({"lift": 0.6}, ["outside the box"]),
        ({"room": 1e15}, ["GB free", "-o"]),
    ],
    ids=["outside", "nan", "fast", "infinite", "high", "full"],
)
def test_invalid_configurations_are_refused(
    bench: Bench, tmp_path: Path, capsys, settings: dict[str, Any], messages: list[str]
) -> None:
    before = bench.arm.state()
    assert main(write_config(bench, tmp_path, **settings)) == 2
    lines = capsys.readouterr().err
    for text in messages:
        assert text in lines
    assert not (tmp_path / "run").exists()
    after = bench.arm.state()
    assert (after["targets"], after["programs"]) == (before["targets"], before["programs"])


@pytest.mark.parametrize(
    ("without", "address", "messages"),
    [
        (["rtde_control", "rtde_receive"], None, ["ur_rtde", "pip install 'ratslam[live]'"]),
        (["usb"], None, ["usb", "pip install 'ratslam[live]'"]),
        (["libusb_package", "libusb"], "usb", ["no libusb", "pip install libusb-package"]),
        ([], "127.0.0.200", ["no head at 127.0.0.200", "plug it in"]),
    ],
    ids=["ur_rtde", "pyusb", "libusb", "head"],
)
def test_missing_libraries_and_devices_are_refused(
    bench: Bench, without: list[str], address: str | None, messages: list[str]
) -> None:
    sent = len(bench.arm.state()["targets"])
    with bench.session(without=without, head={"address": address or bench.host}) as session:
        assert session.code() == 2, session.output()
        assert "Traceback" not in session.output(), session.output()
        for text in messages:
            assert text in session.output()
        assert not session.directory.exists()
    assert len(bench.arm.state()["targets"]) == sent


def test_a_head_below_its_rate_is_refused(bench: Bench) -> None:
    """It streams nothing of what it samples, so no load of the machine lets it pass."""
    sent = len(bench.arm.state()["targets"])
    bench.head(do="skip", frames=10**9)
    with bench.session(rate_check=True) as session:
        assert session.code() == 2, session.output()
        assert "Traceback" not in session.output(), session.output()
        for text in ("head: 0 of 2000 samples per second", "check the USB hub and cable"):
            assert text in session.output()
        assert not session.directory.exists()
    assert moves(bench.arm, sent) == []
    assert bench.head(do="counts")["skipped"] > 0
    bench.replace_head()
