"""Settings of the method of several maps: those that differ, by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ratslam.backends.config import RecallBackendConfig
from ratslam.config.flat_settings import flat_settings
from ratslam.config.run_config import RunConfig


def differing_settings(configs: Sequence[RunConfig]) -> dict[str, list[Any]]:
    """The settings of `backend: recall` and the precision that are not the same in all configurations, by
    their dotted names, with the value in each."""
    each = [_method_settings(config) for config in configs]
    values = {name: [settings.get(name) for settings in each] for name in sorted(set().union(*each))}
    return {name: found for name, found in values.items() if any(value != found[0] for value in found)}


def _method_settings(config: RunConfig) -> dict[str, Any]:
    settings = config.model_dump(mode="json", include=set(RecallBackendConfig.model_fields))
    return flat_settings(settings) | {"session.precision": config.session.precision}
