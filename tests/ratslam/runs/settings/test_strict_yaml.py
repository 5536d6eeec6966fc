"""Configuration files: scalars, refusals with their places, assignments, environment, dumps, the schema."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Annotated, Any, Literal

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import Field, model_validator

from ratslam.runs.settings.strict_yaml import LARGEST, MOST, SMALLEST, dump, load, parse, schema, validate
from ratslam.runs.settings.strict_yaml import override as assign
from tactile.base.errors import InputError
from tactile.base.settings import Settings


class PoseCells(Settings):
    excite_sigma: float = Field(1.0, gt=0)
    """Width of the excitation, cells."""
    shape: tuple[int, int, int] = (21, 21, 36)
    """Cells along x, y and heading."""

    @model_validator(mode="after")
    def _odd(self) -> PoseCells:
        if self.shape[0] % 2 == 0 and self.shape[1] % 2 == 0:
            raise ValueError("one of x and y must be odd")
        return self


class Recording(Settings):
    kind: Literal["recording", "bag"] = "recording"
    path: Path
    """The file of the recording."""


class Simulation(Settings):
    kind: Literal["simulation"] = "simulation"
    simulation: int = 0
    """A field named as the union's tag."""


Source = Annotated[Recording | Simulation, Field(discriminator="kind")]


class Config(Settings):
    """A whole configuration."""

    pose_cells: PoseCells = PoseCells()
    metric: Literal["l1", "cosine"] = "l1"
    motion: Literal["forward", "turn"] = "forward"
    source: Source = Simulation()
    others: tuple[Source, ...] = ()
    optional: PoseCells | None = None
    width: float | tuple[float, float] = 1.0
    gains: dict[str, float] = Field(default_factory=dict)
    learn: bool = True
    steps: int = Field(10, ge=0)
    name: str = Field("run", max_length=1000)
    weights: tuple[float, ...] = Field((), max_length=50)


VALID = """\
# every part once
pose_cells:
  excite_sigma: 1e-3
  shape: [21, 21, 36]
metric: cosine
source: {kind: recording, path: "data/a.mcap"}
others:
- kind: simulation
  simulation: 3
- {kind: bag, path: b.bag}
optional:
width: [1.5, .5]
gains: {left: 1, right: -2.5e+2}
learn: false
name: off
"""


def read(text: str, *assignments: str) -> Config:
    return validate(assign(parse(text, "c.yaml"), assignments), Config)


def refusal(text: str, *assignments: str) -> str:
    with pytest.raises(InputError) as caught:
        read(text, *assignments)
    return str(caught.value)


@pytest.mark.parametrize(("text", "value"), [
    ("1e-3", 1e-3), ("-1E+3", -1000.0), (".5", 0.5), ("1.", 1.0), ("+7", 7), ("0", 0), ("0.0", 0.0),
    ("0o17", 15), ("0x1F", 31), ("-9223372036854775808", -(1 << 63)), ("-.inf", -math.inf), ("true", True),
    ("false", False), ("null", None), ("~", None), ("", None), ("yes", "yes"), ("no", "no"), ("on", "on"),
    ("Off", "Off"), ("True", "True"), ("NULL", "NULL"), ("12:30", "12:30"), ("1:2:3", "1:2:3"),
    ("1_000", "1_000"), ("2024-01-01", "2024-01-01"), ("0b11", "0b11"), (".", "."), ("1e", "1e"),
    ("<<", "<<"), ("=", "="), ("'1e-3'", "1e-3"), ('"010"', "010"), ("'true'", "true"),
    ("|\n  a\n  b", "a\nb"), ("$5 and $${NAME}", "$5 and ${NAME}"), ("größer", "größer"),
])  # fmt: skip
def test_scalars(text: str, value: Any) -> None:
    found = parse(f"nan: .nan\nkey: {text}", "config.yaml").data
    assert found["key"] == value
    assert type(found["key"]) is type(value)
    assert math.isnan(found["nan"])


def test_every_part_is_read() -> None:
    assert read(VALID) == Config(
        pose_cells=PoseCells(excite_sigma=1e-3), metric="cosine", source=Recording(path=Path("data/a.mcap")),
        others=(Simulation(simulation=3), Recording(kind="bag", path=Path("b.bag"))), width=(1.5, 0.5),
        gains={"left": 1.0, "right": -250.0}, learn=False, name="off",
    )  # fmt: skip


