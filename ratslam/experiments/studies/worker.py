"""A job in another process. This module loads without JAX, whose environment has to be settled first."""

from __future__ import annotations

import os
import pickle
from typing import Any

SETTLED = (
    "XLA_FLAGS",
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES",
)
"""What of the environment must be there by then."""


def environment() -> dict[str, str]:
    """That of this process, to be taken along."""
    return {name: os.environ[name] for name in SETTLED if name in os.environ}


def work(settled: dict[str, str], packed: bytes) -> Any:
    """The result of a pickled job, which cannot be unpacked without loading JAX."""
    for name, value in settled.items():
        os.environ.setdefault(name, value)
    from ratslam.experiments.studies.run_job import run_job

    return run_job(pickle.loads(packed))
