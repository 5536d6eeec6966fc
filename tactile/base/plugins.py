"""Parts by name that other packages can add: registered in the process, or through an entry-point group."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from pydantic import Field, ValidationError

from tactile.base.errors import InputError, did_you_mean
from tactile.base.settings import Settings

Entry = TypeVar("Entry")
Model = TypeVar("Model", bound=Settings)


class PluginConfig(Settings):
    """A registered part and its settings."""

    plugin: str
    """Name under which the part is registered."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Its own settings."""


class NoSettings(Settings):
    """The settings of a part that has none."""


class Registry(Generic[Entry]):
    """Entries by name: built-in ones, those registered in this process, and those of an entry-point group.

    A child process (a worker of a study, the mapper of a live session) knows the built-in ones and those of
    the entry points. A package is loaded only when its name is asked for, so a broken one harms nothing else.

    Args:
        group: of the entry points. noun: what an entry is, for messages. kind: type of every entry.
    """

    def __init__(self, group: str, noun: str, kind: type[Entry], builtin: Mapping[str, Entry]) -> None:
        self.group, self.noun, self.builtin = group, noun, dict(builtin)
        self._kind, self._registered = kind, dict[str, Entry]()

    def register(self, name: str, entry: Entry) -> None:
        """Adds an entry to this process.

        Raises:
            ValueError: the name is taken by another entry.
            TypeError: `entry` is of another type.
        """
        if not isinstance(entry, self._kind):
            wanted, given = self._kind.__name__, type(entry).__name__
            raise TypeError(f"a {self.noun} is registered as a {wanted}, not a {given}")
        if name in self.builtin or self._registered.get(name, entry) is not entry:
            raise ValueError(f"the {self.noun} '{name}' is registered already")
        self._registered[name] = entry

    def unregister(self, name: str) -> None:
        """Removes an entry that was added to this process, if there is one of that name."""
        self._registered.pop(name, None)

    def names(self) -> list[str]:
        """All names, built-in ones first; loads no package."""
        found = entry_points(group=self.group)
        return list(dict.fromkeys([*self.builtin, *self._registered, *sorted(point.name for point in found)]))

    def get(self, name: str, where: str) -> Entry:
        """The entry of a name.

        Args:
            where: place of the name, for errors.

        Raises:
            InputError: there is none, or its package is broken.
        """
        entry = self.builtin.get(name) or self._registered.get(name)
        if entry is not None:
            return entry
        points = list(entry_points(group=self.group, name=name))
        if not points:
            names = self.names()
            expected = f"a {self.noun}: {', '.join(names) or 'none'}"
            raise InputError(where, f"'{name}'", expected, did_you_mean(name, names))
        return self._load(points, where)

    def _load(self, points: list[EntryPoint], where: str) -> Entry:
        dists = [f"{p.dist.name} {p.dist.version}" if p.dist else p.value for p in points]
        found = f"the {self.noun} '{points[0].name}' of {', '.join(dists)}"
        if len({point.value for point in points}) > 1:
            raise InputError(where, f"{found} is defined twice", "one package with that name installed")
        try:
            entry = points[0].load()
        except Exception as error:  # whatever a package does while it is imported
            found += f" cannot be loaded: {type(error).__name__}: {error}"
            raise InputError(where, found, cure="repair or remove it") from error
        if not isinstance(entry, self._kind):
            raise InputError(where, f"{found} is of type {type(entry).__name__}", self._kind.__name__)
        return entry


def read_settings(model: type[Model], settings: Mapping[str, Any], where: str) -> Model:
    """The settings of a part as its model.

    Raises:
        InputError: they do not fit the model.
    """
    try:
        return model.model_validate_json(json.dumps(settings), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join([where, *map(str, first["loc"])])
        raise InputError(key, first["msg"]) from None
