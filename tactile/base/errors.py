"""What users are told: errors in their input, with place, finding, expectation and cure; and sentences."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any

_CONTROL = re.compile(
    "([\0-\x09\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff])\\1*"
)


class InputError(ValueError):
    """Invalid user input. The program prints the error without a traceback and exits with code 2.

    Args:
        where: place of the error: `file`, `file:line`, `file:line:column` or a key path.
        found: the input found there.
        expected: valid input ('' if `found` suffices).
        cure: what to do ('' if obvious).
    """

    def __init__(self, where: str, found: str, expected: str = "", cure: str = "") -> None:
        self.where = where
        self.found = found
        self.expected = expected
        self.cure = cure
        if len(found) > 600:
            found = f"{found[:300]} ... {found[-300:]}"
        parts = [f"{where}: {found}" if where else found]
        if expected:
            parts.append(f"expected {expected}")
        if cure:
            parts.append(cure)
        super().__init__(printable("; ".join(parts).replace("\n", " ")))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles the parts, so that a worker process can return the error."""
        return type(self), (self.where, self.found, self.expected, self.cure)


@contextmanager
def os_errors_of(path: str | Path, found: str, expected: str, cure: str = "") -> Iterator[None]:
    """Turns an `OSError` into an `InputError` of a path: `found`, and why."""
    try:
        yield
    except OSError as error:
        raise InputError(str(path), f"{found} ({error.strerror or error})", expected, cure) from None


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The cure that suggests the known name most like an unknown one; '' if none is alike."""
    return "".join(f"did you mean {close!r}?" for close in get_close_matches(name, list(known), n=1))


def printable(text: str) -> str:
    """A text whose control characters, but line ends, are written out: those of a terminal, of directions of
    writing, and halves of pairs, as names and contents of files may have them."""
    return _CONTROL.sub(_written_out, text)


def tell(sentence: str) -> None:
    """Prints one sentence beside the results."""
    print(f"ratslam: {printable(sentence)}", file=sys.stderr, flush=True)


def _written_out(found: re.Match[str]) -> str:
    escape, times = found[1].encode("unicode_escape").decode(), len(found[0])
    return escape * times if times < 4 else f"{escape} ({times} times)"


class InputErrors(InputError):
    """Several errors of one input, reported together."""

    def __init__(self, errors: list[InputError]) -> None:
        self.errors = errors
        ValueError.__init__(self, "\n".join(str(error) for error in errors))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.errors,)
