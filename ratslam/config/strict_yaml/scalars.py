"""Values of unquoted YAML words: YAML 1.2, and stricter.

Only `true` and `false` are booleans (`no` is text), `1e-3` is a number, `12:30` is text, and `010`, which
other readers read as eight or as ten, is refused.
"""

from __future__ import annotations

import math
import re
from typing import Any, NamedTuple

_WORDS: dict[str, float | None] = {"": None, "~": None, "null": None, "true": True, "false": False}
_WORDS |= {".inf": math.inf, "+.inf": math.inf, "-.inf": -math.inf, ".nan": math.nan}
_INTEGER = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_LEADING_ZERO = re.compile(r"[-+]?0[0-9]")


class Refused(NamedTuple):
    """A word that is refused because readers disagree about it."""

    found: str
    expected: str
    cure: str = ""


def read_word(word: str) -> Any:
    """Value of an unquoted word: None, bool, int, float, str or `Refused`."""
    if word in _WORDS:
        return _WORDS[word]
    integer = _INTEGER.fullmatch(word)
    if not integer and not _FLOAT.fullmatch(word):
        return word
    if _LEADING_ZERO.match(word):
        return Refused(f"{word:.60}", "a number without leading zeros", "quote it if it is a name")
    if integer and len(word) <= 20 and -(1 << 63) <= int(word, 0) < 1 << 63:
        return int(word, 0)
    if not integer and math.isfinite(float(word)):
        return float(word)
    return Refused(f"{word:.60}", "a number that fits 64 bits")
