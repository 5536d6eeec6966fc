"""Configuration files: YAML read strictly, validated in one pass, written back exactly.

`load` reads a file, `override` applies `--set`, `validate` makes a model of a document, and `dump` is its
inverse. `read_configuration` also gives moved settings their new names and adds the files that a
configuration includes, such as the rig that `fit` writes. Errors of pydantic become messages with file, line
and column. `kind_of` tells other files from configurations.
"""

from __future__ import annotations

import copy
import difflib
import json
import os
import re
import zipfile
from collections.abc import Container, Sequence
from math import inf
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from ratslam.runs.settings.yaml_document import (
    Document,
    Dumper,
    Place,
    Reader,
    describe,
    join_keys,
    join_words,
)
from robot.recordings.video import SUFFIXES as VIDEOS
from tactile.base.errors import InputError, InputErrors
from tactile.base.settings import KeyPath, Settings

_MAX_ERRORS = 50
_WORDS = {
    "a valid boolean": "true or false",
    "a valid integer": "a whole number",
    "a valid number": "a number",
    "a valid string": "text",
    "a valid array": "a list",
    "an object": "a section of keys and values",
    "None": "nothing",
}


_Spot = tuple[KeyPath, type[BaseModel] | None, list[Any]]
"""The place of an error: its key path in the data; the model of which the last key is a field, None if
unknown or not a model; the types of the value, several for a union and none if unknown."""


def _input_error(details: ErrorDetails, spot: _Spot, model: type[Settings], document: Document) -> InputError:
    """The message for one error of pydantic."""
    path, owner, kinds = spot
    context = details.get("ctx", {})
    value = document.value(path)
    match details["type"]:
        case "extra_forbidden":
            known = list(owner.model_fields) if owner else []
            cure = _suggest(path[-1], known) or f"the keys here are {', '.join(known) or 'none'}"
            return InputError(document.at_key(path), "unknown key", cure=cure)
        case "missing" if isinstance(path[-1], int):  # an item of a tuple
            return _wrong_length(_spot(details["loc"][:-1], model), "more values", document)
        case "missing":
            field = owner.model_fields.get(str(path[-1])) if owner else None
            return InputError(document.at_key(path), "missing", cure=(field and field.description) or "")
        case "too_long":
            return _wrong_length(spot, f"at most {context['max_length']} values", document)
        case "too_short":
            return _wrong_length(spot, f"at least {context['min_length']} values", document)
        case "union_tag_not_found":
            at = (*path, context["discriminator"].strip("'"))
            words = [word for kind in kinds for word in _words(kind, at[-1])]
            return InputError(document.at_key(at), "missing", join_words(words) if words else "")
        case "union_tag_invalid":
            at = (*path, context["discriminator"].strip("'"))
            return _wrong_word(at, context["expected_tags"], document)
        case "literal_error":
            return _wrong_word(path, context["expected"], document)
        case "value_error" | "assertion_error":
            prefix = "" if isinstance(value, dict) else f"{describe(value)}: "
            return InputError(document.at_value(path), f"{prefix}{context['error']}")
    message = details["msg"]
    if not message.startswith("Input should be "):
        return InputError(document.at_value(path), f"{describe(value)}: {message[0].lower()}{message[1:]}")
    expected = message.removeprefix("Input should be ")
    expected = re.sub("^(greater|less|a multiple)", r"a number \1", _WORDS.get(expected, expected))
    return InputError(document.at_value(path), describe(value), expected)


def _wrong_length(spot: _Spot, expected: str, document: Document) -> InputError:
    path, _, kinds = spot
    for kind in kinds:
        if get_origin(kind) is tuple and Ellipsis not in get_args(kind):
            expected = f"{len(get_args(kind))} values"
    return InputError(document.at_value(path), describe(document.value(path)), expected)


def _wrong_word(path: KeyPath, expected: str, document: Document) -> InputError:
    found = document.value(path)
    words = re.findall("'([^']*)'", expected)
    choice = join_words(words) if words else expected
    return InputError(document.at_value(path), describe(found), choice, _suggest(found, words))


def _suggest(found: Any, words: Sequence[str]) -> str:
    """A suggestion of a similar word, or ''."""
    close = difflib.get_close_matches(str(found).lower(), {word.lower(): word for word in words}, n=1)
    return "".join(f"did you mean '{word}'?" for word in words if close and word.lower() == close[0])


def _spot(loc: Sequence[str | int], model: type[Settings]) -> _Spot:
    """Converts a location of pydantic by following it through the types.

    At a union, pydantic's location has the name of the alternative that was tried between two keys; only the
    types distinguish that name from a key.
    """
    path: KeyPath = ()
    owner: type[BaseModel] | None = None
    kinds: list[Any] = [model]
    for item in loc:
        if len(kinds) > 1:
            kinds = [
                kind
                for kind in kinds
                if _is_model(kind)  # pydantic names it by its class or by a tag
                and (kind.__name__ == item or any(item in _words(kind, field) for field in kind.model_fields))
            ][:1]
        elif item != "[key]":
            path += (item,)
            owner = kinds[0] if kinds and _is_model(kinds[0]) else None
            kinds = _alternatives(_inside(kinds[0], item)) if kinds else []
    return path, owner, kinds


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _alternatives(kind: Any) -> list[Any]:
    """Members of a union without None; the type itself if it is not a union."""
    origin = get_origin(kind)
    if origin is Annotated:
        return _alternatives(get_args(kind)[0])
    if origin in (Union, UnionType):
        return [part for member in get_args(kind) if member is not NoneType for part in _alternatives(member)]
    return [kind]


