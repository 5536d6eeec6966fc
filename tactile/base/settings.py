"""Base class of all configuration models."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field

Side = Annotated[int, Field(ge=1, le=4096)]
"""Rows or columns of a view."""


class Settings(BaseModel):
    """Base class of configuration sections: immutable, rejects unknown keys and non-finite numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    def resolved(self, folder: Path) -> Self:
        """A copy with relative paths, also those of its sections, taken from a folder, such as that of the
        configuration file."""
        found: dict[str, Any] = {}
        for name, value in self:
            if isinstance(value, Path):
                found[name] = folder / value
            elif isinstance(value, Settings) and (section := value.resolved(folder)) is not value:
                found[name] = section
        return self.model_copy(update=found) if found else self
