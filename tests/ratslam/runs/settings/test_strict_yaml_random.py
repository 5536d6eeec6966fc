"""Random configuration files and assignments: read, refused, and dumped without loss."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.runs.settings.strict_yaml import LARGEST, MOST, SMALLEST, dump, load, parse, validate
from tactile.base.errors import InputError
from tests.ratslam.runs.settings.example_schema import VALID, Config, Simulation, overridden

TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=40)
FLOATS = st.just(0.0) | st.floats(SMALLEST, LARGEST) | st.floats(-LARGEST, -SMALLEST)
CONFIGS = st.builds(
    Config,
    name=TEXTS
    | st.sampled_from(["yes", "1e-3", "010", "${HOME}", "$${", "~", "12:30", "=", "<<", "0x1", " ", "- "]),
    gains=st.dictionaries(TEXTS, FLOATS),
    width=FLOATS | st.tuples(FLOATS, FLOATS),
    weights=st.lists(FLOATS, max_size=5).map(tuple),
    steps=st.integers(0, MOST),
    metric=st.sampled_from(["l1", "cosine"]),
    others=st.lists(st.builds(Simulation, simulation=st.integers(-9, 9)), max_size=3).map(tuple),
)


def _round_trip(config: Config) -> None:
    text = dump(config)
    assert validate(parse(text, "config.yaml"), Config) == config
    assert validate(parse(text, "config.yaml"), Config).model_dump_json() == config.model_dump_json()  # -0.0
    if "${" not in text:  # any other reader sees the same
        assert yaml.safe_load(text) == config.model_dump(mode="json")


def _refusal(action: Callable[[], object]) -> str:
    """The message of the one error an action may end with; '' if it succeeds."""
    try:
        action()
    except InputError as error:
        return str(error)
    return ""


def _reads_or_refuses(text: str) -> None:
    """Checks that a text gives a config, or an error with a place."""
    message = _refusal(lambda: validate(parse(text, "c.yaml"), Config))
    assert not message or re.match(r"c\.yaml(:\d+:\d+)?: ", message)
    message.encode()  # it can be printed


def _assigns_or_refuses(assignment: str) -> None:
    message = _refusal(lambda: overridden(assignment))
    assert not message or "--set" in message
    message.encode()


SIGNS = [*"[]{}:,-\n\t #&*!|>'\"%@`?~$\\\0\ufeff\x85\u2028", "\n  ", ": ", "- ", "1e-3", "? ", "${", "\\U"]
INSERTED = st.sampled_from(SIGNS) | st.text(max_size=4)
MUTATION = st.tuples(st.integers(0, len(VALID)), st.integers(0, 6), INSERTED)
MUTATIONS = st.lists(MUTATION, min_size=1, max_size=4)
ASSIGNMENTS = st.tuples(
    st.lists(
        st.sampled_from(["pose_cells", "shape", "others", "0", "7", "gains", "kind", ""]) | TEXTS, max_size=3
    ),
    st.text(max_size=20),
)


def _mutated(mutations: list[tuple[int, int, str]]) -> str:
    text = VALID
    for position, length, new in mutations:
        text = text[:position] + new + text[position + length :]
    return text


@given(CONFIGS)
def test_dump_round_trips(config: Config) -> None:
    _round_trip(config)


@given(st.text(max_size=60) | st.text("[]{}:,-\n\t #&*!|>'\"%ab1", max_size=40) | MUTATIONS.map(_mutated))
def test_any_text_reads_or_is_refused(text: str) -> None:
    _reads_or_refuses(text)


@given(ASSIGNMENTS)
def test_any_assignment_is_taken_or_refused(parts: tuple[list[str], str]) -> None:
    _assigns_or_refuses(f"{'.'.join(parts[0])}={parts[1]}")


@pytest.mark.soak
@settings(max_examples=20_000)
@given(CONFIGS)
def test_dump_round_trips_often(config: Config) -> None:
    _round_trip(config)


@pytest.mark.soak
@settings(max_examples=50_000)
@given(st.text(max_size=200) | st.text("[]{}:,-\n\t #&*!|>'\"%ab1", max_size=80) | MUTATIONS.map(_mutated))
def test_many_texts_read_or_are_refused(text: str) -> None:
    _reads_or_refuses(text)


@pytest.mark.soak
@settings(max_examples=20_000)
@given(ASSIGNMENTS)
def test_many_assignments_are_taken_or_refused(parts: tuple[list[str], str]) -> None:
    _assigns_or_refuses(f"{'.'.join(parts[0])}={parts[1]}")


@pytest.mark.soak
@settings(max_examples=20_000)
@given(st.binary(max_size=200))
def test_many_files_read_or_are_refused(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    file = tmp_path_factory.getbasetemp() / "c.yaml"
    file.write_bytes(content)
    message = _refusal(lambda: load(file))
    assert not message or message.startswith(str(file))
