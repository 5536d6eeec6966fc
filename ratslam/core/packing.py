"""Many records of one kind as a few arrays: one for each dtype, a row for each record.

What goes to a compiled function and comes back costs by the array, not by the number. The records' shapes and
names travel as the static part of a pytree.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from tactile.base.types import Array


class Leaf(NamedTuple):
    """Where one array of a record lies: which array of the rows, its columns, its shape."""

    array: int
    first: int
    last: int
    shape: tuple[int, ...]


class Layout(NamedTuple):
    """Of one kind of record. dtypes, widths: of the arrays."""

    tree: Any
    leaves: tuple[Leaf, ...]
    dtypes: tuple[np.dtype, ...]
    widths: tuple[int, ...]


class Rows:
    """Records as arrays [T, width]; a pytree, the layout its static part."""

    def __init__(self, layout: Layout, arrays: tuple[Array, ...]) -> None:
        self.layout, self.arrays = layout, arrays

    def at(self, k: Array) -> Any:
        """The record in row k, traced."""
        rows = [lax.dynamic_index_in_dim(array, k, 0, keepdims=False) for array in self.arrays]
        return _record(self.layout, rows)

    def put(self, k: Array, record: Any) -> Rows:
        """The same with another record in row k, traced."""
        parts: list[list[Array]] = [[] for _ in self.arrays]
        for leaf, value in zip(self.layout.leaves, jax.tree.leaves(record), strict=True):
            parts[leaf.array].append(jnp.reshape(value, -1))
        arrays = (
            lax.dynamic_update_index_in_dim(array, jnp.concatenate(part), k, 0)
            for array, part in zip(self.arrays, parts, strict=True)
        )
        return Rows(self.layout, tuple(arrays))

    def write(self, k: int, record: Any) -> None:
        """Another record in row k, host NumPy in place.

        Raises:
            ValueError: the record is of another shape.
        """
        for leaf, value in zip(self.layout.leaves, jax.tree.leaves(record), strict=True):
            if np.shape(value) != leaf.shape:
                raise ValueError(f"a record of another shape: {np.shape(value)} instead of {leaf.shape}")
            self.arrays[leaf.array][k, leaf.first : leaf.last] = np.reshape(value, -1)

    def records(self, count: int) -> Iterator[Any]:
        """The first `count`, host NumPy."""
        arrays = [np.asarray(array) for array in self.arrays]
        for k in range(count):
            yield _record(self.layout, [array[k] for array in arrays])


def room(layout: Layout, count: int) -> Rows:
    """Rows of zeros, host NumPy."""
    sizes = zip(layout.widths, layout.dtypes, strict=True)
    return Rows(layout, tuple(np.zeros((count, width), dtype) for width, dtype in sizes))


def empty(layout: Layout, count: int) -> Rows:
    """The same, traced."""
    sizes = zip(layout.widths, layout.dtypes, strict=True)
    return Rows(layout, tuple(jnp.zeros((count, width), dtype) for width, dtype in sizes))


def layout_of(example: Any) -> Layout:
    """How records like the example are laid out; of it only shapes and dtypes are asked for."""
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
        leaves.append(Leaf(array, first, last, tuple(value.shape)))
    return Layout(tree, tuple(leaves), tuple(dtypes), tuple(widths))


def _record(layout: Layout, arrays: Sequence[Array]) -> Any:
    values = [arrays[leaf.array][leaf.first : leaf.last].reshape(leaf.shape) for leaf in layout.leaves]
    return jax.tree.unflatten(layout.tree, values)


def _flattened(rows: Rows) -> tuple[tuple[Array, ...], Layout]:
    return rows.arrays, rows.layout


def _unflattened(layout: Layout, arrays: tuple[Array, ...]) -> Rows:
    return Rows(layout, tuple(arrays))


jax.tree_util.register_pytree_node(Rows, _flattened, _unflattened)
