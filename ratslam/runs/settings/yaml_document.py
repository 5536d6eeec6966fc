"""A configuration as plain data with the place of each key and value: its reader, and its writer (`Dumper`).

YAML 1.2, and stricter. Duplicate keys, anchors and tags are refused: every value has one place, and no file
expands into a larger one. Of unquoted words only `true` and `false` are booleans (`no` is text), `1e-3` is a
number, `12:30` is text, and `010`, which other readers read as eight or as ten, is refused. What is written,
readers of YAML 1.1 and of YAML 1.2 read alike.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import yaml

from tactile.base.errors import InputError, InputErrors
from tactile.base.settings import KeyPath


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
        return _label(self.places[self.nearest(path)].key, self.above + path)

    def at_value(self, path: KeyPath) -> str:
        """`file:line:column: a.b` of a value; of the nearest section above if it is missing."""
        place = self.places.get(path)
        return _label(place.value, self.above + path) if place else self.at_key(path)

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


def _label(place: str, path: KeyPath) -> str:
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


_MAX_DEPTH = 32
_NO_ANCHORS = "write the value out at each place"
_RECORDINGS = "the recordings are not part of the project: set RATSLAM_DATA to the folder that holds them"


class Reader:
    """A reader of one text.

    Args:
        text: the YAML; `${NAME}` in its texts becomes the environment variable, `$${` a literal `${`.
        place: name of a line and column (from 1), with the final colon if it has one.
        root: the key path of the text's value.
        replaced: dotted paths of values that may name unset environment variables.

    Attributes:
        places: places of all key paths read so far.
    """

    def __init__(
        self, text: str, place: Callable[[int, int], str], root: KeyPath = (), replaced: Sequence[str] = ()
    ) -> None:
        self.places: dict[KeyPath, Place] = {}
        self._replaced = replaced
        self._text = text
        self._place = place
        self._root = root
        self._events = yaml.parse(text, Loader=yaml.SafeLoader)
        self._line, self._column = 1, 1  # of the last event
        self._brackets: list[str] = []  # places of the open ones
        self._errors: list[InputError] = []  # after which reading continues

    def read(self) -> Any:
        """The data.

        Raises:
            InputError: the first syntax error, or else all values that are refused.
        """
        try:
            data = self._document()
        except yaml.reader.ReaderError as error:
            self._line = self._text.count("\n", 0, error.position) + 1
            self._column = error.position - self._text.rfind("\n", 0, error.position)
            raise self._error(self._root, f"the character {self._text[error.position]!r}", "text") from None
        except yaml.MarkedYAMLError as error:
            raise self._syntax(error) from None
        except InputError:
            raise
        except (ValueError, OverflowError):
            # PyYAML raises these for escapes like "\UFFFFFFFF" and `%YAML 1.111…`.
            raise self._error(self._root, "not YAML: an escape out of range after this") from None
        if self._errors:
            raise InputErrors(self._errors)
        return data

    def _error(self, path: KeyPath, found: str, expected: str = "", cure: str = "") -> InputError:
        """An error at the last event."""
        return InputError(_label(self._place(self._line, self._column), path), found, expected, cure)

    def _syntax(self, error: yaml.MarkedYAMLError) -> InputError:
        """A syntax error of the parser as an `InputError`."""
        problem = error.problem or error.context or ""
        if "<stream end>" in problem and self._brackets:
            return InputError(_label(self._brackets[-1], self._root), "a bracket that is not closed")
        mark = error.problem_mark or error.context_mark
        if mark is not None:
            self._line, self._column = mark.line + 1, mark.column + 1
        cure = "indent with spaces, not tabs" if r"'\t'" in problem else ""
        return self._error(self._root, f"not YAML: {problem}", cure=cure)

    def _next(self) -> yaml.Event:
        event = next(self._events)
        assert event.start_mark
        self._line, self._column = event.start_mark.line + 1, event.start_mark.column + 1
        return event

    def _document(self) -> Any:
        self._next()  # stream start
        if isinstance(self._next(), yaml.StreamEndEvent):
            raise self._error(self._root, "empty", "a value" if self._root else "keys and values")
        data = self._value(self._next(), self._root)
        self._next()  # document end
        if not isinstance(self._next(), yaml.StreamEndEvent):
            raise self._error(self._root, "a second document", "only one")
        return data

    def _value(self, event: yaml.Event, path: KeyPath, key: str = "") -> Any:
        """The value that starts with `event`; `key` is the place of its key."""
        place = self._place(self._line, self._column)
        self.places[path] = Place(key or place, place)
        if isinstance(event, yaml.AliasEvent):
            raise self._error(path, f"an alias (*{event.anchor})", cure=_NO_ANCHORS)
        assert isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent)
        if event.anchor:
            raise self._error(path, f"an anchor (&{event.anchor})", cure=_NO_ANCHORS)
        if event.tag:
            raise self._error(path, f"a tag ({event.tag})", "a plain value")
        if isinstance(event, yaml.ScalarEvent):
            value = event.value if event.style else _read_word(event.value)
            if isinstance(value, tuple):
                self._errors.append(self._error(path, *value))
            if not isinstance(value, str):
                return value
            text = re.sub(r"(\$?)\$\{([^}]*)(\}?)", lambda found: self._variable(found, path), value)
            return self._text_of(text, path)
        if len(path) - len(self._root) >= _MAX_DEPTH:
            raise self._error(path[:3], f"sections nested more than {_MAX_DEPTH} deep")
        if event.flow_style:
            self._brackets.append(place)
        data: Any = []
        if isinstance(event, yaml.MappingStartEvent):
            data = self._mapping(path)
        else:
            while not isinstance(item := self._next(), yaml.SequenceEndEvent):
                data.append(self._value(item, (*path, len(data))))
        if event.flow_style:
            self._brackets.pop()
        return data

    def _mapping(self, path: KeyPath) -> dict[str, Any]:
        data: dict[str, Any] = {}
        while not isinstance(event := self._next(), yaml.MappingEndEvent):
            place = self._place(self._line, self._column)
            if not isinstance(event, yaml.ScalarEvent) or event.anchor or event.tag:
                raise self._error(path, "a key that is not plain text", "a plain key")
            if not event.style and not isinstance(_read_word(event.value), str):
                cure = f"write '{event.value}'"
                self._errors.append(self._error(path, f"the key {event.value or 'is empty'}", "text", cure))
            name = self._text_of(event.value, path)
            at = (*path, name)
            if name in data:
                first = self.places[at].key.rstrip(":")
                self._errors.append(self._error(at, "given twice", cure=f"the first is at {first}"))
            data[name] = self._value(self._next(), at, place)
        return data

    def _text_of(self, text: str, path: KeyPath) -> str:
        """The text; an error if it has control characters that no file name may have."""
        if re.search("[\0\ud800-\udfff]", text):
            self._errors.append(self._error(path, describe(text), "text without control characters"))
        return text

    def _variable(self, found: re.Match[str], path: KeyPath) -> str:
        escaped, name, close = found.groups()
        if escaped:
            return found[0][1:]
        if not close or not re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", name):
            error = self._error(path, describe(found[0]), "${NAME}", "write $${ for a literal ${")
            self._errors.append(error)
            return ""
        value = os.environ.get(name, "")
        if not value and not any(f"{join_keys(path)}.".startswith(f"{key}.") for key in self._replaced):
            cure = _RECORDINGS if name == "RATSLAM_DATA" else f"set {name} or write the value out"
            self._errors.append(self._error(path, f"the environment variable {name} is not set", cure=cure))
        return value


_WORDS: dict[str, float | None] = {"": None, "~": None, "null": None, "true": True, "false": False}
_WORDS |= {".inf": math.inf, "+.inf": math.inf, "-.inf": -math.inf, ".nan": math.nan}
_INTEGER = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_LEADING_ZERO = re.compile(r"[-+]?0[0-9]")


def _read_word(word: str) -> Any:
    """Value of an unquoted word: None, bool, int, float or str; found, expected and cure if it is refused."""
    if word in _WORDS:
        return _WORDS[word]
    integer = _INTEGER.fullmatch(word)
    if not integer and not _FLOAT.fullmatch(word):
        return word
    if _LEADING_ZERO.match(word):
        return f"{word:.60}", "a number without leading zeros", "quote it if it is a name"
    if integer and len(word) <= 20 and -(1 << 63) <= int(word, 0) < 1 << 63:
        return int(word, 0)
    if not integer and math.isfinite(float(word)):
        return float(word)
    return f"{word:.60}", "a number that fits 64 bits"


_TEXT = "tag:yaml.org,2002:str"


class Dumper(yaml.SafeDumper):
    """Quotes texts that a reader of YAML 1.1 or ours would read as another type; flat lists take one line."""

    def resolve(self, kind: type, value: Any, implicit: Any) -> Any:
        """The tag that a reader gives a node: that of YAML 1.1, or a number if our reader finds one."""
        tag = super().resolve(kind, value, implicit)
        plain = kind is yaml.ScalarNode and implicit[0] and tag == _TEXT
        return "tag:yaml.org,2002:float" if plain and not isinstance(_read_word(value), str) else tag

    def ignore_aliases(self, data: Any) -> bool:
        """Always true: anchors are refused on reading, so a shared list is written twice."""
        return True

    def represent_list(self, items: Any) -> yaml.SequenceNode:
        """A list without lists or sections in it in one line."""
        flat = not any(isinstance(item, list | dict) for item in items)
        return self.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=flat)

    def represent_str(self, text: str) -> yaml.ScalarNode:
        """Escaped if not printable: else the emitter folds U+0085 and similar characters like spaces."""
        return self.represent_scalar(_TEXT, text, style=None if text.isprintable() else '"')


Dumper.add_representer(list, Dumper.represent_list)
Dumper.add_representer(str, Dumper.represent_str)