@pytest.mark.parametrize(("text", "message"), [
    ("", "1:1: empty"),
    ("---\n", "2:1: nothing; expected keys and values"),
    ("\n- 1\n", "2:1: a list of 1; expected keys and values"),
    ("a: 1\n---\nb: 1", "2:1: a second document"),
    ("a:\n  b: 1\n  c: 2\n  b: 3", "4:3: a.b: given twice; the first is at c.yaml:2:3"),
    ("a: 1\nb: [1, {c: 2}", "2:4: a bracket that is not closed"),
    ("a:\n\tb: 1", r"2:1: not YAML: found character '\t' that cannot start any token; indent with"),
    ("a: 'b", "1:6: not YAML: found unexpected end of stream"),
    ("a: 010", "1:4: a: 010; expected a number without leading zeros; quote it"),
    ("a: 1e999", "1:4: a: 1e999; expected a number that fits 64 bits"),
    ("a: 9223372036854775808", "1:4: a: 9223372036854775808; expected a number that fits 64 bits"),
    ("1: a", "1:1: the key 1; expected text; write '1'"),
    ("a: {true: 1}", "1:5: a: the key true; expected text; write 'true'"),
    ("? [a, b]\n: 1", "1:3: a key that is not plain text"),
    ("a: &x 1\nb: *x", "1:4: a: an anchor (&x)"),
    ("a: *x", "1:4: a: an alias (*x)"),
    ("a: !!python/name:os.system x", "1:4: a: a tag (tag:yaml.org,2002:python/name:os.system)"),
    ("a: 1\nb: \x07", r"2:4: the character '\x07'"),
    (r'a: "\0"', r"1:4: a: '\x00'; expected text without control characters"),
    (r'a: "\ud800"', r"1:4: a: '\ud800'; expected text without control characters"),
    (r'a: "\UFFFFFFFF"', "1:1: not YAML: an escape out of range"),
    ("a: " + "[" * 33, "1:35: a.0.0: sections nested more than 32 deep"),
    ("a: ${}", "1:4: a: '${}'; expected ${NAME}; write $${"),
    ("a: ${HOME", "1:4: a: '${HOME'; expected ${NAME}"),
    ("pose_cells:\n  exite_sigma: 2", "2:3: pose_cells.exite_sigma: unknown key; did you mean 'excite_"),
    ("source: {sped: 3}", "1:1: source.kind: missing; expected 'recording', 'bag' or 'simulation'"),
    ("source: {kind: simulation, simulation: x}", "1:40: source.simulation: 'x'; expected a whole nu"),
    ("source: {kind: simulation, sped: 3}", "1:28: source.sped: unknown key; the keys here are kind, s"),
    ("others:\n- kind: simulation\n- kind: bag", "3:3: others.1.path: missing; The file of the"),
    ("pose_cells:\n  excite_sigma: -1", "2:17: pose_cells.excite_sigma: -1; expected a number great"),
    ("steps: -1", "1:8: steps: -1; expected a number greater than or equal to 0"),
    ("steps: 1.5", "1:8: steps: 1.5; expected a whole number"),
    ("steps:", "1:7: steps: nothing; expected a whole number"),
    ("learn: yes", "1:8: learn: 'yes'; expected true or false"),
    ("name: 3", "1:7: name: 3; expected text"),
    ("gains: 3", "1:8: gains: 3; expected a section of keys and values"),
    ("gains: {left: .inf}", "1:15: gains.left: inf; expected a finite number"),
    ("gains: {left: 1.1e15}", "1:15: gains.left: 1100000000000000.0; expected 0, or a number of"),
    ("gains: {left: -9e-31}", "1:15: gains.left: -9e-31; expected 0, or a number of 1e-30 to 1e+15"),
    ("steps: 2147483648", "1:8: steps: 2147483648; expected at most 2147483647"),
    ("optional: {shape: 3}", "1:19: optional.shape: 3; expected a list"),
    ("metric: L1", "1:9: metric: 'L1'; expected 'l1' or 'cosine'; did you mean 'l1'?"),
    ("width: wide", "1:8: width: 'wide'; expected a number or a list"),
    ("pose_cells: {shape: [1]}", "1:21: pose_cells.shape: a list of 1; expected 3 values"),
    ("pose_cells: {shape: [1, 2, 3, 4]}", "1:21: pose_cells.shape: a list of 4; expected 3 values"),
    ("pose_cells: {shape: [2, 2, 2]}", "1:13: pose_cells: one of x and y must be odd"),
    (f"weights: {[0] * 51}", "1:10: weights: a list of 51; expected at most 50 values"),
])  # fmt: skip
def test_invalid_configurations_are_refused_where_they_are_wrong(text: str, message: str) -> None:
    assert refusal(text).startswith(f"c.yaml:{message}")


