"""Named random streams: everything random follows from one seed, and nothing from what else was drawn."""

from __future__ import annotations

from zlib import crc32

import numpy as np


def stream(seed: int, name: str) -> np.random.Generator:
    """The random stream of that name; streams of different names are independent."""
    return np.random.default_rng([seed, crc32(name.encode())])
