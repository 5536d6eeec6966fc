"""`doctor --live` checks arm and head, and moves nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from ratslam.cli import main
from tests.ratslam.live.bench import Bench


def check(bench: Bench, folder: Path, **settings: object) -> int:
    config = folder / "config.yaml"
    config.write_text(yaml.safe_dump({"live": bench.quick(**settings)}))
    return main(["doctor", "--live", str(config)])


def test_it_finds_both_devices_and_moves_nothing(bench: Bench, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr("robot.live.selftest.MIN_RATE_SHARE", 0.0)  # a busy machine may be late
    before = bench.arm.state()
    assert check(bench, tmp_path, residual=1.0) == 0
    said = capsys.readouterr().out
    for text in ("disk: ", "route: ", "head: ", "arm: ", "clocks: ", "nothing was moved"):
        assert text in said
    after = bench.arm.state()
    assert (after["targets"], after["programs"]) == (before["targets"], before["programs"])


@pytest.mark.parametrize(
    ("settings", "fault"),
    [({"head": {"address": "127.0.0.200"}}, "no head at 127.0.0.200"), ({"room": 1e15}, "GB free")],
)
def test_what_is_missing_is_named(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str], settings: dict[str, object], fault: str
) -> None:
    assert check(bench, tmp_path, **settings) == 1
    said = capsys.readouterr().out
    assert "cannot start" in said
    assert f"fault: {fault}" in said.replace("head: ", "") or fault in said


def test_a_configuration_without_a_robot_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--live", "square"]) == 2
    assert "no section `live`" in capsys.readouterr().err
