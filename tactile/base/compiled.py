"""Loops compiled by Numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

from tactile.base.se2 import wrap

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """The function compiled at its first call, or loaded from the cache of an earlier process; it releases
    Python's global lock."""
    return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


wrapped = compiled(wrap)
"""`tactile.base.se2.wrap` of one angle, for compiled loops."""
