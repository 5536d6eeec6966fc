"""Laws of arrays that grow, and of records packed as rows of a few arrays."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.core.arrays import GrowableArray, PackedRecords, allocate, layout_of

DTYPES = [np.dtype(name) for name in ("float64", "float32", "int32", "uint32", "bool")]


class Inner(NamedTuple):
    a: np.ndarray
    b: np.ndarray


@st.composite
def kinds(draw):
    """Shapes and dtypes of the leaves of a kind of record."""
    shape = st.lists(st.integers(0, 3), max_size=3).map(tuple)
    return draw(st.lists(st.tuples(shape, st.sampled_from(DTYPES)), min_size=2, max_size=6))


def record(kind, seed):
    stream = np.random.default_rng(seed)
    leaves = [(stream.normal(0, 9, shape) ** 2).astype(dtype) for shape, dtype in kind]
    return {"inner": Inner(*leaves[:2]), "rest": leaves[2:]}


def same(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert a.dtype == b.dtype
        assert np.array_equal(a, b)
        assert np.shape(a) == np.shape(b)


@given(kinds(), st.integers(1, 5))
def test_records_read_back_equal(kind, count):
    records = [record(kind, seed) for seed in range(count)]
    rows = allocate(layout_of(records[0]), count + 2)
    for k, each in enumerate(records):
        rows.write(k, each)
    assert len(rows.arrays) == len({dtype for _, dtype in kind})
    for one, other in zip(records, rows.records(count), strict=True):
        same(one, other)


@pytest.mark.parametrize("seed", range(3))
def test_compiled_code_reads_and_writes_the_same(seed):
    stream = np.random.default_rng(seed)
    dtypes = [DTYPES[k] for k in stream.integers(0, len(DTYPES), 4)]
    kind = [(tuple(stream.integers(1, 4, stream.integers(0, 3))), dtype) for dtype in dtypes]
    records = [record(kind, k) for k in range(3)]
    rows = allocate(layout_of(records[0]), 3)
    for k, each in enumerate(records):
        rows.write(k, each)

    @jax.jit
    def reverse(rows: PackedRecords) -> PackedRecords:
        out = allocate(rows.layout, 3, jnp.zeros)
        for k in range(3):
            out = out.put(jnp.int32(2 - k), rows.at(jnp.int32(k)))
        return out

    for one, other in zip(records, list(reverse(rows).records(3))[::-1], strict=True):
        same(one, other)


@pytest.mark.parametrize("shapes", [(3, 4), (1, (2, 2))])
def test_a_record_of_another_shape_is_refused(shapes):
    rows = allocate(layout_of(Inner(np.zeros(3), np.zeros((2, 2)))), 1)
    with pytest.raises(ValueError, match="expected"):
        rows.write(0, Inner(*map(np.zeros, shapes)))


# Arrays that grow


@given(st.lists(st.integers(0, 40), max_size=12))
def test_rows_are_those_appended(counts: list[int]) -> None:
    array, expected = GrowableArray((2,), np.float64), np.zeros((0, 2))
    for number, count in enumerate(counts):
        rows = np.full((count, 2), float(number))
        expected = np.concatenate([expected, rows])
        if count == 1:
            array.append(rows[0])
        else:
            array.extend(rows)
        assert np.array_equal(array.rows, expected)


def test_what_is_appended_is_copied() -> None:
    array, rows = GrowableArray((), np.float64), np.arange(3.0)
    array.extend(rows)
    rows[:] = -1
    assert array.rows.tolist() == [0.0, 1.0, 2.0]
