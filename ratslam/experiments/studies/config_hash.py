"""What makes two runs the same: the configuration, what was chosen in it, the files it names, the seed."""

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
"""What `seeds` sets, by what is run on."""
DIGITS = 16
"""Of a configuration's hash, in hexadecimal."""


def with_seed(config: RunConfig, seed: int) -> RunConfig:
    """The configuration under another seed: of what is simulated, or of the session on a recording."""
    section, _, name = seed_key(config).partition(".")
    return config.model_copy(update={section: getattr(config, section).model_copy(update={name: seed})})


def seed_key(config: RunConfig) -> str:
    """The key path that `seeds` sets."""
    return next(key for part, key in SEEDS.items() if getattr(config, part) is not None)


def digest_of(config: RunConfig, pace: str = "replay") -> str:
    """Of a configuration with whole paths, without its seed: of each value, of which values were chosen (what
    is not may be completed from the source), and of the content of each file that it names."""
    section, _, name = seed_key(config).partition(".")
    parts = [config.model_dump(), config.model_dump(exclude_unset=True)]
    for part in parts:
        part.get(section, {}).pop(name, None)
    text = json.dumps([*parts, pace], sort_keys=True, default=_content)
    return hashlib.sha256(text.encode()).hexdigest()[:DIGITS]


def _content(value: Any) -> Any:
    """What stands for a value that JSON has no word for: of files what is in them, wherever they lie."""
    if isinstance(value, Path):
        try:
            stat = value.stat()
            return _digest(value, stat.st_mtime_ns, stat.st_size) if value.is_file() else str(value)
        except OSError:
            return str(value)
    raise TypeError(f"a configuration that holds {type(value).__name__}")


@lru_cache(maxsize=256)
def _digest(path: Path, modified: int, size: int) -> str:
    """sha256 of a file; `modified` and `size` tell when it is another one."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
