"""Values of configuration files against their settings: messages with their places, the schema."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ratslam.runs.settings.strict_yaml import parse, schema, validate
from tests.ratslam.runs.settings.example_schema import (
    VALID,
    Config,
    PoseCells,
    Recording,
    Simulation,
    refusal,
)


def test_reads_every_part() -> None:
    config = validate(parse(VALID, "config.yaml"), Config)
    assert config == Config(
        pose_cells=PoseCells(excite_sigma=1e-3),
        metric="cosine",
        source=Recording(path=Path("data/a.mcap")),
        others=(Simulation(simulation=3), Recording(kind="bag", path=Path("b.bag"))),
        width=(1.5, 0.5),
        gains={"left": 1.0, "right": -250.0},
        learn=False,
        name="off",
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "steps: 1\npose_cells:\n  exite_sigma: 2",
            "3:3: pose_cells.exite_sigma: unknown key; did you mean 'excite_sigma'?",
        ),
        ("source: {sped: 3}", "1:1: source.kind: missing; expected 'recording', 'bag' or 'simulation'"),
        (
            "source: {kind: simulation, sped: 3}",
            "1:28: source.sped: unknown key; the keys here are kind, simulation",
        ),
        (
            "source:\n  kind: simulation\n  simulation: x",
            "3:15: source.simulation: 'x'; expected a whole number",
        ),
        (
            "others:\n- kind: simulatoin",
            "2:9: others.0.kind: 'simulatoin'; expected 'recording', 'bag' or 'simulation'; "
            "did you mean 'simulation'?",
        ),
        (
            "others:\n- kind: simulation\n- kind: bag",
            "3:3: others.1.path: missing; The file of the recording.",
        ),
        ("source:\n  kind: bag", "1:1: source.path: missing; The file of the recording."),
        (
            "pose_cells:\n  excite_sigma: -1",
            "2:17: pose_cells.excite_sigma: -1; expected a number greater than 0",
        ),
        ("steps: -1", "1:8: steps: -1; expected a number greater than or equal to 0"),
        ("steps: 1.5", "1:8: steps: 1.5; expected a whole number"),
        ("steps: '5'", "1:8: steps: '5'; expected a whole number"),
        ("steps: true", "1:8: steps: true; expected a whole number"),
        ("steps:", "1:7: steps: nothing; expected a whole number"),
        ("learn: yes", "1:8: learn: 'yes'; expected true or false"),
        ("learn: 1", "1:8: learn: 1; expected true or false"),
        ("name: 3", "1:7: name: 3; expected text"),
        ("gains: 3", "1:8: gains: 3; expected a section of keys and values"),
        ("gains:\n  left: 12:30", "2:9: gains.left: '12:30'; expected a number"),
        ("gains: {left: .inf}", "1:15: gains.left: inf; expected a finite number"),
        ("pose_cells: [1]", "1:13: pose_cells: a list of 1; expected a section of keys and values"),
        ("optional: {shape: 3}", "1:19: optional.shape: 3; expected a list"),
        ("metric: L1", "1:9: metric: 'L1'; expected 'l1' or 'cosine'; did you mean 'l1'?"),
        ("motion: Turns", "1:9: motion: 'Turns'; expected 'forward' or 'turn'; did you mean 'turn'?"),
        ("motion: back", "1:9: motion: 'back'; expected 'forward' or 'turn'"),
        ("width: wide", "1:8: width: 'wide'; expected a number or a list"),
        ("pose_cells: {shape: [1]}", "1:21: pose_cells.shape: a list of 1; expected 3 values"),
        ("pose_cells: {shape: [1, 2, 3, 4]}", "1:21: pose_cells.shape: a list of 4; expected 3 values"),
        ("pose_cells: {shape: [1, 2, x]}", "1:28: pose_cells.shape.2: 'x'; expected a whole number"),
        ("pose_cells: {shape: [2, 2, 2]}", "1:13: pose_cells: one of x and y must be odd"),
        (f"weights: {[0] * 51}", "1:10: weights: a list of 51; expected at most 50 values"),
    ],
)
def test_invalid_configurations_are_refused(text: str, message: str) -> None:
    assert refusal(text) == f"config.yaml:{message}"


def test_all_errors_are_reported_at_once_in_the_order_of_the_file() -> None:
    lines = refusal("zzz: 1\nsteps: x\nmetric: l3\npose_cells:\n  excite_sigma: 0\n  shape: []").splitlines()
    assert [line.split(": ")[1] for line in lines] == [
        "zzz",
        "steps",
        "metric",
        "pose_cells.excite_sigma",
        "pose_cells.shape",
    ]


def test_many_errors_are_cut_short() -> None:
    lines = refusal("gains:\n" + "".join(f"  k{i}: x\n" for i in range(99))).splitlines()
    assert len(lines) == 51
    assert lines[-1] == "and 49 more errors"


def test_the_schema_lists_the_keys_for_editors() -> None:
    described = schema(Config)
    json.dumps(described)
    assert described["$schema"].startswith("https://json-schema.org/")
    assert described["title"] == "Config"
    assert described["description"] == "A whole configuration."
    section = described["$defs"]["PoseCells"]
    assert section["properties"]["excite_sigma"]["description"] == "Width of the excitation, cells."
    assert section["properties"]["excite_sigma"]["exclusiveMinimum"] == 0
    assert section["additionalProperties"] is False
