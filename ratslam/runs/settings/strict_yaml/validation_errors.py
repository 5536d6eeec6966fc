"""Turns validation errors of pydantic into messages with the place in the configuration file."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from ratslam.runs.settings.strict_yaml.document import Document, KeyPath, describe, join_keys, join_words
from tactile.base.errors import InputError
from tactile.base.settings import Settings

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


def input_errors(error: ValidationError, model: type[Settings], document: Document) -> list[InputError]:
    """One error for each wrong value, in the order of the file; one for all alternatives of a union."""
    order = {path: rank for rank, path in enumerate(document.places)}
    found = [(_spot(details["loc"], model), details) for details in error.errors(include_url=False)]
    found.sort(key=lambda pair: order[document.nearest(pair[0].path)])
    merged: dict[tuple[str, str, str], dict[str, None]] = {}
    for spot, details in found:
        renamed = _renaming_errors(details, spot.path, model, document)
        for one in renamed or [_input_error(details, spot, model, document)]:
            merged.setdefault((one.where, one.found, one.cure), {})[one.expected] = None
    errors = [
        InputError(where, found, " or ".join(filter(None, expected)), cure)
        for (where, found, cure), expected in merged.items()
    ]
    rest = len(errors) - _MAX_ERRORS
    return errors[:_MAX_ERRORS] + ([InputError("", f"and {rest} more errors")] if rest > 0 else [])


class _Spot(NamedTuple):
    """The place of an error in the data and in the types.

    Attributes:
        path: key path in the data.
        owner: model of which the last key of the path is a field; None if unknown or not a model.
        kinds: types of the value; several for a union, none if unknown.
    """

    path: KeyPath
    owner: type[BaseModel] | None
    kinds: list[Any]


def _renaming_errors(
    details: ErrorDetails, path: KeyPath, model: type[Settings], document: Document
) -> list[InputError]:
    """The errors for an unknown key that was renamed: one for each key in it, if it is a section."""
    if details["type"] != "extra_forbidden":
        return []
    found = _new_names(join_keys(path), document.value(path), model.renamed_keys)
    return [InputError(document.at_key(tuple(old.split("."))), sentence) for old, sentence in found]


def _new_names(old: str, value: Any, renamed: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Old key and a sentence with the new one, for each key of a section that has new names in it."""
    new = _new_name(old, renamed)
    if new == old:
        return
    if isinstance(value, dict) and value and any(name.startswith((f"{old}.", f"{new}.")) for name in renamed):
        for key, part in value.items():
            yield from _new_names(f"{old}.{key}", part, renamed)
    else:
        yield old, f"`{old}` is now `{new}`" if _is_path(new) else new


def _new_name(path: str, renamed: Mapping[str, str]) -> str:
    """Follows renames of a key or a section above it to the last name, or to a replacement sentence."""
    for _ in range(len(renamed)):
        above = max((name for name in renamed if f"{path}.".startswith(f"{name}.")), key=len, default=None)
        if above is None or not _is_path(path):
            break
        new = renamed[above]
        path = new + path.removeprefix(above) if _is_path(new) else new
    return path


def _is_path(text: str) -> bool:
    return re.fullmatch(r"[\w.]+", text) is not None


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
    for kind in spot.kinds:
        if get_origin(kind) is tuple and Ellipsis not in get_args(kind):
            expected = f"{len(get_args(kind))} values"
    return InputError(document.at_value(spot.path), describe(document.value(spot.path)), expected)


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
            kinds = [kind for kind in kinds if _is_named(kind, item)][:1]
        elif item != "[key]":
            path += (item,)
            owner = kinds[0] if kinds and _is_model(kinds[0]) else None
            kinds = _alternatives(_inside(kinds[0], item)) if kinds else []
    return _Spot(path, owner, kinds)


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


def _is_named(kind: Any, name: str | int) -> bool:
    """Whether pydantic names this alternative of a union `name`: by its class or by a tag."""
    if not _is_model(kind):
        return False
    return kind.__name__ == name or any(name in _words(kind, field) for field in kind.model_fields)


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
