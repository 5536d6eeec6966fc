"""The cache of compiled kernels on disk: a later process loads what it would compile again."""

from __future__ import annotations

import hashlib
import os
import platform
from pathlib import Path

import jax

CPUINFO = Path("/proc/cpuinfo")
FOLDER = "jax_compilation_cache_dir"


def cache_settings() -> dict[str, str | int]:
    """JAX's settings of the cache, by name. Each kind of processor has its own folder, because a kernel may
    use what another processor lacks; of other versions JAX finds nothing there."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return {
        FOLDER: str(Path(home) / "ratslam" / "jax" / processor_name()),
        # The defaults do not cache kernels that compile as fast as ours do on a CPU.
        "jax_persistent_cache_min_compile_time_secs": 0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }


def keep_kernels() -> None:
    """Lets JAX keep compiled kernels on disk, unless the program has chosen a folder for them."""
    if not getattr(jax.config, FOLDER):
        for name, value in cache_settings().items():
            jax.config.update(name, value)


def processor_name() -> str:
    """A name of the kind of processor: its architecture, and a digest of what it can do."""
    lines = CPUINFO.read_text(errors="replace").splitlines() if CPUINFO.exists() else []
    skills = [line for line in lines if line.startswith(("flags", "Features"))][:1]
    digest = hashlib.sha256((platform.processor() + "".join(skills)).encode()).hexdigest()
    return f"{platform.machine()}-{digest[:12]}"
