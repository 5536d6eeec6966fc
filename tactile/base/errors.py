"""The one error a user's input can cause, with everything needed to mend it."""

from __future__ import annotations

from typing import Any


class InputError(ValueError):
    """Input that cannot be used. The program prints it without a traceback and exits with code 2.

    Args:
        where: the place, as `file`, `file:line`, `file:line:column` or a key path.
        found: what is there.
        expected: what would have been right ('' if `found` says it all).
        cure: what the user can do about it ('' if obvious).
    """

    def __init__(self, where: str, found: str, expected: str = "", cure: str = "") -> None:
        self.where = where
        self.found = found
        self.expected = expected
        self.cure = cure
        parts = [f"{where}: {found}" if where else found]
        if expected:
            parts.append(f"expected {expected}")
        if cure:
            parts.append(cure)
        super().__init__("; ".join(parts))

    def __reduce__(self) -> tuple[Any, ...]:
        """Rebuilt from its parts: it has to come whole out of a worker process."""
        return type(self), (self.where, self.found, self.expected, self.cure)


class InputErrors(InputError):
    """Several errors found in one pass over the same input, reported together."""

    def __init__(self, errors: list[InputError]) -> None:
        self.errors = errors
        ValueError.__init__(self, "\n".join(str(error) for error in errors))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.errors,)
