"""Nested settings by their dotted names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def flat_settings(settings: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Settings as a configuration file nests them, each by its dotted name; an empty section is a value.

    Args:
        before: what the names begin with.
    """
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        section = isinstance(value, dict) and value
        flat |= flat_settings(value, f"{before}{name}.") if section else {before + name: value}
    return flat
