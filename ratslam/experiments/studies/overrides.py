"""Settings put into a configuration from a study, so that error messages name their place in the study."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any

from ratslam.config.strict_yaml import Document, override
from ratslam.config.strict_yaml.document import KeyPath, Place
from tactile.base.errors import InputError


def put(document: Document, key: str, value: Any, origin: Document, at: KeyPath) -> Document:
    """The document with a value at a dotted key.

    Args:
        origin, at: the document that the value was written in, and its path there.

    Raises:
        InputError: there is no such key.
    """
    where = origin.at_key(at)
    if "=" in key or not all(key.split(".")):
        raise InputError(where, "not a key path", "names joined by dots, such as pose_cells.cells_xy")
    try:
        changed = override(document, [f"{key}=null"])
    except InputError as error:
        raise InputError(where, error.found, error.expected, error.cure) from None
    *sections, last = _steps(changed.data, key)
    section: Any = changed.data
    for step in sections:
        section = section[step]
    section[last] = copy.deepcopy(value)
    root: KeyPath = (*sections, last)
    key_place, value_place = (origin.places[origin.nearest(path)] for path in (named(at), at))
    here = Place(key_place.key, value_place.value)
    made = {path for path, place in changed.places.items() if document.places.get(path) != place}
    places = {path: here if path in made else place for path, place in changed.places.items()}
    places |= {
        (*root, *path[len(at) :]): place for path, place in origin.places.items() if path[: len(at)] == at
    }
    places[root] = here
    return Document(changed.data, places)


def named(at: KeyPath) -> KeyPath:
    """The path without the index of a value in a list."""
    return at[:-1] if isinstance(at[-1], int) else at


def overlap(first: str, second: str) -> bool:
    """Whether one key path equals the other or is a section that contains it."""
    return f"{first}.".startswith(f"{second}.") or f"{second}.".startswith(f"{first}.")


def outermost_first(keys: Iterable[str]) -> list[str]:
    """Sections before their keys, so that the result does not depend on the order of writing."""
    return sorted(keys, key=lambda key: (key.count("."), key))


def _steps(data: Any, key: str) -> KeyPath:
    """The key path of a dotted key, with integers as list indices."""
    path: KeyPath = ()
    for name in key.split("."):
        step = int(name) if isinstance(data, list) else name
        path, data = (*path, step), data[step]
    return path