def test_all_errors_are_reported_at_once_in_the_order_of_the_file_or_the_first_50() -> None:
    assert refusal("a: 010\nb: 1\nb: 2\n3: 4").count("\n") == 2
    text = "zzz: 1\nsteps: x\nmetric: l3\npose_cells:\n  excite_sigma: 0\n  shape: []"
    names = [line.split(": ")[:2] for line in refusal(text).splitlines()]
    assert names == [
        ["c.yaml:1:1", "zzz"], ["c.yaml:2:8", "steps"], ["c.yaml:3:9", "metric"],
        ["c.yaml:5:17", "pose_cells.excite_sigma"], ["c.yaml:6:10", "pose_cells.shape"],
    ]  # fmt: skip
    for count in (50, 51, 99):
        lines = refusal("gains:\n" + "".join(f"  k{i}: x\n" for i in range(count))).splitlines()
        assert lines[50:] == ([f"and {count - 50} more errors"] if count > 50 else [])


def test_assignments_replace_and_add_values() -> None:
    document = parse(VALID, "config.yaml")
    set_first = ["pose_cells.excite_sigma=2e-3", "pose_cells.shape.0=23", "others.0.simulation=4"]
    set_then = ["optional.excite_sigma=3", "gains={up: 1}", "gains.down=2", "name=a=b", "steps=1", "steps=2"]
    config = validate(assign(document, set_first + set_then), Config)
    changed = {
        "pose_cells": PoseCells(excite_sigma=2e-3, shape=(23, 21, 36)), "optional": PoseCells(excite_sigma=3),
        "others": (Simulation(simulation=4), read(VALID).others[1]), "gains": {"up": 1, "down": 2},
        "name": "a=b", "steps": 2,
    }  # fmt: skip
    assert config == read(VALID).model_copy(update=changed)
    assert document == parse(VALID, "config.yaml")


@pytest.mark.parametrize(("assignment", "message"), [
    ("steps", "steps: not an assignment; expected key=value"),
    ("=1", ": not an assignment"),
    ("steps=", "steps: empty; expected a value"),
    ("steps=yes", "steps: 'yes'; expected a whole number"),
    ("steps=[1", "steps: a bracket that is not closed"),
    ("steps.x=1", "steps.x: steps is 5; expected a section to put a key in"),
    ("weights.2=1", "weights.2: weights has 2 items; expected an index below 2"),
    ("weights.x=1", "weights.x: weights has 2 items; expected an index below 2"),
    ("stepz=1", "stepz: unknown key; did you mean 'steps'?"),
    ("optional.shape.x=1", "optional.shape: a section of keys and values; expected a list"),
    ("source.kind=bag", "source.path: missing; The file of the recording."),
])  # fmt: skip
def test_wrong_assignments_are_refused(assignment: str, message: str) -> None:
    assert refusal("steps: 5\nweights: [1, 2]", assignment).startswith(f"--set {message}")


def test_environment_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "a: ${RATSLAM_TEST}/x\nb: ['${RATSLAM_TEST}']\n${C}: 1"
    monkeypatch.setenv("RATSLAM_TEST", "here: ${and} there")
    data = parse(text, "config.yaml").data
    assert data == {"a": "here: ${and} there/x", "b": ["here: ${and} there"], "${C}": 1}
    monkeypatch.setenv("RATSLAM_TEST", "")
    monkeypatch.delenv("RATSLAM_DATA", raising=False)
    first, second, third = refusal(f"{text}\nd: ${{RATSLAM_DATA}}").splitlines()
    assert first.startswith(
        "c.yaml:1:4: a: the environment variable RATSLAM_TEST is not set; set RATSLAM_TEST"
    )
    assert second.startswith("c.yaml:2:5: b.0: the environment variable RATSLAM_TEST is not set")
    assert third.endswith("set RATSLAM_DATA to the folder that holds them")
    assert parse(text, "c.yaml", ["a", "b.0"]).data["a"] == "/x"  # they will be replaced


