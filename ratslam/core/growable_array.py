"""An append-only array."""

from __future__ import annotations

from typing import Any

import numpy as np


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
