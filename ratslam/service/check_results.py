"""Conformance checks: a requirement with its reason, its result, the runner, and what checks share.

A kind of part (backend, source, touch front end, metric) is a `Trial` whose methods marked by `check` are its
checks. `require`, `require_equal` (the same bits of nested records) and `find_parts` serve them all.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator, Sequence
from enum import Enum
from itertools import groupby
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from ratslam.runs.settings.strict_yaml import override, validate
from ratslam.runs.settings.yaml_document import Document, Place
from tactile.base.errors import InputError
from tactile.base.plugins import Registry
from tactile.base.settings import Settings

Entry = TypeVar("Entry")
LONGEST_MESSAGE = 300
"""Length at which the text of a foreign exception is cut off."""


class Violation(Exception):
    """A part does not do what its protocol says.

    Args:
        found: what the check found. expected: what the protocol asks for.
    """

    def __init__(self, found: str, expected: str) -> None:
        super().__init__(f"{found}; expected {expected}")


class Check(NamedTuple):
    """One requirement.

    Attributes:
        name: the requirement in a few words. reason: what goes wrong in a run otherwise.
        group: its checks assume those of the groups with smaller numbers.
        run: takes the part under test; raises `Violation`, or returns a remark (or nothing).
    """

    name: str
    reason: str
    group: int
    run: Callable[[Any], str | None]


def check(group: int, name: str, reason: str) -> Callable[[Callable[[Any], str | None]], Check]:
    """Decorator that makes a check of a method of a `Trial`."""
    return lambda run: Check(name, reason, group, run)


class Result(NamedTuple):
    """Result of a check.

    Attributes:
        check: its requirement. status: 'ok', 'FAIL' or '-' (not run). text: remark, or finding and
            expectation.
    """

    check: Check
    status: str
    text: str

    def line(self) -> str:
        """The result in one line; of a failed check with the reason for the requirement."""
        reason = f" ({self.check.reason})" if self.status == "FAIL" else ""
        return f"{self.status:<5} {self.check.name}{self.text and ': '}{self.text}{reason}"


class Trial(Generic[Entry]):
    """A registered part under test with its settings; its methods marked by `check` are the requirements.

    Args:
        settings: an instance of the entry's `config_class`.
    """

    def __init__(self, entry: Entry, settings: Any) -> None:
        self.entry, self.settings = entry, settings

    @classmethod
    def checks(cls) -> tuple[Check, ...]:
        """The checks in the order of the text, which is that of their groups."""
        members = {name: member for kind in reversed(cls.__mro__) for name, member in vars(kind).items()}
        return tuple(member for member in members.values() if isinstance(member, Check))

    def run_checks(self) -> Iterator[Result]:
        """Runs the checks of one group after another; a group after one with a failed check is not run.

        An exception of the part under test is a failure, described by its type, text and place in one line.
        """
        sound = True
        for _, group in groupby(self.checks(), lambda check: check.group):
            results = []
            for check in group:
                result = Result(check, "-", "not run after the failures above")
                if sound:
                    try:
                        result = Result(check, "ok", check.run(self) or "")
                    except Violation as violation:
                        result = Result(check, "FAIL", str(violation))
                    except Exception as error:  # whatever foreign code raises
                        text = " ".join(str(error).split())
                        text = text if len(text) <= LONGEST_MESSAGE else f"{text[:LONGEST_MESSAGE]}..."
                        frames = traceback.extract_tb(error.__traceback__)
                        own = [frame for frame in frames if "jax" not in Path(frame.filename).parts] or frames
                        at = f" at {Path(own[-1].filename).name}:{own[-1].lineno}" if own else ""
                        text = f"{type(error).__name__}: {text}{at}; expected no exception"
                        result = Result(check, "FAIL", text)
                results.append(result)
                yield result
            sound = all(result.status == "ok" for result in results)

    @check(0, "the entry is complete", "a configuration names it with its settings")
    def entry_is_complete(self) -> str | None:
        model: Any = getattr(self.entry, "config_class", None)
        sound = isinstance(model, type) and issubclass(model, Settings)
        require(sound, f"config_class {model!r}", "a subclass of tactile.base.settings.Settings")
        return None


def require(condition: bool, found: str, expected: str) -> None:
    """Raises `Violation` unless the condition holds."""
    if not condition:
        raise Violation(found, expected)


def require_equal(expected: Any, found: Any, pair: str) -> None:
    """Raises `Violation` unless two nested records have the same bits.

    Args:
        pair: what the two are, for the message.
    """
    if where := _difference(expected, found):
        raise Violation(f"{pair} differ: {where}", "the same bits")


def _difference(first: Any, second: Any, path: str = "") -> str:
    """Path and values of the first leaf in which two nested records differ; '' if all have the same bits."""
    if isinstance(first, dict) and isinstance(second, dict):
        if list(first) != list(second):
            return f"{path or 'keys'} {list(first)} and {list(second)}"
        parts = [(f"{path}[{key!r}]", first[key], second[key]) for key in first]
    elif isinstance(first, list | tuple) and isinstance(second, list | tuple):
        if type(first) is not type(second) or len(first) != len(second):
            kinds = (f"{type(one).__name__} of {len(one)}" for one in (first, second))
            return f"{path} {' and '.join(kinds)}"
        names = [f".{n}" for n in getattr(first, "_fields", ())] or [f"[{k}]" for k in range(len(first))]
        parts = [(path + name, a, b) for name, a, b in zip(names, first, second, strict=True)]
    elif (
        hasattr(first, "__dict__")  # compared by its attributes, for example a dataclass
        and not isinstance(first, np.ndarray | np.generic | Enum)
        and type(first) is type(second)
    ):
        return _difference(vars(first), vars(second), path)
    else:
        by_value = first is None or second is None or isinstance(first, str)
        if not by_value:
            a, b = np.asarray(first), np.asarray(second)
            by_value = object in (a.dtype, b.dtype)
        if by_value:
            same = bool(first == second)
        else:
            same = a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
        return "" if same else f"{path} {_short(first)} and {_short(second)}".strip()
    return next((found for name, a, b in parts if (found := _difference(a, b, name))), "")


def _short(value: Any) -> str:
    array = np.asarray(value)
    if array.size > 6 or array.dtype == object:
        return f"{array.dtype} {array.shape}" if array.dtype != object else type(value).__name__
    return f"{array.dtype} {array.tolist()}"


def leaves(record: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """The values of nested named tuples, each with its path."""
    if isinstance(record, tuple) and hasattr(record, "_fields"):
        for name in record._fields:
            yield from leaves(getattr(record, name), f"{path}.{name}" if path else name)
    elif record is not None:
        yield path, record


def find_parts(
    named: dict[str, tuple[Registry[Any], str | None, str]], assignments: Sequence[str]
) -> dict[str, tuple[Any, Any]]:
    """Registered parts, each with its settings, by the section of the assignments `SECTION.key=value`.

    Args:
        named: by section the registry, the name in it (None: no part), and the place of the name for errors.

    Returns:
        entry and settings by section; no settings if the entry's `config_class` is no model of settings.

    Raises:
        InputErrors: there is no part of that name, its package is broken, an assignment names another
            section, or the settings do not fit their model.
    """
    entries = {
        section: registry.get(name, where)
        for section, (registry, name, where) in named.items()
        if name is not None
    }
    for assignment in assignments:
        section = assignment.partition("=")[0].partition(".")[0]
        if section not in entries:
            keys = " or ".join(f"{name}.key=value" for name in entries)
            raise InputError(f"--set {assignment}", f"the section '{section}'", keys)
    document = override(Document({}, {(): Place("--set", "--set")}), assignments)
    parts = {}
    for section, entry in entries.items():
        model, settings = entry.config_class, None
        if isinstance(model, type) and issubclass(model, Settings):
            settings = validate(document.section((section,)), model)
        parts[section] = entry, settings
    return parts