def test_files(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_bytes(b"\xef\xbb\xbfname: gr\xc3\xbcn\r\nsteps: 2\r\n")
    assert load(file).data == {"name": "grün", "steps": 2}
    assert load(file).at_value(("steps",)) == f"{file}:2:8: steps"
    for content, found in {
        b"a: 1\nb: \xff": ":2: byte 0xff; expected text in UTF-8",
        b"\xff\xfea\x00": ":1: byte 0xff; expected text in UTF-8",
        b"\x7fELF\x02\x00\x00": r":1:1: the character '\x7f'; expected text",
        b"#" * (128 << 10) + b"\n": ": a large file; expected a configuration of at most 128 KiB",
        b"#" * (128 << 10): ":1:131073: empty",
    }.items():
        file.write_bytes(content)
        with pytest.raises(InputError) as caught:
            load(file)
        assert str(caught.value).startswith(f"{file}{found}")
    for path in (tmp_path / "none.yaml", tmp_path, tmp_path / ("x" * 300), "a\0b"):
        with pytest.raises(InputError, match=r"cannot be read: |: a folder; "):
            load(path)


def test_a_dump_has_flat_lists_and_quoted_words_and_the_schema_lists_the_keys() -> None:
    lines = dump(Config(name="no", source=Recording(path=Path("a")), gains={"1": 1e-300})).splitlines()
    assert {"  shape: [21, 21, 36]", "name: 'no'", "  '1': 1.0e-300", "  path: a", "others: []"} < {*lines}
    described = schema(Config)
    json.dumps(described)
    assert described["$schema"].startswith("https://json-schema.org/")
    assert (described["title"], described["description"]) == ("Config", "A whole configuration.")
    section = described["$defs"]["PoseCells"]
    assert section["properties"]["excite_sigma"]["description"] == "Width of the excitation, cells."
    assert section["additionalProperties"] is False


TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=40)
FLOATS = st.just(0.0) | st.floats(SMALLEST, LARGEST) | st.floats(-LARGEST, -SMALLEST)
WORDS = ["yes", "1e-3", "010", "${HOME}", "$${", "~", "12:30", "=", "<<", "0x1", " ", "- "]
CONFIGS = st.builds(
    Config,
    name=TEXTS | st.sampled_from(WORDS),
    gains=st.dictionaries(TEXTS, FLOATS),
    width=FLOATS | st.tuples(FLOATS, FLOATS),
    weights=st.lists(FLOATS, max_size=5).map(tuple),
    steps=st.integers(0, MOST),
    metric=st.sampled_from(["l1", "cosine"]),
    others=st.lists(st.builds(Simulation, simulation=st.integers(-9, 9)), max_size=3).map(tuple),
)
SIGNS = [*"[]{}:,-\n\t #&*!|>'\"%@`?~$\\\0\ufeff\x85\u2028", "\n  ", ": ", "- ", "1e-3", "? ", "${", "\\U"]
INSERTED = st.sampled_from(SIGNS) | st.text(max_size=4)
MUTATIONS = st.lists(
    st.tuples(st.integers(0, len(VALID)), st.integers(0, 6), INSERTED), min_size=1, max_size=4
)
KEYS = st.sampled_from(["pose_cells", "shape", "others", "0", "7", "gains", "kind", ""]) | TEXTS
ASSIGNMENTS = st.tuples(st.lists(KEYS, max_size=3), st.text(max_size=20))


def mutated(mutations: list[tuple[int, int, str]]) -> str:
    text = VALID
    for position, length, new in mutations:
        text = text[:position] + new + text[position + length :]
    return text


def check_dump(config: Config) -> None:
    text = dump(config)
    assert read(text) == config
    assert read(text).model_dump_json() == config.model_dump_json()  # -0.0
    if "${" not in text:  # any other reader sees the same
        assert yaml.safe_load(text) == config.model_dump(mode="json")


def message_of(action: Callable[[], object]) -> str:
    """The message of the one error an action may end with, which can be printed; '' if it succeeds."""
    try:
        action()
    except InputError as error:
        str(error).encode()
        return str(error)
    return ""


def check_text(text: str) -> None:
    message = message_of(lambda: read(text))
    assert not message or re.match(r"c\.yaml(:\d+:\d+)?: ", message)


def check_assignment(parts: tuple[list[str], str]) -> None:
    message = message_of(lambda: read(VALID, f"{'.'.join(parts[0])}={parts[1]}"))
    assert not message or "--set" in message


def check_file(content: bytes) -> None:
    with NamedTemporaryFile(suffix=".yaml") as file:
        Path(file.name).write_bytes(content)
        message = message_of(lambda: load(file.name))
    assert not message or message.startswith(file.name)


TEXT = st.text(max_size=80) | st.text("[]{}:,-\n\t #&*!|>'\"%ab1", max_size=60) | MUTATIONS.map(mutated)
LAWS = pytest.mark.parametrize(
    ("given_to", "law"),
    [
        pytest.param(CONFIGS, check_dump, id="dump reads back"),
        pytest.param(TEXT, check_text, id="texts read or are refused"),
        pytest.param(ASSIGNMENTS, check_assignment, id="assignments are taken or refused"),
        pytest.param(st.binary(max_size=200), check_file, id="files read or are refused"),
    ],
)


@LAWS
@given(data=st.data())
def test_random_configurations(given_to, law, data):
    law(data.draw(given_to))


@pytest.mark.soak
@LAWS
@settings(max_examples=30_000)
@given(data=st.data())
def test_many_random_configurations(given_to, law, data):
    law(data.draw(given_to))
