"""Sessions on a Create that are refused: one error with its cure, and no run directory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from ratslam.cli import main
from ratslam.runs.settings.run_config import load_config

pytest.importorskip("serial", reason="needs pyserial")
CREATE = {"create": {"port": "/dev/ttyNONE"}, "room": 0.0}


@pytest.mark.parametrize(
    ("config", "messages"),
    [
        ({"live": CREATE | {"arm": {"speed": 0.1}}}, ["create and arm", "one robot"]),
        ({"live": CREATE | {"whisks": 3}}, ["create and whisks", "one robot"]),
        ({"live": CREATE, "backend": "recall"}, ["backend", "recognises views", "--set backend=grid"]),
        ({"live": CREATE}, ["backend", "--set backend=grid"]),
        ({"live": CREATE, "backend": "grid"}, ["/dev/ttyNONE", "no such port; expected one of the ports"]),
        (
            {"live": {"create": {"port": "/dev/ttyNONE", "speed": 0.04}}, "backend": "grid"},
            ["live.create.plan.behaviour", "0.05 m/s", "0.04"],
        ),
    ],
    ids=["arm", "whisks", "recall", "default", "port", "speed"],
)
def test_invalid_sessions_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], config: dict[str, Any], messages: list[str]
) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(yaml.safe_dump(config))
    assert main(["live", str(file), "-o", str(tmp_path / "run")]) == 2
    output = capsys.readouterr().err
    for text in messages:
        assert text in output
    assert output.count("error: ") == 1
    assert not (tmp_path / "run").exists()


def test_a_folder_that_cannot_be_made_is_refused_before_the_devices(tmp_path: Path, capsys) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(yaml.safe_dump({"live": CREATE, "backend": "grid"}))
    assert main(["live", str(file), "-o", str(file / "run")]) == 2
    assert f"{file}: not a folder; expected an existing folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        (["create", "live_maze"], ["that of an arm", "`live_create`"]),
        (["head", "live_create"], ["that of a Create", "`live_maze`"]),
        (["create", "live_create", "--set", "live.create.port=/dev/ttyUSB0"], ["live.create.port"]),
        (["create", "live_create", "--set", "live.head.address=usb"], ["live.head.address"]),
    ],
)
def test_emulators_that_do_not_fit_are_refused(capsys, arguments: list[str], messages: list[str]) -> None:
    assert main(["emulate", *arguments]) == 2
    output = capsys.readouterr().err
    for text in messages:
        assert text in output


def test_the_packaged_session_is_complete() -> None:
    config = load_config("live_create")
    assert config.live is not None
    assert config.live.create is not None
    assert config.backend == "grid"