def _words(kind: Any, field: str | int) -> Sequence[Any]:
    """Values that a field of a model is restricted to."""
    annotation = _inside(kind, field) if _is_model(kind) else None
    return get_args(annotation) if get_origin(annotation) is Literal else ()


def _inside(kind: Any, key: str | int) -> Any:
    """Type of the item at a key or index of a value of type `kind`; None if unknown."""
    if _is_model(kind):
        field = kind.model_fields.get(str(key))
        return field.annotation if field else None
    arguments = get_args(kind)
    match get_origin(kind), key:
        case (origin, int(index)) if origin is tuple and Ellipsis not in arguments and index < len(arguments):
            return arguments[index]
        case (origin, int()) if isinstance(origin, type) and arguments:
            return arguments[0]
        case (origin, str()) if isinstance(origin, type) and len(arguments) == 2:
            return arguments[1]
    return None


RECORDING, MAP, RUN = "a recording", "a map", "a run directory"
FOLDER, BAG_PART, PAGE, DEVICE = "a folder", "the description of a bag", "a page (HTML)", "a FIFO or a device"
CURES = {
    RECORDING: "`python -m ratslam doctor {0} -o mine.yaml` writes one that reads it, then `run mine.yaml`",
    MAP: "`map info {0}` says what is in it, `localise {0} RECORDING` and `run CONFIG --continue {0}` use it",
    RUN: "`doctor {0}`, `score {0}` and `report {0}` tell of it, `run {0}/config.yaml` repeats it",
    BAG_PART: "`python -m ratslam doctor {1} -o mine.yaml` writes one that reads the bag",
    PAGE: "open it in a browser",
}
"""What to do with each kind; {0} is the path, {1} its folder."""
BAGS = (".bag", ".db3", ".mcap")
BEGINNINGS = (  # in lower case
    (b"\x89mcap0", RECORDING), (b"#rosbag", RECORDING), (b"sqlite format 3", RECORDING),
    (b"rosbag2_bagfile", BAG_PART), (b"<!doctype html", PAGE), (b"<html", PAGE),
)  # fmt: skip


def refuse_other_files(
    path: Path, expected: str = "a configuration (YAML)", allowed: Container[str | None] = ()
) -> None:
    """Refuses what cannot be what was expected.

    Args:
        allowed: kinds that may be given too.

    Raises:
        InputError: it is of another kind, which is named with the command that reads it.
    """
    kind = kind_of(path)
    if kind is not None and kind not in allowed:
        raise InputError(str(path), kind, expected, CURES.get(kind, "").format(path, path.parent))


def kind_of(path: Path) -> str | None:
    """What a file or folder is, by its names and first bytes; None if it may be a configuration, or is none
    of ours."""
    try:
        if path.is_dir():
            names = {file.name for file in path.iterdir()}
            bag = "metadata.yaml" in names or any(name.endswith(BAGS) for name in names)
            run = names & {"manifest.json", "steps.csv"}
            return RUN if run else MAP if "map.npz" in names else RECORDING if bag else FOLDER
        if not path.is_file():
            return DEVICE if path.exists() else None
        with path.open("rb") as file:
            begins = file.read(16).lower()
        if begins.startswith(b"pk\3\4"):
            with zipfile.ZipFile(path) as archive:
                return MAP if {"steps.npy", "config.npy"} <= set(archive.namelist()) else RECORDING
    except zipfile.BadZipFile:
        return RECORDING
    except (OSError, ValueError):  # whoever reads it says so
        return None
    if path.suffix.lower() in (".csv", *BAGS, *VIDEOS):
        return RECORDING
    return next((kind for beginning, kind in BEGINNINGS if begins.startswith(beginning)), None)


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
            if isinstance(data, dict) and data.get(str(path[-1])) is None:
                data[str(path[-1])] = {}
            data = data[path[-1]]
        if isinstance(data, dict):
            path += (name,)
        elif isinstance(data, list):
            if not (name.isascii() and name.isdigit() and len(name) < 9 and int(name) < len(data)):
                found = f"{join_keys(path)} has {len(data)} items"
                raise InputError(where, found, f"an index below {len(data)}")
            path += (int(name),)
        else:
            raise InputError(where, f"{join_keys(path)} is {describe(data)}", "a section to put a key in")
    return data, path


