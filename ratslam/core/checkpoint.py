"""The state of an object as named arrays, for a checkpoint."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from ratslam.core.arrays import GrowableArray


class Checkpointed:
    """An object whose state is its growable arrays, its `VALUES` and its `PARTS`; a restored object continues
    bit for bit.

    Attributes:
        VALUES: names of attributes that are numbers, NumPy arrays, or tuples of these.
        PARTS: names of attributes that are `Checkpointed` or None.
    """

    VALUES: ClassVar[tuple[str, ...]] = ()
    PARTS: ClassVar[tuple[str, ...]] = ()

    def arrays(self) -> dict[str, np.ndarray]:
        """Copies of the whole state, by attribute name without a leading underscore."""
        arrays = {name: array.rows.copy() for name, array in self._growable_arrays().items()}
        for name in self.VALUES:
            for k, value in enumerate(_as_tuple(getattr(self, name))):
                arrays[f"{name.lstrip('_')}/{k}"] = np.array(value)
        for name in self._parts():
            part = getattr(self, name).arrays()
            arrays |= {f"{name.lstrip('_')}/{key}": value for key, value in part.items()}
        return arrays

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Replaces the whole state by that of `arrays`.

        Raises:
            KeyError, ValueError, TypeError: arrays are missing or of another kind.
        """
        for name, array in self._growable_arrays().items():
            array.replace(arrays[name])
        for name in self.VALUES:
            before = getattr(self, name)
            values = []
            for k, old in enumerate(_as_tuple(before)):
                value = arrays[f"{name.lstrip('_')}/{k}"]
                if not isinstance(old, np.ndarray):
                    values.append(type(old)(value))
                    continue
                if value.ndim != old.ndim or value.dtype != old.dtype:
                    found = f"{value.dtype} with {value.ndim} dimensions"
                    raise ValueError(f"an array of {found} instead of {old.dtype} with {old.ndim}")
                values.append(np.array(value))
            if not isinstance(before, tuple):
                setattr(self, name, values[0])
            else:
                setattr(self, name, type(before)(*values) if hasattr(before, "_fields") else tuple(values))
        for name in self._parts():
            getattr(self, name).restore(with_prefix(arrays, f"{name.lstrip('_')}/"))

    def _growable_arrays(self) -> dict[str, GrowableArray]:
        found = vars(self).items()
        return {name.lstrip("_"): value for name, value in found if isinstance(value, GrowableArray)}

    def _parts(self) -> list[str]:
        return [name for name in self.PARTS if getattr(self, name) is not None]


def with_prefix(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose names begin with `prefix`, named without it."""
    return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}


def _as_tuple(value: Any) -> tuple[Any, ...]:
    return value if isinstance(value, tuple) else (value,)


def fill_missing(arrays: dict[str, np.ndarray]) -> None:
    """Adds to the arrays of a map file what one of an earlier version lacks: the odometry of the steps, NaN:
    unknown; and that no closure has moved the newest keyframe since the last optimisation."""
    for name, like in (("map/steps/odometry", "map/steps/frame"), ("map/odometry", "map/step_node")):
        if like in arrays:
            arrays.setdefault(name, np.full((len(arrays[like]), 3), np.nan))
    if "map/live/covariance/0" in arrays:
        arrays.setdefault("map/live/strayed/0", np.array(0.0))
