"""Errors in user input: place, finding, expectation and cure."""

from __future__ import annotations

from typing import Any


def printable(text: str) -> str:
    """The text in one line, without the control characters that names and cells of files may hold."""
    if text.isprintable():
        return text
    return "".join(
        letter if letter.isprintable() else ascii(letter)[1:-1] for letter in " ".join(text.split("\n"))
    )


def _short(text: str, most: int = 600) -> str:
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 2 :]}"


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
        found = _short(printable(found))
        parts = [f"{where}: {found}" if where else found]
        if expected:
            parts.append(f"expected {expected}")
        if cure:
            parts.append(cure)
        super().__init__(printable("; ".join(parts)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles the parts, so that a worker process can return the error."""
        return type(self), (self.where, self.found, self.expected, self.cure)


class InputErrors(InputError):
    """Several errors of one input, reported together."""

    def __init__(self, errors: list[InputError]) -> None:
        self.errors = errors
        ValueError.__init__(self, "\n".join(str(error) for error in errors))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.errors,)
