"""Answers of the dashboard."""

from __future__ import annotations

import pytest

from tests.robot.emulators.ur10.controller_bench import Bench


@pytest.mark.parametrize(("polyscope", "modern"), [("3.4", False), ("5.5.1", False), ("5.6", True)])
def test_dashboard_commands_depend_on_the_version(polyscope: str, modern: bool) -> None:
    bench = Bench(polyscope=polyscope)
    assert polyscope in bench.ask("PolyscopeVersion")
    assert bench.ask("robotmode") == "Robotmode: RUNNING"
    assert bench.ask("running") == "Program running: true"
    assert bench.ask("stop") == "Stopped"
    assert bench.ask("running") == "Program running: false"
    assert (bench.ask("is in remote control") == "true") == modern
    assert bench.ask("get serial number").isdigit() == modern
    assert bench.ask("juggle") == "could not understand: 'juggle'"
