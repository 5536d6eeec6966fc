"""Base class of all configuration models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import BaseModel, ConfigDict, Field

Side = Annotated[int, Field(ge=1, le=4096)]
"""Rows or columns of a view."""


class Settings(BaseModel):
    """Base class of configuration sections: immutable, rejects unknown keys and non-finite numbers."""

    renamed_keys: ClassVar[Mapping[str, str]] = {}
    """Old dotted path of a key in this section to the new one, or to a sentence that says what to write."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)
