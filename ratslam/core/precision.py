"""JAX's global float64 switch.

Importing ratslam changes no JAX setting. A program calls `prepare_precision` before it makes a `Session`;
`ratslam.runs` does so for every run.
"""

from __future__ import annotations

from typing import Literal

import jax

Precision = Literal["float64", "float32"]


def prepare_precision(precision: Precision) -> None:
    """Enables JAX's 64-bit types for `float64`; `float32` works with them enabled or not."""
    if precision == "float64":
        jax.config.update("jax_enable_x64", True)


def check_precision(precision: Precision) -> None:
    """Checks that JAX can compute in this precision.

    Raises:
        ValueError: float64 while JAX's 64-bit types are disabled.
    """
    if precision == "float64" and not jax.config.read("jax_enable_x64"):
        raise ValueError(
            "precision float64, but JAX's 64-bit types are disabled; call"
            " ratslam.core.precision.prepare_precision('float64') before JAX is used"
        )
