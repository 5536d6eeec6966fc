"""The settings of registered parts in a configuration, checked like ours."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from evaluation.metrics.registry import METRICS
from ratslam.runs.settings.strict_yaml import validate
from ratslam.runs.settings.strict_yaml.document import Document, KeyPath
from robot.sources.registry import SOURCES
from robot.touch_source import TOUCH
from tactile.base.errors import InputError, InputErrors
from tactile.base.plugins import PluginConfig, Registry, read_settings

if TYPE_CHECKING:
    from ratslam.runs.settings.run_config import RunConfig


class Chosen(NamedTuple):
    """A registered part that a configuration names: the path of its name, that of its settings, and where it
    is registered."""

    name: KeyPath
    settings: KeyPath
    registry: Registry[Any]
    plugin: str


def check_plugins(document: Document, config: RunConfig) -> None:
    """Checks the names and settings of all registered parts in a configuration.

    Raises:
        InputErrors: all errors, each with file, line, column and key path.
    """
    errors: list[InputError] = []
    for part in _chosen(config):
        try:
            entry = part.registry.get(part.plugin, document.at_value(part.name))
            if part.plugin not in part.registry.builtin:
                validate(document.section(part.settings), entry.config_class)
            elif document.value(part.settings):
                found = f"settings of a registered {part.registry.noun}, but '{part.plugin}' is one of ours"
                raise InputError(document.at_key(part.settings), found)
        except InputErrors as several:
            errors += several.errors
        except InputError as error:
            errors.append(error)
    if errors:
        raise InputErrors(errors)


def resolved_plugin(config: PluginConfig, registry: Registry[Any], folder: Path) -> PluginConfig:
    """The configuration of a part with the relative paths in its settings taken from `folder`."""
    model = registry.get(config.plugin, "plugin").config_class
    settings = read_settings(model, config.settings, "settings")
    paths = {name: folder / value for name, value in settings if isinstance(value, Path)}
    given: dict[str, Any] = json.loads(settings.model_copy(update=paths).model_dump_json(exclude_unset=True))
    return config.model_copy(update={"settings": given})


def _chosen(config: RunConfig) -> Iterator[Chosen]:
    from ratslam.methods.registry import BACKENDS  # loads JAX

    yield Chosen(("backend",), ("backend_settings",), BACKENDS, config.backend)
    parts: list[tuple[KeyPath, Registry[Any], PluginConfig | None]] = [
        (("source",), SOURCES, config.source),
        (("touch", "frontend"), TOUCH, config.touch.frontend),
    ]
    parts += [(("score", "metrics", k), METRICS, one) for k, one in enumerate(config.score.metrics)]
    for path, registry, part in parts:
        if part is not None:
            yield Chosen((*path, "plugin"), (*path, "settings"), registry, part.plugin)
