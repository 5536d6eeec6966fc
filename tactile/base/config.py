"""Base class of all configuration models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, field_validator

SMALLEST, LARGEST = 1e-30, 1e15
"""Magnitudes of numbers other than 0; squares and quotients of others overflow."""


class Settings(BaseModel):
    """Base class of configuration sections: immutable, rejects unknown keys and numbers that are not finite or
    beyond all measure."""

    renamed_keys: ClassVar[Mapping[str, str]] = {}
    """Old dotted path of a key in this section to the new one, or to a sentence that says what to write."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    @field_validator("*", mode="after")
    @classmethod
    def _has_measure(cls, value: Any) -> Any:
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and number and not SMALLEST <= abs(number) <= LARGEST:
                raise ValueError(f"{number:g}; give 0, or a number of {SMALLEST:g} to {LARGEST:g}")
        return value
