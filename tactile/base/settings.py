"""Base class of all configuration models."""

from __future__ import annotations

from collections.abc import Container
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field

Side = Annotated[int, Field(ge=1, le=4096)]
"""Rows or columns of a view."""
KeyPath = tuple[str | int, ...]
"""The keys (and list indices) that lead from the top of a configuration to a value."""


class Settings(BaseModel):
    """Base class of configuration sections: immutable, rejects unknown keys and non-finite numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    def resolved(self, folder: Path, here: Container[KeyPath] = (), at: KeyPath = ()) -> Self:
        """A copy with relative paths, also those of its sections, taken from a folder, such as that of the
        configuration file.

        Args:
            here: keys of the paths that start at the working folder instead. at: keys that lead to it.
        """
        found: dict[str, Any] = {}
        for name, value in self:
            keys = (*at, name)
            if isinstance(value, Path):
                found[name] = (Path.cwd() if keys in here else folder) / value
            elif isinstance(value, Settings) and (section := value.resolved(folder, here, keys)) is not value:
                found[name] = section
        return self.model_copy(update=found) if found else self
