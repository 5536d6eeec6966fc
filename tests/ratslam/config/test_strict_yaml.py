"""Configuration files: accepted and refused content, and the places in messages."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from ratslam.config.strict_yaml import dump, load, override, parse, schema, validate
from tactile.base.errors import InputError
from tests.ratslam.config.example_schema import (
    VALID,
    Config,
    PoseCells,
    Recording,
    Simulation,
    overridden,
)


def _message(text: str) -> str:
    """The message for a text that cannot be read or is not a `Config`."""
    with pytest.raises(InputError) as caught:
        validate(parse(text, "config.yaml"), Config)
    return str(caught.value)


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
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        ("-1E+3", -1000.0),
        (".5", 0.5),
        ("1.", 1.0),
        ("+7", 7),
        ("0", 0),
        ("0.0", 0.0),
        ("0o17", 15),
        ("0x1F", 31),
        ("-9223372036854775808", -(1 << 63)),
        ("-.inf", -math.inf),
        ("true", True),
        ("false", False),
        ("null", None),
        ("~", None),
        ("", None),
        ("yes", "yes"),
        ("no", "no"),
        ("on", "on"),
        ("Off", "Off"),
        ("True", "True"),
        ("NULL", "NULL"),
        ("12:30", "12:30"),
        ("1:2:3", "1:2:3"),
        ("1_000", "1_000"),
        ("2024-01-01", "2024-01-01"),
        ("0b11", "0b11"),
        (".", "."),
        ("1e", "1e"),
        ("<<", "<<"),
        ("=", "="),
        ("'1e-3'", "1e-3"),
        ('"010"', "010"),
        ("'true'", "true"),
        ("|\n  a\n  b", "a\nb"),
        ("$5 and $${NAME}", "$5 and ${NAME}"),
        ("größer", "größer"),
    ],
)
def test_scalars(text: str, value: Any) -> None:
    read = parse(f"key: {text}", "config.yaml").data["key"]
    assert read == value
    assert type(read) is type(value)


def test_not_a_number() -> None:
    assert math.isnan(parse("key: .nan", "config.yaml").data["key"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "config.yaml:1:1: empty; expected keys and values"),
        ("# only a comment\n", "config.yaml:2:1: empty; expected keys and values"),
        ("---\n", "config.yaml:2:1: nothing; expected keys and values such as 'seed: 1'"),
        ("\n- 1\n", "config.yaml:2:1: a list of 1; expected keys and values such as 'seed: 1'"),
        ("hello", "config.yaml:1:1: 'hello'; expected keys and values such as 'seed: 1'"),
        ("a: 1\n---\nb: 1", "config.yaml:2:1: a second document; expected only one"),
        (
            "a:\n  b: 1\n  c: 2\n  b: 3",
            "config.yaml:4:3: a.b: given twice; the first is at config.yaml:2:3",
        ),
        ("a: [1, 2\nb: 3", "config.yaml:2:2: not YAML: expected ',' or ']', but got ':'"),
        ("a: 1\nb: [1, {c: 2}", "config.yaml:2:4: a bracket that is not closed"),
        ("b: [1, {c: 2", "config.yaml:1:8: a bracket that is not closed"),
        ("a: b: c", "config.yaml:1:5: not YAML: mapping values are not allowed here"),
        (
            "a:\n\tb: 1",
            r"config.yaml:2:1: not YAML: found character '\t' that cannot start any token; "
            "indent with spaces, not tabs",
        ),
        ("a: 'b", "config.yaml:1:6: not YAML: found unexpected end of stream"),
        (
            "a: 010",
            "config.yaml:1:4: a: 010; expected a number without leading zeros; quote it if it is a name",
        ),
        (
            "a: 00.5",
            "config.yaml:1:4: a: 00.5; expected a number without leading zeros; quote it if it is a name",
        ),
        ("a: 1e999", "config.yaml:1:4: a: 1e999; expected a number that fits 64 bits"),
        (
            "a: 9223372036854775808",
            "config.yaml:1:4: a: 9223372036854775808; expected a number that fits 64 bits",
        ),
        ("1: a", "config.yaml:1:1: the key 1; expected text; write '1'"),
        ("a: {true: 1}", "config.yaml:1:5: a: the key true; expected text; write 'true'"),
        ("? [a, b]\n: 1", "config.yaml:1:3: a key that is not plain text; expected a plain key"),
        ("a: &x 1\nb: *x", "config.yaml:1:4: a: an anchor (&x); write the value out at each place"),
        ("a: *x", "config.yaml:1:4: a: an alias (*x); write the value out at each place"),
        (
            "a: !!python/name:os.system x",
            "config.yaml:1:4: a: a tag (tag:yaml.org,2002:python/name:os.system)",
        ),
        ("a: !e x", "config.yaml:1:4: a: a tag (!e); expected a plain value"),
        ("a: 1\nb: \x07", r"config.yaml:2:4: the character '\x07'; expected text"),
        (r'a: "\0"', r"config.yaml:1:4: a: '\x00'; expected text without control characters"),
        (r'a: "\ud800"', r"config.yaml:1:4: a: '\ud800'; expected text without control characters"),
        (r'a: "\UFFFFFFFF"', "config.yaml:1:1: not YAML: an escape out of range after this"),
        ("a: " + "[" * 33, "config.yaml:1:35: a.0.0: sections nested more than 32 deep"),
        ("- " * 1000, "config.yaml:1:65: 0.0.0: sections nested more than 32 deep"),
        ("a: ${}", "config.yaml:1:4: a: '${}'; expected ${NAME}; write $${ for a literal ${"),
        ("a: ${HOME", "config.yaml:1:4: a: '${HOME'; expected ${NAME}; write $${ for a literal ${"),
    ],
)
def test_invalid_yaml_is_refused(text: str, message: str) -> None:
    assert _message(text).startswith(message)


def test_all_refused_values_are_reported_at_once() -> None:
    lines = _message("a: 010\nb: 1\nb: 2\n3: 4").splitlines()
    assert [line.split(": ")[0] for line in lines] == [
        "config.yaml:1:4",
        "config.yaml:3:1",
        "config.yaml:4:1",
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "steps: 1\npose_cells:\n  exite_sigma: 2",
            "config.yaml:3:3: pose_cells.exite_sigma: unknown key; did you mean 'excite_sigma'?",
        ),
        (
            "source: {sped: 3}",
            "config.yaml:1:1: source.kind: missing; expected 'recording', 'bag' or 'simulation'",
        ),
        (
            "source: {kind: simulation, sped: 3}",
            "config.yaml:1:28: source.sped: unknown key; the keys here are kind, simulation",
        ),
        (
            "source:\n  kind: simulation\n  simulation: x",
            "config.yaml:3:15: source.simulation: 'x'; expected a whole number",
        ),
        (
            "others:\n- kind: simulatoin",
            "config.yaml:2:9: others.0.kind: 'simulatoin'; expected 'recording', 'bag' or 'simulation'; "
            "did you mean 'simulation'?",
        ),
        (
            "others:\n- kind: simulation\n- kind: bag",
            "config.yaml:3:3: others.1.path: missing; The file of the recording.",
        ),
        ("source:\n  kind: bag", "config.yaml:1:1: source.path: missing; The file of the recording."),
        (
            "pose_cells:\n  excite_sigma: -1",
            "config.yaml:2:17: pose_cells.excite_sigma: -1; expected a number greater than 0",
        ),
        ("steps: -1", "config.yaml:1:8: steps: -1; expected a number greater than or equal to 0"),
        ("steps: 1.5", "config.yaml:1:8: steps: 1.5; expected a whole number"),
        ("steps: '5'", "config.yaml:1:8: steps: '5'; expected a whole number"),
        ("steps: true", "config.yaml:1:8: steps: true; expected a whole number"),
        ("steps:", "config.yaml:1:7: steps: nothing; expected a whole number"),
        ("learn: yes", "config.yaml:1:8: learn: 'yes'; expected true or false"),
        ("learn: 1", "config.yaml:1:8: learn: 1; expected true or false"),
        ("name: 3", "config.yaml:1:7: name: 3; expected text"),
        ("gains: 3", "config.yaml:1:8: gains: 3; expected a section of keys and values"),
        ("gains:\n  left: 12:30", "config.yaml:2:9: gains.left: '12:30'; expected a number"),
        ("gains: {left: .inf}", "config.yaml:1:15: gains.left: inf; expected a finite number"),
        (
            "pose_cells: [1]",
            "config.yaml:1:13: pose_cells: a list of 1; expected a section of keys and values",
        ),
        ("optional: {shape: 3}", "config.yaml:1:19: optional.shape: 3; expected a list"),
        ("metric: L1", "config.yaml:1:9: metric: 'L1'; expected 'l1' or 'cosine'; did you mean 'l1'?"),
        (
            "motion: Turns",
            "config.yaml:1:9: motion: 'Turns'; expected 'forward' or 'turn'; did you mean 'turn'?",
        ),
        ("motion: back", "config.yaml:1:9: motion: 'back'; expected 'forward' or 'turn'"),
        ("width: wide", "config.yaml:1:8: width: 'wide'; expected a number or a list"),
        ("pose_cells: {shape: [1]}", "config.yaml:1:21: pose_cells.shape: a list of 1; expected 3 values"),
        (
            "pose_cells: {shape: [1, 2, 3, 4]}",
            "config.yaml:1:21: pose_cells.shape: a list of 4; expected 3 values",
        ),
        (
            "pose_cells: {shape: [1, 2, x]}",
            "config.yaml:1:28: pose_cells.shape.2: 'x'; expected a whole number",
        ),
        ("pose_cells: {shape: [2, 2, 2]}", "config.yaml:1:13: pose_cells: one of x and y must be odd"),
        (
            f"weights: {[0] * 51}",
            "config.yaml:1:10: weights: a list of 51; expected at most 50 values",
        ),
    ],
)
def test_invalid_configurations_are_refused(text: str, message: str) -> None:
    assert _message(text) == message


def test_all_errors_are_reported_at_once_in_the_order_of_the_file() -> None:
    lines = _message("zzz: 1\nsteps: x\nmetric: l3\npose_cells:\n  excite_sigma: 0\n  shape: []").splitlines()
    assert [line.split(": ")[1] for line in lines] == [
        "zzz",
        "steps",
        "metric",
        "pose_cells.excite_sigma",
        "pose_cells.shape",
    ]


def test_many_errors_are_cut_short() -> None:
    lines = _message("gains:\n" + "".join(f"  k{i}: x\n" for i in range(99))).splitlines()
    assert len(lines) == 51
    assert lines[-1] == "and 49 more errors"


def test_environment_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RATSLAM_TEST", "here: ${and} there")
    data = parse("a: ${RATSLAM_TEST}/x\nb: ['${RATSLAM_TEST}']\n${C}: 1", "config.yaml").data
    assert data == {"a": "here: ${and} there/x", "b": ["here: ${and} there"], "${C}": 1}


def test_an_unset_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RATSLAM_DATA", raising=False)
    monkeypatch.setenv("RATSLAM_TEST", "")
    first, second = _message("a: ${RATSLAM_DATA}/x\nb:\n- ${RATSLAM_TEST}").splitlines()
    assert first == (
        "config.yaml:1:4: a: the environment variable RATSLAM_DATA is not set; "
        "the recordings are not part of the project: set RATSLAM_DATA to the folder that holds them"
    )
    assert second.startswith(
        "config.yaml:3:3: b.0: the environment variable RATSLAM_TEST is not set; set RATSLAM_TEST"
    )


def test_files(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_bytes(b"\xef\xbb\xbfname: gr\xc3\xbcn\r\nsteps: 2\r\n")
    assert load(file).data == {"name": "grün", "steps": 2}
    assert load(file).at_value(("steps",)) == f"{file}:2:8: steps"
    for content, found in {
        b"a: 1\nb: \xff": r":2: byte 0xff; expected text in UTF-8",
        b"\xff\xfea\x00": ":1: byte 0xff; expected text in UTF-8",
        b"\x7fELF\x02\x00\x00": r":1:1: the character '\x7f'; expected text",
        b"a: 1\n" * 40000: ": a large file; expected a configuration of at most 128 KiB",
    }.items():
        file.write_bytes(content)
        with pytest.raises(InputError) as caught:
            load(file)
        assert str(caught.value) == f"{file}{found}"
    for path in (tmp_path / "none.yaml", tmp_path, tmp_path / ("x" * 300), "a\0b"):
        with pytest.raises(InputError, match="cannot be read: "):
            load(path)


def test_override() -> None:
    document = parse(VALID, "config.yaml")
    config = validate(
        override(
            document,
            [
                "pose_cells.excite_sigma=2e-3",
                "pose_cells.shape.0=23",
                "others.0.simulation=4",
                "optional.excite_sigma=3",
                "gains={up: 1}",
                "gains.down=2",
                "name=a=b",
                "steps=1",
                "steps=2",
            ],
        ),
        Config,
    )
    assert config.pose_cells == PoseCells(excite_sigma=2e-3, shape=(23, 21, 36))
    assert config.others[0] == Simulation(simulation=4)
    assert config.optional == PoseCells(excite_sigma=3)
    assert config.gains == {"up": 1, "down": 2}
    assert config.name == "a=b"
    assert config.steps == 2
    assert document == parse(VALID, "config.yaml")


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("steps", "--set steps: not an assignment; expected key=value such as pose_cells.excite_sigma=1e-3"),
        ("=1", "--set : not an assignment"),
        ("a..b=1", "--set a..b: not an assignment"),
        ("steps=", "--set steps: empty; expected a value"),
        ("steps=yes", "--set steps: 'yes'; expected a whole number"),
        ("steps=[1", "--set steps: a bracket that is not closed"),
        ("steps=010", "--set steps: 010; expected a number without leading zeros"),
        ("steps.x=1", "--set steps.x: steps is 5; expected a section to put a key in"),
        ("weights.2=1", "--set weights.2: weights has 2 items; expected an index below 2"),
        ("weights.x=1", "--set weights.x: weights has 2 items; expected an index below 2"),
        ("stepz=1", "--set stepz: unknown key; did you mean 'steps'?"),
        (
            "pose_cells.exite_sigma=1",
            "--set pose_cells.exite_sigma: unknown key; did you mean 'excite_sigma'?",
        ),
        (
            "pose_cells={exite_sigma: 1}",
            "--set pose_cells.exite_sigma: unknown key; did you mean 'excite_sigma'?",
        ),
        ("optional.shape.x=1", "--set optional.shape: a section of keys and values; expected a list"),
        ("source.kind=bag", "--set source.path: missing; The file of the recording."),
    ],
)
def test_override_errors(assignment: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        overridden(assignment, text="steps: 5\nweights: [1, 2]")
    assert str(caught.value).startswith(message)


def test_dump_is_readable() -> None:
    assert dump(Config(name="no", source=Recording(path=Path("a")), gains={"1": 1e-300})) == (
        "pose_cells:\n  excite_sigma: 1.0\n  shape: [21, 21, 36]\n"
        "metric: l1\nmotion: forward\n"
        "source:\n  kind: recording\n  path: a\n"
        "others: []\noptional: null\nwidth: 1.0\n"
        "gains:\n  '1': 1.0e-300\n"
        "learn: true\nsteps: 10\nname: 'no'\nweights: []\n"
    )


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
