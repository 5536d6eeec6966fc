"""Units in the header of a CSV file: `t [ms]`, `x (mm)`, `heading_deg`, `vx [mm/s]`."""

from __future__ import annotations

import re
from typing import Literal

TimeUnit = Literal["s", "ms", "us", "ns", "ks", "min"]
LengthUnit = Literal["m", "mm", "cm", "km"]
AngleUnit = Literal["rad", "deg"]
PER_UNIT: dict[str, dict[str, float]] = {
    "time": {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9, "min": 1 / 60, "ks": 1e-3},
    "length": {"m": 1, "mm": 1e3, "cm": 1e2, "km": 1e-3},
    "angle": {"rad": 1, "deg": 57.29577951308232},
}
"""For each quantity, how many of a unit are one s, m or rad."""
WORDS = {
    **{"s": "seconds second secs sec", "ms": "milliseconds millis msec", "us": "microseconds micros usec"},
    **{"ns": "nanoseconds nanosec nsec", "min": "minutes", "ks": "kiloseconds"},
    **{"m": "metres meters metre meter", "mm": "millimetres millimeters", "cm": "centimetres centimeters"},
    **{"km": "kilometres kilometers", "rad": "radians radian rads", "deg": "degrees degree degs"},
    **{"m/s": "mps", "deg/s": "dps", "": "- 1"},
}
"""Other spellings of each unit, its name first."""
ALIASES = {word: unit for unit, words in WORDS.items() for word in words.split()}
BRACKETS = re.compile(r"(.+?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))")


def plain_unit(text: str) -> str:
    """A unit in one spelling: `deg/s` for `°/sec`, `m/s` for `m s^-1`; unknown ones remain."""
    text = text.strip().lower().replace("µ", "u").replace("μ", "u").replace("°", "deg")
    text = re.sub(r"[\s*·.]+([a-z]+)\^?-1$|[\s_]*(?:/|_per_| per |_)\s*([a-z]+)$", r"/\1\2", text)
    text = "/".join(ALIASES.get(word.strip(), word.strip()) for word in text.split("/"))
    return ALIASES.get(text, text)


def per_unit(unit: str, quantity: str) -> float | None:
    """How many of a unit are one in s, m and rad, for a quantity such as `length` or `angle/time`; None if it
    is no unit of it."""
    units, quantities = unit.split("/"), quantity.split("/")
    factors = [PER_UNIT[name].get(part, 0.0) for name, part in zip(quantities, units, strict=False)]
    if len(units) != len(quantities) or not all(factors):
        return None
    return factors[0] if len(factors) == 1 else factors[0] / factors[1]


def split_unit(name: str) -> tuple[str, str]:
    """The name of a column without its unit, and the unit, '' without one; `[...]` always holds a unit unless
    it is a number: `ranges[0]` is `ranges0`."""

    def is_unit(unit: str) -> bool:
        return any(per_unit(unit, kind + rate) is not None for kind in PER_UNIT for rate in ("", "/time"))

    if found := BRACKETS.fullmatch(name):
        before, square, round_ = found.groups()
        if square is not None and square.isdecimal():
            return before + square, ""
        unit = plain_unit(square or round_ or "")
        if square is not None or is_unit(unit):
            return split_unit(before)[0] if before.endswith("]") else before, unit
    words = name.split("_")
    for count in (3, 2, 1):
        unit = plain_unit("_".join(words[-count:]))
        if len(words) > count and is_unit(unit) and unit not in ("min", ""):  # `laser_min` has none
            return "_".join(words[:-count]), unit
    return name, ""
