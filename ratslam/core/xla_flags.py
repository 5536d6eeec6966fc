"""The flags of JAX's compiler that make steps fast on a CPU.

JAX reads XLA_FLAGS of the environment when it first computes, for the whole process. The commands set it;
importing ratslam does not, so that a program sets it before its first session:
`os.environ["XLA_FLAGS"] = add_xla_flags(os.environ.get("XLA_FLAGS", ""))`.
"""

from __future__ import annotations

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
