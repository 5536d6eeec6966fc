"""Append-only arrays, and many records of one kind packed into a few arrays.

Packed records are one array per dtype with one row per record, because the transfer to and from a compiled
function costs time per array, not per number. The shapes and names of the records are the static part of a
pytree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

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
