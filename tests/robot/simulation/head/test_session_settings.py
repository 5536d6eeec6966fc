"""Settings of simulated sessions: refused, dumped, and the tier that they choose."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig, choose_tier
from tactile.base.errors import InputError
from tactile.whisker_geometry import HeadConfig, RingConfig
from tests.robot.simulation.head.session_cases import LOOP, simulate

ROOM = "o---o---o\n|       |\no   o   o\n|       |\no---o---o\n"
BLOCKED = "o---o---o\n|       |\no   o   o\n|   |   |\no---o---o\n"
LOW = HeadConfig(rings=(RingConfig(length=0.16, radius=0.045, height=0.07),), rest_deg=75.0)


@pytest.mark.parametrize(
    ("changes", "pieces"),
    [
        ({"maze": {"loop": 21}}, ["simulation.maze.loop", "21 cells", "even"]),
        ({"maze": {"heights": (0.05, 0.09)}}, ["simulation.maze.heights", "0.09 m", "less than 0.082 m"]),
        ({"maze": {"file": "ROOM"}}, ["simulation.path.loop", "circuits without a loop"]),
        (
            {"maze": {"file": "BLOCKED"}, "path": {"loop": LOOP}},
            ["simulation.path.loop[0] to [1]", "the wall between cells (0, 0) and (1, 0)"],
        ),
        (
            {"maze": {"file": "BLOCKED"}, "path": {"cells": LOOP}},
            ["simulation.path.cells[0] to [1]", "the wall between cells (0, 0) and (1, 0)"],
        ),
        ({"maze": {"file": "ROOM"}, "path": {"cells": [(0, 0), (2, 0)]}}, ["cells[1]", "columns 0 to 1"]),
        ({"maze": {"kind": "tree"}}, ["simulation.path", "without loops", "simulation.maze.kind"]),
        ({"path": {"loop": [*LOOP, (3, 3)]}}, ["path.loop[3] to [4]", "neighbouring"]),
        ({"path": {"loop": [(-1, 0), (0, 0)]}}, ["path.loop[0]", "cell (-1, 0)"]),
        ({"path": {"cells": [(0, 0)]}}, ["simulation.path.cells", "at least two"]),
        ({"path": {"circuits": "CAX"}}, ["simulation.path.circuits", "'CAX'"]),
        ({"path": {"explore": 0.5}}, ["simulation.path", "0.5 s", "one whisk"]),
        ({"whisking": {"amplitude_deg": 80.0}}, ["simulation.whisking.amplitude_deg", "70"]),
        ({"kidnaps": {"count": 40, "ahead": 60.0}}, ["simulation.kidnaps", "40 times 60 s"]),
        ({"fidelity": "kinematic", "raw": True}, ["simulation.fidelity", "no raw samples"]),
    ],
)
def test_impossible_settings_are_refused(
    changes: dict[str, Any], pieces: list[str], tmp_path: Path, refused: Callable[..., InputError]
) -> None:
    for name, drawing in {"ROOM": ROOM, "BLOCKED": BLOCKED}.items():
        (tmp_path / name).write_text(drawing)
    config = SimulationConfig.model_validate(changes).resolved(tmp_path)
    refused(lambda: HeadSimulation(config), *pieces)


def test_a_head_that_does_not_fit_is_refused(refused: Callable[..., InputError]) -> None:
    config = SimulationConfig.model_validate({"maze": {"share": 1.0}})
    words = ("simulation.path", "at 0.0 s, in cell", "whisker", "at rest is inside the", "of cell")
    refused(lambda: HeadSimulation(config, LOW), *words)


@pytest.mark.parametrize(
    "path", [{"circuits": ""}, {"explore": 5.0, "cells": LOOP}, {"circuits": "CA", "explore": 5.0}]
)
def test_exactly_one_kind_of_route_is_given(path: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="give exactly one"):
        SimulationConfig.model_validate({"path": path})


def test_a_dumped_configuration_is_read_back_equal() -> None:
    for path in ({"explore": 5.0}, {"cells": LOOP}, {"circuits": "A"}, {}):
        config = SimulationConfig.model_validate({"path": path})
        assert SimulationConfig.model_validate(config.model_dump(mode="json")) == config


def test_auto_chooses_the_cheapest_sufficient_tier() -> None:
    assert choose_tier(SimulationConfig())[0] == "kinematic"
    assert choose_tier(SimulationConfig(raw=True))[0] == "quasistatic"
    assert choose_tier(SimulationConfig(fidelity="dynamic"))[0] == "dynamic"
    assert all(choose_tier(SimulationConfig(raw=raw))[1] for raw in (False, True))


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"maze": {"added": [[[0, 0], [1, 0]]], "heights": [0.03, 0.05]}}, "one height"),
        ({"path": {"cells": [[0, 0], [1, 0]], "start": 2}}, "start"),
        ({"path": {"circuits": "C", "within": [[0, 0]]}}, "within"),
    ],
)
def test_settings_without_effect_are_refused(part: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        SimulationConfig.model_validate(part)


def test_a_start_beyond_the_loop_is_refused() -> None:
    with pytest.raises(InputError, match=r"simulation\.path\.start: 20"):
        simulate(path={"circuits": "C", "start": 20})
