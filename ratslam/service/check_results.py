"""Conformance checks: a requirement with its reason, its result, the runner, and what checks share.

A part under test (a backend, source, touch front end or metric with settings) is a class whose methods marked
by `check` are its checks. `require`, `require_equal` (the same bits of nested records) and `read_assignments`
serve them all.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import Enum
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ratslam.runs.settings.strict_yaml import override, validate
from ratslam.runs.settings.yaml_document import Document, Place
from tactile.base.errors import InputError
from tactile.base.settings import Settings

LONGEST_MESSAGE = 300
"""Length at which the text of a foreign exception is cut off."""


class Violation(Exception):
    """A part does not do what its protocol says.

    Args:
        found: what the check found. expected: what the protocol asks for.
    """

    def __init__(self, found: str, expected: str) -> None:
        super().__init__(f"{found}; expected {expected}")
        self.found, self.expected = found, expected


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
    """Decorator that makes a check of a method of a class of parts under test; see `checks_of`."""
    return lambda run: Check(name, reason, group, run)


def checks_of(trial: type) -> tuple[Check, ...]:
    """The checks in a class, in the order of its text, which is that of their groups."""
    return tuple(member for member in vars(trial).values() if isinstance(member, Check))


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


def run_checks(checks: Iterable[Check], part: Any) -> Iterator[Result]:
    """Runs the checks of one group after another; a group after one with a failed check is not run.

    An exception of the part under test is a failure, described by its type, text and place in one line.
    """
    sound = True
    for _, group in groupby(checks, lambda check: check.group):
        results = []
        for check in group:
            result = Result(check, "-", "not run after the failures above")
            if sound:
                try:
                    result = Result(check, "ok", check.run(part) or "")
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
            return (
                f"{path} {type(first).__name__} of {len(first)} and {type(second).__name__} of {len(second)}"
            )
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


def require_settings_class(model: Any) -> None:
    """Raises `Violation` unless a registered part's `config_class` is a model of settings."""
    sound = isinstance(model, type) and issubclass(model, Settings)
    require(sound, f"config_class {model!r}", "a subclass of tactile.base.settings.Settings")


def read_assignments(
    models: dict[str, Any], assignments: Sequence[str], option: str = "--set"
) -> dict[str, Settings | None]:
    """The settings of registered parts, each from the assignments `SECTION.key=value`.

    Args:
        models: config class by section; a section whose class is no model of settings gives None.

    Raises:
        InputErrors: an assignment names another section, or the settings do not fit their model.
    """
    for assignment in assignments:
        section = assignment.partition("=")[0].partition(".")[0]
        if section not in models:
            keys = " or ".join(f"{name}.key=value" for name in models)
            raise InputError(f"{option} {assignment}", f"the section '{section}'", keys)
    document = override(Document({}, {(): Place(option, option)}), assignments)
    return {
        section: validate(document.section((section,)), model)
        if isinstance(model, type) and issubclass(model, Settings)
        else None
        for section, model in models.items()
    }