def validate(document: Document, model: type[Model]) -> Model:
    """The document as a model.

    Raises:
        InputErrors: all errors in it, each with its place.
    """
    errors = []
    for path in document.places:
        value = document.value(path)
        if isinstance(value, float) and 0 < abs(value) < inf and not SMALLEST <= abs(value) <= LARGEST:
            expected = f"0, or a number of {SMALLEST:g} to {LARGEST:g}"
        elif isinstance(value, int) and abs(value) > MOST and path[-1:] != ("seed",):
            expected = f"at most {MOST}"
        else:
            continue
        errors.append(InputError(document.at_value(path), describe(value), expected))
    if errors:
        raise InputErrors(errors)
    try:
        # As JSON: pydantic is then strict, but accepts lists for tuples and texts for paths.
        return model.model_validate_json(json.dumps(document.data), strict=True)
    except ValidationError as error:
        raise InputErrors(_input_errors(error, model, document)) from None


def _input_errors(error: ValidationError, model: type[Settings], document: Document) -> list[InputError]:
    """One error for each wrong value, in the order of the file; one for all alternatives of a union."""
    order = {path: rank for rank, path in enumerate(document.places)}
    found = [(_spot(details["loc"], model), details) for details in error.errors(include_url=False)]
    found.sort(key=lambda pair: order[document.nearest(pair[0][0])])
    merged: dict[tuple[str, str, str], dict[str, None]] = {}
    for spot, details in found:
        one = _input_error(details, spot, model, document)
        merged.setdefault((one.where, one.found, one.cure), {})[one.expected] = None
    errors = [
        InputError(where, found, " or ".join(filter(None, expected)), cure)
        for (where, found, cure), expected in merged.items()
    ]
    rest = len(errors) - _MAX_ERRORS
    return errors[:_MAX_ERRORS] + ([InputError("", f"and {rest} more errors")] if rest > 0 else [])


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


def read_configuration(path: Path, assignments: Sequence[str] = ()) -> Document:
    """The document of a configuration file with its moved settings and those of the files that it includes.

    Args:
        assignments: as for `load`.

    Raises:
        InputError: a file cannot be read or is not strict YAML, or an included one includes others; with
            file, line and column.
    """
    return _merge_includes(with_moved_settings(load(path, assignments)), path.parent)


TO_ATTRACTOR = (
    "excite_width", "excite_sigma", "inhibit_width", "inhibit_sigma", "global_inhibition", "settle_steps",
    "engine",
)  # fmt: skip
LEFT_RECALL = ("mode_decay", "miss_weight", "reach", "reach_heading", "modes", "energy")
MOVED: dict[str, str | None] = {
    **{f"pose_cells.{name}": f"attractor.{name}" for name in TO_ATTRACTOR},
    **dict.fromkeys(f"recall.{name}" for name in LEFT_RECALL),
}
"""Old dotted path of a setting to the new one; None: the pose cells have no such setting."""


def with_moved_settings(document: Document) -> Document:
    """A configuration with the settings of `MOVED` under their new names, at the places of the old ones.

    A value that stands under the new name stays. Settings without a new name are left out of what the program
    wrote, which has all of them; a user's own are unknown keys.
    """
    data, places = copy.deepcopy(document.data), dict(document.places)
    paths: dict[KeyPath, KeyPath | None] = {
        tuple(old.split(".")): None if new is None else tuple(new.split(".")) for old, new in MOVED.items()
    }
    written = all(old in places for old, new in paths.items() if new is None)
    for old, new in paths.items():
        if old not in places or (new is None and not written):
            continue
        section = {} if new is None else data.setdefault(str(new[0]), {})
        if not isinstance(section, dict):
            continue
        value, place = data[str(old[0])].pop(old[1]), places.pop(old)
        if new is not None:
            section.setdefault(new[1], value)
            places.setdefault(new[:1], place)
            places.setdefault(new, place)
    return Document(data, places)


INCLUDE = "include"


def _merge_includes(document: Document, folder: Path) -> Document:
    """The document with the settings of the files that it includes, for those that it leaves open.

    A value of the document comes before one of its files, and a later file before an earlier one. Sections
    are merged; lists are not. The key stays, without files.

    Args:
        folder: in which relative paths start, if not given by `--set`.
    """
    names = document.data.get(INCLUDE)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return document  # nothing, or an error that validation reports
    merged = Document({**document.data, INCLUDE: []}, document.places)
    folder = Path() if document.places[INCLUDE,].value.startswith("--set") else folder
    for name in reversed(names):
        if not (folder / name).is_file():
            where, cure = document.at_key((INCLUDE,)), f"paths start at {folder.resolve()}"
            raise InputError(where, f"no file {folder / name}", "an existing file", cure)
        below = load(folder / name)
        if INCLUDE in below.data:
            raise InputError(
                below.at_key((INCLUDE,)), "files that an included file includes", "settings only"
            )
        places: dict[KeyPath, Place] = {**below.places, **merged.places}
        merged = Document(merge_settings(below.data, merged.data), places)
    return merged


def merge_settings(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """The settings of both; those of `above` where both have them."""
    merged = below | above
    for key in below.keys() & above.keys():
        if isinstance(below[key], dict) and isinstance(above[key], dict):
            merged[key] = merge_settings(below[key], above[key])
    return merged
