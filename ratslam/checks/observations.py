"""Requirements of an observation, common to sources and touch front ends."""

from __future__ import annotations

from typing import Any

import numpy as np

from ratslam.checks.common import leaves, require
from tactile.base.types import Observation


def require_shapes(found: Any, view_shape: tuple[int, ...], whiskers: int, what: str) -> None:
    """Raises `Violation` unless this is an observation of these shapes, with the dtypes of each field.

    Args:
        what: the observation, for the message.
    """
    require(isinstance(found, Observation), f"{what} is of type {type(found).__name__}", "Observation")
    shapes: dict[str, tuple[int, ...]] = {
        "view": tuple(view_shape),
        **dict.fromkeys(("contact", "alive"), (whiskers,)),
        "point": (whiskers, 2),
        "wall_point": (2,),
    }
    kinds = dict.fromkeys(("view_seen", "contact", "alive", "wall"), "b")
    kinds |= dict.fromkeys(("motion", "label"), "i")
    names = {"b": "bool", "i": "int", "f": "float"}
    for path, leaf in leaves(found):
        shape, kind = shapes.get(path, ()), kinds.get(path, "f")
        is_array = isinstance(leaf, np.ndarray | np.generic)
        text = f"{leaf.dtype} {leaf.shape}" if is_array else f"a Python {type(leaf).__name__}"
        fits = is_array and leaf.shape == shape and leaf.dtype.kind == kind
        require(fits, f"{path} of {what} is {text}", f"NumPy {names[kind]} {shape}")


def require_finite(found: Observation, what: str) -> None:
    """Raises `Violation` if an observation has NaN or infinite values.

    Args:
        what: the observation, for the message.
    """
    for path, leaf in leaves(found):
        finite = bool(np.isfinite(leaf).all())
        require(
            finite, f"{path} of {what} has NaN or infinity", "absent values masked, for example view_seen"
        )


def require_brightness(found: Observation, what: str) -> None:
    """Raises `Violation` if the view of an observation has values outside 0..1.

    Args:
        what: the observation, for the message.
    """
    low, high = float(np.min(found.view, initial=0.0)), float(np.max(found.view, initial=0.0))
    require(low >= 0 and high <= 1, f"view of {what} has values {low:g} to {high:g}", "values in 0..1")
