"""The settings that a map depends on, and which differ between maps or in a session that is to go on."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from typing import Any

from ratslam.methods.method_registry import BACKENDS, LOCALISING
from ratslam.runs.settings.changed_settings import flat_settings
from ratslam.runs.settings.run_config import RunConfig
from tactile.base.errors import InputError


def check_same_method(where: str, of_map: RunConfig, other: RunConfig) -> None:
    """Raises `InputError` if a session with another method is to go on from a map.

    Args:
        where: the map, for the error.
    """
    if of_map.backend != other.backend:
        cure = f"`--set backend={of_map.backend}` takes that of the map"
        if of_map.backend in LOCALISING.values():
            cure = f"continue the map in which that session was localised, {of_map.localise.map}"
        raise _error(where, {"backend": [of_map.backend, other.backend]}, cure)


def check_same_settings(where: str, of_map: RunConfig, other: RunConfig) -> None:
    """The same with other settings of the method or another precision; all that differ are named. Both are
    completed.
    """
    different = differing_settings([of_map, other])
    if different:
        cure = assignments({name: both[0] for name, both in different.items()})
        raise _error(where, different, f"`{cure}` takes those of the map")


def assignments(settings: dict[str, Any]) -> str:
    """Settings as options of a command."""
    return " ".join(f"--set {shlex.quote(f'{name}={_text(value)}')}" for name, value in settings.items())


def differing_settings(configs: Sequence[RunConfig]) -> dict[str, list[Any]]:
    """The settings of the method and the precision that are not the same in all completed configurations, by
    their dotted names, with the value in each."""
    each = [_settings(config) for config in configs]
    names = dict.fromkeys(name for settings in each for name in settings)
    values = {name: [settings.get(name) for settings in each] for name in names}
    return {name: found for name, found in values.items() if any(value != found[0] for value in found)}


def _error(where: str, different: dict[str, list[Any]], cure: str) -> InputError:
    pairs = [f"{name} is {_text(ours)} and was {_text(was)}" for name, (was, ours) in different.items()]
    found = f"made with other settings: {', '.join(pairs)} when the map was made"
    return InputError(where, found, "a map made with this configuration", cure)


def _settings(config: RunConfig) -> dict[str, Any]:
    """What a method's state and map depend on, by dotted names as in a configuration; not whether keyframes
    are merged, which a session may begin or leave off at any time."""
    builtin = config.backend in BACKENDS.builtin
    kind = BACKENDS.get(config.backend, "backend").config_class
    names = list(kind.model_fields) if builtin else ["backend_settings"]
    plain = config.model_dump(mode="json", include={*names})
    precision = {"session.precision": config.session.precision}
    settings = flat_settings({name: plain[name] for name in names}) | precision
    return {name: value for name, value in settings.items() if name != "keyframes.merge_stood"}


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
