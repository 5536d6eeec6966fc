"""How JAX compiles: precision, flags of the compiler, kernels kept on disk.

Importing ratslam changes no setting of JAX. A program calls `prepare_precision` before it makes a `Session`;
`ratslam.runs` does so for every run. JAX reads XLA_FLAGS of the environment when it first computes, for the
whole process; the commands set it, and a program does before its first session, because steps are faster
then: `os.environ["XLA_FLAGS"] = add_xla_flags(os.environ.get("XLA_FLAGS", ""))`.
"""

from __future__ import annotations

import hashlib
import os
import platform
from pathlib import Path
from typing import Literal

CPUINFO = Path("/proc/cpuinfo")
FOLDER = "jax_compilation_cache_dir"


def cache_settings() -> dict[str, str | int]:
    """JAX's settings of the cache, by name. Each kind of processor has its own folder, because a kernel may
    use what another processor lacks; of other versions JAX finds nothing there."""
    lines = CPUINFO.read_text(errors="replace").splitlines() if CPUINFO.exists() else []
    skills = [line for line in lines if line.startswith(("flags", "Features"))][:1]
    digest = hashlib.sha256((platform.processor() + "".join(skills)).encode()).hexdigest()
    processor = f"{platform.machine()}-{digest[:12]}"
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return {
        FOLDER: str(Path(home) / "ratslam" / "jax" / processor),
        # The defaults do not cache kernels that compile as fast as ours do on a CPU.
        "jax_persistent_cache_min_compile_time_secs": 0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }


def keep_kernels() -> None:
    """Lets JAX keep compiled kernels on disk, unless the program has chosen a folder for them."""
    import jax

    if not getattr(jax.config, FOLDER):
        for name, value in cache_settings().items():
            jax.config.update(name, value)


Precision = Literal["float64", "float32"]


def prepare_precision(precision: Precision) -> None:
    """Enables JAX's 64-bit types for `float64`; `float32` works with them enabled or not."""
    import jax

    if precision == "float64":
        jax.config.update("jax_enable_x64", True)


FLAGS = (
    # More than one thread doubles the latency of a step.
    "--xla_cpu_multi_thread_eigen=false",
    # Unrolled loops over windows of 16 cells are not vectorised: the pose cells need half the time without.
    "--xla_backend_extra_options=xla_cpu_disable_loop_unrolling=true",
)


def add_xla_flags(given: str) -> str:
    """The given flags, and after them those of `FLAGS` that they do not set already."""
    own = given.split()
    names = {flag.partition("=")[0] for flag in own}
    return " ".join([*own, *(flag for flag in FLAGS if flag.partition("=")[0] not in names)])
