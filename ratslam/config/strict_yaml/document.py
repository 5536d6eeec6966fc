"""A configuration as plain data that remembers where each of its keys and values was written."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

KeyPath = tuple[str | int, ...]
"""The keys (and list indices) that lead from the top to a value."""


class Place(NamedTuple):
    """Where a key and its value were written: `file:line:column:`, or the option that gave them."""

    key: str
    value: str


@dataclass(frozen=True)
class Document:
    """What was read.

    Attributes:
        data: nested dicts, lists and scalars.
        places: of every key path in `data`, () included, in the order of reading.
    """

    data: dict[str, Any]
    places: dict[KeyPath, Place]

    def at_key(self, path: KeyPath) -> str:
        """`file:line:column: a.b` of a key, or of the nearest section above it where it is missing."""
        return label(self.places[self.nearest(path)].key, path)

    def at_value(self, path: KeyPath) -> str:
        """`file:line:column: a.b` of a value, or of the nearest section above it where it is missing."""
        return label(self.places[path].value, path) if path in self.places else self.at_key(path)

    def value(self, path: KeyPath) -> Any:
        """What stands at the path; None where nothing does."""
        value: Any = self.data
        for key in path:
            try:
                value = value[key]
            except (KeyError, IndexError, TypeError):
                return None
        return value

    def nearest(self, path: KeyPath) -> KeyPath:
        """The path itself, or that of the nearest section above it that was written."""
        while path not in self.places:
            path = path[:-1]
        return path


def label(place: str, path: KeyPath) -> str:
    """A place and a key path as messages show them: `config.yaml:5:3: pose_cells.shape`, `--set a.b`."""
    return f"{place} {dotted(path)}".rstrip(": ")


def dotted(path: KeyPath) -> str:
    """The path as `--set` takes it."""
    return ".".join(str(key) if str(key).isprintable() else repr(key) for key in path)


def either(words: Iterable[Any]) -> str:
    """The words as a choice: `'a', 'b' or 'c'`."""
    *most, last = map(repr, words)
    return f"{', '.join(most)} or {last}" if most else last


def shown(value: Any) -> str:
    """A value as messages show it, short."""
    match value:
        case None:
            return "nothing"
        case bool():
            return str(value).lower()
        case str():
            return repr(value) if len(value) <= 60 else f"{value[:57]!r}..."
        case list():
            return f"a list of {len(value)}"
        case dict():
            return "a section of keys and values"
        case _:
            return str(value)
