"""A configuration as plain data with the place of each key and value."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

KeyPath = tuple[str | int, ...]
"""The keys (and list indices) that lead from the top to a value."""


class Place(NamedTuple):
    """Place of a key and of its value: `file:line:column:`, or the option that set them."""

    key: str
    value: str


@dataclass(frozen=True)
class Document:
    """A configuration file.

    Attributes:
        data: nested dicts, lists and scalars.
        places: places of all key paths in `data`, including (), in the order of reading.
        above: keys that lead to `data`, if it is a section of a file.
    """

    data: dict[str, Any]
    places: dict[KeyPath, Place]
    above: KeyPath = ()

    def section(self, path: KeyPath) -> Document:
        """The section at a path as a document of its own; empty if it is missing."""
        places = {at[len(path) :]: place for at, place in self.places.items() if at[: len(path)] == path}
        nearest = {(): self.places[self.nearest(path)]}
        return Document(self.value(path) or {}, nearest | places, self.above + path)

    def at_key(self, path: KeyPath) -> str:
        """`file:line:column: a.b` of a key; of the nearest section above if it is missing."""
        return label(self.places[self.nearest(path)].key, self.above + path)

    def at_value(self, path: KeyPath) -> str:
        """`file:line:column: a.b` of a value; of the nearest section above if it is missing."""
        return label(self.places[path].value, self.above + path) if path in self.places else self.at_key(path)

    def value(self, path: KeyPath) -> Any:
        """The value at a path; None if there is none."""
        value: Any = self.data
        for key in path:
            try:
                value = value[key]
            except (KeyError, IndexError, TypeError):
                return None
        return value

    def nearest(self, path: KeyPath) -> KeyPath:
        """The path, or the nearest section above it that exists."""
        while path not in self.places:
            path = path[:-1]
        return path


def label(place: str, path: KeyPath) -> str:
    """A place and a key path for messages: `config.yaml:5:3: pose_cells.shape`, `--set a.b`."""
    return f"{place} {join_keys(path)}".rstrip(": ")


def join_keys(path: KeyPath) -> str:
    """The path in the notation of `--set`."""
    return ".".join(str(key) if str(key).isprintable() else repr(key) for key in path)


def join_words(words: Iterable[Any]) -> str:
    """The words as alternatives: `'a', 'b' or 'c'`."""
    *most, last = map(repr, words)
    return f"{', '.join(most)} or {last}" if most else last


def describe(value: Any) -> str:
    """A short form of a value for messages."""
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
