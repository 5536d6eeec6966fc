"""The environment of programs that tests start."""

from __future__ import annotations

import os


def as_users_do() -> dict[str, str]:
    """The environment of a program that compiles its kernels as it does for users, unlike these tests."""
    return {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
