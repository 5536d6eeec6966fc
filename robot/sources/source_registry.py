"""Sources and recording formats of other packages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from robot.sources.source import Source
from tactile.base.plugins import Registry
from tactile.base.settings import Settings

Warn = Callable[[str], None] | None


class SourceEntry(NamedTuple):
    """A registered source.

    Attributes:
        config_class: its settings; relative paths in them start at the folder of the configuration. A
            recording format has a setting `file`.
        open: opens the source of these settings; the second argument is called with one sentence if only a
            part of it is readable.
        suffixes: of the files that `recording.file` reads with it, for example ('.bag',).
    """

    config_class: type[Settings]
    open: Callable[[Any, Warn], Source]
    suffixes: tuple[str, ...] = ()


SOURCES: Registry[SourceEntry] = Registry("ratslam.sources", "source", SourceEntry, {})
"""Sources by the name in `source.plugin`."""
