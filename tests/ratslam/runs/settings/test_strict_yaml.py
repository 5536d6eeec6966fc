"""Configuration files as text: scalars, refused YAML, variables of the environment, files, dumps."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from ratslam.runs.settings.strict_yaml import dump, load, parse
from tactile.base.errors import InputError
from tests.ratslam.runs.settings.example_schema import Config, Recording, refusal


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
    read = parse(f"key: {text}", "config.yaml").data["key"]
    assert read == value
    assert type(read) is type(value)


def test_not_a_number() -> None:
    assert math.isnan(parse("key: .nan", "config.yaml").data["key"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "1:1: empty; expected keys and values"),
        ("# only a comment\n", "2:1: empty; expected keys and values"),
        ("---\n", "2:1: nothing; expected keys and values such as 'seed: 1'"),
        ("\n- 1\n", "2:1: a list of 1; expected keys and values such as 'seed: 1'"),
        ("hello", "1:1: 'hello'; expected keys and values such as 'seed: 1'"),
        ("a: 1\n---\nb: 1", "2:1: a second document; expected only one"),
        ("a:\n  b: 1\n  c: 2\n  b: 3", "4:3: a.b: given twice; the first is at config.yaml:2:3"),
        ("a: [1, 2\nb: 3", "2:2: not YAML: expected ',' or ']', but got ':'"),
        ("a: 1\nb: [1, {c: 2}", "2:4: a bracket that is not closed"),
        ("b: [1, {c: 2", "1:8: a bracket that is not closed"),
        ("a: b: c", "1:5: not YAML: mapping values are not allowed here"),
        (
            "a:\n\tb: 1",
            r"2:1: not YAML: found character '\t' that cannot start any token; "
            "indent with spaces, not tabs",
        ),
        ("a: 'b", "1:6: not YAML: found unexpected end of stream"),
        ("a: 010", "1:4: a: 010; expected a number without leading zeros; quote it if it is a name"),
        ("a: 00.5", "1:4: a: 00.5; expected a number without leading zeros; quote it if it is a name"),
        ("a: 1e999", "1:4: a: 1e999; expected a number that fits 64 bits"),
        ("a: 9223372036854775808", "1:4: a: 9223372036854775808; expected a number that fits 64 bits"),
        ("1: a", "1:1: the key 1; expected text; write '1'"),
        ("a: {true: 1}", "1:5: a: the key true; expected text; write 'true'"),
        ("? [a, b]\n: 1", "1:3: a key that is not plain text; expected a plain key"),
        ("a: &x 1\nb: *x", "1:4: a: an anchor (&x); write the value out at each place"),
        ("a: *x", "1:4: a: an alias (*x); write the value out at each place"),
        ("a: !!python/name:os.system x", "1:4: a: a tag (tag:yaml.org,2002:python/name:os.system)"),
        ("a: !e x", "1:4: a: a tag (!e); expected a plain value"),
        ("a: 1\nb: \x07", r"2:4: the character '\x07'; expected text"),
        (r'a: "\0"', r"1:4: a: '\x00'; expected text without control characters"),
        (r'a: "\ud800"', r"1:4: a: '\ud800'; expected text without control characters"),
        (r'a: "\UFFFFFFFF"', "1:1: not YAML: an escape out of range after this"),
        ("a: " + "[" * 33, "1:35: a.0.0: sections nested more than 32 deep"),
        ("- " * 1000, "1:65: 0.0.0: sections nested more than 32 deep"),
        ("a: ${}", "1:4: a: '${}'; expected ${NAME}; write $${ for a literal ${"),
        ("a: ${HOME", "1:4: a: '${HOME'; expected ${NAME}; write $${ for a literal ${"),
    ],
)
def test_invalid_yaml_is_refused(text: str, message: str) -> None:
    assert refusal(text).startswith(f"config.yaml:{message}")


def test_all_refused_values_are_reported_at_once() -> None:
    lines = refusal("a: 010\nb: 1\nb: 2\n3: 4").splitlines()
    assert [line.split(": ")[0] for line in lines] == [
        "config.yaml:1:4",
        "config.yaml:3:1",
        "config.yaml:4:1",
    ]


def test_environment_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RATSLAM_TEST", "here: ${and} there")
    data = parse("a: ${RATSLAM_TEST}/x\nb: ['${RATSLAM_TEST}']\n${C}: 1", "config.yaml").data
    assert data == {"a": "here: ${and} there/x", "b": ["here: ${and} there"], "${C}": 1}


def test_an_unset_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RATSLAM_DATA", raising=False)
    monkeypatch.setenv("RATSLAM_TEST", "")
    first, second = refusal("a: ${RATSLAM_DATA}/x\nb:\n- ${RATSLAM_TEST}").splitlines()
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
        with pytest.raises(InputError, match=r"cannot be read: |: a folder; "):
            load(path)


def test_dump_is_readable() -> None:
    assert dump(Config(name="no", source=Recording(path=Path("a")), gains={"1": 1e-300})) == (
        "pose_cells:\n  excite_sigma: 1.0\n  shape: [21, 21, 36]\n"
        "metric: l1\nmotion: forward\n"
        "source:\n  kind: recording\n  path: a\n"
        "others: []\noptional: null\nwidth: 1.0\n"
        "gains:\n  '1': 1.0e-300\n"
        "learn: true\nsteps: 10\nname: 'no'\nweights: []\n"
    )
