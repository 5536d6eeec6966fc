"""Identity of a run: its configuration, the settings given in it, the files it names, its seed."""

from __future__ import annotations

import hashlib
import json
from functools import lru_cache
from pathlib import Path
from typing import Any

from ratslam.config.run_config import RunConfig

SEEDS = {
    "simulation": "simulation.seed",
    "create_simulation": "create_simulation.seed",
    "recording": "session.seed",
}
"""Key path that `seeds` sets, by kind of source."""


def with_seed(config: RunConfig, seed: int) -> RunConfig:
    """The configuration with another seed, of the simulation or of the session on a recording."""
    section, _, name = seed_key(config).partition(".")
    return config.model_copy(update={section: getattr(config, section).model_copy(update={name: seed})})


def seed_key(config: RunConfig) -> str:
    """The key path that `seeds` sets."""
    return next(key for part, key in SEEDS.items() if getattr(config, part) is not None)


def digest_of(config: RunConfig, how: str = "replay") -> str:
    """Hash of a configuration with absolute paths, without its seed.

    It covers all values, which of them were given (others may be completed from the source), and the content
    of each file that the configuration names.
    """
    section, _, name = seed_key(config).partition(".")
    parts = [config.model_dump(), config.model_dump(exclude_unset=True)]
    for part in parts:
        part.get(section, {}).pop(name, None)
    text = json.dumps([*parts, how], sort_keys=True, default=_content)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _content(value: Any) -> Any:
    """JSON for a path: the digest of the file's content."""
    if isinstance(value, Path):
        try:
            stat = value.stat()
            return _digest(value, stat.st_mtime_ns, stat.st_size) if value.is_file() else str(value)
        except OSError:
            return str(value)
    raise TypeError(f"{type(value).__name__} in a configuration")


@lru_cache(maxsize=256)
def _digest(path: Path, modified: int, size: int) -> str:
    """sha256 of a file; `modified` and `size` distinguish its versions in the cache."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
