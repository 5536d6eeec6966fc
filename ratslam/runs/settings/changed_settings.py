"""The settings of a configuration that differ from the defaults."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from ratslam.runs.settings.renamed_keys import with_moved_settings
from ratslam.runs.settings.run_config import LoopConfig
from ratslam.runs.settings.strict_yaml import load, validate


def changed_settings(path: Path) -> list[tuple[str, str, str]]:
    """The settings in a configuration file that differ from the defaults, in the order of the file: of each
    its dotted path, and its value and default as JSON ('' for a setting without default).

    Of a path only the name is given. The file of a run directory is completed: values of its source and of
    presets are among them.

    Raises:
        InputErrors: the configuration has errors.
    """
    return list(_changes(validate(with_moved_settings(load(path)), LoopConfig), LoopConfig(), ""))


def _changes(section: BaseModel, default: BaseModel | None, prefix: str) -> Iterator[tuple[str, str, str]]:
    """The changes in a section; a default of None: it has none, because some setting must be given."""
    values = section.model_dump(mode="json")
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        usual = field.get_default(call_default_factory=True) if default is None else getattr(default, name)
        if isinstance(value, BaseModel):
            if not isinstance(usual, type(value)):
                try:
                    usual = type(value)()
                except ValidationError:
                    usual = None
            yield from _changes(value, usual, f"{prefix}{name}.")
        elif field.is_required() or value != usual:
            shown = value.name if isinstance(value, Path) else values[name]  # its folder is private
            yield prefix + name, _text(shown), "" if field.is_required() else _text(usual)


def _text(value: Any) -> str:
    return json.dumps(
        value,
        default=lambda part: part.model_dump(mode="json") if isinstance(part, BaseModel) else str(part),
        ensure_ascii=False,
    )


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
