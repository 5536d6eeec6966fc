"""Named random streams of one seed, independent of each other and of the order of their use."""

from __future__ import annotations

from zlib import crc32

import numpy as np


def stream(seed: int, name: str) -> np.random.Generator:
    """The random generator of a name; generators of different names are independent."""
    return np.random.default_rng([seed, crc32(name.encode())])
