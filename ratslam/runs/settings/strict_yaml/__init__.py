"""Configuration files: YAML read strictly, validated in one pass, written back exactly."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from ratslam.runs.settings.other_files import refuse_other_files
from ratslam.runs.settings.strict_yaml.document import Document, KeyPath, Place, describe, join_keys
from ratslam.runs.settings.strict_yaml.dumper import Dumper
from ratslam.runs.settings.strict_yaml.validation_errors import input_errors
from ratslam.runs.settings.strict_yaml.yaml_reader import Reader
from tactile.base.errors import InputError, InputErrors
from tactile.base.settings import Settings

Model = TypeVar("Model", bound=Settings)

_ALONE: dict[KeyPath, str] = {("recording", "topics"): "topic"}
"""Sections in which a text stands for a section with this key alone."""
SMALLEST, LARGEST = 1e-30, 1e15
"""Magnitudes of numbers other than 0; squares and quotients of others overflow."""
MOST = 2**31 - 1
"""Largest integer but seeds: counts of steps and cells are 32 bits wide."""
_MAX_BYTES = 1 << 17  # a configuration is a few kB; the parser needs about a second for this much


def load(path: str | os.PathLike[str], assignments: Sequence[str] = ()) -> Document:
    """The document in a file, with `${NAME}` in its texts replaced by environment variables.

    Args:
        assignments: values to replace, as `override` does. The value in the file may then name an environment
            variable that is not set.

    Raises:
        InputError: the file cannot be read or is not strict YAML; with file, line and column.
    """
    name = os.fspath(path)
    refuse_other_files(Path(name))
    try:
        with Path(name).open("rb") as file:
            content = file.read(_MAX_BYTES + 1)
    except OSError as error:
        raise InputError(name, f"cannot be read: {error.strerror}") from None
    except ValueError as error:  # a NUL or a lone surrogate in the name
        raise InputError(ascii(name), f"cannot be read: {error}") from None
    if len(content) > _MAX_BYTES:
        raise InputError(name, "a large file", f"a configuration of at most {_MAX_BYTES >> 10} KiB")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(f"{name}:{line}", f"byte 0x{content[error.start]:02x}", "text in UTF-8") from None
    replaced = [assignment.partition("=")[0] for assignment in assignments]
    return override(parse(text, name, replaced), assignments)


def parse(text: str, name: str, replaced: Sequence[str] = ()) -> Document:
    """The document in a text.

    Args:
        name: of the file, for messages. replaced: dotted paths whose values may name unset environment
            variables, because they will be replaced.
    """
    reader = Reader(text, lambda line, column: f"{name}:{line}:{column}:", replaced=replaced)
    data = reader.read()
    if not isinstance(data, dict):
        where = reader.places[()].value.rstrip(":")
        raise InputError(where, describe(data), "keys and values such as 'seed: 1'")
    return Document(data, reader.places | {(): Place(name, name)})


def override(document: Document, assignments: Sequence[str]) -> Document:
    """The document with values replaced or added, each given as `a.b=value` (list items as `a.0=value`).

    Raises:
        InputError: an assignment is malformed, or its path leads through a value that is not a section.
    """
    data, places = copy.deepcopy(document.data), dict(document.places)
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        where = f"--set {name}"
        if not equals or not all(name.split(".")):
            raise InputError(where, "not an assignment", "key=value such as pose_cells.cell_size=5e-2")
        section, path = open_path(data, name, where)
        reader = Reader(text, lambda line, column: "--set", path)
        section[path[-1]] = reader.read()
        places = {at: place for at, place in places.items() if at[: len(path)] != path}
        for length in range(1, len(path)):
            places.setdefault(path[:length], Place("--set", "--set"))
        places |= reader.places
    return Document(data, places)


def open_path(data: Any, key: str, where: str) -> tuple[Any, KeyPath]:
    """The section or list that a dotted key is in, and the path of the key; missing sections are created.

    Args:
        where: place of the key, for messages.

    Raises:
        InputError: the path leads through a value that is not a section.
    """
    path: KeyPath = ()
    for name in key.split("."):
        if path:
            alone = _ALONE.get(path[:-1])
            if alone is not None and isinstance(data.get(path[-1]), str):
                data[path[-1]] = {alone: data[path[-1]]}
            data = _open_section(data, path[-1])
        path += (_step(data, name, where, path),)
    return data, path


def validate(document: Document, model: type[Model]) -> Model:
    """The document as a model.

    Raises:
        InputErrors: all errors in it, each with its place.
    """
    if errors := [error for path in document.places for error in _beyond_measure(document, path)]:
        raise InputErrors(errors)
    try:
        # As JSON: pydantic is then strict, but accepts lists for tuples and texts for paths.
        return model.model_validate_json(json.dumps(document.data), strict=True)
    except ValidationError as error:
        raise InputErrors(input_errors(error, model, document)) from None


def _beyond_measure(document: Document, path: KeyPath) -> list[InputError]:
    value = document.value(path)
    if isinstance(value, float) and 0 < abs(value) < inf and not SMALLEST <= abs(value) <= LARGEST:
        expected = f"0, or a number of {SMALLEST:g} to {LARGEST:g}"
    elif isinstance(value, int) and abs(value) > MOST and path[-1:] != ("seed",):
        expected = f"at most {MOST}"
    else:
        return []
    return [InputError(document.at_value(path), describe(value), expected)]


def dump(model: BaseModel) -> str:
    """The model as YAML that `load` and `validate` turn into an equal model."""
    return dump_data(model.model_dump(mode="json"))


def dump_data(data: dict[str, Any]) -> str:
    """Nested settings as YAML that `load` turns into the same settings."""
    return yaml.dump(_escape(data), Dumper=Dumper, sort_keys=False, allow_unicode=True, width=100)


def schema(model: type[BaseModel]) -> dict[str, Any]:
    """The JSON schema by which an editor completes and checks a configuration file."""
    first = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": model.__name__}
    return first | model.model_json_schema()


def _escape(data: Any) -> Any:
    """The data with `${` in its texts escaped, so that it is not read as a variable."""
    match data:
        case dict():
            return {key: _escape(value) for key, value in data.items()}
        case list():
            return [_escape(value) for value in data]
        case str():
            return data.replace("${", "$${")
        case _:
            return data


def _step(section: Any, key: str, where: str, path: KeyPath) -> str | int:
    """`key` as a key of a section or as an index of a list."""
    if isinstance(section, dict):
        return key
    if isinstance(section, list):
        count = len(section)
        if key.isascii() and key.isdigit() and len(key) < 9 and int(key) < count:
            return int(key)
        raise InputError(where, f"{join_keys(path)} has {count} items", f"an index below {count}")
    raise InputError(where, f"{join_keys(path)} is {describe(section)}", "a section to put a key in")


def _open_section(section: Any, key: str | int) -> Any:
    """The subsection at a key; created if it is missing."""
    if isinstance(section, dict) and section.get(str(key)) is None:
        section[str(key)] = {}
    return section[key]
