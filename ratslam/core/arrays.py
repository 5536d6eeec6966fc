"""Append-only arrays, and many records of one kind packed into a few arrays.

Packed records are one array per dtype with one row per record, because the transfer to and from a compiled
function costs time per array, not per number. The shapes and names of the records are the static part of a
pytree.

The state of an object as named arrays, for a checkpoint.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from tactile.base.types import Array


class GrowableArray:
    """Rows of one shape and dtype; the capacity doubles when it is used up, so n appends cost O(n)."""

    def __init__(self, shape: tuple[int, ...], dtype: Any) -> None:
        self._buffer = np.zeros((16, *shape), dtype)
        self._count = 0

    @property
    def rows(self) -> np.ndarray:
        """[count, ...] a view: writing to it changes the array; `append` may replace the buffer under it."""
        return self._buffer[: self._count]

    def append(self, row: Any) -> None:
        """Appends one row."""
        if self._count == len(self._buffer):
            self._buffer = np.concatenate([self._buffer, np.zeros_like(self._buffer)])
        self._buffer[self._count] = row
        self._count += 1

    def extend(self, rows: np.ndarray) -> None:
        """Appends rows [n, ...]."""
        end = self._count + len(rows)
        if end > len(self._buffer):
            self.replace(np.concatenate([self.rows, rows]))
        else:
            self._buffer[self._count : end] = rows
            self._count = end

    def replace(self, rows: np.ndarray) -> None:
        """Replaces all rows."""
        capacity = max(16, 1 << (len(rows) - 1).bit_length())
        self._buffer = np.zeros((capacity, *self._buffer.shape[1:]), self._buffer.dtype)
        self._buffer[: len(rows)] = rows
        self._count = len(rows)


class Layout(NamedTuple):
    """Layout of one kind of record.

    Attributes:
        tree: its tree structure. leaves: place of each array of it: index of the packed array, columns first
            to last, shape. dtypes, widths: of the packed arrays.
    """

    tree: Any
    leaves: tuple[tuple[int, int, int, tuple[int, ...]], ...]
    dtypes: tuple[np.dtype, ...]
    widths: tuple[int, ...]


class PackedRecords:
    """T records as arrays [T, width]; a pytree with the layout as its static part."""

    def __init__(self, layout: Layout, arrays: tuple[Array, ...]) -> None:
        self.layout, self.arrays = layout, arrays

    def at(self, k: Array) -> Any:
        """The record in row k (traced)."""
        rows = [lax.dynamic_index_in_dim(array, k, 0, keepdims=False) for array in self.arrays]
        return _record(self.layout, rows)

    def put(self, k: Array, record: Any) -> PackedRecords:
        """A copy with `record` in row k (traced)."""
        parts: list[list[Array]] = [[] for _ in self.arrays]
        for (array, *_), value in zip(self.layout.leaves, jax.tree.leaves(record), strict=True):
            parts[array].append(jnp.reshape(value, -1))
        arrays = (
            lax.dynamic_update_index_in_dim(rows, jnp.concatenate(part), k, 0)
            for rows, part in zip(self.arrays, parts, strict=True)
        )
        return PackedRecords(self.layout, tuple(arrays))

    def write(self, k: int, record: Any) -> None:
        """Writes `record` to row k in place (host NumPy).

        Raises:
            ValueError: the record has another shape.
        """
        rows = [array[k] for array in self.arrays]
        for (array, first, last, shape), value in zip(
            self.layout.leaves, jax.tree.leaves(record), strict=True
        ):
            if np.shape(value) != shape:
                raise ValueError(f"record with an array of shape {np.shape(value)}, expected {shape}")
            if shape:
                rows[array][first:last] = np.ravel(value)
            else:
                rows[array][first] = value

    def records(self, count: int) -> Iterator[Any]:
        """The first `count` records, host NumPy."""
        arrays = [np.asarray(array) for array in self.arrays]
        for k in range(count):
            yield _record(self.layout, [array[k] for array in arrays])


def allocate(layout: Layout, count: int, zeros: Callable[..., Array] = np.zeros) -> PackedRecords:
    """`count` records of zeros, host NumPy; `zeros`: `jnp.zeros` inside a compiled function."""
    sizes = zip(layout.widths, layout.dtypes, strict=True)
    return PackedRecords(layout, tuple(zeros((count, width), dtype) for width, dtype in sizes))


def layout_of(example: Any) -> Layout:
    """The layout of records like the example, of which only shapes and dtypes are used."""
    values, tree = jax.tree.flatten(example)
    dtypes: list[np.dtype] = []
    widths: list[int] = []
    leaves = []
    for value in values:
        dtype = np.dtype(value.dtype)
        if dtype not in dtypes:
            dtypes.append(dtype)
            widths.append(0)
        array = dtypes.index(dtype)
        first, last = widths[array], widths[array] + int(np.prod(value.shape))
        widths[array] = last
        leaves.append((array, first, last, tuple(value.shape)))
    return Layout(tree, tuple(leaves), tuple(dtypes), tuple(widths))


def _record(layout: Layout, arrays: Sequence[Array]) -> Any:
    values = [arrays[array][first:last].reshape(shape) for array, first, last, shape in layout.leaves]
    return jax.tree.unflatten(layout.tree, values)


jax.tree_util.register_pytree_node(
    PackedRecords, lambda records: (records.arrays, records.layout), lambda *parts: PackedRecords(*parts)
)


class Checkpointed:
    """An object whose state is its growable arrays, its `VALUES` and its `PARTS`; a restored object continues
    bit for bit.

    Attributes:
        VALUES: names of attributes that are numbers, NumPy arrays, or tuples of these.
        PARTS: names of attributes that are `Checkpointed` or None.
        FLAT: those of `PARTS` whose arrays keep their own names.
    """

    VALUES: ClassVar[tuple[str, ...]] = ()
    PARTS: ClassVar[tuple[str, ...]] = ()
    FLAT: ClassVar[tuple[str, ...]] = ()

    def arrays(self) -> dict[str, np.ndarray]:
        """Copies of the whole state, by attribute name without a leading underscore."""
        arrays = {name: array.rows.copy() for name, array in self._growable_arrays().items()}
        for name in self.VALUES:
            for k, value in enumerate(_as_tuple(getattr(self, name))):
                arrays[f"{name.lstrip('_')}/{k}"] = np.array(value)
        for name in self._parts():
            part, prefix = getattr(self, name).arrays(), self._prefix(name)
            arrays |= {prefix + key: value for key, value in part.items()}
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
            getattr(self, name).restore(with_prefix(arrays, self._prefix(name)))

    def _append_row(self, *values: Any) -> None:
        """Appends a row to every growable array, whose values come in the order in which these were made."""
        for array, value in zip(self._growable_arrays().values(), values, strict=True):
            array.append(value)

    def _take_rows(self, rows: np.ndarray | slice) -> None:
        """Reduces every growable array to rows: numbers, bool of each, or a slice."""
        for array in self._growable_arrays().values():
            array.replace(array.rows[rows])

    def _growable_arrays(self) -> dict[str, GrowableArray]:
        found = vars(self).items()
        return {name.lstrip("_"): value for name, value in found if isinstance(value, GrowableArray)}

    def _prefix(self, part: str) -> str:
        return "" if part in self.FLAT else f"{part.lstrip('_')}/"

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
